"""The built-in ways of showing a density: functions of one frame that return layers, as anybody's."""

from __future__ import annotations

import numpy as np
import torch

from neuprim.core.extensions import Inspector
from neuprim.core.model.edge import fade
from neuprim.core.task import API_VERSION
from neuprim.inspect.field import FieldFrame
from neuprim.inspect.layers import Ellipsoids, Isosurfaces, Layer, Lines, Mesh, Scale, Slices, Text, Volume
from neuprim.inspect.shapes import cut_ball, level_lines

__all__ = ["DIFFERENCE", "ISOSURFACE", "PRIMITIVE", "PRIMITIVES", "SLICES", "VOLUME"]

SURFACES = "plasma"  # brighter at its lower end, where the outermost surface is
SIGNED = "coolwarm"
_LIFT = 0.004  # of lines above the surface that they are on, so that it hides none of them; of the semi-axes
_BELOW = 0.98  # how far out the sign of a density with a soft edge is looked for, in radii

FAINT = 1.0 / 255.0
"""Opacity from which an ellipsoid is drawn."""


def _volume(frame: FieldFrame) -> list[Layer]:
    return [Volume(frame.sigma, frame.origin, frame.step, frame.scale, depth=frame.gain)]


def _difference(frame: FieldFrame) -> list[Layer]:
    reach = frame.top / 2  # errors are smaller than what they are errors of
    scale = Scale(-reach, reach, SIGNED, "model - truth", frame.scale.unit)
    return [Volume(frame.difference, frame.origin, frame.step, scale, depth=frame.gain)]


def _isosurface(frame: FieldFrame) -> list[Layer]:
    levels = frame.options.levels or tuple(part * frame.top for part in (0.1, 1 / 3, 2 / 3))
    scale = Scale(0.0, frame.top, SURFACES, frame.scale.title, frame.scale.unit)
    return [Isosurfaces(frame.sigma, frame.origin, frame.step, scale, levels=levels)]


def _slices(frame: FieldFrame) -> list[Layer]:
    return [Slices(frame.sigma, frame.origin, frame.step, frame.scale, through=np.array(frame.focus))]


def strongest(frame: FieldFrame) -> np.ndarray:
    """Positions in ``frame.alive`` of the ellipsoids that are drawn: those that can be seen at all, those that absorb
    most first."""
    visible = opacity_of(frame) >= FAINT
    order = frame.masses.argsort()[::-1]
    return np.asarray(order[visible[order]][: frame.options.limit])


def opacity_of(frame: FieldFrame) -> np.ndarray:
    """(M,) opacity 0..1 of primitives: of a ray along their mean radius through their mean extinction."""
    volume = frame.geometry.scales.double().numpy().prod(1)
    return np.asarray(1 - np.exp(-2 * frame.masses / (4.18879 * volume) * volume ** (1 / 3)))


def _primitives(frame: FieldFrame) -> list[Layer]:
    chosen = strongest(frame)
    one = frame.geometry[torch.from_numpy(chosen)]
    axes = (one.rotations * one.scales[:, None, :]).transpose(1, 2).detach().numpy()
    words = f"{len(chosen)} of {frame.model.count} primitives at their true size\nleft out: opacity below 1/255"
    colours = np.clip(frame.colours[chosen], 0.0, 1.0)
    return [Ellipsoids(one.means.detach().numpy(), axes, colours=colours), Text(words)]


def _factor(frame: FieldFrame, position: int, unit: np.ndarray) -> np.ndarray:
    """(P,) a primitive's density at points (P, 3) of the unit ball, less the weight that a soft edge fades it by: it
    has the same zeros inside, but does not vanish with the weight, whose rounding would draw the line on the surface.
    There, it is that of a point just below.
    """
    _, form = frame.model.lower_density(frame.conditions)
    edge = form.edge
    inner = torch.from_numpy(unit)
    if edge:
        radius = inner.norm(dim=1, keepdim=True)
        inner = inner * (_BELOW / radius.clamp_min(_BELOW))
    one = frame.geometry[position : position + 1]
    axes = (one.rotations * one.scales[:, None, :])[0].double()
    sigma = frame.density(int(frame.alive[position]), one.means[0].double() + inner @ axes.T)
    return np.asarray(sigma / fade(inner.square().sum(1), edge).numpy())


def _primitive(frame: FieldFrame) -> list[Layer]:
    position, (unit, faces, normals) = frame.row(), cut_ball()
    one = frame.geometry[position : position + 1]
    axes = (one.rotations * one.scales[:, None, :])[0].double()
    placed = one.means[0].double() + torch.from_numpy(unit) @ axes.T
    sigma = frame.density(int(frame.alive[position]), placed)
    low, high = float(sigma.min()), float(sigma.max())
    reach = max(abs(low), abs(high)) or 1.0
    scale = Scale(
        -reach if low < 0 else 0.0,
        reach,
        SIGNED if low < 0 else frame.scale.colours,
        frame.scale.title,
        frame.scale.unit,
    )
    used, surface = np.unique(faces, return_inverse=True)
    points, sigma, surface = placed.numpy()[used], sigma[used], surface.reshape(faces.shape)
    found: list[Layer] = [Mesh(points, surface, values=sigma, scale=scale)]
    if low < 0 < high:
        lifted, factor = points + _LIFT * normals[used] @ axes.numpy().T, _factor(frame, position, unit[used])
        found.append(Lines(*level_lines(lifted, surface, factor), colours=np.zeros(3)))
    scales = ", ".join(f"{s:.3g}" for s in frame.geometry.scales[position].tolist())
    center = ", ".join(f"{s:.3g}" for s in frame.geometry.means[position].tolist())
    words = f"primitive {frame.alive[position]}\ncentre ({center})\nradii ({scales})\nextinction {low:.3g} to {high:.3g}, unclamped"
    return [*found, Text(words, "upper_right")]


VOLUME = Inspector(API_VERSION, "volume", "the extinction as a cloud", _volume)
ISOSURFACE = Inspector(API_VERSION, "isosurface", "surfaces of equal extinction", _isosurface)
SLICES = Inspector(API_VERSION, "slices", "three planes through the middle of the matter", _slices)
PRIMITIVES = Inspector(API_VERSION, "primitives", "the ellipsoids in their own colours", _primitives, shows="model")
PRIMITIVE = Inspector(
    API_VERSION, "primitive", "the density inside one primitive, cut open", _primitive, shows="primitive"
)
DIFFERENCE = Inspector(API_VERSION, "difference", "model minus ground truth", _difference, shows="both")
