"""What a strategy is: it watches the training and now and then proposes another set of primitives."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import Tensor

from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Tally
from neuprim.core.train.settings import PopulationSettings

__all__ = ["Change", "Population"]


@dataclass(frozen=True)
class Change:
    """A new population: ``params`` row i descends from old row ``origin[i]``; ``fresh`` rows start without momentum."""

    params: dict[str, Tensor]
    origin: Tensor
    fresh: Tensor
    text: str


class Population(ABC):
    """Watches every step and now and then proposes a :class:`Change`."""

    def __init__(self, settings: PopulationSettings) -> None:
        self.settings = settings

    def due(self, step: int, progress: float) -> bool:
        s = self.settings
        return s.start <= progress < s.stop and step % s.every == 0

    @abstractmethod
    def observe(self, model: Primitives, tally: Tally) -> None:
        """Called after each backward pass of one view, while ``.grad`` is fresh."""

    @abstractmethod
    def intervene(self, model: Primitives, extent: float) -> Change | None:
        """The next population, or None to leave it; resets the statistics."""

    def state(self) -> dict[str, Tensor]:
        """Tensors a checkpoint needs."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:  # noqa: B027 - nothing to restore where nothing was kept
        """Counterpart of :meth:`state`."""
