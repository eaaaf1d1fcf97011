"""Forecast the duration of a training before its data are loaded, by a short training on noise images."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import torch

from neuprim.config import Job, RunConfig
from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Dataset, Pixels, PointCloud, PointSamples, View, ViewSet
from neuprim.core.data.dataset import PointSupervision
from neuprim.core.errors import NeuprimError
from neuprim.core.metrics import psnr, ssim
from neuprim.core.model.fields import ConditionSpec
from neuprim.plugins.registry import TASKS
from neuprim.runs.fit import make_run_loss, make_run_trainer, time_run_step, use_one_torch_thread_for_run
from neuprim.runs.measure import render_image

_LEAST_STEPS = 500  # a shorter training has no forecast
_POINTS = 4096  # voxels of the trial


@dataclass(frozen=True)
class Forecast:
    """Estimated durations in seconds, on this machine as busy as it is now: of the training, and of one held-out view.

    Early steps may be slower than the steps of the middle, which are timed, and population control takes time.
    """

    training: float
    view: float

    def describe(self, config: RunConfig, views: int | None = None) -> str:
        """Return the line for the user; ``views`` is the number of held-out views, None if it is not known yet."""
        steps = "" if config.train.iterations is None else f" ({config.train.iterations:,} steps)"
        training = f"{_format_about(self.training)} of training{steps}"
        if views is None:
            return f"forecast: images are loaded or rendered, then {training}"
        return f"forecast: {training}, then {_format_about(self.view * views)} of measuring {views:,} held-out views"


def _format_about(seconds: float) -> str:
    return f"about {seconds / 60:.0f} min" if seconds > 100 else f"about {max(seconds, 1.0):.0f} s"


def has_forecast(config: RunConfig) -> bool:
    """Return whether :func:`forecast_training` applies: to long trainings of the tasks of this package."""
    own = any(info.built_in and info.name == config.task for info in TASKS.list_plugins())
    long = config.train.iterations is None or config.train.iterations >= _LEAST_STEPS
    return own and long and config.model.primitives != "auto" and not config.resume


def forecast_training(config: RunConfig, width: int, height: int) -> Forecast | None:
    """Train for a few steps on noise images of the given size, and return the forecast.

    The steps have the settings of the middle of the run. The kernels must be compiled. Return None if the trial raises
    NeuprimError: noise does not suit the settings, or they are wrong, which the run itself reports.
    """
    try:
        return _time_steps_on_noise(config, width, height)
    except NeuprimError:
        return None


def _time_steps_on_noise(config: RunConfig, width: int, height: int) -> Forecast:
    job = Job.of(config)
    whole = replace(config.train, population=replace(config.train.population, grow_from=1.0))
    trial = Job(replace(config, train=whole), job.task)
    with torch.random.fork_rng(devices=[]), use_one_torch_thread_for_run():
        dataset = noise_dataset(trial, width, height, _POINTS)
        trainer = make_run_trainer(trial, dataset, make_run_loss(trial))
        trainer.step = (config.train.iterations or 0) // 2
        pace = time_run_step(trainer)
        truth = dataset.test.pixels(0).over(dataset.background)
        for _ in range(2):  # the first one may load code
            begin = time.monotonic()
            image = render_image(trainer.model, dataset.test.view(0), trainer.renderer, dataset.background)
            psnr(image, truth), ssim(image, truth)
            view = time.monotonic() - begin
    limits = [config.train.max_seconds, None if config.train.iterations is None else pace * config.train.iterations]
    return Forecast(min(limit for limit in limits if limit is not None), view)


# ---------------------------------------------------------------- noise


class _NoiseViews(ViewSet):
    """Two views. Their images are noise, and their cameras are about 3 units from the origin."""

    def __init__(self, size: tuple[int, int], channels: int, conditions: dict[str, torch.Tensor], opaque: bool) -> None:
        eyes = [torch.tensor([3.0, 0.0, 0.5]), torch.tensor([0.0, 3.0, 0.5])]
        up, middle = torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3)
        width, height = size
        lens = (width, width, width / 2, height / 2, width, height)
        cameras = [Camera(look_at(eye, middle, up), *lens) for eye in eyes]
        self._views = [View(f"noise {i}", camera, conditions) for i, camera in enumerate(cameras)]
        self._pixels = Pixels(torch.rand(height, width, channels), None if opaque else torch.ones(height, width))

    def __len__(self) -> int:
        return len(self._views)

    def view(self, index: int) -> View:
        return self._views[index]

    def pixels(self, index: int) -> Pixels:
        return self._pixels


class _NoisePoints(PointSupervision):
    """Source of random points with random extinction and source radiance."""

    def __init__(self, count: int, channels: int, conditions: dict[str, torch.Tensor]) -> None:
        self._count, self._channels, self._conditions = count, channels, conditions

    def draw(self, count: int, generator: torch.Generator) -> PointSamples:
        points, sigma = torch.rand(self._count, 3) - 0.5, torch.rand(self._count)
        source = torch.rand(self._count, self._channels)
        return PointSamples("noise", self._conditions, points, sigma, source, 1.0)


def noise_dataset(job: Job, width: int, height: int, points: int) -> Dataset:
    """Return a data set for a job's task: noise images and, for voxel files, random ``points`` with extinction.

    The value of a condition with one number, e.g. the time, is the middle of its range. Lights are outside the points.
    """
    voxels, channels = job.scene.spec.volume is not None, len(job.task.channels) or 3
    conditions: list[ConditionSpec] = [spec for spec in job.task.conditions if spec.of_scene(job.config.scene)]
    values = {
        spec.name: torch.full(spec.shape, sum(spec.range) / 2 + (3.0 if spec.shape else 0.0), dtype=torch.float64)
        for spec in conditions
    }
    opaque = job.config.train.exposure_rate > 0  # learned exposures need photographs
    views = _NoiseViews((width, height), channels, values, opaque)

    def start(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
        means = torch.rand(count, 3, generator=generator) - 0.5
        scalars = {name: value.expand(count).clone() for name, value in values.items() if not value.dim()}
        return PointCloud(means, torch.rand(count, channels, generator=generator), scalars)

    return Dataset(
        name="noise", train=views, test=views, start=start, extent=3.0, background=torch.zeros(channels),
        channels=channels, data_source="generated", bounds=torch.tensor([[-0.5] * 3, [0.5] * 3]),
        largest=10.0 if voxels else None, points=_NoisePoints(points, channels, values) if voxels else None,
    )  # fmt: skip
