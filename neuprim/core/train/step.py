"""What one step of a training did, and what it saw on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from neuprim.core.render.output import Contributions
from neuprim.core.train.distributed import Seen

__all__ = ["ImageStep", "StepReport", "of_views"]


@dataclass(frozen=True)
class StepReport:
    """What one step did. ``psnr`` is of the training view just seen (the mean of several), or of the extinction at
    points where no view was; ``change`` says what the population did, if anything."""

    step: int
    seconds: float
    loss: float
    parts: dict[str, float]
    psnr: float
    primitives: int
    view: str
    change: str | None


@dataclass(frozen=True)
class ImageStep:
    """One view, drawn and compared; ``tally`` is filled by the backward pass."""

    loss: Tensor
    parts: dict[str, float]
    psnr: float
    name: str
    truth: Tensor
    tally: Contributions


def of_views(seen: Sequence[Seen]) -> tuple[float, dict[str, float], float, str]:
    """Loss, its parts, PSNR and name of a step, from its views in their order."""
    last, others, looks = seen[-1], seen[:-1], len(seen)
    parts = {**last.parts, **last.more}
    if not others:
        return last.loss, parts, last.psnr, last.name
    cost = last.loss + sum(view.loss for view in others) / looks
    parts |= {part: sum(view.parts[part] for view in seen) / looks for part in last.parts}
    return cost, parts, sum(view.psnr for view in seen) / looks, f"{last.name} and {looks - 1} more"
