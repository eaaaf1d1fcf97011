"""Ground-truth extinction and radiance from a volume sequence's .vdb files, and errors of models against them."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import DataError
from neuprim.core.io.vdb import VdbFrame, list_vdb_files, read_header
from neuprim.core.model.primitives import Primitives
from neuprim.core.volumes.density_grid import voxels_in_box
from neuprim.core.volumes.density_truth import (
    DENSITY_ERRORS,
    DensityGridSource,
    TruthFrame,
    VoxelChannels,
    VoxelLook,
    measure_channel_errors,
    measure_density_errors,
)
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.lit_medium import light_medium
from neuprim.tasks.dynamic.volume.medium import Medium

THIRDS = ("early", "middle", "late")
_COMPARED_PER_THIRD = 3  # frames
_MOST_POINTS = 2**27  # of a frame; of larger boxes, every second, third, ... voxel along each axis is compared


def sample_extinction(
    medium: Medium, scene_from_index: Tensor, shape: tuple[int, int, int], part: bool = False
) -> np.ndarray:
    """Sample a medium's extinction trilinearly at the points of a grid of ``shape`` (X, Y, Z); return float32.

    ``scene_from_index`` (4, 4) maps the grid's indices to scene coordinates. With ``part``, the result is only the
    contribution of the extinction grid, without flames.
    """
    chain = medium.index_from_scene @ scene_from_index.numpy()
    sigma = medium.scattering if part and medium.scattering is not None else medium.values[..., 0]
    points = np.indices(shape, dtype=np.float64).reshape(3, -1).T @ chain[:3, :3].T + chain[:3, 3]
    return medium.bricks.sample(sigma, points).reshape(shape)


class CaptureDensity(DensityGridSource):
    """Ground-truth density from the .vdb files at ``path``, or from the scene's files if ``path`` is None.

    Grid names, optics, placement and times are those of the scene. If ``path`` is a folder, frames outside the scene's
    times are left out. If ``path`` is a single file outside these times, the file's frame has no time. Models are
    compared with the file at the frame's voxels, in a box that also contains the sequence's box.

    Raises:
        DataError: there is no file, or no frame within the scene's times.
    """

    def __init__(self, capture: Capture, path: Path | None = None) -> None:
        self.capture, self.bounds = capture, torch.from_numpy(capture.bounds).double()
        self.placement = capture.placement()
        first, last = capture.clock
        if path is None:
            files = list(capture.frames)
        elif path.is_dir():
            files = [frame for frame in list_vdb_files(path).frames if first <= frame.number <= last]
            if not files:
                raise DataError(f"{path}: no frame from {first} to {last}, the range of the scene's frames")
        else:
            numbers = re.findall(r"[0-9]{1,18}", path.stem)  # the last one counts, as in a folder
            files = [VdbFrame(int(numbers[-1]) if numbers else -1, path)]
        self._files = files
        grids = (grid for file in files for grid in read_header(file.path).grids if grid.name == self.placement.grid)
        self.half = next((grid.half for grid in grids), False)  # not of the first file: empty grids are left out
        self._cached: tuple[int, Medium] | None = None
        timed = [{"time": torch.tensor(capture.time(f))} if first <= f.number <= last else {} for f in files]
        self.frames = [TruthFrame(file.path.name, times) for file, times in zip(files, timed, strict=True)]

    def medium(self, frame: int) -> Medium:
        """Return the medium of a frame. The last medium is cached, since grids are requested in parts."""
        if self._cached is None or self._cached[0] != frame:
            self._cached = None  # only one medium is in memory
            self._cached = (frame, self.capture.medium(self._files[frame]))
        return self._cached[1]

    def points(self, frame: int) -> tuple[Tensor, tuple[int, int, int]] | None:
        medium = self.medium(frame)
        if medium.empty:
            return None
        inside = np.array(medium.bricks.shape) - 2.0  # without the empty layer around it
        ends = np.stack(np.meshgrid(*np.stack([np.ones(3), inside], -1), indexing="ij"), -1).reshape(-1, 3)
        corners = ends @ medium.scene_from_index[:3, :3].T + medium.scene_from_index[:3, 3]
        low, high = self.bounds.numpy()
        box = np.stack([np.minimum(corners.min(0), low), np.maximum(corners.max(0), high)])
        matrix, shape = voxels_in_box(box, medium.scene_from_index)
        every = math.ceil((math.prod(shape) / _MOST_POINTS) ** (1 / 3))
        matrix[:3, :3] *= every
        x, y, z = (-(-n // every) for n in shape)
        return matrix, (x, y, z)

    def grid(
        self, frame: int, scene_from_index: Tensor, shape: tuple[int, int, int], component: str | None = None
    ) -> Tensor:
        return torch.from_numpy(sample_extinction(self.medium(frame), scene_from_index, shape, component is not None))

    def grid_transform(self, frame: int) -> np.ndarray | None:
        extinction = self.capture.reader.read(self._files[frame].path).get(self.capture.reader.extinction)
        return None if extinction is None else extinction.transform

    def look(self, frame: int) -> VoxelLook | None:
        capture, medium = self.capture, self.medium(frame)
        if medium.empty:
            return None
        if capture.lights == 1:
            medium = light_medium(medium, capture.frame_lights(self._files[frame])[0], capture.optics)
        points, where = medium.voxels(medium.values[..., 0] > 0)
        scattered = None if capture.lights == 1 or medium.scattered is None else medium.scattered[where]
        return VoxelLook(points, medium.values[where][:, 1:], scattered)

    def channels(self, frame: int) -> VoxelChannels | None:
        capture, medium = self.capture, self.medium(frame)
        if not capture.channels or medium.empty:
            return None
        points, _ = medium.voxels(medium.values[..., 0] > 0)
        return VoxelChannels(points, capture.read_channels(self._files[frame], points))

    def open_files(self, path: Path) -> CaptureDensity:
        return CaptureDensity(self.capture, path)


def compare_capture_extinction(model: Primitives, capture: Capture, times: list[float]) -> dict[str, Any]:
    """Measure a model's errors of extinction (sigma) against the .vdb files of a sequence; return name -> value.

    All voxels of the sequence's box are compared, or an evenly spaced part if there are more than 2^27 voxels.
    ``times`` has the time of every frame. In the result, "sigma_frames" has the errors of each compared frame, see
    :func:`~neuprim.core.volumes.density_truth.measure_density_errors`. There are also means over the early, middle and
    late third of the sequence, each over three evenly spaced frames. Frames without extinction are left out. If flames
    add to the extinction of a grid, the errors of the grid's own part are also measured: "density_frames", ... Channels
    are measured at the voxels with extinction: "temperature_frames", ...
    """
    count, truth, compared = len(capture.frames), CaptureDensity(capture), 3 * _COMPARED_PER_THIRD
    components = model.density.components(model.params)
    entries: dict[str, list[dict[str, Any]]] = {name: [] for name in ("sigma", *components, *capture.channels)}
    for t in sorted({int((i + 0.5) * count / compared) for i in range(compared)}):
        conditions = {"time": torch.tensor(times[t])}
        found = {
            component or "sigma": measure_density_errors(model, conditions, truth, t, component=component)
            for component in (None, *components)
        }
        channels = truth.channels(t)
        found |= {} if channels is None else measure_channel_errors(model, conditions, channels)
        for name, errors in found.items():
            if errors is not None:
                third = THIRDS[min(3 * t // count, 2)]
                entries[name].append({"frame": capture.frames[t].number, "third": third, **errors})
    result: dict[str, Any] = {}
    for name, own in entries.items():
        result[f"{name}_frames"] = own
        for key in DENSITY_ERRORS:
            for third in THIRDS:
                values = [e[key] for e in own if e["third"] == third]
                result[f"{name}_{key}_{third}"] = float(np.mean(values)) if values else None
    return result
