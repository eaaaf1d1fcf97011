"""The extinction of a scene's files, or of others read by the same rules, in scene units."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.errors import DataError
from neuprim.core.io.vdb import VdbFrame, sequence
from neuprim.core.volumes.density_errors import DensityTruth, TruthFrame
from neuprim.core.volumes.grid import voxels_within
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.medium import Medium

__all__ = ["VolumeTruth", "extinction_on"]


def extinction_on(
    medium: Medium,
    scene_from_index: Tensor,
    shape: tuple[int, int, int],
    where: torch.device = device.HOST,
    part: bool = False,
) -> np.ndarray:
    """(X, Y, Z) float32 extinction of the files at a lattice's points, trilinear; ``where``: the device that computes.

    Args:
        part: the part alone that the extinction grid makes.
    """
    if medium.values.size == 0:
        return np.zeros(shape, np.float32)
    chain = np.linalg.inv(medium.scene_from_index) @ scene_from_index.numpy()
    sigma = medium.scattering if part and medium.scattering is not None else medium.values[..., 0]
    if device.has_warp(where) and not medium.empty and sigma is not medium.scattering:
        from neuprim.tasks.dynamic.volume import traverse_warp

        way = device.copy_from_host(torch.from_numpy(np.ascontiguousarray(chain[:3])), where)
        return traverse_warp.extinctions(medium.on(where)[0], way, shape).cpu().numpy()
    index = np.indices(shape, dtype=np.float64).reshape(3, -1)
    points = chain[:3, :3] @ index + chain[:3, 3:]
    found: np.ndarray = ndimage.map_coordinates(sigma, points, order=1, mode="constant", cval=0.0)
    return found.reshape(shape).astype(np.float32)


class VolumeTruth(DensityTruth):
    """Frames of ``path``, or the scene's own; grids, look, placement and times are those of the scene.

    A frame's time follows from its number: the scene's first is 0 and its last 1. Frames of a folder outside these are
    left out; a single file outside them has no time. Models are compared with a frame on its own voxels, all that lie
    in the sequence's box.

    Raises:
        DataError: no file, or no frame within the scene's times.
    """

    def __init__(self, capture: Capture, path: Path | None = None) -> None:
        self.capture, self.bounds = capture, torch.from_numpy(capture.bounds).double()
        first, last = capture.clock
        if path is None:
            found = list(capture.frames)
        elif path.is_dir():
            found = [frame for frame in sequence(path).frames if first <= frame.number <= last]
            if not found:
                raise DataError(f"{path}: no frame from {first} to {last}, which are the scene's")
        else:
            number = re.findall(r"[0-9]{1,18}", path.stem)  # as in a folder, the last one counts
            found = [VdbFrame(int(number[-1]) if number else -1, path)]
        self._files = found
        self._last: tuple[int, Medium] | None = None
        self.frames = [self._named(frame, first <= frame.number <= last) for frame in found]

    def _named(self, frame: VdbFrame, inside: bool) -> TruthFrame:
        return TruthFrame(frame.path.name, {"time": torch.tensor(self.capture.time(frame))} if inside else {})

    def medium(self, frame: int) -> Medium:
        """A frame's file as extinction and radiance; the last one stays in memory, as grids are asked for in parts."""
        if self._last is None or self._last[0] != frame:
            self._last = (frame, self.capture.medium(self._files[frame]))
        return self._last[1]

    def points(self, frame: int) -> tuple[Tensor, tuple[int, int, int]] | None:
        medium = self.medium(frame)
        if medium.empty:
            return None
        inside = np.array(medium.values.shape[:3]) - 2.0  # but the empty layer around it
        ends = np.stack(np.meshgrid(*np.stack([np.ones(3), inside], -1), indexing="ij"), -1).reshape(-1, 3)
        corners = ends @ medium.scene_from_index[:3, :3].T + medium.scene_from_index[:3, 3]
        low, high = self.bounds.numpy()
        return voxels_within(
            np.stack([np.minimum(corners.min(0), low), np.maximum(corners.max(0), high)]), medium.scene_from_index
        )

    def grid(
        self, frame: int, scene_from_index: Tensor, shape: tuple[int, int, int], component: str | None = None
    ) -> Tensor:
        found = extinction_on(self.medium(frame), scene_from_index, shape, self.capture.device, component is not None)
        return torch.from_numpy(found)
