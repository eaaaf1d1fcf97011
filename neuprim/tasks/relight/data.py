"""Posed images under one point light each, in linear light over the exposure.

Every view has two conditions: "light", (3,) float32, the point light's position in scene units, and "light_intensity", (3,) float32,
its radiant intensity per colour as the files give it, 1 where they do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from neuprim.core.data import View
from neuprim.core.data.common import PosedImages
from neuprim.core.data.views import ImageViews
from neuprim.core.errors import DataError
from neuprim.core.metrics import means
from neuprim.core.metrics.flip import flip_available
from neuprim.core.model.primitives import Primitives
from neuprim.tasks.relight.environment import summary
from neuprim.tasks.relight.measure import scores

__all__ = ["EXPOSURE_PERCENTILE", "Falloff", "PointLit", "bright"]

Falloff = Literal["none", "inverse_square"]

EXPOSURE_PERCENTILE = 99.5
"""An automatic exposure lets this percentile of the training images' values be 1."""

_MATTER = 1.0 / 255.0  # alpha from which a pixel belongs to the mask


class PointLit(PosedImages):
    """Images with a point light each.

    Attributes:
        falloff: "inverse_square" where images darken with the square of the light's distance, so that a renderer should divide by
            it; "none" where intensities are given as they arrive, or nobody knows.
        exposure: what the files' linear values were divided by.
    """

    falloff: Falloff = "none"
    exposure: float = 1.0

    def expose(self, exposure: float) -> None:
        """Divide all images by ``exposure`` from now on (instead of an earlier one)."""
        self.exposure = exposure
        for views in (self.train, self.test):
            views.scale = 1.0 / exposure

    def mask(self, index: int) -> Tensor | None:
        """Pixels of a test view that show matter; None for images without alpha."""
        alpha = self.test.pixels(index).alpha
        return None if alpha is None else alpha > _MATTER

    def judge(self, index: int, rendered: Tensor, truth: Tensor) -> dict[str, float]:
        """See :func:`neuprim.tasks.relight.measure.scores`."""
        return self._judged(index, rendered, truth, structure=True)

    def _judged(self, index: int, rendered: Tensor, truth: Tensor, structure: bool) -> dict[str, float]:
        return scores(rendered, truth, structure)

    def diagnose(self, model: Primitives) -> dict[str, Any]:
        """How light is measured here, and how good a black image would be."""
        result = {"exposure": self.exposure, "falloff": self.falloff, "baselines": self.baselines()}
        return result if flip_available() else {**result, "flip_missing": "pip install 'neuprim[flip]'"}

    def baselines(self) -> dict[str, dict[str, Any]]:
        """Means over the test views of what images that need no model score, by name; SSIM and FLIP are left out, which take long."""
        return {"black": self.guessed(lambda i, truth: torch.zeros_like(truth))}

    def guessed(self, guess: Callable[[int, Tensor], Tensor]) -> dict[str, Any]:
        """Means over the test views of what ``guess(index, truth)``, an (H, W, 3) image, scores."""
        entries = []
        for i in range(len(self.test)):
            truth = self.test.pixels(i).over(self.background)
            entries.append(self._judged(i, guess(i, truth), truth, structure=False))
        return means(entries)

    def facts(self) -> dict[str, Any]:
        """Also where the training lights were, as the scene's centre sees them: see :func:`~neuprim.tasks.relight.environment.summary`."""
        lights = torch.stack([self.train.view(i).conditions["light"] for i in range(len(self.train))])
        return {**super().facts(), "lights": summary(lights, self.center, self.falloff, self.exposure)}

    def orbit(self, frames: int) -> list[View]:
        """Views circling the scene while the light circles it the other way, once, at its mean distance and height."""
        training = [self.train.view(i).conditions for i in range(len(self.train))]
        up, center = (x.double() / n for x, n in ((self.up, self.up.double().norm()), (self.center, 1.0)))
        offsets = torch.stack([c["light"] for c in training]).double() - center
        radius, sine = offsets.norm(dim=-1).mean(), ((offsets @ up) / offsets.norm(dim=-1).clamp_min(1e-12)).mean()
        helper = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
        side = torch.linalg.cross(up, helper)
        side = side / side.norm()
        other = torch.linalg.cross(up, side)
        intensity = torch.stack([c["light_intensity"] for c in training]).mean(0)
        views = []
        for i, view in enumerate(super().orbit(frames)):
            turn = -2.0 * math.pi * i / frames
            across = math.cos(turn) * side + math.sin(turn) * other
            light = center + radius * (sine * up + (1.0 - sine * sine).clamp_min(0.0).sqrt() * across)
            views.append(View(view.name, view.camera, {"light": light.float(), "light_intensity": intensity}))
        return views


def bright(views: ImageViews, where: str) -> float:
    """The percentile :data:`EXPOSURE_PERCENTILE` of all colour values of some views, premultiplied and before any scaling.

    Values count at half precision and below zero as zero; memory stays that of one image.

    Raises:
        DataError: it is zero, so almost everything is black; ``where`` names the data.
    """
    counts = torch.zeros(1 << 15, dtype=torch.int64)  # of each bit pattern: those of non-negative half floats ascend as their values do
    for i in range(len(views)):
        values = (views.pixels(i).rgb / views.scale).clamp(0.0, 65504.0).half()
        counts += torch.bincount(values.reshape(-1).view(torch.int16).long().clamp_min(0), minlength=len(counts))
    total = counts.cumsum(0)
    rank = EXPOSURE_PERCENTILE / 100.0 * float(total[-1] - 1)
    index = int(torch.searchsorted(total, math.floor(rank) + 1))
    value = float(torch.tensor([index], dtype=torch.int16).view(torch.half))
    if not value > 0.0:
        raise DataError(
            f"{where}: {EXPOSURE_PERCENTILE} % of the training images' values are black; expected light, or a number for scene.exposure"
        )
    return value
