"""Measure the quality of models that searches compare: on test views, or on training views for pruning and
compression."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuprim.config import RunConfig
from neuprim.core.data import Dataset, PointSamples, PointSupervision, View
from neuprim.core.data.dataset_check import check_pixels
from neuprim.core.metrics import psnr, ssim
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.core.volumes.points import volume_values_at
from neuprim.runs.measure import render_image

MAX_PSNR = 200.0  # dB that stand for equal images, as JSON has no infinity


@dataclass(frozen=True)
class EvalView:
    """A test view, its (H, W, C) ground truth composited over the background, and an (H, W) mask of valid pixels.

    The mask is None if all pixels are valid.
    """

    view: View
    image: Tensor
    mask: Tensor | None


class EvalQuality(NamedTuple):
    """Mean PSNR and SSIM over evaluation views, in the data set's colour space, and median milliseconds per frame."""

    psnr: float
    ssim: float
    ms_per_frame: float


def choose_trial_views(dataset: Dataset, views: int) -> list[EvalView]:
    """Return at most ``views`` test views, evenly spread over all test views."""
    most, chosen = min(views, len(dataset.test)), []
    for i in (k * len(dataset.test) // most for k in range(most)):
        view, pixels = dataset.test.view(i), dataset.test.pixels(i)
        check_pixels("test", view, pixels, dataset.channels)
        chosen.append(EvalView(view, pixels.over(dataset.background), pixels.mask))
    return chosen


def fill_masked(image: Tensor, view: EvalView) -> Tensor:
    """Return ``image``, with the pixels outside the view's mask replaced by the ground truth."""
    return image if view.mask is None else torch.where(view.mask[..., None], image, view.image.to(image))


def measure_trial_views(
    model: Primitives, views: Sequence[EvalView], settings: RenderSettings, background: Tensor
) -> EvalQuality:
    """Render all views with a model; return the mean quality against the ground truth, and the render time."""
    render_image(model, views[0].view, settings, background)  # the first frame loads and compiles
    rows, seconds = [], []
    for one in views:
        start = time.perf_counter()
        image = render_image(model, one.view, settings, background)
        seconds.append(time.perf_counter() - start)
        image = fill_masked(image, one)
        rows.append((min(psnr(image, one.image, one.mask), MAX_PSNR), ssim(image, one.image)))
    means = [statistics.fmean(column) for column in zip(*rows, strict=True)]
    return EvalQuality(means[0], means[1], 1e3 * statistics.median(seconds))


# ---------------------------------------------------------------- training views

_VIEWS, _QUICK_VIEWS = 24, 8  # views that decide, and how many of them intermediate evaluations use
_SENSITIVITY_VIEWS = 160  # views for sensitivities, at most; primitives of a short time or a corner are in few views

_FRAMES, _QUICK_FRAMES, _POINTS = 64, 8, 4096
"""Largest number of frames in which the extinction is compared with voxels; number of frames that quick evaluations
use; number of points per frame."""

_DRAWS_PER_FRAME = 6  # number of draws over that of frames; each draw is of a random frame, and these find most


class SearchQuality:
    """Quality measure that a search maximises: the mean PSNR of training views. For a run trained on voxels, the error
    of the extinction inside the volume counts, too.

    Views are chosen at random, because training views are often ordered by camera or time.

    Attributes:
        views: indices of the training views whose PSNR is measured.
        others: indices of other training views, used to estimate the effect of parameters on images.
        draws: sets of points with known extinction, one set per frame; empty unless the run was trained on voxels.
    """

    def __init__(self, dataset: Dataset, settings: RenderSettings, inside: bool = False) -> None:
        self.dataset, self.settings = dataset, settings
        order = torch.randperm(len(dataset.train), generator=torch.Generator().manual_seed(0)).tolist()
        decide = min(_VIEWS, max(len(order) // 2, 1))
        self.views, self.others = order[:decide], order[decide : decide + _SENSITIVITY_VIEWS] or order[:decide]
        self.draws = _draw_search_quality_points(dataset.points) if inside and dataset.points is not None else []
        self._offset: float | None = None

    @classmethod
    def of_run(cls, config: RunConfig, dataset: Dataset) -> SearchQuality:
        """Return the quality measure of a run. For a run trained on voxels, errors of the extinction count, too."""
        return cls(dataset, config.renderer, config.train.supervision != "images")

    def __call__(self, model: Primitives, quick: bool = False) -> float:
        """Return a model's quality in dB: the smaller of the PSNR of images and the shifted PSNR of the extinction.

        The shift makes both values equal for the first model that this object evaluates. Without voxels, return the
        PSNR of images.

        Args:
            quick: evaluate fewer views and frames.
        """
        images = self.image_quality(model, quick)
        if not self.draws:
            return images
        inside = self.inside_quality(model, quick and self._offset is not None)
        if self._offset is None:
            self._offset = images - inside
        return min(images, inside + self._offset)

    def image_quality(self, model: Primitives, quick: bool = False) -> float:
        """Return the mean PSNR of the model's images of :attr:`views`; ``quick`` uses only some of the views."""
        step = max(len(self.views) // _QUICK_VIEWS, 1) if quick else 1
        values = []
        for index in self.views[::step]:
            pixels = self.dataset.train.pixels(index)
            image = render_image(model, self.dataset.train.view(index), self.settings, self.dataset.background)
            values.append(min(psnr(image, pixels.over(self.dataset.background), pixels.mask), MAX_PSNR))
        return float(np.mean(values))

    def inside_quality(self, model: Primitives, quick: bool = False) -> float:
        """Return the mean PSNR of the extinction over frames, dB. The peak is a typical extinction of the frame."""
        values = []
        with torch.no_grad():
            for samples in self.draws[:: max(len(self.draws) // _QUICK_FRAMES, 1) if quick else 1]:
                sigma = volume_values_at(
                    model, samples.conditions, samples.points, False, self.settings.threads
                ).sigma.cpu()
                error = float(((sigma - samples.sigma) / samples.sigma_scale).square().mean())
                values.append(-10 * math.log10(max(error, 1e-20)))
        return float(np.mean(values))

    def inside_weight(self, model: Primitives) -> float:
        """Return the factor that makes squared errors of the extinction as large as squared errors of images."""
        return 10 ** ((self.inside_quality(model) - self.image_quality(model)) / 10)


def _draw_search_quality_points(points: PointSupervision) -> list[PointSamples]:
    """Return one set of points with known extinction per frame, for at most 64 random frames, sorted by name."""
    generator, frames = torch.Generator().manual_seed(0), dict[str, PointSamples]()
    for _ in range(_DRAWS_PER_FRAME * _FRAMES):
        samples = points.draw(_POINTS, generator)
        frames.setdefault(samples.name, samples)
        if len(frames) == _FRAMES:
            break
    return [frames[name] for name in sorted(frames)]
