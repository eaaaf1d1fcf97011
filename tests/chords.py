"""Every chord of a small frame by brute force, float64: what layers and images of few primitives are compared with."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.geometry import PrimitiveChords
from neuprim.core.model.primitives import LoweredPrimitives


@dataclass(frozen=True)
class Chords:
    """Of N primitives and an image of H x W pixels, in the order of the frame's primitives.

    Attributes:
        tau: (N, H, W) optical depths, at least 0.
        weight: (N, H, W) alpha_i T_i, front to back by the centres' depth, nothing clamped or cut.
        middle: (N, H, W) camera z of the middles.
    """

    tau: Tensor
    weight: Tensor
    middle: Tensor


def chords(lowered: LoweredPrimitives, camera: Camera, near: float = 0.01) -> Chords:
    """By the quadratic equation of each ray and ellipsoid."""
    geometry, view = lowered.geometry, camera.viewmat.double()
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    gy, gx = torch.meshgrid(y, x, indexing="ij")
    local = torch.stack([gx, gy, torch.ones_like(gx)], -1).reshape(-1, 3)
    length = local.norm(dim=-1)
    directions = (local / length[:, None]) @ view[:3, :3]
    origin, count, pixels = camera.position.double(), geometry.count, len(local)
    tau, middle = torch.zeros(count, pixels, dtype=torch.float64), torch.zeros(count, pixels, dtype=torch.float64)
    for i in range(count):
        whiten = geometry.rotations[i].detach().double().T / geometry.scales[i].detach().double()[:, None]
        start, pace = whiten @ (origin - geometry.means[i].detach().double()), directions @ whiten.T
        a, b, c = (pace * pace).sum(1), pace @ start, start @ start - 1
        root = (b * b - a * c).clamp_min(0).sqrt()
        t0, t1 = torch.maximum((-b - root) / a, near * length), (-b + root) / a
        hit = ((b * b - a * c > 0) & (t1 > t0)).nonzero()[:, 0]
        if len(hit):
            pairs = PrimitiveChords.of(geometry, torch.full_like(hit, i), origin, directions[hit], t0[hit], t1[hit])
            tau[i, hit] = lowered.optical_depth(pairs).detach().clamp_min(0)
            middle[i, hit] = ((t0 + t1) / 2 / length)[hit]
    order = (geometry.means.detach().double() @ view[2, :3] + view[2, 3]).argsort(stable=True)
    alpha = -torch.expm1(-tau[order])
    before = torch.cat([torch.ones(1, pixels, dtype=torch.float64), (1 - alpha).cumprod(0)[:-1]])
    weight = torch.empty_like(tau)
    weight[order] = alpha * before
    return Chords(*(values.reshape(count, camera.height, camera.width) for values in (tau, weight, middle)))
