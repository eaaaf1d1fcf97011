"""Points where photographs show something and the reconstruction has none: on a wall without texture, and far away."""

from __future__ import annotations

import math

import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Pixels, PointCloud, View, ViewSet
from neuprim.core.data.initial import surrounding_points

WALL = 4.0  # behind the origin, as the cameras at y < 0 see it
SIZE = (48, 36)


class Room(ViewSet):
    """Cameras in an arc before a wall at y = WALL, whose colour says where: red grows with x, green with z."""

    def __init__(self, count: int = 5, masked: bool = False) -> None:
        self.masked = masked
        width, height = SIZE
        self.cameras = []
        for t in torch.linspace(-0.6, 0.6, count).tolist():
            eye = torch.tensor([1.5 * math.sin(t), -2.0 * math.cos(t), 0.3])
            view = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
            self.cameras.append(Camera(view, 40.0, 40.0, width / 2, height / 2, width, height))

    def __len__(self) -> int:
        return len(self.cameras)

    def view(self, index: int) -> View:
        return View(f"v{index}", self.cameras[index])

    def pixels(self, index: int) -> Pixels:
        hit = on_the_wall(self.cameras[index])
        shade = hit / 10 + 0.5
        rgb = torch.stack([shade[..., 0], shade[..., 2], torch.zeros(hit.shape[:2])], -1).clamp(0, 1).float()
        mask = torch.ones(hit.shape[:2], dtype=torch.bool)
        mask[:, : SIZE[0] // 2] = False
        return Pixels(rgb, None, mask if self.masked else None)


def on_the_wall(camera: Camera) -> torch.Tensor:
    """(H, W, 3) where the pixels' rays meet the wall."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    local = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1).double()
    ray = local @ camera.viewmat[:3, :3].double()
    t = (WALL - camera.position[1]) / ray[..., 1]
    return camera.position + t[..., None] * ray


def known(count: int = 40) -> PointCloud:
    """Points on a small textured spot of the wall."""
    generator = torch.Generator().manual_seed(3)
    spot = torch.rand(count, 2, generator=generator) - 0.5
    means = torch.stack([spot[:, 0], torch.full((count,), WALL), spot[:, 1]], -1)
    return PointCloud(means, torch.full((count, 3), 0.5))


def fill(views: ViewSet, count: int, seed: int = 0) -> PointCloud:
    return surrounding_points(views, known(), count, torch.Generator().manual_seed(seed))


def test_gaps_on_a_wall_are_filled_on_the_wall() -> None:
    views = Room()
    found = fill(views, 200)
    assert len(found.means) == 200
    wall = found.means[(found.means[:, 1] - WALL).abs() < 1.5]
    assert len(wall) >= 170, "all but the shell and a few, whose depth is guessed from beside"
    beside = (wall[:, 0].abs() > 0.6) | (wall[:, 2].abs() > 0.6)
    assert beside.float().mean() > 0.9, "the spot is known already"
    lifted = found.colors[:180]
    assert (lifted[:, 0] - (found.means[:180, 0] / 10 + 0.5)).abs().mean() < 0.05, "colours of the pixels there"
    for i in range(len(views)):
        camera = views.cameras[i]
        hit = on_the_wall(camera).reshape(-1, 3).float()
        gap = torch.cdist(hit, torch.cat([known().means, found.means])).min(1).values
        before = torch.cdist(hit, known().means).min(1).values
        assert gap.mean() < 0.5 * before.mean(), i


def test_some_are_a_shell_far_behind_everything_where_some_view_looks() -> None:
    views = Room()
    found = fill(views, 300)
    far = found.means[found.means.norm(dim=1) > 6.5]
    assert 10 <= len(far) <= 30
    radius = (far - far.mean(0) * 0).norm(dim=1)
    assert radius.std() / radius.mean() < 0.2
    assert bool(torch.stack([camera.sees(far) for camera in views.cameras]).any(0).all())


def test_pixels_that_do_not_count_are_not_lifted() -> None:
    views = Room(1, masked=True)
    found = fill(views, 100)
    camera = views.cameras[0]
    near = found.means.norm(dim=1) < 6.5
    u = camera.project(found.means)[0][:, 0]
    assert int(near.sum()) > 50 and bool((u[near] >= SIZE[0] / 2).all())
