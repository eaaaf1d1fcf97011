"""Depth images out of a light are read as torch would read them in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.tasks.relight.visibility_cpu import arriving_light
from neuprim.tasks.relight.visibility_torch import arriving


def camera(x: float = 1.0, y: float = 2.0, z: float = -4.0, dtype: torch.dtype = torch.float64) -> Camera:
    at = torch.tensor([x, y, z], dtype=dtype)
    return Camera(
        look_at(at, torch.zeros(3, dtype=dtype), torch.tensor([0.0, 0.0, 1.0], dtype=dtype)),
        50.0,
        50.0,
        8.0,
        8.0,
        16,
        16,
    )


def read(
    points: Tensor,
    view: Tensor,
    near: float,
    focal: float,
    alphas: Tensor,
    depths: Tensor,
    bias: float,
    softness: float,
) -> Tensor:
    """As torch samples images: outside of them nothing is in the way."""
    half = 0.5 * alphas.shape[1]
    nearness = torch.where(alphas > 0, alphas.double() / depths.double().clamp_min(near), 0.0)
    image = torch.stack([alphas.double(), nearness], 1)
    x, y, z = (points @ view[:, :3].T + view[:, 3]).unbind(-1)
    where = torch.stack([x, y], -1) * (focal / half / z.clamp_min(near))[:, None]
    found = F.grid_sample(image.flatten(0, 1)[None], where.clamp(-2, 2)[None, None], align_corners=False)[
        0, :, 0
    ].unflatten(0, (-1, 2))
    behind = z - found[:, 0] / found[:, 1].clamp_min(1e-12)
    u = (0.5 + 0.5 * (behind - bias) / softness).clamp(0, 1)
    return torch.where(z > near, (1 - found[:, 0] * u * u * (3 - 2 * u)).prod(0), 1.0)


@pytest.mark.parametrize("slabs", [1, 4])
def test_depth_images_are_read_as_torch_reads_them(slabs: int) -> None:
    """Points anywhere: inside the images, across their borders, beside and behind the camera and at its centre."""
    generator = torch.Generator().manual_seed(slabs)
    size, near, focal = 24, 0.05, 20.0
    alphas = torch.rand(slabs, size, size, generator=generator)
    alphas[torch.rand(alphas.shape, generator=generator) < 0.4] = 0.0
    depths = torch.where(alphas > 0, 0.01 + 4 * torch.rand(alphas.shape, generator=generator), 0.0)
    view = camera().viewmat[:3].contiguous()
    points = 6 * torch.rand(5000, 3, generator=generator, dtype=torch.float64) - 3
    points[:50] = camera().position + 1e-3 * points[:50]
    points[50] = camera().position
    edge = torch.rand(200, 3, generator=generator, dtype=torch.float64)  # about the border of the images
    side = torch.where(edge[:, 0] < 0.5, -1.0, 1.0) * (size / 2 + (edge[:, 1] - 0.5) * 3) / focal
    local = torch.stack([side, 0.4 * (edge[:, 2] - 0.5), torch.ones(200, dtype=torch.float64)], -1) * 3
    points = torch.cat([points, (local - view[:, 3]) @ view[:, :3]])
    found = np.full(len(points), -1.0, np.float32)
    arriving_light(
        0, len(points), points.numpy(), view.numpy(), near, focal, alphas.numpy(), depths.numpy(), 0.2, 0.3, found
    )
    wanted = read(points, view, near, focal, alphas, depths, 0.2, 0.3).float()
    twin = arriving(points, view, near, focal, alphas, depths, 0.2, 0.3)
    assert torch.allclose(torch.from_numpy(found), wanted, rtol=0, atol=1e-6)
    assert twin.dtype == torch.float32 and torch.allclose(twin, wanted, rtol=0, atol=1e-6)
    assert 0.1 < float((wanted < 0.99).float().mean()) and float(wanted.min()) < 0.3
    assert found[50] == 1.0


@pytest.mark.parametrize("slabs", [1, 4])
def test_so_are_they_on_a_card(slabs: int) -> None:
    """Its kernel, on Warp's CPU blocks; beside what is on the processor, also for points that are not finite."""
    pytest.importorskip("warp", reason="the cuda backend's kernels need Warp")
    from neuprim.tasks.relight import visibility_warp

    generator = torch.Generator().manual_seed(slabs)
    alphas = torch.rand(slabs, 24, 24, generator=generator)
    alphas[torch.rand(alphas.shape, generator=generator) < 0.4] = 0.0
    depths = torch.where(alphas > 0, 0.01 + 4 * torch.rand(alphas.shape, generator=generator), 0.0)
    points = 6 * torch.rand(5000, 3, generator=generator, dtype=torch.float64) - 3
    points[7], points[8, 1], points[9] = float("nan"), float("inf"), camera().position
    given = (points, camera().viewmat[:3].contiguous(), 0.05, 20.0, alphas, depths, 0.2, 0.3)
    found, wanted = visibility_warp.arriving_light(*given), np.full(len(points), -1.0, np.float32)
    arriving_light(0, len(points), *(x.numpy() if isinstance(x, Tensor) else x for x in given), wanted)
    assert torch.allclose(found, torch.from_numpy(wanted), rtol=0, atol=1e-6) and 0.1 < float(
        (found < 0.99).float().mean()
    )


def test_points_that_are_not_finite_are_lit() -> None:
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, -np.inf]])
    found = np.zeros(3, np.float32)
    ones = np.ones((1, 8, 8), np.float32)
    arriving_light(0, 3, points, camera().viewmat[:3].contiguous().numpy(), 0.05, 20.0, ones, ones, 0.1, 0.1, found)
    assert found.tolist() == [1.0, 1.0, 1.0]
    images = torch.ones(1, 8, 8), torch.ones(1, 8, 8)
    assert arriving(torch.from_numpy(points), camera().viewmat[:3], 0.05, 20.0, *images, 0.1, 0.1).tolist() == [
        1.0,
        1.0,
        1.0,
    ]
