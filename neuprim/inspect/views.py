"""The built-in inspectors: functions that take a frame and return layers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from neuprim.core.extensions import Inspector
from neuprim.core.task import API_VERSION
from neuprim.inspect.field import InspectionFrame
from neuprim.inspect.layers import Ellipsoids, Isosurfaces, Layer, Mesh, Scale, Slices, Text, Volume

_SURFACE_COLOURS = "plasma"  # brighter at its lower end, where the outermost surface is
_SIGNED_COLOURS = "coolwarm"
_MIN_OPACITY = 1.0 / 255.0  # least opacity of an ellipsoid that is drawn
_MAX_ELLIPSOIDS = 20_000


def _inspect_volume(frame: InspectionFrame) -> list[Layer]:
    return [Volume(frame.sigma, frame.origin, frame.step, frame.scale, depth=frame.gain)]


def _inspect_difference(frame: InspectionFrame) -> list[Layer]:
    reach = frame.top / 2  # errors are smaller than the values
    scale = Scale(-reach, reach, _SIGNED_COLOURS, "model - truth", frame.scale.unit)
    return [Volume(frame.difference, frame.origin, frame.step, scale, depth=frame.gain)]


def _inspect_isosurface(frame: InspectionFrame) -> list[Layer]:
    levels = frame.levels or tuple(part * frame.top for part in (0.1, 1 / 3, 2 / 3))
    scale = Scale(0.0, frame.top, _SURFACE_COLOURS, frame.scale.title, frame.scale.unit)
    return [Isosurfaces(frame.sigma, frame.origin, frame.step, scale, levels=levels)]


def _inspect_slices(frame: InspectionFrame) -> list[Layer]:
    return [Slices(frame.sigma, frame.origin, frame.step, frame.scale, through=np.array(frame.focus))]


def _inspect_primitives(frame: InspectionFrame) -> list[Layer]:
    # A primitive's opacity is that of a ray along the mean radius through the mean extinction.
    order = frame.masses.argsort()[::-1]
    volume = frame.geometry.scales.double().numpy().prod(1)
    visible = 1 - np.exp(-2 * frame.masses / (4.18879 * volume) * volume ** (1 / 3)) >= _MIN_OPACITY
    chosen = order[visible[order]][:_MAX_ELLIPSOIDS].copy()
    geometry = frame.geometry[torch.from_numpy(chosen)]
    axes = (geometry.rotations * geometry.scales[:, None, :]).transpose(1, 2).detach().numpy()
    text = f"{len(chosen)} of {frame.model.count} primitives at their true size\nleft out: opacity below 1/255"
    colours = np.clip(frame.colours[chosen], 0.0, 1.0)
    return [Ellipsoids(geometry.means.detach().numpy(), axes, colours=colours), Text(text)]


def _inspect_density_in_primitive(frame: InspectionFrame) -> list[Layer]:
    position, (unit, faces) = frame.chosen_position(), make_inspection_ball()
    geometry = frame.geometry[position : position + 1]
    axes = (geometry.rotations * geometry.scales[:, None, :])[0].double()
    points = geometry.means[0].double() + torch.from_numpy(unit) @ axes.T
    with torch.no_grad():
        sigma = frame.active.sigma(torch.full((len(points),), position), points.float()).double().numpy()
    low, high = float(sigma.min()), float(sigma.max())
    reach = max(abs(low), abs(high)) or 1.0
    negative = low < 0
    colours = _SIGNED_COLOURS if negative else frame.scale.colours
    scale = Scale(-reach if negative else 0.0, reach, colours, frame.scale.title, frame.scale.unit)
    mesh = Mesh(points.numpy(), faces, values=sigma, scale=scale)
    scales = ", ".join(f"{s:.3g}" for s in geometry.scales[0].tolist())
    center = ", ".join(f"{s:.3g}" for s in geometry.means[0].tolist())
    text = f"primitive {frame.rows[position]}\ncentre ({center})\nradii ({scales})\n"
    return [mesh, Text(f"{text}extinction {low:.3g} to {high:.3g}, unclamped", "upper_right")]


VOLUME = Inspector(API_VERSION, "volume", "the extinction as a cloud", _inspect_volume)
ISOSURFACE = Inspector(API_VERSION, "isosurface", "surfaces of equal extinction", _inspect_isosurface)
SLICES = Inspector(API_VERSION, "slices", "three planes through the middle of the matter", _inspect_slices)
PRIMITIVES = Inspector(
    API_VERSION, "primitives", "the ellipsoids in their own colours", _inspect_primitives, shows="model"
)
PRIMITIVE = Inspector(
    API_VERSION,
    "primitive",
    "the density inside one primitive, cut open",
    _inspect_density_in_primitive,
    shows="primitive",
)
DIFFERENCE = Inspector(API_VERSION, "difference", "model minus ground truth", _inspect_difference, shows="both")


# ---------------------------------------------------------------- viewpoints

_DIRECTIONS = {"x": (-0.45, 1.0, -1.6), "y": (1.0, 0.45, 1.6), "z": (1.0, -1.6, 0.45)}
"""Upward axis of the scene -> vector of any length that points from the centre of the picture to the camera."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Initial camera of an inspector's view.

    Attributes:
        focus: (3,) point in the middle of the picture, scene units.
        radius: radius of the ball around ``focus`` that fills the picture, scene units.
        direction: (3,) unit vector from ``focus`` to the camera.
        up: (3,) unit vector that points upward in the picture.
    """

    focus: np.ndarray
    radius: float
    direction: np.ndarray
    up: np.ndarray


def find_inspection_viewpoint(inspector: Inspector, frame: InspectionFrame, up: str) -> Viewpoint:
    """Choose the initial camera of an inspector's view. The camera shows the whole grid, or a primitive shown alone.

    Args:
        up: the scene's upward axis, "x", "y" or "z".
    """
    if inspector.shows == "primitive":
        position = frame.chosen_position()
        one = frame.geometry[position : position + 1]
        axes = one.rotations[0].double().numpy()
        direction = axes @ np.array([1.0, -1.0, 0.9])  # into the missing quarter, between the first two axes
        direction /= np.linalg.norm(direction)
        return Viewpoint(one.means[0].double().numpy(), 1.12 * float(one.length_scale), direction, axes[:, 2])
    low, high = frame.box
    radius, upward = float(np.linalg.norm(high - low)) / 2, np.eye(3)["xyz".index(up)]
    direction = np.array(_DIRECTIONS[up]) / np.linalg.norm(_DIRECTIONS[up])
    focus = (low + high) / 2 - 0.08 * radius * upward  # lower than the middle: the scalar bar is below
    return Viewpoint(focus, 1.02 * radius, direction, upward)


# ---------------------------------------------------------------- shapes


def unit_sphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh of the unit sphere: an icosahedron whose triangles are split into four ``subdivisions`` times.

    Returns:
        (V, 3) float64 points, and (F, 3) int64 triangles, counterclockwise seen from outside.
    """
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions)
    return np.asarray(ball.vertices), np.asarray(ball.faces, np.int64)


def make_inspection_ball(rings: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Make a mesh of the unit ball, cut open: without the quarter x > 0, y < 0.

    The sphere and the two planes of the cut share no points, so that smooth shading preserves their edges.

    ``rings`` is the number of rows of points from pole to pole. Return (P, 3) float64 points, (F, 3) int64 triangles.
    """
    radius = np.linspace(0, 1, rings // 2)
    around, down = np.radians(np.linspace(0, 270, 2 * rings + 1)), np.linspace(0, np.pi, rings)
    sphere, first = (1.0, around[None], down[:, None]), (radius[None], 0.0, down[:, None])
    last = (radius[:, None], around[-1], down[None])
    points, faces = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    for r, a, d in (sphere, first, last):
        sheet = np.stack(np.broadcast_arrays(r * np.sin(d) * np.cos(a), r * np.sin(d) * np.sin(a), r * np.cos(d)), -1)
        index = len(points) + np.arange(sheet.size // 3).reshape(sheet.shape[:2])
        corners = [part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])]
        faces = np.concatenate([faces, *(np.stack([corners[0], corners[k], corners[k + 1]], 1) for k in (1, 2))])
        points = np.concatenate([points, sheet.reshape(-1, 3)])
    return points, faces
