"""A data set of two known primitives, small enough to fit in a second, in memory and on disk."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Dataset, Pixels, PointCloud, View, ViewSet, camera_extent
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.train.distributed_trainer import DistributedTrainer
from neuprim.core.train.initial_model import initial_model_to_train
from neuprim.core.train.losses import photometric
from neuprim.core.train.process_group import ProcessGroup
from neuprim.core.train.settings import ModelSettings, PopulationSettings, TrainSettings
from neuprim.core.train.trainer import Trainer
from neuprim.tasks.static import SphericalHarmonics

SIZE = 24


def truth() -> LoweredPrimitives:
    """A red and a blue ellipsoid side by side."""
    geometry = Geometry(
        torch.tensor([[-0.35, 0.0, 0.0], [0.4, 0.1, 0.05]]),
        torch.tensor([[0.4, 0.25, 0.3], [0.3, 0.35, 0.25]]).log(),
        torch.tensor([[1.0, 0.1, 0.2, 0.0], [0.9, 0.0, -0.3, 0.2]]),
    )
    flat = Cosine(torch.zeros(2, 0, 3), torch.zeros(2, 0), torch.zeros(2, 0), torch.tensor([[2.5], [2.0]]))
    return LoweredPrimitives(geometry, flat, Constant(torch.tensor([[0.9, 0.15, 0.1], [0.1, 0.3, 0.85]])))


def camera(angle: float, height: float) -> Camera:
    eye = torch.tensor([2.2 * math.cos(angle), 2.2 * math.sin(angle), height])
    view = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    f = 0.5 * SIZE / math.tan(0.3)
    return Camera(view, f, f, SIZE / 2, SIZE / 2, SIZE, SIZE)


class Views(ViewSet):
    def __init__(self, count: int, start: float) -> None:
        self.cameras = [camera(start + 2 * math.pi * i / count, 0.8 * math.sin(2.0 * i)) for i in range(count)]
        settings = RenderSettings(backend="reference", alpha_min=0.0)
        frames = [render_lowered(truth(), c, settings) for c in self.cameras]
        self.images = [Pixels(f.rgb.contiguous(), f.alpha.contiguous()) for f in frames]

    def __len__(self) -> int:
        return len(self.cameras)

    def view(self, index: int) -> View:
        return View(f"v{index}", self.cameras[index])

    def pixels(self, index: int) -> Pixels:
        return self.images[index]


def two_primitives(
    random_background: bool = False, views: Callable[[int, float], Views] = Views, **changes: Any
) -> Dataset:
    """The two known primitives; ``views(count, start)`` makes the sets, ``changes`` are members of the data set."""
    train, test = views(6, 0.0), views(2, 0.4)
    members: dict[str, Any] = {
        "name": "two",
        "train": train,
        "test": test,
        "start": near_the_truth,
        "extent": camera_extent([train.view(i).camera for i in range(6)]),
        "background": torch.ones(3),
        "random_background": random_background,
        "data_source": "generated",
    }
    return Dataset(**{**members, **changes})


def near_the_truth(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
    side = torch.arange(count) % 2
    means = truth().geometry.means[side] + 0.2 * (torch.rand(count, 3, generator=generator) - 0.5)
    return PointCloud(means, torch.full((count, 3), 0.5))


def trainer(
    dataset: Dataset, iterations: int = 40, seed: int = 0, group: ProcessGroup | None = None, **changes: Any
) -> Trainer:
    """A fresh trainer of 12 primitives; ``changes`` go to the train settings, ``population`` as a dictionary."""
    population = PopulationSettings(
        **{"strategy": "fixed", "every": 7, "start": 0.0, "stop": 1.0, **changes.pop("population", {})}
    )
    settings = TrainSettings(iterations=iterations, **changes, population=population)
    model = initial_model_to_train(
        CosineDensity(4), SphericalHarmonics(1, 3, 0.25), dataset, ModelSettings(primitives=12), seed
    )
    parts = model, dataset, photometric({"ssim_weight": settings.ssim_weight}), settings, RenderSettings(), seed
    return Trainer(*parts) if group is None else DistributedTrainer(*parts, group)


def write_blender(folder: Path) -> Path:
    """The same scene as a NeRF-synthetic folder: 6 training and 2 test views with alpha."""
    dataset = two_primitives()
    for split, views in (("train", dataset.train), ("test", dataset.test)):
        (folder / split).mkdir(parents=True, exist_ok=True)
        frames = []
        for i in range(len(views)):
            Image.fromarray(_rgba(views.pixels(i)), "RGBA").save(folder / split / f"r_{i}.png")
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": _opengl(views.view(i).camera)})
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    return folder


def _rgba(pixels: Pixels) -> np.ndarray[Any, Any]:
    assert pixels.alpha is not None
    straight = pixels.rgb / pixels.alpha[..., None].clamp_min(1e-6)
    both = torch.cat([straight, pixels.alpha[..., None]], -1)
    result: np.ndarray[Any, Any] = (both.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    return result


def _opengl(camera: Camera) -> list[list[float]]:
    pose: Tensor = torch.linalg.inv(camera.viewmat)
    pose[:3, 1:3] *= -1
    result: list[list[float]] = pose.tolist()
    return result
