"""The files of a volume scene for those who write or compare densities: where their grids lie, and their extinction."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neuprim.core.fields import Conditions
from neuprim.core.volume_source import Placement, VolumeSource
from neuprim.tasks.dynamic.volume.compare import RESOLUTION, extinction_on
from neuprim.tasks.dynamic.volume.shoot import Shoot

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


class ShootSource(VolumeSource):
    """The frames of a :class:`~neuprim.tasks.dynamic.volume.shoot.Shoot`."""

    resolution = RESOLUTION

    def __init__(self, shoot: Shoot) -> None:
        self.shoot, self.bounds, self.placement = shoot, np.asarray(shoot.bounds, np.float64), placement_of(shoot)

    def conditions(self, index: int) -> Conditions:
        return {name: torch.tensor(values[index]) for name, values in self.placement.times.items()}

    def transform(self, index: int) -> np.ndarray | None:
        grids = self.shoot.reader.read(self.shoot.frames[index].path)
        absorbing = grids.get(self.shoot.reader.extinction)
        return None if absorbing is None else absorbing.transform

    def sigma(self, index: int, scene_from_index: Tensor, shape: tuple[int, int, int]) -> np.ndarray:
        return extinction_on(self.shoot.medium(self.shoot.frames[index]), scene_from_index, shape)
