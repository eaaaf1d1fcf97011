"""A point light as a condition of frames: where it is, how strong, and how users write that."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import ConditionSpec

_ORBIT = (4.5, 40.0, 60)  # distance in scene units, polar angle in degrees, frames


def typical_light(dataset: Dataset, falloff: bool) -> float:
    """Median over training views of the intensity, with ``falloff`` over the squared distance; 1 in the dark."""
    values = []
    for i in range(len(dataset.train)):
        conditions = dataset.train.view(i).conditions
        squared = (conditions["light"].double() - dataset.center.double()).square().sum().clamp_min(1e-30)
        values.append(conditions["light_intensity"].double().mean() / (squared if falloff else 1.0))
    found = float(torch.stack(values).median())
    return found if 0 < found < math.inf else 1.0


def parse_light_positions(text: str, world: World | None = None) -> list[Tensor]:
    """Parse ``--light``: (3,) scene positions of "x,y,z" in world units, or "orbit[:DISTANCE:POLAR:FRAMES]" about z."""
    expected = "expected x,y,z or orbit or orbit:DISTANCE:POLAR_DEGREES:FRAMES"
    kind, *parts = text.split(":")
    if kind != "orbit":
        return [(world or World()).scene_points(_parse_light_numbers(text, "light", expected)).float()]
    try:
        values = [float(p) for p in parts] + list(_ORBIT[len(parts) :])
        distance, polar, frames = values[0], values[1], int(values[2])
    except (ValueError, IndexError, OverflowError):
        raise ConfigError(f"--light {text}: {expected}") from None
    if len(parts) > 3 or not (0 < distance < 1e6 and 0 <= polar <= 180 and 2 <= frames <= 100_000):
        raise ConfigError(f"--light {text}: {expected}")
    across, height = distance * math.sin(math.radians(polar)), distance * math.cos(math.radians(polar))
    turns = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / frames)
    return list(torch.stack([across * turns.cos(), across * turns.sin(), torch.full_like(turns, height)], -1).float())


def light_orbit_in_frames(text: str, count: int) -> str | None:
    """``"orbit:4"`` in 24 frames -> ``"orbit:4:40:24"``; None unless it is an orbit without a number of frames."""
    parts = text.split(":")
    if parts[0] != "orbit" or len(parts) > 3:
        return None
    return ":".join([*parts, *(f"{x:g}" for x in _ORBIT[len(parts) - 1 : 2]), str(count)])


def parse_light_intensities(text: str) -> list[Tensor]:
    """Parse ``--light-intensity``: (3,) float32 from "r,g,b" or one number, 0 or more."""
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
"""Position of a light, and its intensity."""
