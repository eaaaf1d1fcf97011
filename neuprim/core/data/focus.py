"""What a set of cameras looks at."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.data import camera_extent
from neuprim.core.data.dataset import outlying

__all__ = ["axes_meet", "focus_point"]


def focus_point(cameras: Sequence[Camera]) -> Tensor:
    """(3,) float64 point nearest to all optical axes in the least-squares sense, scene units.

    A weak pull towards one extent in front of the mean camera decides what (nearly) parallel axes leave open.
    """
    positions, forward = _axes(cameras)
    eye = torch.eye(3, dtype=torch.float64)
    planes = eye - forward[:, :, None] * forward[:, None, :]
    pull = 1e-4 * len(positions)
    target = positions.mean(0) + forward.mean(0) * camera_extent(cameras)
    right = (planes @ positions[:, :, None]).sum(0)[:, 0] + pull * target
    return torch.linalg.solve(planes.sum(0) + pull * eye, right)


def axes_meet(cameras: Sequence[Camera]) -> bool:
    """Whether the optical axes determine a point in front of the cameras.

    They do if they pass it closer than half the spread of the camera centres, and nine cameras of ten look towards it.
    Parallel axes, cameras that look outward from their centre, and cameras that share one centre do not.
    """
    positions, forward = _axes(cameras)
    offsets = focus_point(cameras) - positions
    depths = (offsets * forward).sum(-1)
    miss = (offsets - depths[:, None] * forward).square().sum(-1).mean()
    spread = (positions - positions.mean(0)).square().sum(-1).mean()
    turned = 1.0 - torch.linalg.eigvalsh(forward.T @ forward / len(forward))[-1]  # 0 where all axes are parallel
    return bool((miss < 0.25 * spread) & (turned > 1e-3) & ((depths > 0).double().mean() >= 0.9))


def _axes(cameras: Sequence[Camera]) -> tuple[Tensor, Tensor]:
    """(N, 3) centres and (N, 3) viewing directions, float64, of the cameras that count for a scene's place."""
    positions = torch.stack([c.position.detach().double() for c in cameras])
    forward = torch.stack([c.viewmat[2, :3].detach().double() for c in cameras])
    usual = ~outlying(positions)
    return positions[usual], forward[usual]
