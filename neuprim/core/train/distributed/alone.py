"""What a trainer asks of the ranks that it is one of, and the answers of a process that is alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from neuprim.core.data import View
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Contributions, sum_contributions

if TYPE_CHECKING:
    from torch import Tensor

    from neuprim.core.train.optimizer import RowAdam
    from neuprim.core.train.population import Change, Population

__all__ = ["ALONE", "Alone", "Look", "Seen", "StepViews"]


@dataclass(frozen=True)
class Look:
    """What a rank is about to draw, from which others know what of theirs it needs.

    Attributes:
        view: its camera and conditions.
        beside: conditions of the points that it looks at, too; None for no points.
    """

    view: View
    beside: Conditions | None = None


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
        self._tallies: list[Contributions] = []

    def drawn(self, looks: Callable[[], Sequence[Look]]) -> Primitives:
        """What this rank draws next, when ``looks`` says what each of them does, by rank; gradients are to end in its
        parameters."""
        return self.model

    def add(self, seen: Seen, tally: Contributions) -> None:
        """Called after the backward pass of each view."""
        self.seen.append(seen)
        self._tallies.append(tally)

    def close(self) -> Contributions:
        """After the last one: gradients are those of all views, and so is the tally that is returned."""
        return self._tallies[0] if len(self._tallies) == 1 else sum_contributions(self._tallies, self.model.count)


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
        """``asked`` says whether this process was asked to stop; what is returned, whether the step just done is the
        last one as any rank was, which is the same on all of them."""
        return asked

    @property
    def parts(self) -> bool:
        """Whether each rank has a part of the primitives; else all have all of them."""
        return False

    def count(self, model: Primitives) -> int:
        """Primitives of the whole model of which ``model`` is what this rank has."""
        return model.count

    def own_of(self, count: int) -> tuple[int, int]:
        """First row that this rank keeps of a whole model of ``count`` primitives from now on, and the one after the
        last.

        Raises:
            ConfigError: there are too few for all.
        """
        return 0, count

    def collected(self, value: Tensor) -> Iterator[Tensor]:
        """On the first rank an (N, ...) tensor of the whole model, in pieces from first to last; called on all, with
        their rows of it."""
        yield value

    def cut(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """What this rank keeps of (N, ...) tensors of the whole model."""
        return tensors

    def saves(self, asked: Callable[[], bool]) -> Callable[[], bool]:
        """As :meth:`last`, for whether a checkpoint is due; the first rank's word counts."""
        return asked

    def judged(
        self, model: Primitives, views: Sequence[View], judge: Callable[[int, Primitives], float]
    ) -> list[float]:
        """What ``judge`` says of each view, by its place and the primitives that it shows; the same on all ranks."""
        return [judge(place, model) for place in range(len(views))]

    def intervene(self, population: Population, model: Primitives, optimizer: RowAdam, extent: float) -> Change | None:
        """The next population, of what this rank has of it; None to leave it."""
        return population.intervene(model, extent)

    def step(self, model: Primitives, views: int, elapsed: float, start: float) -> StepViews:
        """What collects a step, of so many ``views`` of each rank, that began at ``start`` (seconds of
        ``time.perf_counter``) after ``elapsed`` seconds of training."""
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
