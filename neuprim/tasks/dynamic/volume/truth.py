"""The extinction of a scene's files, or of others read by the same rules, in scene units."""

from __future__ import annotations

import re
from pathlib import Path

import torch
from torch import Tensor

from neuprim.core.errors import DataError
from neuprim.core.io.vdb import VdbFrame, sequence
from neuprim.core.volumes.truth import DensityTruth, TruthFrame
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.compare import RESOLUTION, extinction_on

__all__ = ["VolumeTruth"]


class VolumeTruth(DensityTruth):
    """Frames of ``path``, or the scene's own; grids, look, placement and times are those of the scene.

    A frame's time follows from its number: the scene's first is 0 and its last 1. Frames of a folder outside these are left out; a
    single file outside them has no time.

    Raises:
        DataError: no file, or no frame within the scene's times.
    """

    resolution = RESOLUTION

    def __init__(self, capture: Capture, path: Path | None = None) -> None:
        self.capture, self.bounds = capture, torch.from_numpy(capture.bounds).double()
        first, last = capture.frames[0].number, capture.frames[-1].number
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
        self.frames = [self._named(frame, first, last) for frame in found]

    @staticmethod
    def _named(frame: VdbFrame, first: int, last: int) -> TruthFrame:
        inside = first <= frame.number <= last
        times = {"time": torch.tensor((frame.number - first) / max(last - first, 1))} if inside else {}
        return TruthFrame(frame.path.name, times)

    def grid(self, frame: int, scene_from_index: Tensor, shape: tuple[int, int, int]) -> Tensor:
        return torch.from_numpy(extinction_on(self.capture.medium(self._files[frame]), scene_from_index, shape))
