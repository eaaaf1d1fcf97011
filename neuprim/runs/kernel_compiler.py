"""Compile the CPU kernels of a run in a second process, while the first process generates or reads the images.

Compiling takes about a minute on one core, once per installation and task. The second process trains a few primitives
on noise images for one step. The first process then reads the compiled code from the kernel cache on disk.
"""

from __future__ import annotations

import atexit
import json
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import torch

from neuprim.config import Job, RunConfig
from neuprim.core.cameras import Camera, look_at
from neuprim.core.compute import device
from neuprim.core.compute.kernels import cache_directory, sources_hash
from neuprim.core.compute.threads import core_count
from neuprim.core.data import Dataset, Pixels, PointCloud, PointSamples, View, ViewSet
from neuprim.core.data.dataset import PointSupervision
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.render.cpu import backend
from neuprim.plugins.registry import TASKS
from neuprim.runs.fit import Events, Preparing, compile_run_kernels, make_run_loss, make_run_trainer

_SIZE, _PRIMITIVES, _POINTS = 32, 64, 64  # of the noise: pixels a side, primitives and points


class KernelCompiler:
    """Second process that compiles the CPU kernels of a run while the first process loads the data.

    The process only starts for a built-in task whose kernels no run has compiled before. It does not start on a machine
    with only one core, or if torch finds a CUDA device.

    Args:
        config: configuration of the run.
    """

    def __init__(self, config: RunConfig) -> None:
        self._marker = _marker(config.task)
        self._process: subprocess.Popen[bytes] | None = None
        own = any(info.built_in and info.name == config.task for info in TASKS.list_plugins())
        if not own or self._marker.exists() or core_count() < 2 or device.cuda_unavailable() is None:
            return
        command = [sys.executable, "-m", "neuprim.runs.kernel_compiler"]
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet)
        atexit.register(self._process.terminate)
        assert self._process.stdin is not None
        with suppress(BrokenPipeError), self._process.stdin as pipe:  # it may have failed already
            pipe.write(json.dumps(config.to_dict()).encode())

    def wait(self, events: Events) -> None:
        """Wait until the compiling process has ended; otherwise this process would compile the same kernels again."""
        if self._process is not None and self._process.poll() is None:
            events(Preparing("compiling kernels; once per installation this takes about a minute"))
            self._process.wait()

    def finish(self) -> None:
        """Create the marker file that says that the kernels of this task are compiled."""
        self._marker.touch()


def _marker(task: str) -> Path:
    """Return the path of a marker file, which exists if the kernels of this version were compiled for ``task``.

    There is one marker for all models of a task, because they share most kernels.
    """
    return cache_directory() / f"compiled-{sources_hash(Path(backend.__file__))}-{task}"


# ---------------------------------------------------------------- the second process


class _NoiseViews(ViewSet):
    """Two views for compiling kernels. Their images are noise, and their cameras are about 3 units from the origin."""

    def __init__(self, channels: int, conditions: dict[str, torch.Tensor]) -> None:
        eyes = [torch.tensor([3.0, 0.0, 0.5]), torch.tensor([0.0, 3.0, 0.5])]
        up, middle = torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3)
        half = _SIZE / 2
        cameras = [Camera(look_at(eye, middle, up), _SIZE, _SIZE, half, half, _SIZE, _SIZE) for eye in eyes]
        self._views = [View(f"noise {i}", camera, conditions) for i, camera in enumerate(cameras)]
        self._pixels = Pixels(torch.rand(_SIZE, _SIZE, channels), torch.ones(_SIZE, _SIZE))

    def __len__(self) -> int:
        return len(self._views)

    def view(self, index: int) -> View:
        return self._views[index]

    def pixels(self, index: int) -> Pixels:
        return self._pixels


class _NoisePoints(PointSupervision):
    """Source of random points with random extinction and source radiance, for compiling kernels."""

    def __init__(self, channels: int, conditions: dict[str, torch.Tensor]) -> None:
        self._channels, self._conditions = channels, conditions

    def draw(self, count: int, generator: torch.Generator) -> PointSamples:
        points, sigma = torch.rand(_POINTS, 3) - 0.5, torch.rand(_POINTS)
        source = torch.rand(_POINTS, self._channels)
        return PointSamples("noise", self._conditions, points, sigma, source, 1.0)


def _noise_dataset(conditions: list[ConditionSpec], channels: int, voxels: bool) -> Dataset:
    """Return a data set for compiling kernels: noise images, and random points with extinction if ``voxels``.

    The value of each condition (e.g. the time) is the middle of the condition's range.
    """
    values = {spec.name: torch.full(spec.shape, 0.5 * sum(spec.range), dtype=torch.float64) for spec in conditions}
    views = _NoiseViews(channels, values)

    def start(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
        means = torch.rand(count, 3, generator=generator) - 0.5
        scalars = {name: value.expand(count).clone() for name, value in values.items() if not value.dim()}
        return PointCloud(means, torch.rand(count, channels, generator=generator), scalars)

    return Dataset(
        name="noise", train=views, test=views, start=start, extent=3.0, background=torch.zeros(channels),
        channels=channels, data_source="generated", bounds=torch.tensor([[-0.5] * 3, [0.5] * 3]),
        largest=10.0 if voxels else None, points=_NoisePoints(channels, values) if voxels else None,
    )  # fmt: skip


def _compile(config: RunConfig) -> None:
    job = Job.of(config)
    volume = job.scene.spec.volume is not None
    conditions = [spec for spec in job.task.conditions if spec.of_scene(config.scene)]
    dataset = _noise_dataset(conditions, len(job.task.channels) or 3, volume)
    small = replace(config, model=replace(config.model, primitives=_PRIMITIVES))
    compile_run_kernels(make_run_trainer(Job(small, job.task), dataset, make_run_loss(job)))


if __name__ == "__main__":
    _compile(RunConfig.from_dict(json.load(sys.stdin)))
