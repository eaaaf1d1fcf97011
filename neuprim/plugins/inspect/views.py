"""The built-in ways of showing a density: each draws one frame into the plotter's current panel."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from neuprim.core.extensions import Inspector
from neuprim.core.task import API_VERSION
from neuprim.plugins.inspect.field import UNIT, FieldFrame
from neuprim.plugins.inspect.shapes import ellipsoids, image, padded

__all__ = ["DIFFERENCE", "ISOSURFACE", "PRIMITIVE", "PRIMITIVES", "SLICES", "VOLUME"]

COLOURS = "inferno"
SURFACES = "plasma"  # brighter at its lower end, where the outermost surface is
_STEPS = 256

FAINT = 1.0 / 255.0
"""Opacity from which an ellipsoid is drawn."""


def _bar(frame: FieldFrame, title: str = UNIT) -> dict[str, Any]:
    """A scalar bar of the frame's own panel; plotters tell bars apart by their titles only."""
    look = {"title_font_size": 15, "label_font_size": 13, "n_labels": 2, "fmt": "%.3g", "color": "white"}
    return {"title": title + " " * frame.panel, "width": 0.6, "height": 0.09, "position_x": 0.2, "position_y": 0.02, **look}


def _add_bar(plotter: Any, frame: FieldFrame, clim: tuple[float, float], colours: str, title: str = UNIT) -> None:
    """A scalar bar that does not hang on what is drawn: opaque, and there where nothing else is."""
    import pyvista

    ends = pyvista.PolyData(np.repeat(frame.box[:1], 2, 0))
    ends["values"] = np.array(clim, np.float32)
    plotter.add_mesh(ends, scalars="values", cmap=colours, clim=clim, point_size=1, scalar_bar_args=_bar(frame, title))


def _outline(plotter: Any, frame: FieldFrame) -> None:
    import pyvista

    low, high = frame.box
    box = pyvista.Box(np.stack([low, high], 1).ravel())
    plotter.add_mesh(box.outline(), color="#8894a0", line_width=1, lighting=False)


def _opacities(frame: FieldFrame, values: np.ndarray) -> np.ndarray:
    """Opacity over one grid step of |values| times the frame's gain: the density's own law, made visible."""
    alpha: np.ndarray = 1.0 - np.exp(-np.abs(values) * frame.gain * frame.step)
    return alpha


def _add_volume(plotter: Any, frame: FieldFrame, values: np.ndarray, clim: tuple[float, float], colours: str, title: str) -> None:
    ramp = np.linspace(*clim, _STEPS)
    data = image(frame, np.clip(values, *clim))
    plotter.add_volume(
        data,
        scalars="values",
        cmap=colours,
        clim=clim,
        opacity=np.rint(255 * _opacities(frame, ramp)),
        opacity_unit_distance=frame.step,
        shade=False,
        mapper="smart",
        show_scalar_bar=False,
    )
    _add_bar(plotter, frame, clim, colours, title)
    _outline(plotter, frame)


def _volume(plotter: Any, frame: FieldFrame) -> None:
    _add_volume(plotter, frame, frame.sigma, (0.0, frame.top), COLOURS, UNIT)


def _difference(plotter: Any, frame: FieldFrame) -> None:
    reach = frame.top / 2  # errors are smaller than what they are errors of
    _add_volume(plotter, frame, frame.difference, (-reach, reach), "coolwarm", "model - truth [1/scene unit]")


def levels_of(frame: FieldFrame) -> tuple[float, ...]:
    """The levels of isosurfaces, 1/scene unit."""
    return frame.options.levels or tuple(part * frame.top for part in (0.1, 1 / 3, 2 / 3))


def _isosurface(plotter: Any, frame: FieldFrame) -> None:
    data, levels = padded(frame, frame.sigma), sorted(levels_of(frame))
    for i, level in enumerate(levels):
        surface = data.contour([level], scalars="values")
        if surface.n_points:
            last = i == len(levels) - 1
            plotter.add_mesh(
                surface,
                scalars="values",
                cmap=SURFACES,
                clim=(0.0, frame.top),
                opacity=0.95 if last else 0.22 + 0.2 * i,
                smooth_shading=True,
                specular=0.25,
                show_scalar_bar=False,
            )
    _outline(plotter, frame)
    _add_bar(plotter, frame, (0.0, frame.top), SURFACES)


def _slices(plotter: Any, frame: FieldFrame) -> None:
    x, y, z = frame.focus
    cut = image(frame, frame.sigma).slice_orthogonal(x=x, y=y, z=z)
    plotter.add_mesh(cut, scalars="values", cmap=COLOURS, clim=(0.0, frame.top), lighting=False, scalar_bar_args=_bar(frame))
    _outline(plotter, frame)


def strongest(frame: FieldFrame) -> np.ndarray:
    """Positions in ``frame.alive`` of the ellipsoids that are drawn: those that can be seen at all, those that absorb most first."""
    visible = opacity_of(frame) >= FAINT
    order = frame.masses.argsort()[::-1]
    return np.asarray(order[visible[order]][: frame.options.limit])


def opacity_of(frame: FieldFrame) -> np.ndarray:
    """(M,) opacity 0..1 of primitives: of a ray along their mean radius through their mean extinction."""
    volume = frame.geometry.scales.double().numpy().prod(1)
    return np.asarray(1 - np.exp(-2 * frame.masses / (4.18879 * volume) * volume ** (1 / 3)))


def _primitives(plotter: Any, frame: FieldFrame) -> None:
    import pyvista

    chosen = strongest(frame)
    if len(chosen):
        points, faces = ellipsoids(frame.geometry[torch.from_numpy(chosen)], 2 if len(chosen) <= 4000 else 1)
        mesh = pyvista.PolyData(points, np.c_[np.full(len(faces), 3), faces].ravel())
        mesh.point_data["colour"] = np.rint(255 * np.repeat(frame.colours[chosen], len(points) // len(chosen), 0)).astype(np.uint8)
        plotter.add_mesh(
            mesh, scalars="colour", rgb=True, smooth_shading=True, ambient=0.3, diffuse=0.8, specular=0.15, show_scalar_bar=False
        )
    _outline(plotter, frame)
    words = f"{len(chosen)} of {frame.model.count} primitives at their true size\nleft out: opacity below 1/255"
    plotter.add_text(words, position="lower_right", font_size=8, color="white")


def cut_open(frame: FieldFrame, position: int, rings: int = 48) -> tuple[Any, np.ndarray]:
    """A primitive without a quarter of its ellipsoid, as a ``pyvista`` grid, and its unclamped extinction at the grid's points."""
    import pyvista

    ball = pyvista.SolidSphere(
        outer_radius=1.0, radius_resolution=rings // 2, theta_resolution=2 * rings, phi_resolution=rings, start_theta=0, end_theta=270
    )
    one = frame.geometry[position : position + 1]
    axes = (one.rotations * one.scales[:, None, :])[0].double()
    unit = torch.from_numpy(np.asarray(ball.points, np.float64))
    placed = one.means[0].double() + unit @ axes.T
    ball.points = placed.numpy()
    return ball, frame.density(int(frame.alive[position]), placed)


def _primitive(plotter: Any, frame: FieldFrame) -> None:
    position = frame.row()
    solid, sigma = cut_open(frame, position)
    solid.point_data["values"] = sigma.astype(np.float32)
    low, high = float(sigma.min()), float(sigma.max())
    reach = max(abs(low), abs(high)) or 1.0
    clim = (-reach, reach) if low < 0 else (0.0, reach)
    surface = solid.extract_surface(algorithm="dataset_surface")
    plotter.add_mesh(
        surface,
        scalars="values",
        cmap="coolwarm" if low < 0 else COLOURS,
        clim=clim,
        ambient=0.5,
        diffuse=0.6,
        scalar_bar_args=_bar(frame),
    )
    if low < 0 < high:
        zero = solid.contour([0.0], scalars="values")
        if zero.n_points:
            plotter.add_mesh(zero.extract_feature_edges(), color="black", line_width=2)
    scales = ", ".join(f"{s:.3g}" for s in frame.geometry.scales[position].tolist())
    center = ", ".join(f"{s:.3g}" for s in frame.geometry.means[position].tolist())
    words = f"primitive {frame.alive[position]}\ncentre ({center})\nradii ({scales})\nextinction {low:.3g} to {high:.3g}, unclamped"
    plotter.add_text(words, position="upper_right", font_size=8, color="white")


VOLUME = Inspector(API_VERSION, "volume", "the extinction as a cloud", _volume)
ISOSURFACE = Inspector(API_VERSION, "isosurface", "surfaces of equal extinction", _isosurface)
SLICES = Inspector(API_VERSION, "slices", "three planes through the middle of the matter", _slices)
PRIMITIVES = Inspector(API_VERSION, "primitives", "the ellipsoids in their own colours", _primitives, shows="model")
PRIMITIVE = Inspector(API_VERSION, "primitive", "the density inside one primitive, cut open", _primitive, shows="primitive")
DIFFERENCE = Inspector(API_VERSION, "difference", "model minus ground truth", _difference, shows="both")
