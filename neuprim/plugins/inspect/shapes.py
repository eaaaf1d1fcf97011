"""Ellipsoids as triangles, and a grid as pyvista's image."""

from __future__ import annotations

from typing import Any

import numpy as np

from neuprim.core.model.geometry import Geometry
from neuprim.plugins.inspect.field import FieldFrame

__all__ = ["ellipsoids", "image", "padded", "unit_sphere"]


def unit_sphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) float64 points of norm 1 and (F, 3) int64 triangles, seen from outside anticlockwise."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions)
    return np.asarray(ball.vertices), np.asarray(ball.faces, np.int64)


def ellipsoids(geometry: Geometry, subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """(N V, 3) float32 points on the surfaces of N ellipsoids and (N F, 3) int64 triangles, ellipsoid by ellipsoid."""
    points, faces = unit_sphere(subdivisions)
    axes = (geometry.rotations * geometry.scales[:, None, :]).detach().double().numpy()  # columns are the semi-axes
    means = geometry.means.detach().double().numpy()
    placed = means[:, None, :] + np.einsum("nab,vb->nva", axes, points)
    shifted = faces[None] + (np.arange(len(means)) * len(points))[:, None, None]
    return placed.reshape(-1, 3).astype(np.float32), shifted.reshape(-1, 3)


def image(frame: FieldFrame, values: np.ndarray) -> Any:
    """``pyvista.ImageData`` of (X, Y, Z) values at the frame's grid points, named "values"."""
    import pyvista

    found = pyvista.ImageData(dimensions=values.shape, spacing=(frame.step,) * 3, origin=frame.origin)
    found.point_data["values"] = values.ravel(order="F")
    return found


def padded(frame: FieldFrame, values: np.ndarray) -> Any:
    """The same with one layer of zeros around, so that surfaces are closed."""
    found = image(frame, np.pad(values, 1))
    found.origin = frame.origin - frame.step
    return found
