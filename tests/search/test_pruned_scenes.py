"""Models end no larger than their scenes: a still sequence without time, matte things without bands, soft blobs without
cosines."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from neuprim.config import RunConfig, compose
from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Dataset, Pixels, PointCloud, View, ViewSet, camera_extent
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import LoweredPrimitives, Primitives
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.plugins.registry import load_task
from neuprim.runs.fit import prepare_training, train_to_end
from neuprim.search.pruning import ModelShrinker

SIZE = 24


class Blobs(ViewSet):
    """Three soft blobs from all sides, as a camera with some noise sees them, and where there is time, the same at all
    times."""

    def __init__(self, count: int, begin: float, times: bool) -> None:
        self.cameras = [_camera(begin + 2.4 * i, 0.7 * math.sin(1.7 * i)) for i in range(count)]
        self.times = [torch.tensor(i * 0.37 % 1.0) for i in range(count)] if times else None
        frames = [render_lowered(_truth(), camera, RenderSettings(alpha_min=0.0, threads=1)) for camera in self.cameras]
        generator = torch.Generator().manual_seed(count)
        self.images = [
            Pixels(f.rgb + (1 - f.alpha)[..., None] + 0.01 * torch.randn(f.rgb.shape, generator=generator))
            for f in frames
        ]

    def __len__(self) -> int:
        return len(self.cameras)

    def view(self, index: int) -> View:
        conditions = {} if self.times is None else {"time": self.times[index]}
        return View(f"v{index}", self.cameras[index], conditions)

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
    times = {"time": torch.rand(count, generator=generator)} if views.view(0).conditions else {}
    return PointCloud(means, torch.full((count, 3), 0.5), times)


def dataset(times: bool) -> Dataset:
    train, test = Blobs(48, 0.0, times), Blobs(4, 0.5, times)
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


def pruned(task: str, *words: str, steps: int = 2400) -> tuple[Primitives, Primitives, tuple[str, ...], ModelShrinker]:
    """A model that could do more than its scene asks for, what is left of it, and what its fields do with less of."""
    scene = {"static": "solids", "dynamic": "smoke_fire"}[task]
    common = ["model.primitives=24", "train.max_seconds=null", "train.eval_every=0", "renderer.threads=1"]
    config: RunConfig = compose([f"task={task}", f"scene={scene}", *common, *words], check_output=False)
    data = dataset(task == "dynamic")
    fitted = train_to_end(prepare_training(config, dataset=data))
    shrinker = ModelShrinker(
        replace(config, output_dir=config.output_dir / "none"), load_task(task), data, tolerance=0.5, steps=steps
    )
    small, less = shrinker.shrink(fitted.model)
    assert shrinker.quality(small) >= shrinker.base - shrinker.tolerance - 1e-6 and shrinker.base > 33.0
    return fitted.model, small, less, shrinker


def test_what_is_matte_ends_without_bands_and_what_is_soft_with_few_cosines() -> None:
    words = ("train.iterations=500", "model.neurons=4", "model.sh_degree=3", "seed=0")
    _, small, less, _ = pruned("static", *words, steps=9000)
    assert small.colour.settings()["degree"] == 0 and less.count("colour.degree=0") == 1
    neurons = small.density.settings()["neurons"]
    assert neurons <= 2 and [word for word in less if word.startswith("density.neurons")] == [
        f"density.neurons={neurons}"
    ]
    assert small.count <= 16, "three blobs, of 24 primitives"


def test_what_is_still_ends_without_time() -> None:
    model, small, _, _ = pruned("dynamic", "train.iterations=1000", "train.supervision=images", "train.ssim_weight=0.0")
    assert model.density.settings()["time"] == "window+motion"
    assert small.density.settings()["time"] == "none"
    assert not {"window_center", "log_window", "velocity", "acceleration"} & small.params.keys()
