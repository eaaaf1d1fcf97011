"""Where one stands to look at a frame: at the whole box, or at a single primitive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neuprim.core.extensions import Inspector
from neuprim.inspect.field import FieldFrame

__all__ = ["Stand", "stand_of"]

_DIRECTIONS = {"x": (-0.45, 1.0, -1.6), "y": (1.0, 0.45, 1.6), "z": (1.0, -1.6, 0.45)}
"""Where the camera stands, from the middle, by the scene's upward axis."""


@dataclass(frozen=True, eq=False)
class Stand:
    """A direction to look from.

    Attributes:
        focus: (3,) what is looked at, scene units.
        radius: of the ball around it that should fill the picture, scene units.
        away: (3,) direction from there to the camera, of norm 1.
        up: (3,) what is upward in the picture, of norm 1.
    """

    focus: np.ndarray
    radius: float
    away: np.ndarray
    up: np.ndarray


def stand_of(inspector: Inspector, frame: FieldFrame, up: str) -> Stand:
    """Where a view of the frame begins.

    Args:
        up: the scene's upward axis, "x", "y" or "z".
    """
    if inspector.shows == "primitive":
        one = frame.geometry[frame.row() : frame.row() + 1]
        axes = one.rotations[0].double().numpy()
        away = axes @ np.array(
            [1.0, -1.0, 0.9]
        )  # into the quarter that is missing, between the first two axes of the ellipsoid
        return Stand(
            one.means[0].double().numpy(), 1.12 * float(one.length_scale), away / np.linalg.norm(away), axes[:, 2]
        )
    low, high = frame.box
    radius, upward = float(np.linalg.norm(high - low)) / 2, np.eye(3)["xyz".index(up)]
    away = np.array(_DIRECTIONS[up]) / np.linalg.norm(_DIRECTIONS[up])
    return Stand(
        (low + high) / 2 - 0.08 * radius * upward, 1.02 * radius, away, upward
    )  # at an angle, with the scalar bar below
