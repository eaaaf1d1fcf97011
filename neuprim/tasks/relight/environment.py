"""Light from all around as a sum of the point lights that the model was trained with.

Each direction of the environment becomes a point light at the training lights' mean distance r from the scene's centre,
of the radiant intensity that gives the centre the environment's irradiance E = radiance x solid angle:

    falloff inverse_square:  I = exposure E r^2    the model draws I/distance^2 over the exposure
    falloff none:            I = exposure E / pi   an intensity of 1 is taken to light a white matt surface that faces
    it with 1

In both, a uniform environment of radiance 1 shows a white matt surface that nothing shades with value 1: the
environment is in the images' unit, linear light over the exposure. In lit_solids that is the renderer's own: a surface
there sends out (albedo/pi + highlight) cosine I/distance^2. Light from a finite distance is not quite parallel: away
from the centre it differs from that of a distant environment by about 2 offset/r.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neuprim.core.environment import Environment, Illumination
from neuprim.core.io.json_reader import JsonReader

__all__ = ["FAR", "illuminate", "summary"]

FAR = 15.0
"""Degrees from every training light beyond which a direction counts as never seen."""

_KEPT = 256  # directions of training lights in a model's header


def summary(lights: Tensor, center: Tensor, falloff: str, exposure: float) -> dict[str, Any]:
    """What a model's header keeps of the training lights.

    Args:
        lights: (L, 3) positions, scene units.
        center: (3,) of the scene.
        falloff: see :class:`~neuprim.tasks.relight.data.Lighting`.
        exposure: of the data set.

    Returns:
        mean ``distance`` from the centre; ``directions``, at most 256, each as far from those before it as can be, so
        that they cover all of the lights' directions alike; ``falloff``; ``exposure``.
    """
    offsets = lights.double() - center.double()
    distance = offsets.norm(dim=-1)
    units = offsets / distance.clamp_min(1e-30)[:, None]
    kept = [0]
    nearest = units @ units[0]
    while len(kept) < min(_KEPT, len(units)):
        kept.append(int(nearest.argmin()))
        nearest = torch.maximum(nearest, units @ units[kept[-1]])
    return {
        "distance": float(distance.mean()),
        "directions": [[round(float(x), 4) for x in units[i]] for i in kept],
        "falloff": falloff,
        "exposure": float(exposure),
    }


def illuminate(environment: Environment, count: int, facts: Mapping[str, Any]) -> Illumination:
    """Point lights for an environment; a black one gives a single light of intensity 0.

    Args:
        facts: of the data set, from the model's header.

    Raises:
        DataError: facts that are missing or damaged.
    """
    data = JsonReader(dict(facts), "the model's header: data")
    center = data.array("center", (3,), "3 numbers")
    up = data.array("up", (3,), "3 numbers")
    lights = data.values.get("lights")
    if not isinstance(lights, dict):
        raise data.fail("lights", "an object with distance, directions, falloff and exposure")
    known = JsonReader(lights, f"{data.where}: lights")
    distance = known.number("distance", "a distance above 0", 0.0)
    exposure = known.number("exposure", "a number above 0", 0.0)
    if known.text("falloff") not in ("none", "inverse_square"):
        raise known.fail("falloff", "none or inverse_square")
    listed = known.values.get("directions")
    number = len(listed) if isinstance(listed, list) and 0 < len(listed) <= _KEPT else 1
    trained = known.array("directions", (number, 3), f"1 to {_KEPT} directions of 3 numbers")
    trained = trained / trained.norm(dim=-1, keepdim=True).clamp_min(1e-30)
    factor = exposure * (distance**2 if known.values["falloff"] == "inverse_square" else 1.0 / math.pi)
    beams = environment.beams(count)
    frames = [
        {"light": (center + distance * d).float(), "light_intensity": (factor * e).float()}
        for d, e in zip(beams.directions, beams.irradiance, strict=True)
    ]
    if not frames:
        return Illumination(
            ({"light": (center + distance * up).float(), "light_intensity": torch.zeros(3)},),
            ("the environment is black",),
        )
    unseen = environment.share_beyond(trained, FAR)
    guessed = ((beams.directions @ trained.T).amax(1) < math.cos(math.radians(FAR))).tolist()
    far = f"{unseen:.0%} of the environment's light comes from more than {FAR:g} degrees off every training light, where the model guesses"
    return Illumination(tuple(frames), (far,) if unseen > 0.01 else (), tuple(guessed))
