"""What was trained and measured of one model, as ``tradeoff.json`` and ``tradeoff.csv`` hold it."""

from __future__ import annotations

import shlex
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

from neuprim.core.validation import coerce, field_types
from neuprim.search.design.variants import Variant
from neuprim.search.tradeoff.record import Measured

__all__ = ["Model", "command"]


def command(words: Sequence[str]) -> str:
    """What trains such a model, ready to paste."""
    return shlex.join(["neuprim", "run", *words])


@dataclass
class Model(Measured):
    """A trained model.

    Attributes:
        words: those after ``neuprim run`` that train it.
        turned, length: of its :class:`~neuprim.search.design.variants.Variant`.
        primitives: how many it has; parameters_per_primitive: numbers of each.
        steps, seconds: of its training.
        steps_in_turns: seconds per step over the centre's beside it, of each round in which both took turns.
        centre_ms: median milliseconds per frame of the centre over all its rounds.
        seeds: PSNR of the training with each seed; ``quality`` has the means of PSNR and SSIM over them, and the other
        numbers of the first. run_dir: the first seed's, inside the folder of the set.
    """

    turned: tuple[str, ...] = ()
    length: float = 1.0
    primitives: int = 0
    parameters_per_primitive: int = 0
    steps: int = 0
    seconds: float = 0.0
    centre_ms: float = 0.0
    steps_in_turns: tuple[float, ...] = ()
    seeds: tuple[float, ...] = ()
    run_dir: str = ""

    @property
    def variant(self) -> Variant:
        return Variant(self.knob, self.turned, self.length)

    @property
    def name(self) -> str:
        return self.variant.name

    @property
    def time(self) -> float:
        """Milliseconds per frame: the centre's, times the ratio; models that were timed in different rounds, under
        another load, compare so."""
        return self.ratio * self.centre_ms if self.centre_ms else super().time

    @property
    def ms_per_step(self) -> float:
        """Mean over the training."""
        return 1e3 * self.seconds / max(self.steps, 1)

    @property
    def seed_spread(self) -> float | None:
        """Standard deviation over the seeds, dB; None of one."""
        return statistics.stdev(self.seeds) if len(self.seeds) > 1 else None

    def to_dict(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in _OWN}
        own |= {name: list(getattr(self, name)) for name in _LISTS}
        return {**super().to_dict(), **own, "name": self.name, "ms_per_step": self.ms_per_step}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        hints = field_types(cls)
        return replace(
            super().from_dict(data),
            **{name: coerce(data[name], hints[name], f"points.{name}") for name in (*_OWN, *_LISTS)},
        )


_OWN = ("length", "primitives", "parameters_per_primitive", "steps", "seconds", "centre_ms", "run_dir")
_LISTS = ("turned", "steps_in_turns", "seeds")
