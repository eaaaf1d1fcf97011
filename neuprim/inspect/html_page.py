"""Write the layers of all frames as one HTML file, for any browser with WebGL 2 and without a network.

Grids are stored in 8 bits; arrays are compressed and stored once each.
"""

from __future__ import annotations

import base64
import html
import json
import zlib
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Protocol

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
    Lines,
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

ELLIPSOIDS_LIMIT = 4000  # of a layer, the first ones
_ALWAYS = (VOLUME, ISOSURFACE, SLICES, DIFFERENCE)  # they show grids that the page has anyway
_SIZE_LIMIT = 2**29  # bytes of a page; browsers refuse longer strings


class InspectionFrames(Protocol):
    """What a page is made of: frames on one grid."""

    name: str
    up: str

    def __len__(self) -> int: ...

    def frame(self, index: int) -> InspectionFrame: ...


def write_inspection_page(path: Path, frames: InspectionFrames, inspectors: Sequence[Inspector]) -> None:
    """Write the page, whole or not at all. It opens with the first inspector and offers the built-in views, too.

    Raises:
        ConfigError: more frames than one page holds.
    """
    first = frames.frame(0)
    free = [view for view in _ALWAYS if view.shows != "both" or first.truth is not None]
    views = [*free, *(view for view in inspectors if view not in free)]
    stored: list[dict[str, Any]] = []
    size = 0
    for i in range(len(frames)):
        packed = InspectionFrameArrays()
        stored.append(_inspection_frame_data(frames.frame(i), views, frames.up, packed))
        size += packed.size
        if size > _SIZE_LIMIT:
            raise ConfigError(
                f"--out {path}: more than {_SIZE_LIMIT >> 20} MiB after {i + 1} of {len(frames)} frames; "
                "expected fewer, or a smaller --grid"
            )
    points, faces = unit_sphere(1)
    kinds = {v.name: {"numbers": v.shows in ("sigma", "both"), "alone": v.shows == "primitive"} for v in views}
    data = {
        "up": frames.up,
        "box": first.box.tolist(),
        "views": kinds,
        "first": inspectors[0].name,
        "maps": {name: colormap_bytes(name).ravel().tolist() for name in sorted(set(_inspection_colormaps(stored)))},
        "ball": {"points": points.ravel().round(6).tolist(), "faces": faces.ravel().tolist()},
        "frames": stored,
    }
    template = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    title = html.escape(f"neuprim inspect: {frames.name}")
    write_text(path, template.replace("__TITLE__", title).replace("__DATA__", text))


def _inspection_frame_data(
    frame: InspectionFrame, views: Sequence[Inspector], up: str, packed: InspectionFrameArrays
) -> dict[str, Any]:
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


def _inspection_colormaps(frames: Sequence[dict[str, Any]]) -> Iterator[str]:
    for frame in frames:
        for sides in frame["layers"].values():
            for layers in sides.values():
                yield from (layer["scale"]["colours"] for layer in layers if layer.get("scale"))


def encode_inspected_values(values: np.ndarray, scale: Scale) -> tuple[np.ndarray, str]:
    """Encode numbers as uint8, and name the code. Roots spend most steps near 0, where thin matter is.

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
        code, byte = "root", 255 * np.sqrt(np.clip(values / high, 0.0, 1.0))
    elif low < 0 < high:
        part = np.clip(values, low, high) / max(-low, high)
        code, byte = "signed", 128 + 127 * np.sign(part) * np.sqrt(np.abs(part))
    else:
        code, byte = "linear", 255 * np.clip((values - low) / (high - low), 0.0, 1.0)
    return np.asarray(np.rint(byte).astype(np.uint8)), code


class InspectionFrameArrays:
    """The arrays of one frame, compressed, in the order in which layers use them."""

    def __init__(self) -> None:
        self.arrays: list[str] = []
        # with the grid itself, so that its id stays its own
        self._grids: dict[tuple[int, float, float], tuple[np.ndarray, int, str]] = {}

    @property
    def size(self) -> int:
        """Characters of all arrays."""
        return sum(map(len, self.arrays))

    def pack_layers(self, layers: Sequence[Layer]) -> list[dict[str, Any]]:
        """Return the JSON of valid layers; arrays are given by their index in :attr:`arrays`."""
        return [self._pack(layer) for layer in layers]

    def _pack(self, layer: Layer) -> dict[str, Any]:
        if isinstance(layer, Text):
            return {"kind": "text", "text": layer.text, "corner": layer.corner}
        if isinstance(layer, InspectionGrid):
            return self._pack_grid(layer)
        scale = None if layer.values is None or layer.scale is None else _inspection_scale_data(layer.scale)
        found: dict[str, Any] = {"opacity": float(layer.opacity), "scale": scale}
        if isinstance(layer, Ellipsoids):
            count = min(len(layer.centres), ELLIPSOIDS_LIMIT)
            exact = layer.values is None and layer.colours is not None and layer.colours.ndim == 2
            rgb = layer.colours if exact else layer_colours(layer, len(layer.centres)) / 255.0
            assert rgb is not None
            rows = np.c_[layer.centres[:count], layer.axes[:count].reshape(-1, 9), rgb[:count]]
            more = {"rows": self._store(rows, "<f4"), "count": count, "of": len(layer.centres)}
            return {**found, "kind": "ellipsoids", **more}
        points = layer.centres if isinstance(layer, Points) else layer.vertices
        found |= {"points": self._store(points, "<f4"), "rgb": self._store(layer_colours(layer, len(points)), "u1")}
        if isinstance(layer, Points):
            return {**found, "kind": "points", "size": float(layer.size)}
        if isinstance(layer, Mesh):
            return {**found, "kind": "mesh", "rows": self._store(layer.faces, "<u4")}
        assert isinstance(layer, Lines)
        return {**found, "kind": "lines", "rows": self._store(layer.pairs, "<u4")}

    def _pack_grid(self, layer: InspectionGrid) -> dict[str, Any]:
        scale, box = layer.scale, layer.box
        key = (id(layer.values), float(scale.low), float(scale.high))
        if key not in self._grids:
            stored, code = encode_inspected_values(layer.values.astype(np.float32, copy=False), scale)
            self._grids[key] = (layer.values, self._store(stored.ravel(order="F"), "u1"), code)
        _, index, code = self._grids[key]
        found = {"grid": index, "code": code, "shape": layer.values.shape, "low": box[0].tolist()}
        found |= {
            "size": (box[1] - box[0]).tolist(),
            "step": float(layer.steps.min()),
            "scale": _inspection_scale_data(scale),
        }
        if isinstance(layer, Volume):
            return {**found, "kind": "volume", "depth": float(layer.depth)}
        if isinstance(layer, Isosurfaces):
            return {**found, "kind": "isosurfaces", "level": float(min(layer.levels))}
        assert isinstance(layer, Slices)
        through = box.mean(0) if layer.through is None else np.asarray(layer.through, np.float64)
        return {**found, "kind": "slices", "through": ((through - box[0]) / (box[1] - box[0])).tolist()}

    def _store(self, values: np.ndarray, dtype: str) -> int:
        self.arrays.append(base64.b64encode(zlib.compress(np.ascontiguousarray(values, dtype).tobytes(), 9)).decode())
        return len(self.arrays) - 1


def _inspection_scale_data(scale: Scale) -> dict[str, Any]:
    return {"low": float(scale.low), "high": float(scale.high), "colours": scale.colours, "words": scale.label}
