"""Point lights as conditions of a frame: parse position and intensity, and approximate environment maps by lights."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import horizontal_axes
from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset
from neuprim.core.environment import Environment, Illumination
from neuprim.core.errors import ConfigError
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.model.fields import ConditionSpec

MAX_LIGHT_ANGLE = 15.0  # a direction more than so many degrees from every training light counts as unseen
_MAX_DIRECTIONS = 256  # of training lights in a model's header
_ORBIT = (4.5, 40.0, 60)  # distance in scene units, polar angle in degrees, frames


def typical_light(dataset: Dataset, falloff: bool) -> float:
    """Return the median light intensity of the training views; 1 if the median is 0 or infinite.

    With ``falloff``, each intensity is first divided by the squared distance of the light to the scene's centre.
    """
    values = []
    for i in range(len(dataset.train)):
        conditions = dataset.train.view(i).conditions
        squared = (conditions["light"].double() - dataset.center.double()).square().sum().clamp_min(1e-30)
        values.append(conditions["light_intensity"].double().mean() / (squared if falloff else 1.0))
    found = float(torch.stack(values).median())
    return found if 0 < found < math.inf else 1.0


def parse_light_positions(text: str, world: World | None = None) -> list[Tensor]:
    """Parse ``--light`` to (3,) positions in scene units: "x,y,z" in world units, or "orbit[:DISTANCE:POLAR:FRAMES]".

    An orbit circles the upward direction of the scene, +z without a ``world``.
    """
    expected = "expected x,y,z or orbit or orbit:DISTANCE:POLAR_DEGREES:FRAMES"
    kind, *parts = text.split(":")
    world = world or World()
    if kind != "orbit":
        return [world.scene_points(_parse_light_numbers(text, "light", expected)).float()]
    try:
        values = [float(p) for p in parts] + list(_ORBIT[len(parts) :])
        distance, polar, frames = values[0], values[1], int(values[2])
    except (ValueError, IndexError, OverflowError):
        raise ConfigError(f"--light {text}: {expected}") from None
    if len(parts) > 3 or not (0 < distance < 1e6 and 0 <= polar <= 180 and 2 <= frames <= 100_000):
        raise ConfigError(f"--light {text}: {expected}")
    across, height = distance * math.sin(math.radians(polar)), distance * math.cos(math.radians(polar))
    turns = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / frames)
    up = world.up / world.up.norm()
    second, back = horizontal_axes(up)
    around = turns.sin()[:, None] * second - turns.cos()[:, None] * back  # from x towards y where up is z
    return list((across * around + height * up).float())


def light_orbit_in_frames(text: str, count: int) -> str | None:
    """Return the text of the orbit ``text`` with ``count`` frames added, such as ``"orbit:4:40:24"``.

    Return None if ``text`` is no orbit, or already states a number of frames.
    """
    parts = text.split(":")
    if parts[0] != "orbit" or len(parts) > 3:
        return None
    return ":".join([*parts, *(f"{x:g}" for x in _ORBIT[len(parts) - 1 : 2]), str(count)])


def parse_light_intensities(text: str) -> list[Tensor]:
    """Parse ``--light-intensity`` to (3,) float32: "r,g,b" or one number for all channels, each at least 0."""
    expected = "expected r,g,b or one number, 0 or more"
    found = _parse_light_numbers(
        f"{text},{text},{text}" if "," not in text else text, "light-intensity", expected
    ).float()
    if bool((found < 0).any()):
        raise ConfigError(f"--light-intensity {text}: {expected}")
    return [found]


def _parse_light_numbers(text: str, name: str, expected: str) -> Tensor:
    try:
        values = [float(p) for p in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 3 or not all(math.isfinite(v) for v in values):
        raise ConfigError(f"--{name} {text}: {expected}")
    return torch.tensor(values, dtype=torch.float64)


LIGHT_CONDITIONS = (
    ConditionSpec(
        "light",
        (3,),
        "position, scene units",
        (-1e6, 1e6),
        parse_light_positions,
        sweep="orbit",
        in_frames=light_orbit_in_frames,
        place=parse_light_positions,
    ),
    ConditionSpec("light_intensity", (3,), "radiometric", (0.0, 1e6), parse_light_intensities),
)
"""Conditions of a scene lit by one point light: the light's position and intensity."""


# ---------------------------------------------------------------- environments


def summarize_lights(lights: Tensor, center: Tensor, falloff: str, exposure: float) -> dict[str, Any]:
    """Return JSON-able facts on the training lights for a model's header.

    The facts are the mean distance of the positions ``lights`` (L, 3) from ``center``, at most 256 directions of lights
    (chosen by farthest-point sampling), ``falloff`` and ``exposure``.
    """
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
    """Approximate an environment map by at most ``count`` point lights like the lights of the training views.

    The environment map is first reduced to ``count`` directions. Each direction becomes a point light at the mean
    distance r of the training lights. The light's intensity I is chosen so that the scene's centre receives the
    irradiance E of the direction. With falloff "inverse_square", the model renders I / (distance^2 x exposure), so I =
    exposure x E r^2. With falloff "irradiance", I = exposure x E. With falloff "none", I = exposure x E / pi. At an
    offset from the centre, the light differs from parallel light by about 2 offset/r. A black environment map gives one
    black light.

    ``facts`` is the entry "data" of the model's header, see :func:`summarize_lights`. Raises DataError if the entry is
    damaged.
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
    factors = {"none": 1 / math.pi, "inverse_square": distance**2, "irradiance": 1.0}
    if falloff not in factors:
        raise known.fail("falloff", " or ".join(factors))
    listed = known.values.get("directions")
    number = len(listed) if isinstance(listed, list) and 0 < len(listed) <= _MAX_DIRECTIONS else 1
    trained = known.array("directions", (number, 3), f"1 to {_MAX_DIRECTIONS} directions of 3 numbers")
    trained = trained / trained.norm(dim=-1, keepdim=True).clamp_min(1e-30)
    factor = exposure * factors[falloff]
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
