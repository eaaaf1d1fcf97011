"""From the world of a sequence of files to the unit box of the scene, and back."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from neuprim.core.errors import DataError

__all__ = ["Normalisation"]


@dataclass(frozen=True)
class Normalisation:
    """scene = (world - center) · scale; one for all frames, so that motion stays motion. Axes are not turned.

    Attributes:
        center: of the sequence's box, world units.
        scale: scene units per world unit, > 0.
    """

    center: tuple[float, float, float]
    scale: float

    def __post_init__(self) -> None:
        if len(self.center) != 3 or not all(math.isfinite(c) for c in self.center) or not 0.0 < self.scale < math.inf:
            raise DataError(
                f"normalisation: center {self.center}, scale {self.scale}; expected three finite numbers and one > 0"
            )

    @staticmethod
    def from_bounds(bounds: np.ndarray) -> Normalisation:
        """The (2, 3) box ``bounds``, world units, with its centre in the origin and its longest side 1."""
        low, high = np.asarray(bounds, np.float64)
        longest = float((high - low).max())
        if not np.isfinite(high - low).all() or longest <= 0.0 or (high < low).any():
            raise DataError(
                f"normalisation: box from {low.tolist()} to {high.tolist()}; expected a finite one with a volume"
            )
        x, y, z = ((low + high) / 2).tolist()
        return Normalisation((x, y, z), 1.0 / longest)

    def to_scene(self, points: np.ndarray) -> np.ndarray:
        """(…, 3) float64 scene points of world points."""
        return (np.asarray(points, np.float64) - self.center) * self.scale

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """(…, 3) float64 world points of scene points."""
        return np.asarray(points, np.float64) / self.scale + self.center

    def matrix(self) -> np.ndarray:
        """(4, 4) float64, world to scene, acting on column vectors."""
        matrix = np.diag([self.scale, self.scale, self.scale, 1.0])
        matrix[:3, 3] = -np.asarray(self.center) * self.scale
        return matrix

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, exact when read back."""
        return {"center": list(self.center), "scale": self.scale}

    @staticmethod
    def from_json(record: Mapping[str, Any], where: str = "normalisation") -> Normalisation:
        """What :meth:`to_json` gave; ``where`` names the file in errors.

        Raises:
            DataError: a missing key, or anything but numbers.
        """
        try:
            x, y, z = (float(c) for c in record["center"])
            return Normalisation((x, y, z), float(record["scale"]))
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(
                f"{where}: {dict(record)!r} ({error!r}); expected 'center' (three numbers) and 'scale'"
            ) from None
