"""Lights of datasets, of the command line, and of environments.

Every view has two conditions: "light" (3,), the position in scene units, and "light_intensity" (3,), radiant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from neuprim.core.data import Clip, Dataset, ViewSet
from neuprim.core.data.dataset_check import get_extra
from neuprim.core.environment import Environment, Illumination
from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.json_reader import JsonReader
from neuprim.tasks.relight.colour import real_light_harmonics

if TYPE_CHECKING:
    from neuprim.core.data.image_views import ImageViews

Falloff = Literal["none", "inverse_square"]

EXPOSURE_PERCENTILE = 99.5  # an automatic exposure lets this percentile of the training images' values be 1
FALLOFF_VIEWS = 200  # training views, evenly spread, whose brightness says how light weakens with distance
FALLOFF_SPREAD = 0.4  # standard error of the exponent beyond which they do not say it
MAX_LIGHT_ANGLE = 15.0  # degrees from every training light beyond which a direction counts as unseen
_MAX_DIRECTIONS = 256  # of training lights in a model's header


@dataclass(frozen=True)
class Lighting:
    """Optional facts about a relighting dataset besides images, cameras and lights: its ``extra``."""

    # "inverse_square" if images darken with the square of the light's distance, so that a renderer divides by it;
    # "none" if intensities are given as they arrive, or unknown
    falloff: Falloff = "none"
    # (views, index) -> (H, W) uint8 pixel classes of a view, indices of :data:`~neuprim.scenes.PIXEL_CLASSES`; errors
    # are then reported per class. The views may be a :class:`~neuprim.core.data.dataset.ViewSubset`
    classes: Callable[[ViewSet, int], Tensor] | None = None
    # prefixes of names of test views that get scores of their own, e.g. those with a new light
    parts: tuple[str, ...] = ()
    # name -> function of (views, index) that gives (H, W, 3) linear light over the exposure, an image without a model,
    # or None for views that have none; a black one is always included
    baselines: Mapping[str, Callable[[ViewSet, int], Tensor | None]] = field(default_factory=dict)
    clips: tuple[Clip, ...] = ()  # films besides the test views


def dataset_lighting(dataset: Dataset) -> Lighting:
    """The dataset's facts about its light, or the defaults. Raises DatasetFault: its ``extra`` is something else."""
    return get_extra(dataset, Lighting) or Lighting()


def olat_percentile_exposure(views: ImageViews, where: str) -> float:
    """The 99.5th percentile of all premultiplied values, in half precision; raises DataError if it is zero."""
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
            "expected light, or a number for scene.exposure"
        )
    return value


def measure_falloff(dataset: Dataset) -> Falloff:
    """Whether training images darken with the square of the light's distance, warning where they do not say it.

    The logarithm of a view's mean value over its intensity is fitted by a line in the logarithm of the light's
    distance, harmonics of degree 2 of the directions to light and camera, and the cosine between the two and its
    square. A slope below -1 is "inverse_square"; so is an unknown one, as that is how point lights are.
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
            f"{dataset.name}: training images do not say whether light weakens with its distance; taken for "
            "inverse_square, as of point lights; scene.falloff=none where it does not"
        )
        return "inverse_square"
    return "none" if slope > -1 else "inverse_square"


# ---------------------------------------------------------------- environments


def summarize_lights(lights: Tensor, center: Tensor, falloff: str, exposure: float) -> dict[str, Any]:
    """Summarise lights (L, 3) for a model's header: mean distance, at most 256 directions, farthest-point sampled."""
    offsets = lights.double() - center.double()
    distance = offsets.norm(dim=-1)
    units = offsets / distance.clamp_min(1e-30)[:, None]
    chosen = [0]
    nearest = units @ units[0]
    while len(chosen) < min(_MAX_DIRECTIONS, len(units)):
        chosen.append(int(nearest.argmin()))
        nearest = torch.maximum(nearest, units @ units[chosen[-1]])
    directions = [[round(float(x), 4) for x in units[i]] for i in chosen]
    return {
        "distance": float(distance.mean()),
        "directions": directions,
        "falloff": falloff,
        "exposure": float(exposure),
    }


def lights_from_environment(environment: Environment, count: int, facts: Mapping[str, Any]) -> Illumination:
    """Approximate an environment by point lights like those of the training; a black one gives one of intensity 0.

    Each direction becomes a light at the training lights' mean distance r, of the intensity that gives the centre the
    environment's irradiance E: exposure E r^2 with falloff inverse_square (the model draws I/distance^2 over the
    exposure), else exposure E / pi. Away from the centre light differs from parallel light by about 2 offset/r.
    ``facts`` are the dataset's, of the model's header; raises DataError if they are damaged.
    """
    data = JsonReader(dict(facts), "the model's header: data")
    center, up = (data.array(name, (3,), "3 numbers") for name in ("center", "up"))
    lights = data.values.get("lights")
    if not isinstance(lights, dict):
        raise data.fail("lights", "an object with distance, directions, falloff and exposure")
    known = JsonReader(lights, f"{data.where}: lights")
    distance = known.number("distance", "a distance above 0", 0.0)
    exposure = known.number("exposure", "a number above 0", 0.0)
    falloff = known.text("falloff")
    if falloff not in ("none", "inverse_square"):
        raise known.fail("falloff", "none or inverse_square")
    listed = known.values.get("directions")
    number = len(listed) if isinstance(listed, list) and 0 < len(listed) <= _MAX_DIRECTIONS else 1
    trained = known.array("directions", (number, 3), f"1 to {_MAX_DIRECTIONS} directions of 3 numbers")
    trained = trained / trained.norm(dim=-1, keepdim=True).clamp_min(1e-30)
    factor = exposure * (distance**2 if falloff == "inverse_square" else 1.0 / math.pi)
    found = environment.directional_lights(count)
    frames = [
        {"light": (center + distance * d).float(), "light_intensity": (factor * e).float()}
        for d, e in zip(found.directions, found.irradiance, strict=True)
    ]
    if not frames:
        dark = {"light": (center + distance * up).float(), "light_intensity": torch.zeros(3)}
        return Illumination((dark,), ("the environment is black",))
    unseen = environment.share_beyond(trained, MAX_LIGHT_ANGLE)
    extrapolated = ((found.directions @ trained.T).amax(1) < math.cos(math.radians(MAX_LIGHT_ANGLE))).tolist()
    note = (
        f"{unseen:.0%} of the environment's light comes from more than {MAX_LIGHT_ANGLE:g} degrees off every training "
        "light, where the model guesses"
    )
    return Illumination(tuple(frames), (note,) if unseen > 0.01 else (), tuple(extrapolated))
