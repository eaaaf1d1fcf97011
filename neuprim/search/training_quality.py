"""Quality on training views and on points inside volumes; it decides what to prune and how coarsely to quantize."""

from __future__ import annotations

import math

import numpy as np
import torch

from neuprim.config import RunConfig
from neuprim.core.data import Dataset, PointSamples, PointSupervision
from neuprim.core.metrics import psnr
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.core.volumes.points import volume_values_at
from neuprim.runs.measure import render_image

_VIEWS, _QUICK_VIEWS = 24, 8
"""Views that decide, and how many of them intermediate evaluations use."""

_SENSITIVITY_VIEWS = 160
"""Views for sensitivities, at most; primitives of a short time or a corner are in few views."""

_MAX_PSNR = 200.0
"""dB that stand for equal images."""

_FRAMES, _QUICK_FRAMES, _POINTS = 64, 8, 4096
"""Frames with known extinction, how many of them intermediate evaluations use, and points of each."""

_DRAWS_PER_FRAME = 6
"""Each draw is of a random frame; so many times the frames find most of them."""


class TrainingQuality:
    """Mean PSNR of some training views; of a volume trained on its voxels also the accuracy of its extinction.

    Views are chosen at random, as training views are often ordered by camera or time.

    Attributes:
        views: views that decide.
        others: other views, for sensitivities.
        draws: points of known extinction; empty unless the run was trained on them.
    """

    def __init__(self, dataset: Dataset, settings: RenderSettings, inside: bool = False) -> None:
        self.dataset, self.settings = dataset, settings
        order = torch.randperm(len(dataset.train), generator=torch.Generator().manual_seed(0)).tolist()
        decide = min(_VIEWS, max(len(order) // 2, 1))
        self.views, self.others = order[:decide], order[decide : decide + _SENSITIVITY_VIEWS] or order[:decide]
        self.draws = _draw_frames(dataset.points) if inside and dataset.points is not None else []
        self._offset: float | None = None

    @classmethod
    def of_run(cls, config: RunConfig, dataset: Dataset) -> TrainingQuality:
        """Return the quality that decides for a run; inside volumes too, where it was trained on them."""
        return cls(dataset, config.renderer, config.train.supervision != "images")

    def __call__(self, model: Primitives, quick: bool = False) -> float:
        """Return dB: of images, or of points if they lost more since the first model evaluated.

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
        """Return the mean PSNR of the views."""
        step = max(len(self.views) // _QUICK_VIEWS, 1) if quick else 1
        values = []
        for index in self.views[::step]:
            pixels = self.dataset.train.pixels(index)
            image = render_image(model, self.dataset.train.view(index), self.settings, self.dataset.background)
            values.append(min(psnr(image, pixels.over(self.dataset.background), pixels.mask), _MAX_PSNR))
        return float(np.mean(values))

    def inside_quality(self, model: Primitives, quick: bool = False) -> float:
        """Return dB of the extinction's error against its typical size, mean over frames."""
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
        """Return the error of images over that inside: the weight of changes inside."""
        return 10 ** ((self.inside_quality(model) - self.image_quality(model)) / 10)


def _draw_frames(points: PointSupervision) -> list[PointSamples]:
    """Return points of different frames, in the order of the frames' names."""
    generator, frames = torch.Generator().manual_seed(0), dict[str, PointSamples]()
    for _ in range(_DRAWS_PER_FRAME * _FRAMES):
        samples = points.draw(_POINTS, generator)
        frames.setdefault(samples.name, samples)
        if len(frames) == _FRAMES:
            break
    return [frames[name] for name in sorted(frames)]
