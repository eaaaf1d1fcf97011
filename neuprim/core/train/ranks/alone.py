"""What a trainer asks of the ranks that it is one of, and the answers of a process that is alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Tally, together

__all__ = ["ALONE", "Alone", "Seen", "StepViews"]


@dataclass(frozen=True)
class Seen:
    """A view of a step in a few numbers, which all ranks learn.

    Attributes:
        index, name: of the training view.
        loss: its own; of the last one of a step its share, with that of whatever the step looked at beside views.
        psnr, parts: its own.
        more: named parts of what the step looked at beside views.
        gain: gradient of the logarithm of its exposure, one number per channel; None for no exposures.
    """

    index: int
    name: str
    loss: float
    psnr: float
    parts: dict[str, float]
    more: dict[str, float] = field(default_factory=dict)
    gain: list[float] | None = None


class StepViews:
    """The views of one step, of a process that looks at all of them; the gradients stay where they are.

    Attributes:
        seen: all of them in their order, whoever looked.
    """

    def __init__(self, model: Primitives) -> None:
        self.model = model
        self.seen: list[Seen] = []
        self._tallies: list[Tally] = []

    def add(self, seen: Seen, tally: Tally) -> None:
        """Called after the backward pass of each view."""
        self.seen.append(seen)
        self._tallies.append(tally)

    def close(self) -> Tally:
        """After the last one: gradients are those of all views, and so is the tally that is returned."""
        return self._tallies[0] if len(self._tallies) == 1 else together(self._tallies, self.model.count)


class Alone:
    """One process.

    Attributes:
        rank, size: its number, and how many there are.
    """

    rank = 0
    size = 1

    @property
    def first(self) -> bool:
        """Whether this is the rank that writes and speaks."""
        return self.rank == 0

    def last(self, asked: Callable[[], bool]) -> Callable[[], bool]:
        """``asked`` says whether this process was asked to stop; what is returned, whether the step just done is the last one as any rank was,
        which is the same on all of them."""
        return asked

    def step(self, model: Primitives, views: int, elapsed: float, start: float) -> StepViews:
        """What collects a step, of so many ``views`` of each rank, that began at ``start`` (seconds of ``time.perf_counter``) after ``elapsed`` seconds of training."""
        return StepViews(model)

    def spent(self, elapsed: float, start: float) -> float:
        """Seconds of training after that step; the same on all ranks."""
        return elapsed + time.perf_counter() - start

    def agree(self, what: str, facts: dict[str, Any]) -> None:
        """Refuse ranks that are to train one model and differ in ``facts``.

        Raises:
            RankError: they do; names the rank and what differs.
        """

    @contextmanager
    def in_turn(self) -> Iterator[None]:
        """Inside, what is made once is made: the first rank goes first, the others when it is through."""
        yield


ALONE = Alone()
"""The process of a run that nobody launched in several."""
