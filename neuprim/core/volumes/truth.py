"""The extinction that a data set was made from, where there is one, on any regular grid."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from neuprim.core.model.fields import Conditions

__all__ = ["DensityTruth", "TruthFrame"]


@dataclass(frozen=True)
class TruthFrame:
    """One frame of it.

    Attributes:
        name: for people, such as a file's.
        conditions: under which a model shows the same; empty where that is not known.
    """

    name: str
    conditions: Conditions


class DensityTruth(ABC):
    """Extinction sigma, 1/scene unit.

    Attributes:
        frames: in order, one or more.
        bounds: (2, 3) float64 box around all of it, scene units.
    """

    frames: Sequence[TruthFrame]
    bounds: Tensor

    @abstractmethod
    def points(self, frame: int) -> tuple[Tensor, tuple[int, int, int]] | None:
        """(4, 4) float64 scene_from_index and shape of the regular grid on which models are compared with a frame: of
        files, all their own voxels in the box. None where the frame holds nothing.
        """

    @abstractmethod
    def grid(
        self, frame: int, scene_from_index: Tensor, shape: tuple[int, int, int], component: str | None = None
    ) -> Tensor:
        """(X, Y, Z) float32 extinction of a frame at the points ``scene_from_index @ (i, j, k, 1)``, float64 (4, 4).

        Args:
            component: the part alone that comes from the source grid of this name
            (:meth:`~neuprim.core.model.fields.DensityField.components`).
        """
