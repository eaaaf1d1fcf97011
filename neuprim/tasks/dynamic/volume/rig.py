"""Cameras around the unit box: the upper hemisphere, evenly, most to train and two to test."""

from __future__ import annotations

import math

import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.core.errors import ConfigError

__all__ = ["AXES", "rig"]

AXES = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
"""Up directions by name."""

_TEST = (0.4, 0.75)
"""Where the test cameras stand in the sequence, which goes from the rim to the pole: neighbours on all sides, 90
degrees apart."""


def rig(
    size: int,
    cameras: int = 40,
    *,
    up: str = "z",
    distance: float = 2.7,
    field_of_view: float = 27.0,
    elevations: tuple[float, float] = (3.0, 80.0),
) -> tuple[list[Camera], list[Camera]]:
    """Training and two test cameras on a Fibonacci lattice: equal areas of the hemisphere, no two at one azimuth.

    Args:
        size: edge of the square images in pixels.
        cameras: of both kinds, at least 4.
        up: 'y' or 'z'.
        distance: from the origin, the centre of the box, in scene units (box sides).
        field_of_view: whole angle, degrees.
        elevations: of the lowest and the highest camera, degrees above the horizon.
    """
    low, high = (math.sin(math.radians(e)) for e in elevations)
    if up not in AXES:
        raise ConfigError(f"up {up!r}; expected 'y' or 'z'")
    if (
        size < 1
        or cameras < 4
        or distance <= 0.0
        or not 0.0 < field_of_view < 180.0
        or not -90 <= elevations[0] < elevations[1] <= 90
    ):
        raise ConfigError(
            f"size {size}, cameras {cameras}, distance {distance}, field_of_view {field_of_view}, elevations {elevations}; "
            "expected positive sizes, at least 4 cameras, an angle below 180 and rising elevations"
        )
    focal = 0.5 * size / math.tan(math.radians(field_of_view) / 2)
    axis = torch.tensor(AXES[up], dtype=torch.float64)
    views = []
    for n in range(cameras):
        height = low + (high - low) * n / (cameras - 1)
        angle = n * math.pi * (3.0 - math.sqrt(5.0))
        around = math.sqrt(1.0 - height * height)
        a, b = around * math.cos(angle), around * math.sin(angle)
        eye = torch.tensor([a, b, height] if up == "z" else [b, height, a], dtype=torch.float64) * distance
        viewmat = look_at(eye, torch.zeros(3, dtype=torch.float64), axis)
        views.append(Camera(viewmat, focal, focal, size / 2, size / 2, size, size))
    chosen = {int(cameras * part) for part in _TEST}
    return [v for n, v in enumerate(views) if n not in chosen], [v for n, v in enumerate(views) if n in chosen]
