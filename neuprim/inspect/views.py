"""The built-in inspectors: functions of a frame that return layers."""

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
_MIN_OPACITY = 1.0 / 255.0  # of an ellipsoid that is drawn
_MAX_ELLIPSOIDS = 20_000


def _inspect_volume(frame: InspectionFrame) -> list[Layer]:
    return [Volume(frame.sigma, frame.origin, frame.step, frame.scale, depth=frame.gain)]


def _inspect_difference(frame: InspectionFrame) -> list[Layer]:
    reach = frame.top / 2  # errors are smaller than the values
    scale = Scale(-reach, reach, _SIGNED_COLOURS, "model - truth", frame.scale.unit)
    return [Volume(frame.difference, frame.origin, frame.step, scale, depth=frame.gain)]


def _inspect_isosurface(frame: InspectionFrame) -> list[Layer]:
    levels = frame.options.levels or tuple(part * frame.top for part in (0.1, 1 / 3, 2 / 3))
    scale = Scale(0.0, frame.top, _SURFACE_COLOURS, frame.scale.title, frame.scale.unit)
    return [Isosurfaces(frame.sigma, frame.origin, frame.step, scale, levels=levels)]


def _inspect_slices(frame: InspectionFrame) -> list[Layer]:
    return [Slices(frame.sigma, frame.origin, frame.step, frame.scale, through=np.array(frame.focus))]


def _inspected_primitives(frame: InspectionFrame) -> np.ndarray:
    """Return positions in ``frame.rows`` of the ellipsoids to draw, by what they absorb.

    Their opacity is that of a ray along the mean radius through the mean extinction.
    """
    order = frame.masses.argsort()[::-1]
    volume = frame.geometry.scales.double().numpy().prod(1)
    visible = 1 - np.exp(-2 * frame.masses / (4.18879 * volume) * volume ** (1 / 3)) >= _MIN_OPACITY
    return np.asarray(order[visible[order]][:_MAX_ELLIPSOIDS])


def _inspect_primitives(frame: InspectionFrame) -> list[Layer]:
    chosen = _inspected_primitives(frame)
    geometry = frame.geometry[torch.from_numpy(chosen)]
    axes = (geometry.rotations * geometry.scales[:, None, :]).transpose(1, 2).detach().numpy()
    text = f"{len(chosen)} of {frame.model.count} primitives at their true size\nleft out: opacity below 1/255"
    colours = np.clip(frame.colours[chosen], 0.0, 1.0)
    return [Ellipsoids(geometry.means.detach().numpy(), axes, colours=colours), Text(text)]


def _inspect_primitive(frame: InspectionFrame) -> list[Layer]:
    position, (unit, faces) = frame.chosen_position(), make_inspection_ball()
    geometry = frame.geometry[position : position + 1]
    axes = (geometry.rotations * geometry.scales[:, None, :])[0].double()
    points = geometry.means[0].double() + torch.from_numpy(unit) @ axes.T
    sigma = frame.density(int(frame.rows[position]), points)
    low, high = float(sigma.min()), float(sigma.max())
    reach = max(abs(low), abs(high)) or 1.0
    negative = low < 0
    colours = _SIGNED_COLOURS if negative else frame.scale.colours
    scale = Scale(-reach if negative else 0.0, reach, colours, frame.scale.title, frame.scale.unit)
    used, surface = np.unique(faces, return_inverse=True)
    mesh = Mesh(points.numpy()[used], surface.reshape(faces.shape), values=sigma[used], scale=scale)
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
    API_VERSION, "primitive", "the density inside one primitive, cut open", _inspect_primitive, shows="primitive"
)
DIFFERENCE = Inspector(API_VERSION, "difference", "model minus ground truth", _inspect_difference, shows="both")


# ---------------------------------------------------------------- viewpoints

_DIRECTIONS = {"x": (-0.45, 1.0, -1.6), "y": (1.0, 0.45, 1.6), "z": (1.0, -1.6, 0.45)}
"""From the middle to the camera, by the scene's upward axis."""


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Where a view starts.

    Attributes:
        focus: (3,) what is looked at, scene units.
        radius: of the ball around it that fills the picture, scene units.
        direction: (3,) unit vector from there to the camera.
        up: (3,) unit vector that points upward in the picture.
    """

    focus: np.ndarray
    radius: float
    direction: np.ndarray
    up: np.ndarray


def find_inspection_viewpoint(inspector: Inspector, frame: InspectionFrame, up: str) -> Viewpoint:
    """Choose where a view of a frame starts: before the whole box, or before a single primitive.

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
    """Return (V, 3) float64 points of norm 1 and (F, 3) int64 triangles, anticlockwise seen from outside."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions)
    return np.asarray(ball.vertices), np.asarray(ball.faces, np.int64)


def make_inspection_ball(rings: int = 48) -> tuple[np.ndarray, np.ndarray]:
    """Make the unit ball without the quarter x > 0 > y.

    The sphere and the two planes of the cut share no points on their edges, so that these stay sharp.

    Returns:
        (P, 3) float64 points throughout the ball, and (F, 3) int64 triangles of its surface.
    """
    radius = np.linspace(0, 1, rings // 2)
    around, down = np.radians(np.linspace(0, 270, 2 * rings + 1)), np.linspace(0, np.pi, rings)
    r, a, d = np.meshgrid(radius, around, down, indexing="ij")
    solid = np.stack([r * np.sin(d) * np.cos(a), r * np.sin(d) * np.sin(a), r * np.cos(d)], -1)
    index = np.arange(r.size).reshape(r.shape)
    edges = np.concatenate([solid[-1, 0], solid[-1, -1]])  # copies for the planes where they meet the sphere
    first, last = index[:, 0].copy(), index[:, -1].copy()
    first[-1], last[-1] = r.size + np.arange(rings), r.size + rings + np.arange(rings)
    faces = [
        _inspection_ball_triangles(index[-1].T),
        _inspection_ball_triangles(first.T),
        _inspection_ball_triangles(last),
    ]
    return np.concatenate([solid.reshape(-1, 3), edges]), np.concatenate(faces)


def _inspection_ball_triangles(index: np.ndarray) -> np.ndarray:
    """Return (2 (A - 1) (B - 1), 3) triangles of an (A, B) sheet of points."""
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
