"""How much of a distant light reaches every voxel of a medium."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from neuprim.core.compute import device
from neuprim.core.compute.threads import parallel_for
from neuprim.core.errors import ConfigError
from neuprim.tasks.dynamic.volume.medium import Medium
from neuprim.tasks.dynamic.volume.traverse import depths

__all__ = ["transmittance"]


def transmittance(
    medium: Medium, direction: Sequence[float], threads: int = 0, where: torch.device = device.HOST
) -> np.ndarray:
    """(X, Y, Z) float32 exp(-∫ σ ds) from each voxel centre towards a directional light.

    Every voxel has its own ray, walked cell by cell, so the optical depth is that of the trilinear field but for
    rounding.
    Voxels without extinction get 1 without a ray: nothing there scatters.

    Args:
        direction: towards the light, scene axes, any length > 0.
        threads: 0 for all cores.
        where: the device that computes.
    """
    towards = np.array(direction, np.float64)
    length = float(np.linalg.norm(towards)) if towards.shape == (3,) else 0.0
    if not 0.0 < length < np.inf:
        raise ConfigError(f"direction {tuple(direction)}; expected three finite numbers that are not all 0")
    result = np.zeros(medium.values.shape[:3], np.float32)
    if not medium.empty:
        way = medium.index_from_scene[:3, :3] @ (towards / length)
        sigma = np.ascontiguousarray(medium.values[..., 0])
        if device.has_warp(where):
            from neuprim.tasks.dynamic.volume import traverse_warp

            held = (device.copy_from_host(torch.from_numpy(x), where) for x in (sigma, medium.skips, way))
            return np.exp(-traverse_warp.depths(*held).cpu().numpy())
        rx, ry, rz = way.tolist()
        parallel_for(depths, len(sigma), 2, threads, sigma, medium.skips, rx, ry, rz, result)
    return np.exp(-result)
