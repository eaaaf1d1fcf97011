"""Models end no larger than their scenes: a still sequence without time."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from neuprim.config import compose
from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Dataset, Pixels, PointCloud, View, ViewSet, camera_extent
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.plugins.registry import load_task
from neuprim.runs.fit import prepare_training, train_to_end
from neuprim.search.pruning import ModelShrinker

SIZE = 24


class Blobs(ViewSet):
    """Three soft blobs from all sides, as a camera with some noise sees them, the same at all times."""

    def __init__(self, count: int, begin: float) -> None:
        self.cameras = [_camera(begin + 2.4 * i, 0.7 * math.sin(1.7 * i)) for i in range(count)]
        frames = [render_lowered(_truth(), camera, RenderSettings(alpha_min=0.0, threads=1)) for camera in self.cameras]
        generator = torch.Generator().manual_seed(count)
        self.images = [
            Pixels(f.rgb + (1 - f.alpha)[..., None] + 0.01 * torch.randn(f.rgb.shape, generator=generator))
            for f in frames
        ]

    def __len__(self) -> int:
        return len(self.cameras)

    def view(self, index: int) -> View:
        return View(f"v{index}", self.cameras[index], {"time": torch.tensor(index * 0.37 % 1.0)})

    def pixels(self, index: int) -> Pixels:
        return self.images[index]


def _truth() -> LoweredPrimitives:
    means = torch.tensor([[-0.4, 0.0, 0.0], [0.35, 0.2, 0.1], [0.1, -0.4, -0.2]])
    geometry = Geometry(
        means, torch.tensor([[0.5, 0.4, 0.45]]).log().repeat(3, 1), torch.tensor([[1.0, 0.1, 0.0, 0.2]]).repeat(3, 1)
    )
    flat = Cosine(
        torch.zeros(3, 0, 3), torch.zeros(3, 0), torch.zeros(3, 0), torch.tensor([[3.0], [2.0], [4.0]]), edge=2
    )
    return LoweredPrimitives(
        geometry, flat, Constant(torch.tensor([[0.9, 0.2, 0.1], [0.2, 0.7, 0.3], [0.1, 0.3, 0.9]]))
    )


def _camera(angle: float, height: float) -> Camera:
    eye = torch.tensor([2.4 * math.cos(angle), 2.4 * math.sin(angle), height])
    f = 0.5 * SIZE / math.tan(0.32)
    return Camera(look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])), f, f, SIZE / 2, SIZE / 2, SIZE, SIZE)


def _near(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
    side = torch.arange(count) % 3
    means: Tensor = _truth().geometry.means[side] + 0.3 * (torch.rand(count, 3, generator=generator) - 0.5)
    return PointCloud(means, torch.full((count, 3), 0.5), {"time": torch.rand(count, generator=generator)})


def dataset() -> Dataset:
    train, test = Blobs(48, 0.0), Blobs(4, 0.5)
    extent = camera_extent([train.view(i).camera for i in range(len(train))])
    return Dataset(
        name="blobs",
        train=train,
        test=test,
        start=_near,
        extent=extent,
        background=torch.ones(3),
        data_source="generated",
    )


def test_what_is_still_ends_without_time() -> None:
    words = ["task=dynamic", "scene=smoke_fire", "model.primitives=24", "train.max_seconds=null", "train.eval_every=0"]
    words += ["train.iterations=1000", "train.supervision=images", "train.ssim_weight=0.0", "renderer.threads=1"]
    config, data = compose(words, check_output=False), dataset()
    model = train_to_end(prepare_training(config, dataset=data)).model
    config = replace(config, output_dir=config.output_dir / "none")
    shrinker = ModelShrinker(config, load_task("dynamic"), data, tolerance=0.5, steps=2400)
    small, _ = shrinker.shrink(model)
    assert shrinker.quality(small) >= shrinker.base - shrinker.tolerance - 1e-6 and shrinker.base > 33.0
    assert model.density.settings()["time"] == "window+motion"
    assert small.density.settings()["time"] == "none"
    assert not {"window_center", "log_window", "velocity", "acceleration"} & small.params.keys()
