"""Evaluation views: some test views, evenly spread, with their ground truth."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from neuprim.core.data import Dataset, View
from neuprim.core.data.dataset_check import check_pixels
from neuprim.core.metrics import psnr, ssim
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.runs.measure import render_image

MAX_PSNR = 200.0
"""dB that stand for equal images, as JSON has no infinity."""


@dataclass(frozen=True)
class EvalView:
    """A test view, its ground truth over the background, (H, W, C), and the pixels that count (None: all)."""

    view: View
    image: Tensor
    mask: Tensor | None


class EvalQuality(NamedTuple):
    """Mean PSNR and SSIM over evaluation views, in the data set's colour space, and median milliseconds per frame."""

    psnr: float
    ssim: float
    ms_per_frame: float


def eval_views(dataset: Dataset, views: int) -> list[EvalView]:
    """Return at most ``views`` of the test views, evenly spread."""
    count, chosen = len(dataset.test), []
    most = min(views, count)
    for i in (k * count // most for k in range(most)):
        view, pixels = dataset.test.view(i), dataset.test.pixels(i)
        check_pixels("test", view, pixels, dataset.channels)
        chosen.append(EvalView(view, pixels.over(dataset.background), pixels.mask))
    return chosen


def fill_masked(image: Tensor, view: EvalView) -> Tensor:
    """Replace the pixels that do not count by the ground truth."""
    return image if view.mask is None else torch.where(view.mask[..., None], image, view.image.to(image))


def measure_eval_views(
    model: Primitives, views: Sequence[EvalView], settings: RenderSettings, background: Tensor
) -> EvalQuality:
    """Render all views and compare them with the ground truth."""
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
