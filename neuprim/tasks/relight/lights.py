"""What a user may write after ``--light`` and ``--light-intensity``."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError

__all__ = ["ORBIT", "orbit_in_frames", "parse_intensities", "parse_lights", "typical_light"]

ORBIT = (4.5, 40.0, 60)
"""Distance in scene units, polar angle in degrees and frames of ``--light orbit``."""


def parse_lights(text: str, world: World | None = None) -> list[Tensor]:
    """Positions (3,) float32 in scene units: "x,y,z" is one, in the coordinates of the data's files; "orbit", or
    "orbit:DISTANCE:POLAR:FRAMES", goes round the scene's z axis.

    Raises:
        ConfigError: another form, or numbers that are not finite.
    """
    expected = "expected x,y,z or orbit or orbit:DISTANCE:POLAR_DEGREES:FRAMES"
    if text.split(":")[0] == "orbit":
        parts = text.split(":")[1:]
        try:
            values = [float(p) for p in parts] + list(ORBIT[len(parts) :])
            distance, polar, frames = values[0], values[1], int(values[2])
        except (ValueError, IndexError, OverflowError):
            raise ConfigError(f"--light {text}: {expected}") from None
        if len(parts) > 3 or not (0 < distance < 1e6 and 0 <= polar <= 180 and 2 <= frames <= 100_000):
            raise ConfigError(f"--light {text}: {expected}")
        across, height = distance * math.sin(math.radians(polar)), distance * math.cos(math.radians(polar))
        turns = torch.arange(frames, dtype=torch.float64) * (2 * math.pi / frames)
        return list(
            torch.stack([across * turns.cos(), across * turns.sin(), torch.full_like(turns, height)], -1).float()
        )
    return [(world or World()).scene_points(_numbers(text, "light", expected)).float()]


def orbit_in_frames(text: str, count: int) -> str | None:
    """``"orbit:4"`` in 24 frames -> ``"orbit:4:40:24"``; None for what is no orbit, or says its frames."""
    parts = text.split(":")
    if parts[0] != "orbit" or len(parts) > 3:
        return None
    return ":".join([*parts, *(f"{x:g}" for x in ORBIT[len(parts) - 1 : 2]), str(count)])


def parse_intensities(text: str) -> list[Tensor]:
    """(3,) float32 intensity: "r,g,b" or one number for all.

    Raises:
        ConfigError: another form, or numbers that are negative or not finite.
    """
    expected = "expected r,g,b or one number, 0 or more"
    found = _numbers(f"{text},{text},{text}" if "," not in text else text, "light-intensity", expected).float()
    if bool((found < 0).any()):
        raise ConfigError(f"--light-intensity {text}: {expected}")
    return [found]


def _numbers(text: str, name: str, expected: str) -> Tensor:
    try:
        values = [float(p) for p in text.split(",")]
    except ValueError:
        values = []
    if len(values) != 3 or not all(math.isfinite(v) for v in values):
        raise ConfigError(f"--{name} {text}: {expected}")
    return torch.tensor(values, dtype=torch.float64)


def typical_light(dataset: Dataset, falloff: bool) -> float:
    """Median over the training views of the light's mean intensity, over its squared distance from the scene's centre
    with ``falloff``.

    1 where that is zero: a data set in the dark has no unit of light.
    """
    values = []
    for i in range(len(dataset.train)):
        conditions = dataset.train.view(i).conditions
        squared = (conditions["light"].double() - dataset.center.double()).square().sum().clamp_min(1e-30)
        values.append(conditions["light_intensity"].double().mean() / (squared if falloff else 1.0))
    found = float(torch.stack(values).median())
    return found if 0 < found < math.inf else 1.0
