"""Ground truth to compare a model with, and the model's own grids as OpenVDB files that can serve as such."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.errors import DataError
from neuprim.core.io.vdb import VdbFrame, VdbGrid, list_vdb_files, read_grid, read_header, write_vdb
from neuprim.core.model.fields import Conditions
from neuprim.core.volumes.density_grid import voxels_in_box
from neuprim.core.volumes.density_truth import DensityGridSource, DensityTruth, TruthFrame
from neuprim.inspect.field import InspectionFrame

_GRID, _MARK, _CONDITION = "extinction", "neuprim_units", "neuprim_condition_"
_USUAL = (_GRID, "density", "sigma")


def open_inspection_truth(
    path: str, volume: Callable[[], DensityGridSource | None], world: World
) -> tuple[DensityTruth, str]:
    """Open the ground truth that the user named, and say in a line how it was read.

    Args:
        path: an OpenVDB file or a folder of them, or "scene" for what the run's scene was made from.
        volume: opens the files of the run's scene; None if it has none. Not called for files that neuprim wrote.
        world: of the run's model.

    Raises:
        DataError: no such file, or the scene has no volumes.
    """
    place = Path(path)
    if path == "scene" and not place.exists():
        truth = volume()
        if truth is None:
            raise DataError("--against scene: the run's scene has no volumes; give an OpenVDB file or folder")
        return truth, "ground truth: the scene's own volumes"
    if not place.exists():
        raise DataError(f"--against {path}: no such file or folder; expected .vdb files, or scene for the scene's own")
    frames = list(list_vdb_files(place).frames) if place.is_dir() else [VdbFrame(0, place)]
    if _written_by_neuprim(frames[0].path):
        return InspectionGroundTruth(frames, world), f"ground truth: {path}, written by neuprim in scene units"
    scene = volume()
    if scene is not None:
        return scene.open_files(place), f"ground truth: {path}, placed and scaled by the rules of the run's scene"
    world_name = "the scene" if world.identity else f"that of the run's data, of {world.scale:g} scene units"
    source = f"ground truth: {path}, taken as extinction in 1/scene unit, its world as {world_name}"
    return InspectionGroundTruth(frames, world), source


def pair_inspected_frames(
    frames: Sequence[Conditions], truth: DensityTruth, given: bool
) -> list[tuple[Conditions, int]]:
    """Pair each frame to show with the nearest frame of the truth: (conditions, truth's frame), each frame once.

    The conditions are those of the truth's frame. A truth of one frame is shown under the user's conditions if these
    were ``given`` or its own are not known.
    """
    if len(truth.frames) == 1 and (given or not truth.frames[0].conditions):
        return [(conditions, 0) for conditions in frames]
    if not given and len(truth.frames) == 1:
        return [(type(frames[0])({**frames[0], **truth.frames[0].conditions}), 0)]  # type: ignore[call-arg]
    pairs: dict[int, Conditions] = {}
    for i, conditions in enumerate(frames):
        distances = [_inspected_condition_distance(conditions, frame.conditions) for frame in truth.frames]
        known = all(frame.conditions for frame in truth.frames)
        nearest = int(np.argmin(distances)) if known else min(i, len(truth.frames) - 1)
        pairs.setdefault(nearest, type(conditions)({**conditions, **truth.frames[nearest].conditions}))  # type: ignore[call-arg]
    return [(conditions, number) for number, conditions in pairs.items()]


def _inspected_condition_distance(a: Conditions, b: Conditions) -> float:
    return sum(float((a[name] - b[name]).abs().sum()) for name in b if name in a)


class InspectionGroundTruth(DensityTruth):
    """OpenVDB files of extinction, 1/scene unit, in the world of a model; trilinear between voxels, 0 outside.

    Raises:
        DataError: no float grid to take, or nothing in it.
    """

    def __init__(self, frames: Sequence[VdbFrame], world: World) -> None:
        self._files, self._world = list(frames), world
        self.frames, lows, highs = [], [], []
        for frame in frames:
            grid = self._read_extinction(frame)
            found = {
                name.removeprefix(_CONDITION): torch.tensor(value)
                for name, value in grid.metadata.items()
                if name.startswith(_CONDITION) and isinstance(value, float) and np.isfinite(value)
            }
            self.frames.append(TruthFrame(frame.path.name, found))
            if (bounds := grid.world_bounds()) is not None:
                low, high = world.scene_box(bounds)
                lows.append(low)
                highs.append(high)
        if not lows:
            raise DataError(f"{frames[0].path}: no active voxel; expected matter in at least one frame")
        self.bounds = torch.from_numpy(np.stack([np.min(lows, 0), np.max(highs, 0)])).double()

    @staticmethod
    def _read_extinction(frame: VdbFrame) -> VdbGrid:
        names = [g.name for g in read_header(frame.path).grids if g.refusal() is None]
        chosen = next((name for name in _USUAL if name in names), names[0] if len(names) == 1 else None)
        if chosen is None:
            found = ", ".join(map(repr, names)) or "none"
            raise DataError(f"{frame.path}: grids {found}; expected one, or one of {', '.join(_USUAL)}")
        grid = read_grid(frame.path, chosen)
        if grid.channels != 1:
            raise DataError(f"{frame.path}: grid {chosen!r} has {grid.channels} channels; expected one")
        return grid

    def _scene_from_index(self, grid: VdbGrid) -> np.ndarray:
        """Return the (4, 4) matrix from index to scene."""
        return np.asarray(self._world.scene_from_world.numpy() @ grid.transform)

    def points(self, frame: int) -> tuple[Tensor, tuple[int, int, int]] | None:
        source = self._read_extinction(self._files[frame])
        return None if source.bounds is None else voxels_in_box(self.bounds, self._scene_from_index(source))

    def grid(
        self, frame: int, scene_from_index: Tensor, shape: tuple[int, int, int], component: str | None = None
    ) -> Tensor:
        source = self._read_extinction(self._files[frame])
        if source.bounds is None:
            return torch.zeros(shape)
        (x0, y0, z0), (x1, y1, z1) = source.bounds
        dense = source.to_dense(((x0 - 1, y0 - 1, z0 - 1), (x1 + 1, y1 + 1, z1 + 1)))
        values = np.nan_to_num(dense, nan=0.0, posinf=0.0, neginf=0.0)
        chain = np.linalg.inv(self._scene_from_index(source)) @ scene_from_index.numpy()
        offset = chain[:3, 3] - (np.array(source.bounds[0]) - 1)
        found = ndimage.affine_transform(values, chain[:3, :3], offset, shape, order=1, mode="constant")
        return torch.from_numpy(np.ascontiguousarray(found, np.float32))


def _written_by_neuprim(path: Path) -> bool:
    names = [grid.name for grid in read_header(path).grids]
    return names == [_GRID] and read_grid(path, _GRID).metadata.get(_MARK) == "scene"


def write_inspection_vdb(path: Path, frame: InspectionFrame, world: World) -> None:
    """Write the frame's extinction, 1/scene unit, as OpenVDB in the world of its model, one voxel per grid point."""
    scalars = {_CONDITION + name: float(value) for name, value in frame.conditions.items() if value.numel() == 1}
    meaning = {_MARK: "scene", "neuprim_value": "extinction, 1/scene unit; each primitive clamped at 0 from below"}
    transform = world.world_from_scene.numpy() @ frame.scene_from_index.numpy()
    grid = VdbGrid.from_dense(_GRID, frame.sigma, transform=transform, metadata={**meaning, **scalars})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_vdb(path, [grid], compression="zip")
