"""A tiny data set for tasks that bring none: ellipsoids of constant density, seen by a ring of cameras under random
conditions."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Dataset, Pixels, PointCloud, View, ViewSet, camera_extent
from neuprim.core.model.fields import ConditionSpec, Constant, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.backends import REFERENCE

__all__ = ["between", "example", "ring_camera", "sample"]

WIDTH, HEIGHT = 10, 9  # below the window of SSIM, which then costs nothing
DISTANCE = 2.5
_NEAR_ZERO = 3.0  # conditions without bounds worth the name (a light's place) are drawn from within this of zero


def between(spec: ConditionSpec) -> tuple[float, float]:
    """The part of a condition's range that checks draw from."""
    low, high = max(spec.range[0], -_NEAR_ZERO), min(spec.range[1], _NEAR_ZERO)
    return (low, high) if low < high else spec.range


def sample(spec: ConditionSpec, generator: torch.Generator) -> Tensor:
    """A value of the condition's shape, float32, uniform in :func:`between`."""
    low, high = between(spec)
    return low + (high - low) * torch.rand(spec.shape, generator=generator)


def ring_camera(angle: float, height: float, distance: float = DISTANCE) -> Camera:
    """A camera on a ring around the origin, which it looks at."""
    eye = distance * torch.tensor([math.cos(angle), math.sin(angle), height], dtype=torch.float64)
    focal = 0.5 * WIDTH / math.tan(0.35)
    return Camera(
        look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])), focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT
    )


class _Views(ViewSet):
    def __init__(
        self,
        split: str,
        cameras: list[Camera],
        conditions: tuple[ConditionSpec, ...],
        generator: torch.Generator,
        channels: int,
    ) -> None:
        self.views = [
            View(f"{split}{i}", c, {s.name: sample(s, generator) for s in conditions}) for i, c in enumerate(cameras)
        ]
        settings = RenderSettings(backend=REFERENCE)
        frames = [render_lowered(_truth(channels), c, settings) for c in cameras]
        self.images = [Pixels(f.rgb, f.alpha) for f in frames]

    def __len__(self) -> int:
        return len(self.views)

    def view(self, index: int) -> View:
        return self.views[index]

    def pixels(self, index: int) -> Pixels:
        return self.images[index]


def example(conditions: tuple[ConditionSpec, ...], channels: int = 3) -> Dataset:
    """Six training and two test views of 10 x 9 pixels, background grey, sRGB; conditions and channels as the task
    declares them."""
    generator = torch.Generator().manual_seed(7)
    ring = [ring_camera(1.1 * i, 0.6 * math.sin(2.0 * i)) for i in range(8)]
    train, test = (_Views(n, c, conditions, generator, channels) for n, c in (("train", ring[:6]), ("test", ring[6:])))

    def start(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
        means = 1.4 * (torch.rand(count, 3, generator=generator) - 0.5)
        found = {}
        for spec in conditions:
            if spec.shape == ():
                low, high = between(spec)
                found[spec.name] = low + (high - low) * torch.rand(count, generator=generator)
        return PointCloud(means, 0.2 + 0.6 * torch.rand(count, channels, generator=generator), found)

    return Dataset(
        name="conformance example",
        train=train,
        test=test,
        start=start,
        extent=camera_extent(ring[:6]),
        background=torch.full((channels,), 0.3),
        channels=channels,
        data_source="generated",
        bounds=torch.tensor([[-0.8] * 3, [0.8] * 3]),
    )


def _truth(channels: int) -> Lowered:
    geometry = Geometry(
        torch.tensor([[-0.35, 0.0, 0.0], [0.4, 0.1, 0.05], [0.0, -0.2, 0.4]]),
        torch.tensor([[0.4, 0.25, 0.3], [0.3, 0.35, 0.25], [0.2, 0.3, 0.2]]).log(),
        torch.tensor([[1.0, 0.1, 0.2, 0.0], [0.9, 0.0, -0.3, 0.2], [1.0, 0.0, 0.0, 0.0]]),
    )
    flat = Cosine(torch.zeros(3, 0, 3), torch.zeros(3, 0), torch.zeros(3, 0), torch.tensor([[2.5], [2.0], [1.5]]))
    colours = torch.tensor([[0.9, 0.15, 0.1], [0.1, 0.3, 0.85], [0.2, 0.7, 0.3]])
    return Lowered(geometry, flat, Constant(colours[:, torch.arange(channels) % 3]))
