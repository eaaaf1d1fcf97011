"""Velocities of a volume sequence, from a grid of its files: the motion with which primitives start.

Files do not state the unit of their velocities (per second, per frame, or voxels). The unit is measured: of many units,
the one is taken with which velocities carry the extinction of a frame best to the next frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from neuprim.core.errors import DataError, nearest, warn_once
from neuprim.core.io.vdb import VdbFrame, read_grids, read_header
from neuprim.tasks.dynamic.volume.lit_medium import vdb_grid_sampler
from neuprim.tasks.dynamic.volume.survey import GridReader

VELOCITY_NAMES = ("velocity", "vel", "v")
"""Usual names of grids of velocities."""

_PAIRS, _POINTS = 6, 4096  # pairs of frames that are compared, and points in each
_MATTER = 0.01  # least extinction of a point, over the largest of its frame
_STEPS = np.geomspace(0.05, 30.0, 64)  # displacements of fast points between two frames to try, in voxels
_FAST = 90.0  # percentile of speeds
_OUTLIER = 10.0  # largest speed with which a primitive starts, over the speed of fast points
_EXPLAINED = 0.1  # least part of the squared change between frames that velocities must explain


def sample_vdb_frame(frame: VdbFrame, names: Iterable[str], world: np.ndarray) -> dict[str, np.ndarray]:
    """Return name -> (M, C) float32 values, at ``world`` (M, 3), of those of the grids ``names`` that a frame has.

    Raises:
        DataError: the file or a grid cannot be read.
    """
    stored, found = {grid.name for grid in read_header(frame.path).grids}, dict[str, np.ndarray]()
    for grid in read_grids(frame.path, [name for name in names if name in stored]):
        try:
            found[grid.name] = vdb_grid_sampler(grid)(world)
        except DataError as error:
            raise DataError(f"{frame.path}: {error}") from error
    return found


class VelocityGrid(NamedTuple):
    """A grid of velocities in the files of a sequence."""

    name: str
    unit: float  # world units per frame number, of a value of 1
    fastest: float = np.inf  # value to which speeds are limited

    def sample(self, frame: VdbFrame, world: np.ndarray) -> np.ndarray:
        """Return (M, 3) float64 velocities at ``world`` (M, 3), world units per frame number; 0 without the grid.

        Raises:
            DataError: the file or the grid cannot be read, or the grid has no vectors.
        """
        try:
            found = sample_vdb_frame(frame, [self.name], world)
        except DataError as error:
            raise DataError(f"{error}. scene.velocity=none ignores the grid of velocities") from error
        values = found.get(self.name, np.zeros((len(world), 3))).astype(np.float64)
        if values.shape[1] != 3:
            what = f"grid {self.name!r} has {values.shape[1]} number per voxel"
            raise DataError(f"{frame.path}: {what}; expected 3, as in other frames (or scene.velocity=none)")
        speeds = np.linalg.norm(values, axis=1, keepdims=True)
        return self.unit * values * np.minimum(1.0, self.fastest / np.maximum(speeds, 1e-300))


def find_velocity_grid(frames: Sequence[VdbFrame], wanted: str) -> str | None:
    """Return the name of the grid of velocities: ``wanted``, or for "auto" a grid with a usual name if there is one.

    Return None for "none".

    Raises:
        DataError: no file has the grid ``wanted``, it has no vectors, or a file is damaged.
    """
    if wanted == "none":
        return None
    vectors = set[str]()
    for frame in frames:
        grids = read_header(frame.path).grids
        vectors |= {grid.name for grid in grids if grid.channels == 3 and grid.refusal() is None}
    if wanted != "auto" and wanted not in vectors:
        problem = f"no frame has such a grid of vectors{nearest(wanted, vectors)}"
        raise DataError(f"{frames[0].path.parent}: scene.velocity={wanted}: {problem}")
    return next((name for name in VELOCITY_NAMES if name in vectors), None) if wanted == "auto" else wanted


def measure_velocity_grid(frames: Sequence[VdbFrame], reader: GridReader, name: str | None) -> VelocityGrid | None:
    """Measure the unit of the grid of velocities ``name``, and tell the user; None without a grid or a unit."""
    if name is None or len(frames) < 2:
        return None
    folder, found = frames[0].path.parent, _measure_velocity_unit(frames, reader, name)
    if found is None:
        warn_once(f"{folder}: grid {name!r} does not explain how the density moves; primitives start at rest")
        return None
    unit = f"1 is {found.unit:.3g} world units per frame"
    warn_once(f"{folder}: primitives that can move start with the velocities of grid {name!r}: {unit}")
    return found


class _MovingPoints(NamedTuple):
    """Points of a frame with their velocities, and the extinctions of this frame and the next, over the largest."""

    places: np.ndarray  # (M, 3), world
    velocities: np.ndarray  # (M, 3) values of the grid, times the number of frames between the two
    before: np.ndarray  # (M,)
    after: Callable[[np.ndarray], np.ndarray]
    voxel: float

    def change(self, unit: float) -> float:
        """Return the sum of squared differences between a point's extinction before, and after its motion."""
        return float(np.square(self.after(self.places + unit * self.velocities) - self.before).sum())


def _measure_velocity_unit(frames: Sequence[VdbFrame], reader: GridReader, name: str) -> VelocityGrid | None:
    """Return the grid with its unit; None if velocities explain too little of the change between frames."""
    moving = list[_MovingPoints]()
    for i in np.unique(np.linspace(0, len(frames) - 2, _PAIRS).round().astype(int)):
        if (found := _find_moving_points(frames[i], frames[i + 1], reader, name)) is not None:
            moving.append(found)
    speeds = np.concatenate([np.linalg.norm(m.velocities, axis=1) for m in moving] or [np.zeros(1)])
    fast = float(np.percentile(speeds, _FAST))
    if not fast > 0:
        return None
    units = _STEPS * min(m.voxel for m in moving) / fast
    changes = [sum(m.change(unit) for m in moving) for unit in (0.0, *units)]
    best = int(np.argmin(changes[1:]))
    if not changes[1 + best] < (1 - _EXPLAINED) * changes[0]:
        return None
    return VelocityGrid(name, float(units[best]), _OUTLIER * fast)


def _find_moving_points(first: VdbFrame, second: VdbFrame, reader: GridReader, name: str) -> _MovingPoints | None:
    """Return points in the matter of ``first``; None if a frame has no matter, or the first has no velocities."""
    before, after = (reader.read(frame.path).get(reader.extinction) for frame in (first, second))
    velocity = VelocityGrid(name, float(second.number - first.number))
    if before is None or after is None or not len(before.values):
        return None
    values = np.where(np.isfinite(before.values), before.values, 0.0)
    largest = float(values.max())
    leaf, *inside = np.nonzero(before.masks & (values > _MATTER * largest))
    if not (largest > 0 and len(leaf)):
        return None
    random = np.random.default_rng(first.number)
    rows = random.choice(len(leaf), min(_POINTS, len(leaf)), replace=False)
    index = before.origins[leaf[rows]] + np.stack(inside, -1)[rows]
    places = index @ before.transform[:3, :3].T + before.transform[:3, 3]
    sampler = vdb_grid_sampler(after)
    voxel = float(np.linalg.norm(before.transform[:3, :3], axis=0).min())
    shares = values[(leaf, *inside)][rows] / largest
    return _MovingPoints(places, velocity.sample(first, places), shares, lambda at: sampler(at)[:, 0] / largest, voxel)
