"""Starting points: hulls of known solids, even spreading, rays of cameras that meet nowhere, and surroundings."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Pixels, PointCloud, View, ViewSet
from neuprim.core.data.dataset import dataset_axes_meet, dataset_focus_point
from neuprim.core.data.initial import (
    box_starting_points,
    farthest_points,
    hull_points,
    initial_points,
    surrounding_points,
)
from neuprim.core.data.starting_points import count_seeing_views, hull_surface
from neuprim.core.errors import DataError

CENTER = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)


UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


class TakenViews(ViewSet):
    """Views of what ``draw`` shows."""

    def __init__(self, cameras: Sequence[Camera], draw: Callable[[Camera], Pixels]) -> None:
        self.cameras, self.images = cameras, [draw(c) for c in cameras]

    def __len__(self) -> int:
        return len(self.cameras)

    def view(self, index: int) -> View:
        return View(str(index), self.cameras[index])

    def pixels(self, index: int) -> Pixels:
        return self.images[index]


def views_around(draw: Callable[[Camera], Pixels], count: int = 24, size: int = 96) -> TakenViews:
    """Cameras around CENTER at distance 4."""
    directions = torch.randn((count, 3), generator=rng(), dtype=torch.float64)
    eyes = CENTER + 4.0 * directions / directions.norm(dim=-1, keepdim=True)
    lens = (1.6 * size, 1.6 * size, size / 2 + 3, size / 2 - 2, size, size)
    return TakenViews([Camera(look_at(e, CENTER, UP), *lens) for e in eyes], draw)


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
    views = views_around(sphere(0.7), count=40)
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

    means = initial_points(views_around(draw), None, 2000, rng()).means.double() - CENTER
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

    surface, _ = hull_surface(views_around(draw), 128)
    z = surface[:, 2] - CENTER[2]
    covered = torch.histc(z.float(), 20, -0.55, 0.55)
    assert (covered > 0).all() and (surface[:, :2] - CENTER[:2]).norm(dim=-1).quantile(0.9) < 0.08


def test_one_wrong_mask_in_fifty_is_forgiven_and_disagreement_is_not() -> None:
    views = views_around(sphere(0.7), count=50)
    views.images[7] = Pixels(torch.zeros(96, 96, 3), torch.zeros(96, 96))
    surface, _ = hull_surface(views, 64)
    assert len(surface) > 1000
    for i in range(0, 50, 2):
        views.images[i] = sphere(0.2, shift=0.9)(views.cameras[i])
    with pytest.raises(DataError, match="visual hull of 50 alpha masks is empty"):
        hull_points(views, 10, rng())


def test_masked_pixels_rule_nothing_out() -> None:
    views = views_around(sphere(0.7))
    full, _ = hull_surface(views, 32)
    hidden = views.images[0]
    assert hidden.alpha is not None
    nothing = torch.zeros_like(hidden.alpha)
    views.images[0] = Pixels(hidden.rgb, nothing, nothing.bool())
    assert abs(len(hull_surface(views, 32)[0]) - len(full)) < 0.2 * len(full)


@pytest.mark.parametrize("count", [1, 40_000])
def test_points_are_distinct_as_many_as_asked_and_reproducible(count: int) -> None:
    views = views_around(sphere(0.7), count=12)
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
    views = views_around(sphere(0.7), count=15)
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

    views = views_around(draw)
    points = initial_points(views, None, 2000, rng())
    offsets = points.means.double() - CENTER
    assert offsets.abs().max() <= 2.0 + 1e-5 and offsets.mean(0).abs().max() < 0.15
    assert torch.allclose(points.colors, torch.full((2000, 3), 0.3)) and points.means.unique(dim=0).shape[0] == 2000
    opaque = views_around(lambda c: Pixels(draw(c).rgb, torch.ones(c.height, c.width)))
    expected = box_starting_points(opaque, 50, rng()).means
    assert torch.equal(initial_points(opaque, None, 50, rng()).means, expected), "opaque alpha says nothing"


def test_focus_point() -> None:
    assert torch.allclose(dataset_focus_point(views_around(sphere(0.1)).cameras), CENTER, atol=1e-3)
    eye = torch.eye(4, dtype=torch.float64)
    row = []
    for x in (-1.0, 0.0, 1.0):  # parallel axes: somewhere in front of the middle camera
        view = eye.clone()
        view[0, 3] = -x
        row.append(Camera(view, 10.0, 10.0, 5.0, 5.0, 10, 10))
    point = dataset_focus_point(row)
    assert point[:2].abs().max() < 1e-6 and 0.5 < point[2] < 3.0
    assert torch.isfinite(dataset_focus_point(row[:1])).all()


SIDES = torch.tensor([1.0, 1.3, 0.8], dtype=torch.float64)  # of rooms: swapped axes would show


def striped_room(size: float) -> Callable[[Camera], Pixels]:
    """A box about the origin, seen from inside, with smooth stripes of three frequencies on its walls."""
    half = size * SIDES

    def draw(camera: Camera) -> Pixels:
        d = rays(camera)[1]
        t = ((half * d.sign() - camera.position) / d).amin(-1)
        p = (camera.position + t[..., None] * d) / half
        return Pixels((0.5 + 0.45 * torch.sin(p @ torch.tensor([[7.0, 2, 1], [1, 8, 3], [2, 1, 9]]).double())).float())

    return draw


def upright_camera(eye: Tensor, forward: Tensor) -> Camera:
    return Camera(look_at(eye.double(), (eye + forward).double(), UP), 40.0, 40.0, 32.0, 24.0, 64, 48)


def turned(count: int, radius: float, noise: float = 0.0) -> list[Camera]:
    """Cameras that look outward from a ring about the origin, all around."""
    angles = [2 * math.pi * i / count for i in range(count)]
    forward = [torch.tensor([math.cos(a), math.sin(a), 0.1 * math.sin(5 * a)], dtype=torch.float64) for a in angles]
    spots = noise * torch.randn((count, 3), generator=rng(), dtype=torch.float64)
    return [upright_camera(radius * f + s, f) for f, s in zip(forward, spots, strict=True)]


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_outward_cameras_begin_on_the_walls(scale: float) -> None:
    views = TakenViews(turned(24, 0.7 * scale), striped_room(3 * scale))
    assert not dataset_axes_meet(views.cameras)
    points = initial_points(views, None, 300, rng())
    assert len(points.means) > 250 and int(count_seeing_views(views, points.means).min()) >= 2
    off = ((points.means / (3 * scale * SIDES)).abs().amax(1) - 1).abs()
    assert float(off.median()) < 0.25, "half of the points lie on the walls, up to a quarter of their distance"


@pytest.mark.parametrize("noise", [0.0, 1e-7, 1e-3])
def test_a_tripod_has_no_unit(noise: float) -> None:
    """Positions that the images do not show count as one place: points begin in any unit, and far beyond the noise."""
    views = TakenViews(turned(24, 0.0, noise), striped_room(3.0))
    points = initial_points(views, None, 300, rng())
    assert len(points.means) > 250 and float(points.means.norm(dim=1).min()) > 100 * noise
    assert int(count_seeing_views(views, points.means).min()) >= 1


def test_an_array_of_parallel_cameras() -> None:
    corner, ahead = torch.tensor([0.5, 3.5, 0.5]), torch.tensor([0.0, 1, 0])
    side = [upright_camera(0.25 * torch.tensor([i, 0.0, j]) - corner, ahead) for i in range(5) for j in range(5)]
    views = TakenViews(side, striped_room(4.0))
    assert not dataset_axes_meet(side)
    off = initial_points(views, None, 300, rng()).means.div(4.0 * SIDES).abs().amax(1) - 1
    assert float(off.abs().median()) < 0.25


def test_cameras_without_a_common_place_ask_for_points() -> None:
    ahead = torch.tensor([1.0, 0, 0])
    back_to_back = [upright_camera(0.5 * ahead, ahead), upright_camera(-0.5 * ahead, -ahead)]
    with pytest.raises(DataError, match=r"model\.init\.points=FILE\.ply, or with ply_file_path"):
        initial_points(TakenViews(back_to_back, striped_room(3.0)), None, 50, rng())


WALL = 4.0  # behind the origin, as the cameras at y < 0 see it
SIZE = (48, 36)


def wall_views(count: int = 5, masked: bool = False) -> TakenViews:
    """Cameras in an arc before a wall at y = WALL, whose colour says where: red grows with x, green with z."""
    width, height = SIZE
    cameras = []
    for t in torch.linspace(-0.6, 0.6, count).tolist():
        eye = torch.tensor([1.5 * math.sin(t), -2.0 * math.cos(t), 0.3])
        view = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
        cameras.append(Camera(view, 40.0, 40.0, width / 2, height / 2, width, height))

    def draw(camera: Camera) -> Pixels:
        shade = on_the_wall(camera) / 10 + 0.5
        rgb = torch.stack([shade[..., 0], shade[..., 2], torch.zeros(shade.shape[:2])], -1).clamp(0, 1).float()
        mask = torch.ones(shade.shape[:2], dtype=torch.bool)
        mask[:, : SIZE[0] // 2] = False
        return Pixels(rgb, None, mask if masked else None)

    return TakenViews(cameras, draw)


def on_the_wall(camera: Camera) -> Tensor:
    """(H, W, 3) where the pixels' rays meet the wall."""
    eye, ray = rays(camera)
    return eye + ((WALL - eye[1]) / ray[..., 1])[..., None] * ray


def known(count: int = 40) -> PointCloud:
    """Points on a small textured spot of the wall."""
    generator = torch.Generator().manual_seed(3)
    spot = torch.rand(count, 2, generator=generator) - 0.5
    means = torch.stack([spot[:, 0], torch.full((count,), WALL), spot[:, 1]], -1)
    return PointCloud(means, torch.full((count, 3), 0.5))


def fill(views: ViewSet, count: int, seed: int = 0) -> PointCloud:
    return surrounding_points(views, known(), count, torch.Generator().manual_seed(seed))


def test_gaps_on_a_wall_are_filled_on_the_wall() -> None:
    views = wall_views()
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
    views = wall_views()
    found = fill(views, 300)
    far = found.means[found.means.norm(dim=1) > 6.5]
    assert 10 <= len(far) <= 30
    radius = (far - far.mean(0) * 0).norm(dim=1)
    assert radius.std() / radius.mean() < 0.2
    assert bool(torch.stack([camera.sees(far) for camera in views.cameras]).any(0).all())


def test_pixels_that_do_not_count_are_not_lifted() -> None:
    views = wall_views(1, masked=True)
    found = fill(views, 100)
    camera = views.cameras[0]
    near = found.means.norm(dim=1) < 6.5
    u = camera.project(found.means)[0][:, 0]
    assert int(near.sum()) > 50 and bool((u[near] >= SIZE[0] / 2).all())
