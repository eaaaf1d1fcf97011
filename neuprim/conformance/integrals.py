"""Optical depths of chords twice over: by the lowered form, and by quadrature of the density that it claims to
integrate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuprim.core.model.fields import Conditions, CustomColour, LoweredColour, LoweredDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.pairs import Pairs
from neuprim.core.model.primitives import Primitives

__all__ = ["Alive", "by_quadrature", "chords", "inside", "opaque_colour"]

_PANELS, _NODES = 8, 16


@dataclass(frozen=True)
class Alive:
    """The primitives of a model that live in a frame.

    Attributes:
        rows: their rows in the model.
        params: the density's tensors of those rows.
        home, moved: their geometry as stored, and where the frame's conditions put it.
        form: their lowered density.
    """

    rows: Tensor
    params: dict[str, Tensor]
    home: Geometry
    moved: Geometry
    form: LoweredDensity

    @classmethod
    def of(cls, model: Primitives, conditions: Conditions) -> Alive:
        rows = model.density.active_rows(model.of(model.density), conditions)
        rows = torch.arange(model.count) if rows is None else rows
        params = {name: value[rows] for name, value in model.of(model.density).items()}
        home = model.geometry[rows]
        moved = model.density.move(params, home, conditions)
        return cls(rows, params, home, moved, model.density.lower(params, moved, conditions))


def inside(geometry: Geometry, rows: Tensor, generator: torch.Generator, reach: float = 0.95) -> Tensor:
    """(M, 3) float64 scene points, one uniform in ``reach`` of the ellipsoid of each of ``rows`` (M,)."""
    direction = torch.nn.functional.normalize(
        torch.randn(len(rows), 3, generator=generator, dtype=torch.float64), dim=-1
    )
    radius = reach * torch.rand(len(rows), 1, generator=generator, dtype=torch.float64) ** (1 / 3)
    local = geometry.scales.double()[rows] * direction * radius
    return geometry.means.double()[rows] + (geometry.rotations.double()[rows] @ local[:, :, None])[..., 0]


def chords(geometry: Geometry, rows: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(origins, directions, t0, t1), float64: a random ray from outside through the ellipsoid of each of ``rows``
    (M,)."""
    point = inside(geometry, rows, generator)
    d = torch.nn.functional.normalize(torch.randn(len(rows), 3, generator=generator, dtype=torch.float64), dim=-1)
    whiten = geometry.rotations.double()[rows].transpose(1, 2) / geometry.scales.double()[rows][:, :, None]
    y, v = ((whiten @ x[:, :, None])[..., 0] for x in (point - geometry.means.double()[rows], d))
    a, b = (v * v).sum(-1), (y * v).sum(-1)
    root = (b * b + a * (1 - (y * y).sum(-1))).sqrt()
    far = 3 * geometry.length_scale.double()[rows]
    return point - far[:, None] * d, d, far + (-b - root) / a, far + (-b + root) / a


def by_quadrature(
    model: Primitives, alive: Alive, conditions: Conditions, prim: Tensor, o: Tensor, d: Tensor, t0: Tensor, t1: Tensor
) -> tuple[Tensor, Tensor]:
    """(integral, greatest |sigma|), both (M,), of the field's own ``density`` along chord pieces: Gauss-Legendre on
    eight panels."""
    x, w = (torch.from_numpy(q) for q in np.polynomial.legendre.leggauss(_NODES))
    nodes = ((x[None] + 1) / 2 + torch.arange(_PANELS)[:, None]).reshape(-1) / _PANELS
    weights = (w / (2 * _PANELS)).repeat(_PANELS)
    t = t0[:, None] + (t1 - t0)[:, None] * nodes
    points = (o[:, None] + t[..., None] * d[:, None]).reshape(-1, 3)
    rows = prim.repeat_interleave(len(nodes))
    sigma = model.density.density(alive.params, alive.home, rows, points, conditions).reshape(t.shape)
    return (sigma * weights).sum(-1) * (t1 - t0), sigma.abs().amax(-1) if len(prim) else sigma.sum(-1)


def opaque_colour(colour: LoweredColour, geometry: Geometry) -> CustomColour:
    """The same colour as torch code per ray-primitive pair."""

    def radiance(prim: Tensor, x: Tensor, d: Tensor) -> Tensor:
        nothing = x.new_zeros(len(x))
        return colour.chord_colours(Pairs.of(geometry, prim, x, d, nothing, nothing))

    return CustomColour(radiance, colour.channels)
