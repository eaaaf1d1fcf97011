"""What an inspector returns: a frame as layers, which a window, a picture, a film and a page draw alike.

Positions are in scene units, in the scene's axes. Arrays are numpy arrays of finite numbers. Colours are
display-referred (what a screen shows), red, green and blue from 0 to 1. The box of the frame's grid, its title and a
bar for every :class:`Scale` that has a title are drawn around the layers; they need none of their own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

__all__ = [
    "Ellipsoids",
    "Grid",
    "Isosurfaces",
    "Layer",
    "Lines",
    "Mesh",
    "Painted",
    "Points",
    "Scale",
    "Slices",
    "Text",
    "Volume",
]


@dataclass(frozen=True)
class Scale:
    """Which colour a number has; numbers beyond an end have the colour of that end.

    Attributes:
        low, high: its ends, the lower one first; the same for all frames, or colours mean something else in each.
        colours: name of a colour map of matplotlib.
        title, unit: what the numbers are, for the bar, as "extinction" and "1/scene unit"; no bar without a title.
    """

    low: float
    high: float
    colours: str = "inferno"
    title: str = ""
    unit: str = ""

    @property
    def words(self) -> str:
        """For example "extinction [1/scene unit]"."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


@dataclass(frozen=True, eq=False)
class Grid:
    """Numbers at the points of a regular grid whose axes are the scene's; drawn as one of the three kinds below.

    Attributes:
        values: (X, Y, Z).
        origin: (3,) where ``values[0, 0, 0]`` is, scene units.
        spacing: distance of neighbours, scene units: one number, or three along x, y and z.
    """

    values: np.ndarray
    origin: np.ndarray
    spacing: float | tuple[float, float, float]
    scale: Scale

    @property
    def steps(self) -> np.ndarray:
        """(3,) float64 distances of neighbours along x, y and z."""
        return np.broadcast_to(np.asarray(self.spacing, np.float64), 3)

    @property
    def box(self) -> np.ndarray:
        """(2, 3) float64 box that the grid's cells fill."""
        low = np.asarray(self.origin, np.float64) - self.steps / 2
        return np.stack([low, low + self.steps * self.values.shape])


@dataclass(frozen=True, eq=False)
class Volume(Grid):
    """A cloud: over a length h it hides 1 - exp(-|value| depth h) of what is behind.

    Attributes:
        depth: optical depth per scene unit of the value 1; ``frame.gain`` for extinction.
    """

    depth: float = 1.0


@dataclass(frozen=True, eq=False)
class Slices(Grid):
    """Three planes across the axes.

    Attributes:
        through: (3,) the point that they share, scene units; None for the middle of the grid.
    """

    through: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Isosurfaces(Grid):
    """Surfaces of equal value, closed as if values were 0 outside the grid.

    Attributes:
        levels: their values, at least one. A page shows one surface, of the level that its slider is at: of the lowest
        of these at first.
    """

    levels: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Painted:
    """What the parts of a shape look like: numbers on a scale, or colours, or neither (white).

    Attributes:
        values: (N,) one number per vertex, point or ellipsoid; with ``scale``.
        colours: (N, 3) colours, or (3,) for all.
        opacity: 0..1.
    """

    values: np.ndarray | None = None
    scale: Scale | None = None
    colours: np.ndarray | None = None
    opacity: float = 1.0


@dataclass(frozen=True, eq=False)
class Ellipsoids(Painted):
    """N solid ellipsoids, those first that matter most: a page shows a limited number.

    Attributes:
        centres: (N, 3) scene units.
        axes: (N, 3, 3) the semi-axes as vectors, ``axes[n, k]`` the k-th, scene units.
    """

    centres: np.ndarray
    axes: np.ndarray


@dataclass(frozen=True, eq=False)
class Mesh(Painted):
    """Triangles; smooth where they share vertices, so an edge has vertices of its own on either side.

    Attributes:
        vertices: (N, 3) scene units.
        faces: (F, 3) integers, rows of ``vertices``.
    """

    vertices: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True, eq=False)
class Points(Painted):
    """Balls of one size on the screen.

    Attributes:
        centres: (N, 3) scene units.
        size: their diameter in pixels.
    """

    centres: np.ndarray
    size: float = 8.0


@dataclass(frozen=True, eq=False)
class Lines(Painted):
    """Straight pieces.

    Attributes:
        vertices: (N, 3) scene units.
        pairs: (S, 2) integers, rows of ``vertices`` that are joined.
        width: in pixels; a page's lines have one.
    """

    vertices: np.ndarray
    pairs: np.ndarray
    width: float = 2.0


@dataclass(frozen=True)
class Text:
    """Lines of text in a corner of the picture."""

    text: str
    corner: Literal["upper_right", "lower_right"] = "lower_right"


Layer = Volume | Slices | Isosurfaces | Ellipsoids | Mesh | Points | Lines | Text
