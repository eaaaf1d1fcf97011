"""Starting points: the hull of known solids, even spreading, determinism, colours."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Pixels, View, ViewSet
from neuprim.core.data.hull import hull_surface
from neuprim.core.data.initial import box_points, farthest_points, hull_points, initial_points
from neuprim.core.data.scene_frame import focus_point
from neuprim.core.errors import DataError

CENTER = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


class Views(ViewSet):
    """Cameras around CENTER whose pixels come from a function of the camera."""

    def __init__(
        self, draw: Callable[[Camera], Pixels], count: int = 24, size: int = 96, seed: int = 0, distance: float = 4.0
    ) -> None:
        directions = torch.randn((count, 3), generator=rng(seed), dtype=torch.float64)
        eyes = CENTER + distance * directions / directions.norm(dim=-1, keepdim=True)
        up = torch.tensor([0.0, 0.0, 1.0])
        self.cameras = [
            Camera(look_at(e, CENTER, up), 1.6 * size, 1.6 * size, size / 2 + 3, size / 2 - 2, size, size) for e in eyes
        ]
        self.images = [draw(c) for c in self.cameras]

    def __len__(self) -> int:
        return len(self.cameras)

    def view(self, index: int) -> View:
        return View(str(index), self.cameras[index])

    def pixels(self, index: int) -> Pixels:
        return self.images[index]


def rays(camera: Camera) -> tuple[Tensor, Tensor]:
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    d = (
        torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1).double()
        @ camera.viewmat[:3, :3]
    )
    return camera.position, d / d.norm(dim=-1, keepdim=True)


def sphere(
    radius: float, color: tuple[float, float, float] = (0.8, 0.4, 0.2), shift: float = 0.0
) -> Callable[[Camera], Pixels]:
    """A ball about CENTER, ray-cast; ``shift`` moves it in world x."""
    middle = CENTER + torch.tensor([shift, 0.0, 0.0])

    def draw(camera: Camera) -> Pixels:
        o, d = rays(camera)
        miss = ((middle - o) - ((middle - o) @ d.reshape(-1, 3).T).reshape(d.shape[:2])[..., None] * d).norm(dim=-1)
        alpha = (miss < radius).float()
        return Pixels(alpha[..., None] * torch.tensor(color), alpha)

    return draw


def test_hull_of_a_ball_is_its_surface() -> None:
    views = Views(sphere(0.7), count=40)
    surface, voxel = hull_surface(views, 128)
    radius = (surface.double() - CENTER).norm(dim=-1)
    assert voxel < 2.2 * 0.7 / 128 * 1.2
    pixel = 4.0 / (1.6 * 96)
    assert radius.min() > 0.7 - 2 * pixel, "a surface voxel inside the ball"
    assert radius.quantile(0.95) < 0.7 + 3 * pixel + voxel and radius.max() < 0.85
    corners = torch.nn.functional.normalize(surface.double() - CENTER, dim=-1)
    assert all((corners @ d).max() > 0.99 for d in torch.eye(3, dtype=torch.float64)), "all sides are covered"


def test_starting_points_lie_along_the_axes_of_what_is_there() -> None:
    """An ellipsoid with another radius along each axis: swapped axes would show."""
    radii = torch.tensor([0.9, 0.5, 0.25], dtype=torch.float64)

    def draw(camera: Camera) -> Pixels:
        o, d = rays(camera)
        o, d = (o - CENTER) / radii, d / radii
        alpha = (torch.linalg.cross(o.expand_as(d), d).norm(dim=-1) < d.norm(dim=-1)).float()
        return Pixels(alpha[..., None] * torch.ones(3), alpha)

    means = initial_points(Views(draw), None, 2000, rng()).means.double() - CENTER
    assert torch.allclose(means.amax(0), radii, atol=0.08) and torch.allclose(means.amin(0), -radii, atol=0.08)


def test_thin_parts_survive() -> None:
    # a rod of 1.5 pixels' width, thinner than a coarse voxel by far
    def draw(camera: Camera) -> Pixels:
        o, d = rays(camera)
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        n = torch.linalg.cross(d, axis.expand_as(d))
        gap = ((CENTER - o) * n).sum(-1).abs() / n.norm(dim=-1)
        t = ((CENTER - o) @ d.reshape(-1, 3).T).reshape(d.shape[:2])
        z = o[2] + t * d[..., 2] - CENTER[2]
        alpha = ((gap < 0.02) & (z.abs() < 0.6)).float()
        return Pixels(alpha[..., None] * torch.ones(3), alpha)

    surface, _ = hull_surface(Views(draw), 128)
    z = surface[:, 2] - CENTER[2]
    covered = torch.histc(z.float(), 20, -0.55, 0.55)
    assert (covered > 0).all() and (surface[:, :2] - CENTER[:2]).norm(dim=-1).quantile(0.9) < 0.08


def test_one_wrong_mask_in_fifty_is_forgiven_and_disagreement_is_not() -> None:
    views = Views(sphere(0.7), count=50)
    views.images[7] = Pixels(torch.zeros(96, 96, 3), torch.zeros(96, 96))
    surface, _ = hull_surface(views, 64)
    assert len(surface) > 1000
    for i in range(0, 50, 2):
        views.images[i] = sphere(0.2, shift=0.9)(views.cameras[i])
    with pytest.raises(DataError, match="visual hull of 50 alpha masks is empty"):
        hull_points(views, 10, rng())


def test_masked_pixels_rule_nothing_out() -> None:
    views = Views(sphere(0.7))
    full, _ = hull_surface(views, 32)
    hidden = views.images[0]
    assert hidden.alpha is not None
    nothing = torch.zeros_like(hidden.alpha)
    views.images[0] = Pixels(hidden.rgb, nothing, nothing.bool())
    assert abs(len(hull_surface(views, 32)[0]) - len(full)) < 0.2 * len(full)


@pytest.mark.parametrize("count", [1, 300, 40_000])
def test_points_are_distinct_as_many_as_asked_and_reproducible(count: int) -> None:
    views = Views(sphere(0.7), count=12)
    points = initial_points(views, None, count, rng(3))
    assert points.means.shape == points.colors.shape == (count, 3) and points.means.dtype == torch.float32
    assert len(np.unique(points.means.numpy(), axis=0)) == count
    again = initial_points(views, None, count, rng(3))
    assert torch.equal(points.means, again.means) and torch.equal(points.colors, again.colors)
    assert not torch.equal(points.means, initial_points(views, None, count, rng(4)).means)
    assert torch.allclose(points.colors, torch.tensor([0.8, 0.4, 0.2]).expand(count, 3), atol=1e-6)


def test_farthest_points_spread() -> None:
    cloud = torch.rand((4000, 3), generator=rng())
    rows = farthest_points(cloud, 200, rng())
    gap = torch.cdist(cloud[rows], cloud[rows]).fill_diagonal_(9.0).min()
    drawn = cloud[torch.randperm(4000, generator=rng())[:200]]
    assert gap > 5 * torch.cdist(drawn, drawn).fill_diagonal_(9.0).min()
    covered = torch.cdist(cloud, cloud[rows]).min(dim=1).values.max()
    assert covered < gap + 1e-6, "farthest-point sampling covers to its own gap"


def test_colors_are_straight_and_medians_over_the_views_that_show_the_point() -> None:
    views = Views(sphere(0.7), count=15)
    for i, image in enumerate(views.images):
        assert image.alpha is not None
        if i < 4:  # a minority of views with a highlight
            views.images[i] = Pixels(torch.ones(96, 96, 3) * image.alpha[..., None], image.alpha)
        else:  # half transparent, same colour
            views.images[i] = Pixels(image.rgb * 0.75, image.alpha * 0.75)
    points = hull_points(views, 100, rng())
    assert torch.allclose(points.colors, torch.tensor([0.8, 0.4, 0.2]).expand(100, 3), atol=1e-5)


def test_photographs_start_in_a_box_where_the_cameras_look() -> None:
    def draw(camera: Camera) -> Pixels:
        return Pixels(torch.full((camera.height, camera.width, 3), 0.3))

    views = Views(draw)
    points = initial_points(views, None, 2000, rng())
    offsets = points.means.double() - CENTER
    assert offsets.abs().max() <= 2.0 + 1e-5 and offsets.mean(0).abs().max() < 0.15
    assert torch.allclose(points.colors, torch.full((2000, 3), 0.3)) and points.means.unique(dim=0).shape[0] == 2000
    opaque = Views(lambda c: Pixels(draw(c).rgb, torch.ones(c.height, c.width)))
    expected = box_points(opaque, 50, rng()).means
    assert torch.equal(initial_points(opaque, None, 50, rng()).means, expected), "opaque alpha says nothing"


def test_focus_point() -> None:
    assert torch.allclose(focus_point(Views(sphere(0.1)).cameras), CENTER, atol=1e-3)
    eye = torch.eye(4, dtype=torch.float64)
    row = []
    for x in (-1.0, 0.0, 1.0):  # parallel axes: somewhere in front of the middle camera
        view = eye.clone()
        view[0, 3] = -x
        row.append(Camera(view, 10.0, 10.0, 5.0, 5.0, 10, 10))
    point = focus_point(row)
    assert point[:2].abs().max() < 1e-6 and 0.5 < point[2] < 3.0
    assert torch.isfinite(focus_point(row[:1])).all()
