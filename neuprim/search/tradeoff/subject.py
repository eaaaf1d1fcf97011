"""What is measured: a run's model and some of its held-out views, and the images that it is compared with."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from neuprim.config import RunConfig, suspects_of
from neuprim.core.channels import Channels, channels_of
from neuprim.core.data import Dataset, View
from neuprim.core.errors import BackendUnavailable, ConfigError, DataError
from neuprim.core.metrics import psnr
from neuprim.core.metrics.lpips import Lpips
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import backends
from neuprim.core.task import TaskSpec
from neuprim.plugins.blame import Suspects
from neuprim.runs.open import load_dataset, load_run, model_file, move_to_render_device
from neuprim.runs.render_config import RenderConfig, parse_render_config
from neuprim.search.tradeoff.knobs import Candidate
from neuprim.search.truths import Truth, truths_of

__all__ = ["Exact", "Subject", "exact_images", "load_subject"]

_EQUAL = 400.0
"""dB that stand for equal images, as JSON has no infinity."""

_SMALL = 48
"""Pixels on the longer side of the image that tells how exact, and how slow, an exact image is."""


@dataclass
class Subject:
    """A run as it is measured.

    Attributes:
        reference: the point that others are compared with: how the run draws, and what was asked for over that.
        file: the model's.
    """

    run_dir: Path
    config: RunConfig
    task: TaskSpec
    model: Primitives
    dataset: Dataset
    channels: Channels
    suspects: Suspects
    reference: RenderConfig
    truths: list[Truth]
    file: Path
    lpips: Lpips | None = None

    @property
    def background(self) -> Tensor:
        return self.dataset.background

    @property
    def double(self) -> Primitives:
        """The model in float64."""
        return Primitives(
            self.model.density, self.model.colour, {n: v.detach().double() for n, v in self.model.params.items()}
        )

    def small(self, longer: int) -> View:
        """The first view with at most so many pixels on its longer side."""
        view = self.truths[0].view
        width, height = view.camera.width, view.camera.height
        scale = min(1.0, longer / max(width, height))
        return replace(view, camera=view.camera.resized(max(1, round(scale * width)), max(1, round(scale * height))))

    def words(self, point: RenderConfig) -> tuple[str, ...]:
        """What reproduces a point with ``neuprim render`` or ``neuprim eval``."""
        return point.to_overrides(self.config.renderer)

    def prepared(self, point: RenderConfig) -> Primitives:
        """The model as a point draws it, where its frames are drawn."""
        return move_to_render_device(point.prepare_model(self.model), point.settings, self.truths[0].view)

    def fault(self, point: RenderConfig) -> str | None:
        """Why a point cannot be drawn here; None if it can."""
        view = point.scale_view(self.truths[0].view)
        try:
            backends.check_backend_device(point.settings)
            model = self.prepared(point)
            backends.choose_backend(model.lower_unchecked(view.camera, view.conditions), point.settings, view.camera)
        except (BackendUnavailable, ConfigError) as error:
            return str(error)
        return None

    def backend(self, point: RenderConfig) -> backends.Backend:
        """Which one draws it."""
        model, view = self.prepared(point), self.truths[0].view
        return backends.choose_backend(model.lower_unchecked(view.camera, view.conditions), point.settings, view.camera)

    def differs(self, candidate: Candidate) -> bool:
        """Whether a backend's point is drawn by another one than the reference."""
        return candidate.knob != "backend" or self.backend(candidate.point).name != self.backend(self.reference).name


def load_subject(
    run_dir: Path,
    words: Sequence[str],
    views: int,
    lpips: str | Path | None = None,
    shown: tuple[Dataset, list[Truth]] | None = None,
) -> Subject:
    """A finished run with ``views`` of its held-out views, evenly spread.

    Args:
        words: of the operating point that is the reference, over how the run draws.
        lpips: weights for LPIPS; without, those that the run names.
        shown: the run's data set and the views to measure on, if they are loaded already.

    Raises:
        NeuprimError: no such run, no held-out views, or words that do not fit.
    """
    config, task, model, _ = load_run(run_dir)
    reference = parse_render_config(words, config.renderer, model)
    weights = lpips or config.metrics.lpips
    distance = None if weights is None else Lpips.load(weights)
    suspects = suspects_of(config)
    if shown is None:
        dataset = load_dataset(config, task, run_dir=run_dir)
        shown = dataset, truths_of(dataset, views)
    dataset, truths = shown
    suspects.know(dataset)
    if not truths:
        raise DataError(f"{run_dir}: {dataset.name} has no held-out views; expected some to measure on")
    channels, file = channels_of(task, dataset), model_file(run_dir)
    return Subject(run_dir, config, task, model, dataset, channels, suspects, reference, truths, file, distance)


# ---------------------------------------------------------------- exact images


@dataclass(frozen=True)
class Exact:
    """What the model shows when nothing is cut: no faint pair and no hidden one left out.

    Attributes:
        images: (H, W, C) float64, one per view.
        float64: whether the reference backend drew them from float64 parameters. Else the reference point's backend
        did, in float32, and
            ``error`` is how close it comes, dB, in an image of ``checked`` pixels.
        seconds: that an image took; oracle_seconds: that one of the reference backend takes, about.
    """

    images: list[Tensor]
    float64: bool
    error: float | None
    checked: tuple[int, int]
    seconds: float
    oracle_seconds: float

    def record(self) -> dict[str, Any]:
        """JSON-able facts."""
        how = "reference backend, float64" if self.float64 else "nothing cut, float32"
        known = {
            "psnr_against_float64": self.error,
            "checked_size": list(self.checked),
            "oracle_seconds": self.oracle_seconds,
        }
        return {"drawn_by": how, "float64": self.float64, **known}


def exact_images(subject: Subject, allowed: float, float64: bool | None = None) -> Exact:
    """The exact images of all views: by the float64 oracle where ``allowed`` seconds are enough for it, else by the
    reference point's own backend without any cut, whose error against the oracle is measured on one small image.

    The opacity clamp, the order and the rays per pixel are the reference point's: they say what is drawn, not how
    exactly.

    Args:
        float64: which of both, where that is decided already.
    """
    settings = replace(subject.reference.settings, alpha_min=0.0, transmittance_min=0.0)
    uncut = RenderConfig(settings)
    oracle = RenderConfig(replace(settings, backend=backends.REFERENCE, device="auto"))
    double, small = subject.double, subject.small(_SMALL)
    background = subject.background.double()
    size = (small.camera.width, small.camera.height)
    start = time.perf_counter()
    check = oracle.render_view(double, small, background)
    pixels = sum(t.view.camera.width * t.view.camera.height for t in subject.truths) / len(subject.truths)
    slow = (time.perf_counter() - start) * pixels / (size[0] * size[1])
    start = time.perf_counter()
    if float64 or (float64 is None and slow * len(subject.truths) <= allowed):
        images = [oracle.render_view(double, t.view, background) for t in subject.truths]
        seconds = (time.perf_counter() - start) / len(images)
        return Exact(images, True, None, size, seconds, seconds)
    model = subject.prepared(uncut)
    images = [uncut.render_view(model, t.view, subject.background).double() for t in subject.truths]
    seconds = (time.perf_counter() - start) / len(images)
    error = min(psnr(uncut.render_view(model, small, subject.background).double(), check), _EQUAL)
    return Exact(images, False, error, size, seconds, slow)
