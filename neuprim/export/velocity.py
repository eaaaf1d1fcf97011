"""The grid ``vel`` of exported OpenVDB files: velocities from the motion of the primitives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.conditions import frame_interval
from neuprim.core.errors import ConfigError
from neuprim.core.extensions import ExportJob
from neuprim.core.io.vdb import VdbGrid, VdbTiles
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import ActivePrimitives, Primitives
from neuprim.core.volumes.points import weighted_extinctions_at

_STEP = 1e-3  # of central differences in time, which are exact for motion that is quadratic in time
_LEAVES = 512  # evaluated at once, with about 64 MB of sums


@dataclass(frozen=True)
class VelocityExport:
    """Settings of the grid ``vel``.

    Attributes:
        interval: units of the condition "time" per second or per frame.
        unit: unit of the values, for metadata.
        scene_from_world: (4, 4) float64.
        threads: number of threads, 0 for all cores.
    """

    interval: float
    unit: str
    scene_from_world: np.ndarray
    threads: int

    def sample_grid(self, model: Primitives, conditions: Conditions, density: VdbGrid) -> VdbGrid:
        """Return the grid ``vel`` of a frame, with the active voxels of ``density``.

        The value of a voxel is the mean velocity of the primitives at its centre, weighted by their extinctions.

        Args:
            model: the model from which ``density`` was sampled.
            conditions: conditions of the frame, among them "time".
        """
        values = np.zeros((*density.masks.shape, 3), np.float32)
        scene_from_index = self.scene_from_world @ density.transform
        per_time = np.linalg.inv(self.scene_from_world[:3, :3]).T * self.interval
        with torch.no_grad():
            active = model.to(device.HOST).active(conditions)
            form = active.field.lower(active.own, active.geometry, conditions)
            velocities = primitive_velocities(active)
            for start in range(0, len(values), _LEAVES):
                part = slice(start, start + _LEAVES)
                leaf, *inside = np.nonzero(density.masks[part])
                index = density.origins[part][leaf] + np.stack(inside, -1)
                points = torch.from_numpy(index @ scene_from_index[:3, :3].T + scene_from_index[:3, 3])
                sums = weighted_extinctions_at(active, form, points, velocities, threads=self.threads).numpy()
                mean = sums[:, 1:] / np.maximum(sums[:, :1], np.finfo(np.float32).tiny)
                values[part][density.masks[part]] = mean @ per_time
        metadata = {"vector_type": "contravariant relative", "neuprim_units": self.unit}
        tree = (np.zeros(3, np.float32), density.origins, values, density.masks, VdbTiles.none(3))
        return VdbGrid("vel", density.transform, *tree, kind="unknown", half=density.half, metadata=metadata)


def choose_velocity(
    job: ExportJob, model: Primitives, frames: Sequence[Conditions], scene_from_world: np.ndarray
) -> VelocityExport | None:
    """Return the settings of the options ``velocity`` and ``fps``; None if no velocity is asked for.

    Raises:
        ConfigError: the primitives do not move, or the interval between frames is unknown.
    """
    rate = job.number("fps", 0.1, 240.0)
    if not job.flag("velocity"):
        if rate is not None:
            raise ConfigError("fps: found without velocity; expected both. Pass velocity=true.")
        return None
    active = model.active(frames[0])
    if "time" not in frames[0] or active.geometry is active.stored:
        expected = "a model with motion in model.density.time"
        raise ConfigError(
            f"velocity=true: the primitives of this model do not move; expected {expected}. Omit velocity."
        )
    interval = frame_interval(job.run.header, (float(conditions["time"]) for conditions in frames))
    if interval is None:
        found = "one frame, and the model has no numbered frames"
        raise ConfigError(
            f"velocity=true: {found}; expected an interval between frames. Pass a range, as --time 0:1:48."
        )
    unit = "world units per frame" if rate is None else "world units per second"
    return VelocityExport(interval * (rate or 1.0), unit, scene_from_world, job.run.settings.threads)


def primitive_velocities(active: ActivePrimitives) -> Tensor:
    """Return the (N, 3) float32 velocities of a frame's primitives, in scene units per unit of the condition "time"."""
    own = {name: value.double() for name, value in active.own.items()}
    stored = active.stored.double()

    def means(step: float) -> Tensor:
        time = active.conditions["time"].double() + step
        return active.field.move(own, stored, {**active.conditions, "time": time}).means

    return ((means(_STEP) - means(-_STEP)) / (2 * _STEP)).float()
