"""Posed images under one point light each, in linear light over the exposure.

Every view has two conditions: "light", (3,) float32, the point light's position in scene units, and "light_intensity",
(3,) float32, its radiant intensity per colour as the files give it, 1 where they do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from neuprim.core.data import Clip, Dataset
from neuprim.core.data.dataset_check import get_extra
from neuprim.core.errors import DataError

if TYPE_CHECKING:
    from neuprim.core.data.image_views import ImageViews

__all__ = ["EXPOSURE_PERCENTILE", "Falloff", "Lighting", "bright", "lighting_of"]

Falloff = Literal["none", "inverse_square"]

EXPOSURE_PERCENTILE = 99.5
"""An automatic exposure lets this percentile of the training images' values be 1."""


@dataclass(frozen=True)
class Lighting:
    """What relighting likes to know of a data set beside images, cameras and lights: its ``extra``. Every part may be
    left out.

    Attributes:
        falloff: "inverse_square" where images darken with the square of the light's distance, so that a renderer should
        divide by
            it; "none" where intensities are given as they arrive, or nobody knows.
        classes: index of a test view -> (H, W) uint8, what its pixels show, indices of
        :data:`~neuprim.scenes.PIXEL_CLASSES`;
            errors are then told by class.
        parts: beginnings of the names of test views whose scores are also told apart, e.g. those with a new light.
        baselines: name -> function of a test view's index that gives (H, W, 3) linear light over the exposure, an image
        that needs no
            model; a black one is always there.
        clips: films beside the test views.
    """

    falloff: Falloff = "none"
    classes: Callable[[int], Tensor] | None = None
    parts: tuple[str, ...] = ()
    baselines: Mapping[str, Callable[[int], Tensor]] = field(default_factory=dict)
    clips: tuple[Clip, ...] = ()


def lighting_of(dataset: Dataset) -> Lighting:
    """What the data set says of its light, which may be nothing.

    Raises:
        DatasetFault: its ``extra`` is something else.
    """
    return get_extra(dataset, Lighting) or Lighting()


def bright(views: ImageViews, where: str) -> float:
    """The percentile :data:`EXPOSURE_PERCENTILE` of all colour values of some views, premultiplied and before any
    scaling.

    Values count at half precision and below zero as zero; memory stays that of one image.

    Raises:
        DataError: it is zero, so almost everything is black; ``where`` names the data.
    """
    counts = torch.zeros(
        1 << 15, dtype=torch.int64
    )  # of each bit pattern: those of non-negative half floats ascend as their values do
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
