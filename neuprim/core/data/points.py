"""A second kind of supervision beside images: points at which a data set knows what a model should hold."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from neuprim.core.model.fields import Conditions

__all__ = ["PointSamples", "PointSupervision"]


@dataclass(frozen=True)
class PointSamples:
    """What is true at M points of one frame.

    Attributes:
        name: of the frame, for logs.
        conditions: of the frame, the same for all points.
        points: (M, 3) float32, scene units.
        sigma: (M,) float32 extinction, 1/scene unit.
        source: (M, C) float32 extinction times source radiance in the data set's colour space, where it is the same
        towards all directions;
            None where it is not, or not known: then the extinction alone is learned from points.
        sigma_scale, source_scale: typical sizes of both where there is matter, what errors are divided by.
        components: name -> (M,) float32, the part of ``sigma`` that comes from the source grid of that name, and its
        typical size.
    """

    name: str
    conditions: Conditions
    points: Tensor
    sigma: Tensor
    source: Tensor | None
    sigma_scale: float
    source_scale: float = 1.0
    components: Mapping[str, tuple[Tensor, float]] = field(default_factory=dict)


class PointSupervision(ABC):
    """Points to learn from; a data set's ``points``.

    Attributes:
        components: names of the source grids whose part of the extinction is known (:attr:`PointSamples.components`).
    """

    components: tuple[str, ...] = ()

    @abstractmethod
    def draw(self, count: int, generator: torch.Generator) -> PointSamples:
        """``count`` points of one frame, both drawn by ``generator`` alone, so that a resumed run draws the same."""
