"""Layers: the drawable objects that an inspector returns for a frame.

Windows, pictures, videos and HTML pages draw the same layers. Positions are in scene units, on the scene's axes.
Arrays are numpy arrays of finite numbers. Colours are display-referred red, green and blue from 0 to 1. Each view also
shows the box of the frame's grid, the frame's title and a colour bar for every :class:`Scale` with a title.
"""

from __future__ import annotations

from dataclasses import dataclass
from numbers import Real
from typing import Any, Literal, get_args

import matplotlib
import numpy as np

__all__ = ["Ellipsoids", "InspectionGrid", "Isosurfaces", "Mesh", "Painted"]
__all__ += ["Points", "Scale", "Slices", "Text", "Volume"]


@dataclass(frozen=True)
class Scale:
    """A colour scale, which maps values to colours; values beyond an end have the colour of that end.

    Attributes:
        title: name of the quantity for the colour bar, e.g. "extinction"; no bar if empty.
        unit: unit of the quantity for the colour bar, e.g. "1/scene unit".
    """

    low: float  # number at the lower end; use the same scale for all frames
    high: float  # number at the upper end
    colours: str = "inferno"  # name of a colour map of matplotlib
    title: str = ""
    unit: str = ""

    @property
    def label(self) -> str:
        """Label of the colour bar, e.g. "extinction [1/scene unit]"."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


@dataclass(frozen=True, eq=False)
class InspectionGrid:
    """Values on a regular grid along the scene's axes; base class of volumes, slices and isosurfaces."""

    values: np.ndarray  # (X, Y, Z) numbers
    origin: np.ndarray  # (3,) position of values[0, 0, 0], scene units
    spacing: float  # distance of neighbouring points, scene units
    scale: Scale  # colours of the numbers

    @property
    def box(self) -> np.ndarray:
        """Corners of the box that the voxels around the grid points fill, (2, 3) float64, scene units."""
        low = np.asarray(self.origin, np.float64) - self.spacing / 2
        return np.stack([low, low + self.spacing * np.array(self.values.shape)])


@dataclass(frozen=True, eq=False)
class Volume(InspectionGrid):
    """A volume rendering of a grid. A ray segment of length h (scene units) has opacity 1 - exp(-|value| depth h)."""

    depth: float = 1.0  # optical depth of the value 1 per scene unit; frame.gain for extinction


@dataclass(frozen=True, eq=False)
class Slices(InspectionGrid):
    """Slices of a grid: three planes perpendicular to the axes."""

    through: np.ndarray | None = None  # (3,) common point of the planes, scene units; None for the centre of the grid


@dataclass(frozen=True, eq=False)
class Isosurfaces(InspectionGrid):
    """Isosurfaces of a grid. The surfaces are closed at the grid's border, as if values were 0 outside the grid.

    Attributes:
        levels: values of the surfaces, at least one. HTML pages show one surface, with a slider for its level.
    """

    levels: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Painted:
    """Base class of layers with a colour per vertex, point or ellipsoid.

    The colours come from ``values`` and ``scale``, else from ``colours``; without these, the layer is white.
    """

    values: np.ndarray | None = None  # (N,) numbers, one per vertex, point or ellipsoid; with scale
    scale: Scale | None = None  # colours of values
    colours: np.ndarray | None = None  # (N, 3) colours, or (3,) for all
    opacity: float = 1.0  # opacity 0..1


@dataclass(frozen=True, eq=False)
class Ellipsoids(Painted):
    """N solid ellipsoids; put the most important first, since HTML pages show a limited number.

    Attributes:
        axes: (N, 3, 3) semi-axes, scene units; the vector ``axes[n, k]`` is semi-axis k of ellipsoid n.
    """

    centres: np.ndarray  # (N, 3) centres, scene units
    axes: np.ndarray


@dataclass(frozen=True, eq=False)
class Mesh(Painted):
    """A triangle mesh; triangles that share vertices are shaded smoothly."""

    vertices: np.ndarray  # (N, 3) positions, scene units
    faces: np.ndarray  # (F, 3) integers: rows of vertices


@dataclass(frozen=True, eq=False)
class Points(Painted):
    """Points, drawn as balls; all have the same size on the screen."""

    centres: np.ndarray  # (N, 3) positions, scene units
    size: float = 8.0  # diameter in pixels


@dataclass(frozen=True)
class Text:
    """Lines of text in a corner of the picture."""

    text: str  # lines, separated by line breaks
    corner: Literal["upper_right", "lower_right"] = "lower_right"


Layer = Volume | Slices | Isosurfaces | Ellipsoids | Mesh | Points | Text


# ---------------------------------------------------------------- colours


def colormap_bytes(name: str, count: int = 256) -> np.ndarray:
    """Return (count, 3) uint8 colours of a colour map, from its lower to its upper end."""
    return np.asarray(np.rint(255 * matplotlib.colormaps[name](np.linspace(0, 1, count))[:, :3]).astype(np.uint8))


def layer_colours(layer: Painted, count: int) -> np.ndarray:
    """Return (count, 3) uint8 colours of a layer's vertices, points or ellipsoids."""
    if layer.values is not None and layer.scale is not None:
        scale = layer.scale
        part = np.clip((layer.values.astype(np.float64) - scale.low) / (scale.high - scale.low), 0.0, 1.0)
        return colormap_bytes(scale.colours)[np.minimum((256 * part).astype(np.int64), 255)]
    colours = np.ones(3) if layer.colours is None else layer.colours
    return np.asarray(np.broadcast_to(np.rint(255 * colours).astype(np.uint8), (count, 3)))


# ---------------------------------------------------------------- validation

_CORNERS = ("upper_right", "lower_right")
_LARGEST = float(np.finfo(np.float32).max)


class _InvalidLayer(Exception):
    """Error for a layer that cannot be drawn; the message names the member, its value, and the expected value."""


def validate_inspection_layers(found: Any) -> str | None:
    """Find the first invalid layer in an inspector's result (VTK crashes on a wrong index).

    Returns:
        ``"returned WHAT; expected WHAT"``, or None if all layers are valid.
    """
    expected = f"of neuprim.inspect.layers: {', '.join(kind.__name__ for kind in get_args(Layer))}"
    if not isinstance(found, list | tuple):
        return f"returned a {type(found).__name__}; expected a list of layers {expected}"
    for i, layer in enumerate(found):
        if not isinstance(layer, get_args(Layer)):
            return f"returned a {type(layer).__name__} as layer {i}; expected one {expected}"
        try:
            if isinstance(layer, Text):
                _require_inspectable(isinstance(layer.text, str), "text", repr(layer.text), "text")
                _require_inspectable(layer.corner in _CORNERS, "corner", repr(layer.corner), " or ".join(_CORNERS))
            elif isinstance(layer, InspectionGrid):
                _check_inspection_grid(layer)
            else:
                _check_inspection_shape(layer)
        except _InvalidLayer as problem:
            return f"returned layer {i}, a {type(layer).__name__}, whose {problem}"
    return None


def _require_inspectable(ok: object, name: str, found: object, expected: str) -> None:
    if not ok:
        raise _InvalidLayer(f"{name} is {found}; expected {expected}")


def _check_inspection_grid(layer: Any) -> None:
    values = _check_inspection_array(layer, "values", (None, None, None))
    _require_inspectable(min(values.shape), "values", f"of shape {values.shape}", "at least one point along each axis")
    _check_inspection_array(layer, "origin", (3,))
    _check_inspection_scale(layer.scale)
    positive = _is_number(layer.spacing, 0) and layer.spacing
    _require_inspectable(positive, "spacing", repr(layer.spacing), "a positive number of scene units")
    if isinstance(layer, Volume):
        _require_inspectable(_is_number(layer.depth, 0), "depth", repr(layer.depth), "a number from 0")
    if isinstance(layer, Slices) and layer.through is not None:
        _check_inspection_array(layer, "through", (3,))
    if isinstance(layer, Isosurfaces):
        fine = isinstance(layer.levels, tuple | list) and layer.levels and all(map(_is_number, layer.levels))
        _require_inspectable(fine, "levels", repr(layer.levels), "a tuple of at least one number")


def _check_inspection_shape(layer: Any) -> None:
    count = len(_check_inspection_array(layer, "vertices" if isinstance(layer, Mesh) else "centres", (None, 3)))
    if isinstance(layer, Ellipsoids):
        _check_inspection_array(layer, "axes", (count, 3, 3))
    if isinstance(layer, Mesh):
        rows = _check_inspection_array(layer, "faces", (None, 3))
        _require_inspectable(rows.dtype.kind in "iu", "faces", f"of type {rows.dtype}", "integers")
        inside = not rows.size or 0 <= int(rows.min()) <= int(rows.max()) < count
        _require_inspectable(inside, "faces", "an index beyond the vertices", f"rows 0 to {count - 1} of them")
    if isinstance(layer, Points):
        positive = _is_number(layer.size, 0) and layer.size
        _require_inspectable(positive, "size", repr(layer.size), "a positive number of pixels")
    _require_inspectable(_is_number(layer.opacity, 0, 1), "opacity", repr(layer.opacity), "a number from 0 to 1")
    if layer.values is not None:
        _check_inspection_array(layer, "values", (count,))
        _check_inspection_scale(layer.scale)
    elif layer.colours is not None:
        colours = _check_inspection_array(layer, "colours", (3,) if np.ndim(layer.colours) == 1 else (count, 3))
        inside = not colours.size or bool(0 <= colours.min() <= colours.max() <= 1)
        _require_inspectable(inside, "colours", "beyond 0 or 1", "numbers from 0 to 1")


def _check_inspection_scale(scale: Any) -> None:
    _require_inspectable(isinstance(scale, Scale), "scale", f"a {type(scale).__name__}", "a Scale")
    ends = _is_number(scale.low) and _is_number(scale.high) and scale.low < scale.high
    _require_inspectable(ends, "scale", f"from {scale.low!r} to {scale.high!r}", "a lower and a higher number")
    known = isinstance(scale.colours, str) and scale.colours in matplotlib.colormaps
    _require_inspectable(known, "scale", f"of colours {scale.colours!r}", "a colour map of matplotlib, as 'inferno'")


def _check_inspection_array(layer: Any, name: str, shape: tuple[int | None, ...]) -> Any:
    value = getattr(layer, name)
    _require_inspectable(isinstance(value, np.ndarray), name, f"a {type(value).__name__}", "a numpy array")
    fits = len(value.shape) == len(shape) and all(n in (None, m) for n, m in zip(shape, value.shape, strict=True))
    expected = ", ".join("N" if n is None else str(n) for n in shape)
    _require_inspectable(fits, name, f"of shape {value.shape}", f"({expected})")
    _require_inspectable(value.dtype.kind in "fiub", name, f"of type {value.dtype}", "real numbers")
    finite = not value.size or bool(-_LARGEST <= value.min() <= value.max() <= _LARGEST)  # False for NaN, too
    _require_inspectable(finite, name, "not finite in float32", "finite numbers")
    return value


def _is_number(value: Any, low: float = -_LARGEST, high: float = _LARGEST) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and bool(low <= value <= high)  # type: ignore[operator]
