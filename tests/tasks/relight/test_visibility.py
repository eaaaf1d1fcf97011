"""Depth images from a light are read alike by the numba kernel and by torch's sampling of images."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.tasks.relight.visibility import _visibility_kernel, sample_visibility

SIZE, NEAR, FOCAL = 24, 0.05, 20.0


def camera() -> Camera:
    eye, up = torch.tensor([1.0, 2.0, -4.0], dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return Camera(look_at(eye, torch.zeros(3, dtype=torch.float64), up), 50.0, 50.0, 8.0, 8.0, 16, 16)


@pytest.mark.parametrize("slabs", [1, 4])
def test_both_read_the_same(slabs: int) -> None:
    """Points anywhere: inside the images, across their borders, behind the camera and at its centre; and not finite."""
    generator = torch.Generator().manual_seed(slabs)
    alphas = torch.rand(slabs, SIZE, SIZE, generator=generator)
    alphas[torch.rand(alphas.shape, generator=generator) < 0.4] = 0.0
    depths = torch.where(alphas > 0, 0.01 + 4 * torch.rand(alphas.shape, generator=generator), 0.0)
    view = camera().viewmat[:3].contiguous()
    points = 6 * torch.rand(5000, 3, generator=generator, dtype=torch.float64) - 3
    points[:50] = camera().position + 1e-3 * points[:50]
    points[50] = camera().position
    points[51:54] = torch.tensor([[torch.nan, 0, 0], [torch.inf, 0, 0], [0, 0, -torch.inf]])
    edge = torch.rand(200, 3, generator=generator, dtype=torch.float64)  # about the border of the images
    side = torch.where(edge[:, 0] < 0.5, -1.0, 1.0) * (SIZE / 2 + (edge[:, 1] - 0.5) * 3) / FOCAL
    local = torch.stack([side, 0.4 * (edge[:, 2] - 0.5), torch.ones(200, dtype=torch.float64)], -1) * 3
    points = torch.cat([points, (local - view[:, 3]) @ view[:, :3]])
    found = np.full(len(points), -1.0, np.float32)
    images = (alphas.numpy(), depths.numpy())
    _visibility_kernel(0, len(points), points.numpy(), view.numpy(), NEAR, FOCAL, *images, 0.2, 0.3, found)
    wanted = sample_visibility(points, view, NEAR, FOCAL, alphas, depths, 0.2, 0.3)
    assert wanted.dtype == torch.float32 and torch.allclose(torch.from_numpy(found), wanted, rtol=0, atol=5e-7)
    assert 0.1 < float((wanted < 0.99).float().mean()) and float(wanted.min()) < 0.3
    assert found[50:54].tolist() == wanted[50:54].tolist() == [1.0] * 4
