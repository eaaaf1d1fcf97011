"""What an inspector returned, checked before anything is drawn: VTK ends the process where an index is out of range."""

from __future__ import annotations

from numbers import Real
from typing import Any, get_args

import numpy as np

from neuprim.inspect.layers import (
    Ellipsoids,
    Grid,
    Isosurfaces,
    Layer,
    Lines,
    Mesh,
    Painted,
    Points,
    Scale,
    Slices,
    Text,
    Volume,
)

__all__ = ["fault"]

_KINDS = get_args(Layer)
_MOST = float(np.finfo(np.float32).max)
_NAMES = ", ".join(kind.__name__ for kind in _KINDS)


def fault(found: Any) -> str | None:
    """``"returned WHAT; expected WHAT"`` of what is not a list of layers that can be drawn; None if all is well."""
    if not isinstance(found, list | tuple):
        return f"returned {_a(found)}; expected a list of layers of neuprim.inspect.layers: {_NAMES}"
    for i, layer in enumerate(found):
        if not isinstance(layer, _KINDS):
            return f"returned {_a(layer)} as layer {i}; expected one of neuprim.inspect.layers: {_NAMES}"
        wrong = _layer(layer)
        if wrong:
            return f"returned layer {i}, {_a(layer)}, whose {wrong}"
    return None


def _layer(layer: Any) -> str | None:
    if isinstance(layer, Text):
        return None if isinstance(layer.text, str) and layer.corner in ("upper_right", "lower_right") else _text(layer)
    return _grid(layer) if isinstance(layer, Grid) else _shape(layer)


def _text(layer: Text) -> str:
    if not isinstance(layer.text, str):
        return f"text is {_a(layer.text)}; expected text"
    return f"corner is {layer.corner!r}; expected 'upper_right' or 'lower_right'"


def _grid(layer: Grid) -> str | None:
    wrong = (
        _array("values", layer.values, (None, None, None))
        or _array("origin", layer.origin, (3,))
        or _scale(layer.scale)
    )
    if wrong:
        return wrong
    if min(layer.values.shape) < 1:
        return f"values has shape {layer.values.shape}; expected at least one point along each axis"
    spacing = layer.spacing
    parts: list[Any] = (
        list(spacing)
        if isinstance(spacing, tuple | list | np.ndarray) and np.ndim(spacing) == 1 and len(spacing) == 3
        else [spacing]
    )
    if not all(_number(part) and part > 0 for part in parts):
        return f"spacing is {spacing!r}; expected a positive number of scene units, or three"
    if isinstance(layer, Volume) and not (_number(layer.depth) and layer.depth >= 0):
        return f"depth is {layer.depth!r}; expected a number from 0"
    if isinstance(layer, Slices) and layer.through is not None:
        return _array("through", layer.through, (3,))
    if isinstance(layer, Isosurfaces):
        levels = layer.levels
        if not isinstance(levels, tuple | list) or not levels or not all(_number(level) for level in levels):
            return f"levels is {levels!r}; expected a tuple of at least one number"
    return None


def _shape(layer: Any) -> str | None:
    if isinstance(layer, Ellipsoids):
        wrong = _array("centres", layer.centres, (None, 3)) or _array("axes", layer.axes, (len(layer.centres), 3, 3))
        count = layer.centres
    elif isinstance(layer, Points):
        wrong = _array("centres", layer.centres, (None, 3)) or _positive("size", layer.size)
        count = layer.centres
    elif isinstance(layer, Mesh):
        wrong = _array("vertices", layer.vertices, (None, 3)) or _rows("faces", layer.faces, 3, layer.vertices)
        count = layer.vertices
    else:
        assert isinstance(layer, Lines)
        wrong = _array("vertices", layer.vertices, (None, 3)) or _rows("pairs", layer.pairs, 2, layer.vertices)
        wrong = wrong or _positive("width", layer.width)
        count = layer.vertices
    return wrong or _paint(layer, len(count))


def _paint(layer: Painted, count: int) -> str | None:
    if not (_number(layer.opacity) and 0 <= layer.opacity <= 1):
        return f"opacity is {layer.opacity!r}; expected a number from 0 to 1"
    if layer.values is not None:
        if layer.colours is not None:
            return "values and colours are both given; expected one of them"
        return _array("values", layer.values, (count,)) or _scale(layer.scale)
    if layer.colours is None:
        return None
    wrong = _array("colours", layer.colours, (3,) if np.ndim(layer.colours) == 1 else (count, 3))
    if not wrong and layer.colours.size and not 0 <= layer.colours.min() <= layer.colours.max() <= 1:
        return f"colours reach from {layer.colours.min():.4g} to {layer.colours.max():.4g}; expected 0 to 1"
    return wrong


def _scale(scale: Any) -> str | None:
    if not isinstance(scale, Scale):
        return f"scale is {_a(scale)}; expected a Scale"
    if not (_number(scale.low) and _number(scale.high) and scale.low < scale.high):
        return f"scale reaches from {scale.low!r} to {scale.high!r}; expected a lower and a higher number"
    if not isinstance(scale.title, str) or not isinstance(scale.unit, str):
        return f"scale has the title {scale.title!r} and unit {scale.unit!r}; expected texts"
    import matplotlib

    if not isinstance(scale.colours, str) or scale.colours not in matplotlib.colormaps:
        return f"scale has the colours {scale.colours!r}; expected a colour map of matplotlib, as 'inferno'"
    return None


def _array(name: str, value: Any, shape: tuple[int | None, ...]) -> str | None:
    if not isinstance(value, np.ndarray):
        return f"{name} is {_a(value)}; expected a numpy array"
    if len(value.shape) != len(shape) or any(
        want not in (None, got) for got, want in zip(value.shape, shape, strict=True)
    ):
        letters = iter("NPQ")
        wanted = ", ".join(next(letters) if want is None else str(want) for want in shape) + "," * (len(shape) == 1)
        return f"{name} has shape {value.shape}; expected ({wanted})"
    if value.dtype.kind not in "fiub":
        return f"{name} has the type {value.dtype}; expected real numbers"
    if value.size and not -_MOST <= value.min() <= value.max() <= _MOST:  # false for NaN, too
        return f"{name} has a number that is not finite in float32"
    return None


def _rows(name: str, value: Any, width: int, vertices: np.ndarray) -> str | None:
    wrong = _array(name, value, (None, width))
    if wrong:
        return wrong
    if value.dtype.kind not in "iu":
        return f"{name} has the type {value.dtype}; expected integers"
    if value.size and not 0 <= int(value.min()) <= int(value.max()) < len(vertices):
        return f"{name} has rows {value.min()} to {value.max()} of vertices; there are {len(vertices)}"
    return None


def _positive(name: str, value: Any) -> str | None:
    return None if _number(value) and value > 0 else f"{name} is {value!r}; expected a positive number of pixels"


def _number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and bool(abs(value) <= _MOST)  # type: ignore[operator]


def _a(value: Any) -> str:
    kind = type(value).__name__
    return "None" if value is None else f"{'an' if kind[:1].lower() in 'aeiou' else 'a'} {kind}"
