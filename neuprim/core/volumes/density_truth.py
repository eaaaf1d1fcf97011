"""Ground truth for a model's extinction: the voxel files of a scene, their placement, and errors of a model."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import DataError
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.core.volumes.density_grid import density_grid
from neuprim.core.volumes.points import channel_values_at

__all__ = ["DensityGridPlacement", "DensityGridSource", "DensityTruth", "GridExtent", "TruthFrame"]

DENSITY_ERRORS = ("correlation", "relative_l2", "psnr_active", "max_error")
"""Names of the errors that :meth:`DensityComparison.errors` returns."""

_BLOCK_POINTS = 1 << 22  # 16 MiB of each grid
_MIN_SQUARED_ERROR = 1e-20  # share of the squared peak: 200 dB, so that no number is infinite


class GridExtent(NamedTuple):
    """Range of values and bounding box of the absorbing grid (the grid of extinctions) in one frame."""

    smallest: float  # smallest active value; 0 if that is negative, or without any
    largest: float  # largest value
    box: np.ndarray | None  # (2, 3) box around the active voxels, world units; None without any

    @staticmethod
    def around(extents: Sequence[GridExtent]) -> GridExtent:
        """Return the extent that covers several frames: the range of all values and the common bounding box."""
        full = [extent for extent in extents if extent.box is not None]
        boxes = [extent.box for extent in full if extent.box is not None]
        box = np.stack([np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)]) if boxes else None
        smallest = min((extent.smallest for extent in full), default=0.0)
        return GridExtent(smallest, max((extent.largest for extent in full), default=0.0), box)


@dataclass(frozen=True)
class DensityGridPlacement:
    """Position of a scene's voxel files in scene coordinates, and meaning of their values.

    Attributes:
        scene_from_world: (4, 4) float64 transform.
        numbers: number of each frame.
        times: condition that differs between frames -> its value per frame, e.g. ``{"time": [0.0, 0.5, 1.0]}``.
        sigma_per_unit: extinction, 1/scene unit, of a grid value of 1.
        grid: name of the absorbing grid, whose values are extinctions.
        exact: whether all extinction comes from the absorbing grid; if False, other grids add to the extinction.
        component: name that models use for the part of the extinction from the absorbing grid.
        extents: range of values and bounding box of the absorbing grid, for each frame; empty if unknown.
    """

    scene_from_world: np.ndarray
    numbers: Sequence[int]
    times: Mapping[str, Sequence[float]]
    sigma_per_unit: float
    grid: str
    exact: bool = True
    component: str = "density"
    extents: Sequence[GridExtent] = ()

    def matches(self, other: DensityGridPlacement) -> bool:
        """Return whether ``other`` has the same frame numbers, transform, absorbing grid and extinction per grid value.

        The attributes compared are ``numbers``, ``scene_from_world``, ``grid``, ``exact`` and ``sigma_per_unit``.
        """
        keys = ("scene_from_world", "numbers", "sigma_per_unit", "grid", "exact")
        mine, theirs = self.to_json(), other.to_json()
        return all(mine[key] == theirs[key] for key in keys)

    def to_json(self) -> dict[str, Any]:
        """Return the placement as JSON-able values, which :meth:`from_json` restores exactly."""
        return {
            "scene_from_world": self.scene_from_world.tolist(),
            "numbers": list(self.numbers),
            "times": {name: list(values) for name, values in self.times.items()},
            "sigma_per_unit": self.sigma_per_unit,
            "grid": self.grid,
            "exact": self.exact,
            "component": self.component,
            "extents": [
                [one.smallest, one.largest, None if one.box is None else one.box.tolist()] for one in self.extents
            ],
        }

    @staticmethod
    def from_json(record: Mapping[str, Any], where: str) -> DensityGridPlacement:
        """Return the placement that :meth:`to_json` wrote; ``where`` names the file in errors.

        Raises:
            DataError: the record is invalid.
        """
        try:
            placement = DensityGridPlacement(
                np.array(record["scene_from_world"], np.float64).reshape(4, 4),
                [int(n) for n in record["numbers"]],
                {str(name): [float(v) for v in values] for name, values in record["times"].items()},
                float(record["sigma_per_unit"]),
                str(record["grid"]),
                bool(record["exact"]),
                str(record.get("component", "density")),
                [
                    GridExtent(
                        float(low), float(high), None if box is None else np.array(box, np.float64).reshape(2, 3)
                    )
                    for low, high, box in record.get("extents", ())
                ],
            )
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise DataError(f"{where}: header field 'world' is damaged ({type(error).__name__}: {error})") from None
        matrix, count, extents = placement.scene_from_world, len(placement.numbers), placement.extents
        sound = (
            np.isfinite(matrix).all()
            and (matrix[3] == (0, 0, 0, 1)).all()
            and abs(np.linalg.det(matrix)) > 0
            and 0 < placement.sigma_per_unit < np.inf
            and all(0 <= one.smallest <= one.largest < np.inf for one in extents)
            and all(one.box is None or np.isfinite(one.box).all() for one in extents)
            and all(len(values) == count for values in placement.times.values())
            and len(extents) in (0, count)
        )
        if not sound:
            raise DataError(
                f"{where}: header field 'world' is damaged; expected an invertible affine matrix, and a time per frame"
            )
        return placement


@dataclass(frozen=True)
class TruthFrame:
    """One frame of the ground truth of a volume."""

    name: str  # name to show
    conditions: Conditions  # conditions of the same frame of a model; empty if unknown


class DensityTruth(ABC):
    """Base class of ground-truth extinctions, which can be sampled on any regular grid.

    Attributes:
        frames: the frames in order, one or more.
        bounds: (2, 3) float64 box around the extinction of all frames, scene units.
    """

    frames: Sequence[TruthFrame]
    bounds: Tensor

    @abstractmethod
    def points(self, frame: int) -> tuple[Tensor, tuple[int, int, int]] | None:
        """Return the grid on which a model is compared with a frame, e.g. a file's voxels; None for an empty frame.

        The grid is given by matrix scene_from_index (4, 4), float64, and shape (X, Y, Z).
        """

    @abstractmethod
    def grid(
        self, frame: int, scene_from_index: Tensor, shape: tuple[int, int, int], component: str | None = None
    ) -> Tensor:
        """Return the (X, Y, Z) float32 extinction, 1/scene unit, at the points ``scene_from_index @ (i, j, k, 1)``.

        Args:
            component: name of a source grid, for the extinction from this grid alone; None for the whole extinction.
        """


class VoxelLook(NamedTuple):
    """Emission and scattering of M voxels of a frame, in linear light per scene unit.

    ``scattered`` is None if nothing scatters light, or if ``emission`` includes the scattered light.
    """

    points: np.ndarray  # (M, 3) float64 centres, scene units
    emission: np.ndarray  # (M, 3) extinction times emitted radiance
    scattered: np.ndarray | None  # (M, 3) extinction times scattering albedo


class VoxelChannels(NamedTuple):
    """Values of the channels (grids besides the extinction) at M voxels of a frame that absorb light."""

    points: np.ndarray  # (M, 3) float64 centres, scene units
    values: dict[str, np.ndarray]  # name -> (M, C) values


class DensityGridSource(DensityTruth):
    """Base class of ground truth in voxel files, read one frame at a time."""

    placement: DensityGridPlacement  # position and units of the files; has the same frames as the ground truth
    half = False  # whether the files store the absorbing grid as 16-bit floats

    @abstractmethod
    def grid_transform(self, frame: int) -> np.ndarray | None:
        """Return the (4, 4) float64 matrix world_from_index of a frame's absorbing grid; None without such a grid."""

    def look(self, frame: int) -> VoxelLook | None:
        """Return the emission and scattering of a frame's voxels; None if they are unknown or the frame is empty."""
        return None

    def channels(self, frame: int) -> VoxelChannels | None:
        """Return the values of a frame's channels; None if there are no channels or the frame is empty."""
        return None

    @abstractmethod
    def open_files(self, path: Path) -> DensityTruth:
        """Return the ground truth in another file or folder, with the same reading rules and placement.

        Raises:
            DataError: no file in ``path`` can be read by these rules.
        """


# ---------------------------------------------------------------- errors


class DensityComparison:
    """Errors of a model's extinction against the true extinction, added up block by block in float64."""

    def __init__(self) -> None:
        self.points = self.active = 0
        self.sums = np.zeros(5)  # a, b, aa, bb, ab
        self.error = self.error_active = self.peak = self.worst = 0.0

    def add_block(self, truth: np.ndarray, values: np.ndarray) -> None:
        """Add a block of true values, and the model's values at the same points."""
        a, b = truth.reshape(-1).astype(np.float64), values.reshape(-1).astype(np.float64)
        wrong = b - a
        inside = wrong[a != 0]
        self.points += a.size
        self.active += int(np.count_nonzero(a))
        self.sums += (a.sum(), b.sum(), a @ a, b @ b, a @ b)
        self.error += float(wrong @ wrong)
        self.error_active += float(inside @ inside)
        self.peak = max(self.peak, float(np.abs(a).max(initial=0.0)))
        self.worst = max(self.worst, float(np.abs(wrong).max(initial=0.0)))

    def errors(self) -> dict[str, float] | None:
        """Return name -> value for each of :data:`DENSITY_ERRORS`; None if the truth is the same everywhere.

        ``correlation`` is Pearson's and ``relative_l2`` is |values - truth| / |truth|, both over all points.
        ``psnr_active`` is the PSNR in dB over the points where the truth is not 0; the peak is the largest absolute
        value of the truth. ``max_error`` is the largest absolute error of all points, divided by the same peak.
        """
        n = max(self.points, 1)
        a, b, aa, bb, ab = (float(x) for x in self.sums)
        spread_a, spread_b = aa - a * a / n, bb - b * b / n
        if not self.active or spread_a <= 1e-12 * aa:
            return None
        correlation = (ab - a * b / n) / math.sqrt(spread_a * spread_b) if spread_b > 1e-12 * bb else 0.0
        share = self.error_active / self.active / self.peak**2
        psnr = -10 * math.log10(max(share, _MIN_SQUARED_ERROR))
        values = (correlation, math.sqrt(self.error / aa), psnr, self.worst / self.peak)
        return dict(zip(DENSITY_ERRORS, values, strict=True))


def measure_density_errors(
    model: Primitives,
    conditions: Conditions,
    truth: DensityTruth,
    frame: int,
    threads: int = 0,
    component: str | None = None,
) -> dict[str, float] | None:
    """Return the errors of the model's extinction under ``conditions`` against one frame of the ground truth.

    The errors are those of :meth:`DensityComparison.errors`; None for an empty frame.

    Args:
        component: name of a source grid, to compare only the extinction from this grid; None for the whole extinction.
    """
    place = truth.points(frame)
    if place is None:
        return None
    model = model if component is None else model.component(component)
    comparison = DensityComparison()
    for matrix, shape in split_density_grid_planes(*place):
        sigma = truth.grid(frame, matrix, shape, component).numpy()
        comparison.add_block(sigma, density_grid(model, conditions, matrix, shape, threads).numpy())
    return comparison.errors()


def measure_channel_errors(
    model: Primitives, conditions: Conditions, truth: VoxelChannels, threads: int = 0
) -> dict[str, dict[str, float]]:
    """Return channel name -> errors of the model's values at the voxels of ``truth``, for one frame.

    The errors are those of :meth:`DensityComparison.errors`. Channels that are constant in this frame are left out.
    """
    own = channel_values_at(model, conditions, torch.from_numpy(truth.points), threads)
    found = {}
    for name, values in truth.values.items():
        comparison = DensityComparison()
        if name in own:
            comparison.add_block(values, own[name].numpy())
        if errors := comparison.errors():
            found[name] = errors
    return found


def split_density_grid_planes(
    scene_from_index: Tensor, shape: tuple[int, int, int]
) -> list[tuple[Tensor, tuple[int, int, int]]]:
    """Split a grid into blocks of whole planes of equal x; return scene_from_index (4, 4) and shape of each block."""
    planes = max(1, _BLOCK_POINTS // max(1, shape[1] * shape[2]))
    parts = []
    for x in range(0, shape[0], planes):
        matrix = scene_from_index.clone()
        matrix[:3, 3] += matrix[:3, 0] * x
        parts.append((matrix, (min(planes, shape[0] - x), shape[1], shape[2])))
    return parts
