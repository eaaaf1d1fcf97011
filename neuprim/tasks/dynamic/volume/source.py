"""The files of a volume scene for those who write or compare densities: where their grids lie, and their extinction."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neuprim.core.volumes.source import Placement, VolumeSource
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.truth import VolumeTruth

__all__ = ["CaptureSource", "placement_of"]


def placement_of(capture: Capture) -> Placement:
    """How the scene lies in the world of its files; times as the data set has them."""
    look, names = capture.look, capture.reader.names
    glows = look.flame_extinction > 0 and look.flame_grid in names
    return Placement(
        capture.normalisation.matrix(),
        [frame.number for frame in capture.frames],
        {"time": [capture.time(frame) for frame in capture.frames]},
        look.extinction or 1.0,
        names[capture.reader.extinction],
        exact=not glows and look.extinction > 0,
        component=capture.reader.extinction,
        extents=[capture.measured[frame.number] for frame in capture.frames] if capture.measured else (),
    )


class CaptureSource(VolumeTruth, VolumeSource):
    """The frames of a :class:`~neuprim.tasks.dynamic.volume.capture.Capture`."""

    def __init__(self, capture: Capture) -> None:
        super().__init__(capture)
        self.placement = placement_of(capture)

    def transform(self, frame: int) -> np.ndarray | None:
        grids = self.capture.reader.read(self.capture.frames[frame].path)
        absorbing = grids.get(self.capture.reader.extinction)
        return None if absorbing is None else absorbing.transform

    def of(self, path: Path) -> VolumeTruth:
        return VolumeTruth(self.capture, path)
