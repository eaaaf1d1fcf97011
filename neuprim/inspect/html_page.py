"""Write the inspection layers of all frames as one HTML file, for browsers with WebGL 2; the page needs no network.

Grids are stored with 8 bits per value. Arrays are compressed. A grid that several layers use is stored once.
"""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Inspector
from neuprim.core.io.files import write_text
from neuprim.inspect.field import InspectionFrame
from neuprim.inspect.layers import (
    Ellipsoids,
    InspectionGrid,
    Isosurfaces,
    Layer,
    Mesh,
    Points,
    Scale,
    Slices,
    Text,
    Volume,
    colormap_bytes,
    layer_colours,
)
from neuprim.inspect.views import DIFFERENCE, ISOSURFACE, SLICES, VOLUME, find_inspection_viewpoint, unit_sphere

ELLIPSOIDS_LIMIT = 4000  # most ellipsoids per layer, the first ones
_ALWAYS = (VOLUME, ISOSURFACE, SLICES, DIFFERENCE)  # always offered: their grids are in the page anyway
_SIZE_LIMIT = 2**29  # bytes of a page; browsers refuse longer strings


def write_inspection_page(
    path: Path,
    name: str,
    up: str,
    count: int,
    frame: Callable[[int], InspectionFrame],
    inspectors: Sequence[Inspector],
) -> None:
    """Write an HTML page of ``count`` frames, with the layers of ``inspectors`` and of some built-in inspectors.

    The page opens with the first of ``inspectors``.

    Args:
        name: name of the run.
        up: the scene's upward axis, "x", "y" or "z".
        frame: function that returns the frame with a given index; all frames have the same grid.

    Raises:
        ConfigError: the page would be too large; the message says after how many frames.
    """
    first = frame(0)
    free = [view for view in _ALWAYS if view.shows != "both" or first.truth is not None]
    views = [*free, *(view for view in inspectors if view not in free)]
    frames: list[dict[str, Any]] = []
    size = 0
    for i in range(count):
        frames.append(_inspection_frame_data(frame(i), views, up))
        size += sum(map(len, frames[-1]["arrays"]))
        if size > _SIZE_LIMIT:
            raise ConfigError(
                f"--out {path}: the page exceeds {_SIZE_LIMIT >> 20} MiB after {i + 1} of {count} frames; "
                "expected fewer frames or a smaller --grid"
            )
    layers = [x for one in frames for sides in one["layers"].values() for side in sides.values() for x in side]
    colours = sorted({layer["scale"]["colours"] for layer in layers if layer.get("scale")})
    points, faces = unit_sphere(1)
    data = {
        "up": up,
        "box": first.box.tolist(),
        "views": {v.name: {"numbers": v.shows in ("sigma", "both"), "alone": v.shows == "primitive"} for v in views},
        "first": inspectors[0].name,
        "maps": {name: colormap_bytes(name).ravel().tolist() for name in colours},
        "ball": {"points": points.ravel().round(6).tolist(), "faces": faces.ravel().tolist()},
        "frames": frames,
    }
    template = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    title = html.escape(f"neuprim inspect: {name}")
    write_text(path, template.replace("__TITLE__", title).replace("__DATA__", text))


def _inspection_frame_data(frame: InspectionFrame, views: Sequence[Inspector], up: str) -> dict[str, Any]:
    packed = InspectionFrameArrays()
    layers: dict[str, Any] = {}
    viewpoints: dict[str, Any] = {}
    for view in views:
        sides = ("model", "truth") if view.shows == "sigma" and frame.truth is not None else ("model",)
        layers[view.name] = {side: packed.pack_layers(view.layers(frame.of_side(side))) for side in sides}
        if view.shows == "primitive":
            point = find_inspection_viewpoint(view, frame, up)
            place = {"focus": point.focus.tolist(), "radius": point.radius, "away": point.direction.tolist()}
            viewpoints[view.name] = place
    numbers = None if frame.numbers is None else dict(frame.numbers)
    words = {"title": frame.title, "truthName": frame.truth_name, "numbers": numbers}
    return {**words, "stands": viewpoints, "layers": layers, "arrays": packed.arrays}


def encode_inspected_values(values: np.ndarray, scale: Scale) -> tuple[np.ndarray, str]:
    """Encode values as uint8; return the bytes and the name of the code. The ends of the scale decide the code.

    ========  ==========================  ==================================================
    code      scale                       byte
    ========  ==========================  ==================================================
    root      begins at 0                 255 sqrt(v / high)
    signed    has 0 between its ends      128 + 127 sign(v) sqrt(|v| / reach), so 0 stays 0
    linear    any other                   255 (v - low) / (high - low)
    ========  ==========================  ==================================================

    v is a value, low and high are the ends of the scale, and ``reach`` is the larger of |low| and |high|. The codes
    "root" and "signed" resolve values near 0 best.
    """
    low, high = scale.low, scale.high
    if low == 0:
        code, byte = "root", 255 * np.sqrt(np.clip(values / high, 0.0, 1.0))
    elif low < 0 < high:
        part = np.clip(values, low, high) / max(-low, high)
        code, byte = "signed", 128 + 127 * np.sign(part) * np.sqrt(np.abs(part))
    else:
        code, byte = "linear", 255 * np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(np.rint(byte).astype(np.uint8)), code


class InspectionFrameArrays:
    """Compressed arrays of one frame, as base64 text. The frame's layers refer to them by index in :attr:`arrays`."""

    def __init__(self) -> None:
        self.arrays: list[str] = []
        # holds the grid itself, so that its id is not reused
        self._grids: dict[tuple[int, float, float], tuple[np.ndarray, int, str]] = {}

    def pack_layers(self, layers: Sequence[Layer]) -> list[dict[str, Any]]:
        """Convert valid layers to JSON values. Arrays are stored in :attr:`arrays`; the JSON has their indices."""
        return [self._pack(layer) for layer in layers]

    def _pack(self, layer: Layer) -> dict[str, Any]:
        if isinstance(layer, Text):
            return {"kind": "text", "text": layer.text, "corner": layer.corner}
        if isinstance(layer, InspectionGrid):
            return self._pack_grid(layer)
        scale = None if layer.values is None or layer.scale is None else _inspection_scale_data(layer.scale)
        found: dict[str, Any] = {"opacity": float(layer.opacity), "scale": scale}
        points = layer.vertices if isinstance(layer, Mesh) else layer.centres
        rgb = layer_colours(layer, len(points))
        if isinstance(layer, Ellipsoids):
            rows = np.c_[points, layer.axes.reshape(-1, 9), rgb / 255.0][:ELLIPSOIDS_LIMIT]
            more = {"rows": self._store(rows, "<f4"), "count": len(rows), "of": len(points)}
            return {**found, "kind": "ellipsoids", **more}
        found |= {"points": self._store(points, "<f4"), "rgb": self._store(rgb, "u1")}
        if isinstance(layer, Points):
            return {**found, "kind": "points", "size": float(layer.size)}
        return {**found, "kind": "mesh", "rows": self._store(layer.faces, "<u4")}

    def _pack_grid(self, layer: InspectionGrid) -> dict[str, Any]:
        scale, box = layer.scale, layer.box
        key = (id(layer.values), float(scale.low), float(scale.high))
        if key not in self._grids:
            stored, code = encode_inspected_values(layer.values.astype(np.float32, copy=False), scale)
            self._grids[key] = (layer.values, self._store(stored.ravel(order="F"), "u1"), code)
        _, index, code = self._grids[key]
        size = box[1] - box[0]
        found = {"grid": index, "code": code, "shape": layer.values.shape, "low": box[0].tolist()}
        found |= {"size": size.tolist(), "step": float(layer.spacing), "scale": _inspection_scale_data(scale)}
        if isinstance(layer, Volume):
            return {**found, "kind": "volume", "depth": float(layer.depth)}
        if isinstance(layer, Isosurfaces):
            return {**found, "kind": "isosurfaces", "level": float(min(layer.levels))}
        assert isinstance(layer, Slices)
        through = box.mean(0) if layer.through is None else np.asarray(layer.through, np.float64)
        return {**found, "kind": "slices", "through": ((through - box[0]) / size).tolist()}

    def _store(self, values: np.ndarray, dtype: str) -> int:
        self.arrays.append(base64.b64encode(zlib.compress(np.ascontiguousarray(values, dtype).tobytes(), 9)).decode())
        return len(self.arrays) - 1


def _inspection_scale_data(scale: Scale) -> dict[str, Any]:
    return {"low": float(scale.low), "high": float(scale.high), "colours": scale.colours, "words": scale.label}
