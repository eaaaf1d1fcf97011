"""Starting points of cameras that do not look at one point: seen by two cameras, at depths that the images agree
with."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Pixels, View, ViewSet
from neuprim.core.data.initial import initial_points
from neuprim.core.data.ray_points import count_seeing_views
from neuprim.core.data.scene_frame import optical_axes_meet
from neuprim.core.errors import DataError

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


SIDES = torch.tensor([1.0, 1.3, 0.8], dtype=torch.float64)  # of rooms: swapped axes would show


def room(size: float) -> Callable[[Camera], Pixels]:
    """A box about the origin, seen from inside, with smooth stripes of three frequencies on its walls."""
    half = size * SIDES

    def draw(camera: Camera) -> Pixels:
        y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
        d = (
            torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1).double()
            @ camera.viewmat[:3, :3]
        )
        t = ((half * d.sign() - camera.position) / d).amin(-1)
        p = (camera.position + t[..., None] * d) / half
        return Pixels((0.5 + 0.45 * torch.sin(p @ torch.tensor([[7.0, 2, 1], [1, 8, 3], [2, 1, 9]]).double())).float())

    return draw


class Taken(ViewSet):
    """Views of what ``draw`` shows."""

    def __init__(self, cameras: Sequence[Camera], draw: Callable[[Camera], Pixels]) -> None:
        self.cameras, self.images = cameras, [draw(c) for c in cameras]

    def __len__(self) -> int:
        return len(self.cameras)

    def view(self, index: int) -> View:
        return View(str(index), self.cameras[index])

    def pixels(self, index: int) -> Pixels:
        return self.images[index]


def camera(eye: Tensor, forward: Tensor) -> Camera:
    return Camera(look_at(eye.double(), (eye + forward).double(), UP), 40.0, 40.0, 32.0, 24.0, 64, 48)


def turned(count: int, radius: float, noise: float = 0.0) -> list[Camera]:
    """Cameras that look outward from a ring about the origin, all around."""
    angles = [2 * math.pi * i / count for i in range(count)]
    forward = [torch.tensor([math.cos(a), math.sin(a), 0.1 * math.sin(5 * a)], dtype=torch.float64) for a in angles]
    spots = noise * torch.randn((count, 3), generator=rng(), dtype=torch.float64)
    return [camera(radius * f + s, f) for f, s in zip(forward, spots, strict=True)]


def array(count: int, step: float) -> list[Camera]:
    return [camera(step * torch.tensor([i, j, 0.0]), UP.roll(2)) for i in range(count) for j in range(count)]


@pytest.mark.parametrize("scale", [1e-4, 1.0, 1e4])
def test_outward_cameras_begin_on_the_walls(scale: float) -> None:
    views = Taken(turned(24, 0.7 * scale), room(3 * scale))
    assert not optical_axes_meet(views.cameras)
    points = initial_points(views, None, 300, rng())
    assert len(points.means) > 250 and int(count_seeing_views(views, points.means).min()) >= 2
    off = ((points.means / (3 * scale * SIDES)).abs().amax(1) - 1).abs()
    assert float(off.median()) < 0.25, "half of the points lie on the walls, up to a quarter of their distance"


@pytest.mark.parametrize("noise", [0.0, 1e-12, 1e-7, 1e-3])
def test_a_tripod_has_no_unit(noise: float) -> None:
    """Positions that the images do not show count as one place: points begin in any unit, and far beyond the noise."""
    views = Taken(turned(24, 0.0, noise), room(3.0))
    points = initial_points(views, None, 300, rng())
    assert len(points.means) > 250 and float(points.means.norm(dim=1).min()) > 100 * noise
    assert int(count_seeing_views(views, points.means).min()) >= 1


def test_an_array_of_parallel_cameras() -> None:
    corner, ahead = torch.tensor([0.5, 3.5, 0.5]), torch.tensor([0.0, 1, 0])
    side = [camera(0.25 * torch.tensor([i, 0.0, j]) - corner, ahead) for i in range(5) for j in range(5)]
    views = Taken(side, room(4.0))
    assert not optical_axes_meet(side)
    off = initial_points(views, None, 300, rng()).means.div(4.0 * SIDES).abs().amax(1) - 1
    assert float(off.abs().median()) < 0.25


def test_cameras_without_a_common_place_ask_for_points() -> None:
    ahead = torch.tensor([1.0, 0, 0])
    back_to_back = [camera(0.5 * ahead, ahead), camera(-0.5 * ahead, -ahead)]
    with pytest.raises(DataError, match=r"model\.init\.points=FILE\.ply, or with ply_file_path"):
        initial_points(Taken(back_to_back, room(3.0)), None, 50, rng())


def test_which_axes_meet() -> None:
    around = [camera(4 * d / d.norm(), -d) for d in torch.randn((12, 3), generator=rng(), dtype=torch.float64)]
    assert optical_axes_meet(around)
    for cameras in (array(4, 0.3), turned(12, 0.7), turned(12, 0.0, 1e-7), around[:1]):
        assert not optical_axes_meet(cameras)
