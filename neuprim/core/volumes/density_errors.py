"""Errors of a model's extinction against the extinction that a data set was made from, in blocks of planes."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.core.volumes.grid import density_grid

NUMBERS = ("correlation", "relative_l2", "psnr_active", "max_error")
"""What :func:`measure_frame_errors` gives."""

_BLOCK = 1 << 22  # points at a time, 16 MiB of each grid

_NO_ERROR = 1e-20
"""Smallest squared error as a share of the peak's square: 200 dB, as no number may be infinite."""


@dataclass(frozen=True)
class TruthFrame:
    """One frame of the ground truth: a name to show, and the conditions of the same frame of a model; empty if
    unknown."""

    name: str
    conditions: Conditions


class DensityTruth(ABC):
    """The extinction sigma that a data set was made from, on any regular grid, 1/scene unit.

    Attributes:
        frames: in order, one or more.
        bounds: (2, 3) float64 box around all of it, scene units.
    """

    frames: Sequence[TruthFrame]
    bounds: Tensor

    @abstractmethod
    def points(self, frame: int) -> tuple[Tensor, tuple[int, int, int]] | None:
        """(4, 4) float64 scene_from_index and shape of the grid on which models are compared with a frame: all voxels
        of a file in the box. None where the frame holds nothing."""

    @abstractmethod
    def grid(
        self, frame: int, scene_from_index: Tensor, shape: tuple[int, int, int], component: str | None = None
    ) -> Tensor:
        """(X, Y, Z) float32 extinction of a frame at the points ``scene_from_index @ (i, j, k, 1)``.

        Args:
            component: only the part from the source grid of this name.
        """


class Comparison:
    """Sums over the points of a grid, block by block, from which all numbers follow; float64."""

    def __init__(self) -> None:
        self.points = self.active = 0
        self.sums = np.zeros(5)  # a, b, aa, bb, ab
        self.error = self.error_active = self.peak = self.worst = 0.0

    def add(self, truth: np.ndarray, found: np.ndarray) -> None:
        """Two blocks of one shape."""
        a, b = truth.reshape(-1).astype(np.float64), found.reshape(-1).astype(np.float64)
        wrong = b - a
        self.points += a.size
        self.active += int(np.count_nonzero(a))
        self.sums += (a.sum(), b.sum(), a @ a, b @ b, a @ b)
        self.error += float(wrong @ wrong)
        inside = wrong[a != 0]
        self.error_active += float(inside @ inside)
        self.peak = max(self.peak, float(a.max(initial=0.0)))
        self.worst = max(self.worst, float(np.abs(wrong).max(initial=0.0)))

    def numbers(self) -> dict[str, float] | None:
        """See :data:`NUMBERS`; None where the truth is the same everywhere.

        ``correlation`` is Pearson's, ``relative_l2`` |found - truth| / |truth|, both over all points; ``psnr_active``
        is over those where the truth is not 0, against its largest value; ``max_error`` is the largest error anywhere,
        as a share of that value.
        """
        n = max(self.points, 1)
        a, b, aa, bb, ab = (float(x) for x in self.sums)
        spread_a, spread_b = aa - a * a / n, bb - b * b / n
        if not self.active or spread_a <= 1e-12 * aa:
            return None
        correlation = (ab - a * b / n) / math.sqrt(spread_a * spread_b) if spread_b > 1e-12 * bb else 0.0
        share = self.error_active / self.active / self.peak**2
        return {
            "correlation": correlation,
            "relative_l2": math.sqrt(self.error / aa),
            "psnr_active": -10 * math.log10(max(share, _NO_ERROR)),
            "max_error": self.worst / self.peak,
        }


def measure_frame_errors(
    model: Primitives,
    conditions: Conditions,
    truth: DensityTruth,
    frame: int,
    threads: int = 0,
    where: torch.device = device.HOST,
    component: str | None = None,
) -> dict[str, float] | None:
    """Compare the model under ``conditions`` with a frame of the truth, see :meth:`Comparison.numbers`.

    Args:
        where: the device that computes the model's extinction.
        component: compare this part of both extinctions.
    """
    place = truth.points(frame)
    if place is None:
        return None
    model = model if component is None else model.component(component)
    found = Comparison()
    for matrix, shape in split_planes(*place):
        sigma = truth.grid(frame, matrix, shape, component).numpy()
        found.add(sigma, density_grid(model, conditions, matrix, shape, threads, where).numpy())
    return found.numbers()


def split_planes(scene_from_index: Tensor, shape: tuple[int, int, int]) -> list[tuple[Tensor, tuple[int, int, int]]]:
    """The same points in parts of whole planes."""
    planes = max(1, _BLOCK // max(1, shape[1] * shape[2]))
    made = []
    for x in range(0, shape[0], planes):
        matrix = scene_from_index.clone()
        matrix[:3, 3] += matrix[:3, 0] * x
        made.append((matrix, (min(planes, shape[0] - x), shape[1], shape[2])))
    return made
