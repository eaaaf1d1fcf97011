"""Trainings of random primitives on random images: what a step costs, without a scene to load."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Dataset, Pixels, PointCloud, View, ViewSet
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.render import RenderSettings
from neuprim.core.train.losses import photometric
from neuprim.core.train.settings import PopulationSettings, TrainSettings
from neuprim.core.train.trainer import Trainer
from neuprim.tasks.static.fields import SphericalHarmonics

__all__ = ["random_trainer"]

_FOV = math.radians(40.0)


class _Views(ViewSet):
    """Random images, from around the unit cube or from within it."""

    def __init__(self, count: int, size: int, inside: bool, seed: int) -> None:
        g = torch.Generator().manual_seed(seed)
        f = 0.5 * size / math.tan(_FOV / 2)
        self.cameras = []
        for _ in range(count):
            towards = torch.nn.functional.normalize(torch.randn(3, generator=g, dtype=torch.float64), dim=0)
            eye = 0.6 * (torch.rand(3, generator=g, dtype=torch.float64) - 0.5) if inside else -1.7 * towards
            up = torch.tensor([0.0, 0.0, 1.0] if abs(float(towards[2])) < 0.9 else [0.0, 1.0, 0.0], dtype=torch.float64)
            self.cameras.append(Camera(look_at(eye, eye + towards, up), f, f, size / 2, size / 2, size, size))
        self.image = torch.rand(size, size, 3, generator=g)

    def __len__(self) -> int:
        return len(self.cameras)

    def view(self, index: int) -> View:
        return View(str(index), self.cameras[index])

    def pixels(self, index: int) -> Pixels:
        return Pixels(self.image)


def random_trainer(
    primitives: int,
    size: int,
    overlap: float,
    degree: int = 3,
    views: int = 1,
    inside: bool = False,
    threads: int = 1,
    shard: bool = False,
) -> Trainer:
    """A fixed population of two neurons with a soft edge in the unit cube, in the middle of an endless budget, which
    nothing moves.

    Args:
        size: edge of the images in pixels.
        overlap: how many times the primitives would cover the cube's face.
        degree: of the colours' spherical harmonics.
        inside: whether cameras are within the cube and see a part of it; else around it.
    """
    sets = [_Views(count, size, inside, seed) for seed, count in enumerate((24, 1))]
    g = torch.Generator().manual_seed(2)
    means = torch.rand(primitives, 3, generator=g) - 0.5
    radius = math.sqrt(overlap / (primitives * math.pi))
    axes = radius * torch.exp(0.3 * torch.randn(primitives, 3, generator=g))
    colours = torch.rand(primitives, 3, generator=g)

    def start(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
        return PointCloud(means[:count], colours[:count])

    quats: Tensor = torch.randn(primitives, 4, generator=g)
    context = InitContext(means, torch.full((primitives,), radius), colours, g, {"alpha": 0.1}, axes=axes, quats=quats)
    model = Primitives.initialise(CosineDensity(2, edge=2, gain=True), SphericalHarmonics(degree, 3, 0.0), context)
    dataset = Dataset(
        name="random",
        train=sets[0],
        test=sets[1],
        start=start,
        extent=1.0,
        background=torch.zeros(3),
        data_source="generated",
    )
    still = {
        spec.name: 0.0 for spec in model.specs
    }  # a step costs the same and leaves the scene as it is, however many are taken
    population = PopulationSettings(strategy="fixed")
    settings = TrainSettings(iterations=10**9, views_per_step=views, shard=shard, rates=still, population=population)
    loss = photometric({"ssim_weight": settings.ssim_weight})
    return Trainer(model, dataset, loss, settings, RenderSettings(device="cpu", threads=threads), 0)
