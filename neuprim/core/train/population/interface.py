"""What a strategy is: it watches the training and now and then proposes another set of primitives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Contributions
from neuprim.core.train.settings import PopulationSettings

__all__ = ["Change", "Plan", "Population"]


@dataclass(frozen=True)
class Change:
    """A new population: ``params`` row i descends from old row ``origin[i]``; ``fresh`` rows start without momentum."""

    params: dict[str, Tensor]
    origin: Tensor
    fresh: Tensor
    text: str


@dataclass(frozen=True)
class Plan:
    """What is to become of a population, in numbers of its primitives alone: whoever has a primitive's row can carry
    out its part.

    Attributes:
        parents: (P,) rows that split in two; the first child takes its parent's row.
        others: (P,) rows that the second children take; those from ``count`` on are new.
        count, births: primitives before, and how many more there are afterwards.
        text: what happens, in words.
    """

    parents: Tensor
    others: Tensor
    count: int
    births: int
    text: str

    @property
    def origin(self) -> Tensor:
        """(count + births,) the row that each descends from."""
        origin = torch.arange(self.count + self.births, device=self.parents.device)
        origin[self.others] = self.parents
        return origin

    @property
    def fresh(self) -> Tensor:
        """(count + births,) bool, which rows are children."""
        fresh = torch.zeros(self.count + self.births, dtype=torch.bool, device=self.parents.device)
        fresh[self.parents] = fresh[self.others] = True
        return fresh


class Population(ABC):
    """Watches every step and now and then proposes a :class:`Change`.

    Attributes:
        plans: whether it decides by :meth:`plan`, from sums over views of each primitive's tally, so that several
        processes that have a part of
            the primitives each can decide together.
        count: primitives of the whole model where this one watches a part of it; None where it watches all.
    """

    plans = False

    def __init__(self, settings: PopulationSettings) -> None:
        self.settings = settings
        self.count: int | None = None

    def due(self, step: int, progress: float) -> bool:
        s = self.settings
        return s.start <= progress < s.stop and step % s.every == 0

    @abstractmethod
    def observe(self, model: Primitives, tally: Contributions) -> None:
        """Called after each backward pass of one view, while ``.grad`` is fresh."""

    @abstractmethod
    def intervene(self, model: Primitives, extent: float) -> Change | None:
        """The next population, or None to leave it; resets the statistics."""

    def take(self) -> tuple[Tensor, Tensor] | None:
        """The (N,) statistics that :meth:`plan` decides by, which begin anew; None where there are none."""
        return None

    def plan(self, weight: Tensor, error: Tensor) -> Plan | None:
        """What is to become of the N primitives with these statistics; None to leave them."""
        return None

    def state(self) -> dict[str, Tensor]:
        """Tensors a checkpoint needs."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:  # noqa: B027 - nothing to restore where nothing was kept
        """Counterpart of :meth:`state`."""
