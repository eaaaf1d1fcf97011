"""What pruning is judged by: some training views, and points inside. Test views are looked at only at the end."""

from __future__ import annotations

import math

import numpy as np
import torch

from neuprim.config import RunConfig
from neuprim.core.data import Dataset, PointSamples, PointSupervision
from neuprim.core.metrics import psnr
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.core.volumes.points import values_at
from neuprim.runs.measure import render_image

__all__ = ["Judge", "judge_of"]

_JUDGED, _QUICK = 24, 8
"""Views that decide, and how many of them a search in between looks at."""

_LOOKED_AT = 160
"""Views that sensitivities come from, at most: primitives that live for a moment, or in a corner, are in few of
them."""

_MOST = 200.0
"""dB that stand for equal images."""


_FRAMES, _QUICK_FRAMES, _POINTS = 64, 8, 4096
"""Frames whose points decide where a volume is known inside, at most, how many a search in between looks at, and points
of each."""

_DRAWS = 6
"""Draws for each such frame: each is of any frame, and most frames are to be there once."""


def judge_of(config: RunConfig, dataset: Dataset) -> Judge:
    """What judges a run's model: points inside, too, where it learned from them."""
    return Judge(dataset, config.renderer, config.train.supervision != "images" and dataset.points is not None)


class Judge:
    """Mean PSNR over some training views, as ``metrics.json`` has it over test views; and of a volume that a run
    learned from its voxels, too, how well its extinction is met, so that what images do not show is not lost.

    Which views is drawn by lot, as they often are in an order (all times of a camera, all cameras of a time) that even
    steps would fall in with.

    Args:
        inside: whether points of known extinction count; the data set has them.

    Attributes:
        views: those that decide; others: of the remaining ones, as far as there are some, those that sensitivities come
        from. draws: points that decide; none unless ``inside``.
    """

    def __init__(self, dataset: Dataset, settings: RenderSettings, inside: bool = False) -> None:
        self.dataset, self.settings = dataset, settings
        lot = torch.randperm(len(dataset.train), generator=torch.Generator().manual_seed(0)).tolist()
        decide = min(_JUDGED, max(len(lot) // 2, 1))
        self.views, self.others = lot[:decide], lot[decide : decide + _LOOKED_AT] or lot[:decide]
        self.draws = _frames(dataset.points) if inside and dataset.points is not None else []
        self._apart: float | None = None

    def __call__(self, model: Primitives, quick: bool = False) -> float:
        """dB: of the views, or of the points if these lost more since the first model that was asked for; with
        ``quick`` over some of them."""
        images = self.images(model, quick)
        if not self.draws:
            return images
        inside = self.inside(model, quick and self._apart is not None)
        if self._apart is None:
            self._apart = images - inside
        return min(images, inside + self._apart)

    def images(self, model: Primitives, quick: bool = False) -> float:
        """dB, mean over the views."""
        step = max(len(self.views) // _QUICK, 1) if quick else 1
        found = []
        for index in self.views[::step]:
            pixels = self.dataset.train.pixels(index)
            image = render_image(model, self.dataset.train.view(index), self.settings, self.dataset.background)
            found.append(min(psnr(image, pixels.over(self.dataset.background), pixels.mask), _MOST))
        return float(np.mean(found))

    def inside(self, model: Primitives, quick: bool = False) -> float:
        """dB of the extinction's error at points, against its typical size; mean over frames."""
        found = []
        with torch.no_grad():
            for samples in self.draws[:: max(len(self.draws) // _QUICK_FRAMES, 1) if quick else 1]:
                sigma = values_at(model, samples.conditions, samples.points, False, self.settings.threads).sigma.cpu()
                error = float(((sigma - samples.sigma) / samples.sigma_scale).square().mean())
                found.append(-10 * math.log10(max(error, 1e-20)))
        return float(np.mean(found))

    def apart(self, model: Primitives) -> float:
        """How many times as large the error of the views is as that inside: what a change inside counts as much as one
        of images by."""
        return 10 ** ((self.inside(model) - self.images(model)) / 10)


def _frames(points: PointSupervision) -> list[PointSamples]:
    """Points of different frames, as they are drawn, in the order of the frames' names."""
    generator, found = torch.Generator().manual_seed(0), dict[str, PointSamples]()
    for _ in range(_DRAWS * _FRAMES):
        samples = points.draw(_POINTS, generator)
        found.setdefault(samples.name, samples)
        if len(found) == _FRAMES:
            break
    return [found[name] for name in sorted(found)]
