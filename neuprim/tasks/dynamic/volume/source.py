"""The files of a volume scene for those who write or compare densities: where their grids lie, and their extinction."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neuprim.core.volumes.source import Placement, VolumeSource
from neuprim.tasks.dynamic.volume.shoot import Shoot
from neuprim.tasks.dynamic.volume.truth import VolumeTruth

__all__ = ["ShootSource", "placement_of"]


def placement_of(shoot: Shoot) -> Placement:
    """How the scene lies in the world of its files; times as the data set has them."""
    numbers = [frame.number for frame in shoot.frames]
    look, names = shoot.look, shoot.reader.names
    glows = look.flame_extinction > 0 and look.flame_grid in names
    return Placement(
        shoot.normalisation.matrix(),
        numbers,
        {"time": [(n - numbers[0]) / max(numbers[-1] - numbers[0], 1) for n in numbers]},
        look.extinction or 1.0,
        names[shoot.reader.extinction],
        exact=not glows and look.extinction > 0,
    )


class ShootSource(VolumeTruth, VolumeSource):
    """The frames of a :class:`~neuprim.tasks.dynamic.volume.shoot.Shoot`."""

    def __init__(self, shoot: Shoot) -> None:
        super().__init__(shoot)
        self.placement = placement_of(shoot)

    def transform(self, frame: int) -> np.ndarray | None:
        grids = self.shoot.reader.read(self.shoot.frames[frame].path)
        absorbing = grids.get(self.shoot.reader.extinction)
        return None if absorbing is None else absorbing.transform

    def of(self, path: Path) -> VolumeTruth:
        return VolumeTruth(self.shoot, path)
