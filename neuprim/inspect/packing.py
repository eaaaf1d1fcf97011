"""Layers as what a page holds: JSON, and arrays that are compressed and stored once each."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from neuprim.inspect.layers import (
    Ellipsoids,
    Grid,
    Isosurfaces,
    Layer,
    Lines,
    Mesh,
    Points,
    Scale,
    Slices,
    Text,
    Volume,
)
from neuprim.inspect.paint import painted

__all__ = ["ELLIPSOIDS_LIMIT", "Packed", "encoded"]

ELLIPSOIDS_LIMIT = 4000
"""Ellipsoids of a layer that a page holds, the first ones."""


def encoded(values: np.ndarray, scale: Scale) -> tuple[np.ndarray, str]:
    """uint8 of numbers, and which code they are in. Roots spend most steps on what is near 0, where thin matter is.

    ========  ==========================  ==================================================
    code      scales                      byte
    ========  ==========================  ==================================================
    root      that begin at 0             255 sqrt(v / high)
    signed    with 0 between their ends   128 + 127 sign(v) sqrt(|v| / reach), so that 0 is 0
    linear    others                      255 (v - low) / (high - low)
    ========  ==========================  ==================================================

    ``reach`` is the larger of |low| and |high|.
    """
    low, high = scale.low, scale.high
    if low == 0:
        return _byte(255 * np.sqrt(np.clip(values / high, 0.0, 1.0))), "root"
    if low < 0 < high:
        part = np.clip(values, low, high) / max(-low, high)
        return _byte(128 + 127 * np.sign(part) * np.sqrt(np.abs(part))), "signed"
    return _byte(255 * np.clip((values - low) / (high - low), 0.0, 1.0)), "linear"


def _byte(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.rint(values).astype(np.uint8))


class Packed:
    """The arrays of one frame, in the order in which layers asked for them."""

    def __init__(self) -> None:
        self.arrays: list[str] = []
        self._grids: dict[
            tuple[int, float, float], tuple[np.ndarray, int, str]
        ] = {}  # the grid itself, so that its id stays its own

    @property
    def size(self) -> int:
        """Characters of all arrays."""
        return sum(map(len, self.arrays))

    def layers(self, layers: Sequence[Layer]) -> list[dict[str, Any]]:
        """JSON of layers without a fault; arrays are named by their place in :attr:`arrays`."""
        return [self._layer(layer) for layer in layers]

    def _layer(self, layer: Layer) -> dict[str, Any]:
        if isinstance(layer, Text):
            return {"kind": "text", "text": layer.text, "corner": layer.corner}
        if isinstance(layer, Grid):
            return self._grid(layer)
        found: dict[str, Any] = {
            "opacity": float(layer.opacity),
            "scale": None if layer.values is None else _scale(layer.scale),
        }
        if isinstance(layer, Ellipsoids):
            count = min(len(layer.centres), ELLIPSOIDS_LIMIT)
            colours = (
                layer.colours
                if layer.colours is not None and layer.values is None and layer.colours.ndim == 2
                else None
            )
            rgb = painted(layer, len(layer.centres))[:count] / 255.0 if colours is None else colours[:count]
            rows = np.c_[layer.centres[:count], layer.axes[:count].reshape(-1, 9), rgb]
            return {
                **found,
                "kind": "ellipsoids",
                "rows": self._keep(rows, "<f4"),
                "count": count,
                "of": len(layer.centres),
            }
        points = layer.centres if isinstance(layer, Points) else layer.vertices
        found |= {"points": self._keep(points, "<f4"), "rgb": self._keep(painted(layer, len(points)), "u1")}
        if isinstance(layer, Points):
            return {**found, "kind": "points", "size": float(layer.size)}
        rows = layer.faces if isinstance(layer, Mesh) else layer.pairs
        assert isinstance(layer, Mesh | Lines)
        return {**found, "kind": "mesh" if isinstance(layer, Mesh) else "lines", "rows": self._keep(rows, "<u4")}

    def _grid(self, layer: Grid) -> dict[str, Any]:
        scale, box = layer.scale, layer.box
        key = (id(layer.values), float(scale.low), float(scale.high))
        if key not in self._grids:
            stored, code = encoded(layer.values.astype(np.float32, copy=False), scale)
            self._grids[key] = (layer.values, self._keep(stored.ravel(order="F"), "u1"), code)
        _, place, code = self._grids[key]
        found = {
            "grid": place,
            "code": code,
            "shape": layer.values.shape,
            "low": box[0].tolist(),
            "size": (box[1] - box[0]).tolist(),
        }
        found |= {"step": float(layer.steps.min()), "scale": _scale(scale)}
        if isinstance(layer, Volume):
            return {**found, "kind": "volume", "depth": float(layer.depth)}
        if isinstance(layer, Isosurfaces):
            return {**found, "kind": "isosurfaces", "level": float(min(layer.levels))}
        assert isinstance(layer, Slices)
        through = box.mean(0) if layer.through is None else np.asarray(layer.through, np.float64)
        return {**found, "kind": "slices", "through": ((through - box[0]) / (box[1] - box[0])).tolist()}

    def _keep(self, values: np.ndarray, kind: str) -> int:
        self.arrays.append(base64.b64encode(zlib.compress(np.ascontiguousarray(values, kind).tobytes(), 9)).decode())
        return len(self.arrays) - 1


def _scale(scale: Scale | None) -> dict[str, Any] | None:
    if scale is None:
        return None
    return {"low": float(scale.low), "high": float(scale.high), "colours": scale.colours, "words": scale.words}
