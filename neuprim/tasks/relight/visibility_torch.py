"""Depth images out of a light, read at points, in torch code: the twin of
:mod:`neuprim.tasks.relight.visibility_cpu`."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["arriving"]


def arriving(
    points: Tensor,
    view: Tensor,
    near: float,
    focal: float,
    alphas: Tensor,
    depths: Tensor,
    bias: float,
    softness: float,
) -> Tensor:
    """(M,) float32 visibility of ``points`` (M, 3) float64, see
    :func:`~neuprim.tasks.relight.visibility_cpu.arriving_light`."""
    slabs, size = alphas.shape[:2]
    x, y, z = ((view[a, :3] * points).sum(-1) + view[a, 3] for a in range(3))
    ahead = z > near
    depth = torch.where(ahead, z, 1.0)
    u, v = (
        focal * x / depth + 0.5 * size - 0.5,
        focal * y / depth + 0.5 * size - 0.5,
    )  # in pixels, 0 the middle of the first
    ahead &= (u > -1.0) & (u < size) & (v > -1.0) & (v < size)
    u, v = (torch.where(ahead, w, 0.0) for w in (u, v))
    i, j = v.floor().long(), u.floor().long()
    down, right = v - i, u - j
    alpha, nearness = (torch.zeros((slabs, len(z)), dtype=torch.float64, device=z.device) for _ in range(2))
    opacities, distances = alphas.reshape(slabs, -1), depths.reshape(slabs, -1)
    for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
        row, column = i + di, j + dj
        inside = (row >= 0) & (row < size) & (column >= 0) & (column < size)
        pixel = torch.where(inside, row * size + column, 0)
        weight = (down if di else 1.0 - down) * (right if dj else 1.0 - right) * inside * opacities[:, pixel].double()
        alpha += weight
        nearness += weight / distances[:, pixel].double().clamp_min(near)
    behind = z - alpha / nearness.clamp_min(1e-30)
    s = (0.5 + 0.5 * (behind - bias) / softness).clamp(0.0, 1.0)
    found = (1.0 - alpha * s * s * (3.0 - 2.0 * s)).prod(0)
    return torch.where(ahead, found, 1.0).float()
