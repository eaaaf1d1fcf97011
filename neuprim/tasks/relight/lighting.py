"""Properties of a relighting dataset: falloff of the light with distance, exposure, baseline images.

Every view has two conditions (inputs of the model besides the camera): "light" (3,), the light's position in scene
units, and "light_intensity" (3,), its RGB radiant intensity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from neuprim.core.data import Clip, Dataset, ViewSet
from neuprim.core.data.dataset_check import get_extra
from neuprim.core.errors import DataError, warn_once
from neuprim.tasks.relight.colour import real_light_harmonics

if TYPE_CHECKING:
    from neuprim.core.data.image_views import ImageViews

Falloff = Literal["none", "inverse_square"]

EXPOSURE_PERCENTILE = 99.5  # an automatic exposure maps this percentile of the training images' values to 1
FALLOFF_VIEWS = 200  # evenly spaced training views, from whose brightness the falloff is measured
FALLOFF_SPREAD = 0.4  # largest standard error of a measured falloff exponent


@dataclass(frozen=True)
class Lighting:
    """Light falloff, pixel classes, groups of test views, baselines and films; stored in ``Dataset.extra``."""

    # "inverse_square" if images darken with the square of the light's distance; a renderer then divides the intensity
    # by this square. "none" if the given intensities already include the falloff, or if the falloff is unknown
    falloff: Falloff = "none"
    # function (views, index) -> (H, W) uint8 pixel classes of a view, which are indices into
    # :data:`~neuprim.scenes.PIXEL_CLASSES`. With this function, errors are reported per class, too. The views may be a
    # :class:`~neuprim.core.data.dataset.ViewSubset`
    classes: Callable[[ViewSet, int], Tensor] | None = None
    # prefixes of view names; test views with the same prefix, e.g. "new_light", get separate scores
    parts: tuple[str, ...] = ()
    # baseline name -> function (views, index) -> an image that was made without the model: (H, W, 3) linear light over
    # the exposure, or None for views without such an image. A black baseline image is always included
    baselines: Mapping[str, Callable[[ViewSet, int], Tensor | None]] = field(default_factory=dict)
    clips: tuple[Clip, ...] = ()  # films besides the test views


def dataset_lighting(dataset: Dataset) -> Lighting:
    """Return ``dataset.extra``, or a default :class:`Lighting` if ``extra`` is None.

    Raises DatasetError if ``extra`` has another type.
    """
    return get_extra(dataset, Lighting) or Lighting()


def olat_percentile_exposure(views: ImageViews, where: str) -> float:
    """Return the exposure, by which images are divided: the 99.5th percentile of the images' premultiplied values.

    Raises DataError if the percentile is 0; ``where`` names the data in the message.
    """
    # counts per bit pattern, as patterns of non-negative half floats ascend with their values
    counts = torch.zeros(1 << 15, dtype=torch.int64)
    for i in range(len(views)):
        values = (views.pixels(i).rgb / views.scale).clamp(0.0, 65504.0).half()
        counts += torch.bincount(values.reshape(-1).view(torch.int16).long().clamp_min(0), minlength=len(counts))
    total = counts.cumsum(0)
    rank = EXPOSURE_PERCENTILE / 100.0 * float(total[-1] - 1)
    index = int(torch.searchsorted(total, math.floor(rank) + 1))
    value = float(torch.tensor([index], dtype=torch.int16).view(torch.half))
    if not value > 0.0:
        raise DataError(
            f"{where}: {EXPOSURE_PERCENTILE} % of the training images' values are black; "
            "expected lit images, or a number for scene.exposure"
        )
    return value


def measure_falloff(dataset: Dataset) -> Falloff:
    """Return "inverse_square" if training images darken with the light's distance, else "none".

    The function fits log(mean value of a view / light intensity) by a linear combination. Its terms are the logarithm
    of the light's distance, spherical harmonics up to degree 2 of the directions to light and camera, and the cosine
    between these directions and its square. If the coefficient of the distance is at most -1, the result is
    "inverse_square", as for a point light. If the images do not determine the coefficient, the result is also
    "inverse_square", with a warning.
    """
    center, views = dataset.center.double(), dataset.train
    rows, values = [], []
    for i in sorted({round(x) for x in torch.linspace(0, len(views) - 1, min(len(views), FALLOFF_VIEWS)).tolist()}):
        view = views.view(i)
        light, eye = view.conditions["light"].double() - center, view.camera.position.double() - center
        brightness = views.pixels(i).rgb.double().mean() / view.conditions["light_intensity"].double().mean()
        if 0 < float(brightness) < math.inf and min(float(light.norm()), float(eye.norm())) > 0:
            units = torch.stack([light / light.norm(), eye / eye.norm()])
            phase = units.prod(0).sum()[None]
            bands = real_light_harmonics(units, 2)[:, 1:].flatten()
            rows.append(torch.cat([light.norm().log()[None], phase.new_ones(1), phase, phase.square(), bands]))
            values.append(brightness.log())
    slope, error = -2.0, math.inf
    if rows and len(rows) > 2 * len(rows[0]):
        system, wanted = torch.stack(rows), torch.stack(values)
        distances = system[:, 0] - system[:, 1:] @ torch.linalg.pinv(system[:, 1:]) @ system[:, 0]
        spread = float(distances.square().sum())
        if spread > 1e-6 * len(rows):
            slope = float(distances @ wanted) / spread
            left = wanted - system @ torch.linalg.pinv(system) @ wanted
            error = math.sqrt(float(left.square().sum()) / (len(rows) - len(rows[0])) / spread)
    if error > FALLOFF_SPREAD:
        warn_once(
            f"{dataset.name}: training images do not show whether light weakens with distance; scene.falloff="
            "inverse_square (point lights) is assumed. Set scene.falloff=none if light does not weaken"
        )
        return "inverse_square"
    return "none" if slope > -1 else "inverse_square"
