"""Layers into a pyvista plotter's current panel: the one place that knows VTK's objects."""

from __future__ import annotations

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
    Painted,
    Points,
    Scale,
    Slices,
    Text,
    Volume,
)
from neuprim.inspect.paint import painted
from neuprim.inspect.shapes import ellipsoids

__all__ = ["add_box", "add_layers"]

_STEPS = 256
_FINE = 4000  # ellipsoids up to which each gets many triangles


def add_layers(plotter: Any, layers: Sequence[Layer], panel: int) -> None:
    """Draws the layers, and a bar for each of their scales.

    Args:
        layers: without a fault (:func:`~neuprim.inspect.layer_checks.fault`).
        panel: number of the panel; plotters tell bars apart by their titles only.
    """
    scales: dict[Scale, None] = {}
    for layer in layers:
        if isinstance(layer, Text):
            plotter.add_text(layer.text, position=layer.corner, font_size=8, color="white")
            continue
        _ADD[type(layer)](plotter, layer)
        scale = layer.scale if isinstance(layer, Grid) or layer.values is not None else None
        if scale is not None and scale.title:
            scales[scale] = None
    for place, scale in enumerate(scales):
        _add_bar(plotter, scale, panel, place)


def add_box(plotter: Any, box: np.ndarray) -> None:
    """The edges of a (2, 3) box."""
    import pyvista

    low, high = box
    edges = pyvista.Box(np.stack([low, high], 1).ravel())
    plotter.add_mesh(edges.outline(), color="#8894a0", line_width=1, lighting=False)


def _add_bar(plotter: Any, scale: Scale, panel: int, place: int) -> None:
    """A scalar bar that does not hang on what is drawn: opaque, and there where nothing is. The first is lowest."""
    import pyvista

    mapper = pyvista.DataSetMapper()
    mapper.lookup_table = pyvista.LookupTable(scale.colours, scalar_range=(scale.low, scale.high))
    look = {"title_font_size": 15, "label_font_size": 13, "n_labels": 2, "fmt": "%.3g", "color": "white"}
    size = {"width": 0.6, "height": 0.09, "position_x": 0.2, "position_y": 0.02 + 0.11 * place}
    title = scale.words + " " * panel + "\u200a" * place
    plotter.add_scalar_bar(title, mapper=mapper, render=False, **size, **look)


def _image(layer: Grid, values: np.ndarray, around: int = 0) -> Any:
    """``pyvista.ImageData`` of values at the layer's points, named "values", with some layers of zeros around."""
    import pyvista

    origin = np.asarray(layer.origin, np.float64) - around * layer.steps
    found = pyvista.ImageData(dimensions=np.array(values.shape) + 2 * around, spacing=tuple(layer.steps), origin=origin)
    found.point_data["values"] = np.pad(values.astype(np.float32, copy=False), around).ravel(order="F")
    return found


def _volume(plotter: Any, layer: Volume) -> None:
    scale, step = layer.scale, float(layer.steps.min())
    ramp = np.linspace(scale.low, scale.high, _STEPS)
    plotter.add_volume(
        _image(layer, np.clip(layer.values, scale.low, scale.high)),
        scalars="values",
        cmap=scale.colours,
        clim=(scale.low, scale.high),
        opacity=np.rint(255 * (1.0 - np.exp(-np.abs(ramp) * layer.depth * step))),
        opacity_unit_distance=step,
        shade=False,
        mapper="smart",
        show_scalar_bar=False,
    )


def _isosurfaces(plotter: Any, layer: Isosurfaces) -> None:
    data, levels = _image(layer, layer.values, around=1), sorted(layer.levels)
    for i, level in enumerate(levels):
        surface = data.contour([level], scalars="values")
        if surface.n_points:
            opacity = 0.95 if i == len(levels) - 1 else min(0.22 + 0.2 * i, 0.95)
            plotter.add_mesh(surface, opacity=opacity, smooth_shading=True, specular=0.25, **_numbers(layer.scale))


def _slices(plotter: Any, layer: Slices) -> None:
    x, y, z = layer.box.mean(0) if layer.through is None else layer.through
    cut = _image(layer, layer.values).slice_orthogonal(x=x, y=y, z=z)
    if any(part.n_points for part in cut):
        plotter.add_mesh(cut, lighting=False, **_numbers(layer.scale))


def _ellipsoids(plotter: Any, layer: Ellipsoids) -> None:
    count = len(layer.centres)
    points, faces = ellipsoids(layer.centres, layer.axes, 2 if count <= _FINE else 1)
    if count:
        data, colours = _poly(points, faces=_cells(faces)), np.repeat(painted(layer, count), len(points) // count, 0)
        look = {"smooth_shading": True, "ambient": 0.3, "diffuse": 0.8, "specular": 0.15, "opacity": layer.opacity}
        plotter.add_mesh(data, **look, **_bytes(data, colours))


def _mesh(plotter: Any, layer: Mesh) -> None:
    if len(layer.faces):
        data = _poly(layer.vertices, faces=_cells(layer.faces))
        plotter.add_mesh(
            data, smooth_shading=True, ambient=0.5, diffuse=0.6, opacity=layer.opacity, **_paint(layer, data)
        )


def _points(plotter: Any, layer: Points) -> None:
    if len(layer.centres):
        data = _poly(layer.centres)
        look = {"render_points_as_spheres": True, "point_size": layer.size, "opacity": layer.opacity}
        plotter.add_mesh(data, **look, **_paint(layer, data))


def _lines(plotter: Any, layer: Lines) -> None:
    if len(layer.pairs):
        data = _poly(layer.vertices, lines=_cells(layer.pairs))
        plotter.add_mesh(data, line_width=layer.width, lighting=False, opacity=layer.opacity, **_paint(layer, data))


def _poly(points: np.ndarray, **cells: np.ndarray) -> Any:
    import pyvista

    return pyvista.PolyData(np.ascontiguousarray(points, np.float32), **cells)  # type: ignore[arg-type]


def _cells(rows: np.ndarray) -> np.ndarray:
    return np.c_[np.full(len(rows), rows.shape[1]), rows].ravel()


def _paint(layer: Painted, data: Any) -> dict[str, Any]:
    """How ``add_mesh`` colours a layer's vertices: numbers are coloured where they are seen, between vertices too."""
    if layer.values is not None and layer.scale is not None:
        data.point_data["values"] = layer.values.astype(np.float32)
        return _numbers(layer.scale)
    return _bytes(data, painted(layer, data.n_points))


def _bytes(data: Any, colours: np.ndarray) -> dict[str, Any]:
    data.point_data["colours"] = colours
    return {"scalars": "colours", "rgb": True, "show_scalar_bar": False}


def _numbers(scale: Scale) -> dict[str, Any]:
    return {"scalars": "values", "cmap": scale.colours, "clim": (scale.low, scale.high), "show_scalar_bar": False}


_ADD: dict[type, Any] = {
    Volume: _volume,
    Isosurfaces: _isosurfaces,
    Slices: _slices,
    Ellipsoids: _ellipsoids,
    Mesh: _mesh,
    Points: _points,
    Lines: _lines,
}
