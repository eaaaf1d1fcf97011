"""Ground-truth images of a medium: rays integrated cell by cell."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute import device
from neuprim.core.compute.threads import parallel_for
from neuprim.core.errors import ConfigError
from neuprim.tasks.dynamic.volume.medium import Medium
from neuprim.tasks.dynamic.volume.traverse import radiances

__all__ = ["integrate"]

_ROWS = 4


def integrate(
    medium: Medium,
    camera: Camera,
    samples: int = 2,
    subdivisions: int = 1,
    threads: int = 0,
    where: torch.device = device.HOST,
) -> Tensor:
    """(H, W, 4) float32 linear premultiplied RGBA of what a pinhole camera in scene units sees, behind nothing; on the
    processor.

    L = ∫ T σ c ds and alpha = 1 - T from the camera on, per ray and averaged over a pixel. Each cell between voxel
    centres is integrated by itself with two Gauss points per sub-interval: alpha is exact but for rounding, radiance of
    fourth order; see :mod:`~neuprim.tasks.dynamic.volume.traverse`. A ray ends where T < 1e-4. The result does not
    depend on ``threads``.

    Args:
        samples: rays per pixel side, on a regular grid.
        subdivisions: sub-intervals per cell; 1 is enough, more are for proof.
        threads: 0 for all cores.
        where: the device that computes; images of a card are the processor's but for rounding.
    """
    if samples < 1 or subdivisions < 1:
        raise ConfigError(f"samples {samples}, subdivisions {subdivisions}; expected at least 1")
    if medium.empty or medium.skips.min() > 0:
        return torch.zeros(camera.height, camera.width, 4)
    camera.validate("camera")
    pose = (medium.index_from_scene @ np.linalg.inv(camera.viewmat.detach().double().cpu().numpy()))[:3]
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)
    if device.has_warp(where):
        from neuprim.tasks.dynamic.volume import traverse_warp

        values, skips = medium.on(where)
        place, lenses = (device.copy_from_host(torch.from_numpy(np.ascontiguousarray(x)), where) for x in (pose, lens))
        return traverse_warp.radiances(
            values, skips, place, lenses, camera.width, camera.height, samples, subdivisions
        ).cpu()
    image = np.zeros((camera.height, camera.width, 4), np.float32)
    parallel_for(
        radiances,
        camera.height,
        _ROWS,
        threads,
        medium.values,
        medium.skips,
        np.ascontiguousarray(pose),
        lens,
        camera.width,
        samples,
        subdivisions,
        image,
    )
    return torch.from_numpy(image)
