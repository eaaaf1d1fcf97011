"""Closed triangle meshes the solids are cut from, and the vertex normals that keep edges sharp and curves smooth.

Every builder returns a watertight :class:`trimesh.Trimesh` in scene units with outward faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations, product

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

__all__ = ["arc_tube", "ball", "chamfered_box", "corner_normals", "lathe", "merged", "pyramid", "ring", "rod"]

CREASE_DEGREES = 24.0
"""Faces that meet at more than this angle keep their own normals: chamfers and caps stay hard, facets of round parts
blend."""

CORNERS_AT_ONCE = 1 << 18
"""Bounds the memory for pairs of corners."""


def chamfered_box(size: ArrayLike, centre: ArrayLike, chamfer: float) -> trimesh.Trimesh:
    """An axis-aligned box of edge lengths ``size`` (3,) about ``centre`` (3,), every edge cut at 45 degrees by
    ``chamfer``."""
    half = np.asarray(size, dtype=np.float64) / 2
    # Each corner becomes a triangle: one axis at full extent, the other two drawn in. Their hull is the chamfered box.
    pulls = sorted(set(permutations((0.0, chamfer, chamfer))))
    points = [np.array(sign) * (half - np.array(pull)) for sign in product((-1.0, 1.0), repeat=3) for pull in pulls]
    hull = trimesh.convex.convex_hull(np.array(points))
    hull.apply_translation(centre)
    return hull


def pyramid(base: float, height: float, centre: ArrayLike, turn: float) -> trimesh.Trimesh:
    """A four-sided pyramid: square of edge ``base`` about ``centre`` (3,) turned by ``turn`` radians about z, apex
    ``height`` above."""
    angles = turn + np.pi / 4 + np.pi / 2 * np.arange(4)
    square = np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1) * base / np.sqrt(2)
    vertices = np.concatenate([square, [[0.0, 0.0, height]]]) + np.asarray(centre, dtype=np.float64)
    faces = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [2, 1, 0], [3, 2, 0]]
    return trimesh.Trimesh(vertices, faces)


def ball(centre: ArrayLike, radius: float, fine: bool = True) -> trimesh.Trimesh:
    """A sphere of 5,120 (or, not ``fine``, 1,280) triangles."""
    mesh = trimesh.creation.icosphere(subdivisions=4 if fine else 3, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def ring(centre: ArrayLike, axis: ArrayLike, major: float, minor: float) -> trimesh.Trimesh:
    """A torus about ``centre`` (3,): circle of radius ``major`` in the plane normal to ``axis`` (3,), tube radius
    ``minor``."""
    mesh = trimesh.creation.torus(major, minor, major_sections=128, minor_sections=48)
    mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], axis))
    mesh.apply_translation(centre)
    return mesh


def rod(start: ArrayLike, end: ArrayLike, radius: float) -> trimesh.Trimesh:
    """A thin straight rod with flat ends from ``start`` (3,) to ``end`` (3,)."""
    length = float(np.linalg.norm(np.subtract(end, start)))
    return lathe(start, np.subtract(end, start), [(0.0, radius), (length, radius)], sections=24)


def lathe(
    start: ArrayLike, axis: ArrayLike, profile: Sequence[tuple[float, float]], sections: int = 96
) -> trimesh.Trimesh:
    """A solid of revolution: ``profile`` lists (distance along ``axis`` from ``start``, radius); equal distances make a
    shoulder."""
    direction = np.asarray(axis, dtype=np.float64)
    direction = direction / np.linalg.norm(direction)
    side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    side /= np.linalg.norm(side)
    heights, radii = np.array(profile, dtype=np.float64).T
    path = np.asarray(start, dtype=np.float64) + heights[:, None] * direction
    return _tube(
        path, np.broadcast_to(side, path.shape), np.cross(direction, side), np.stack([radii, radii], axis=1), sections
    )


def arc_tube(
    centre: ArrayLike,
    first: ArrayLike,
    second: ArrayLike,
    radius: float,
    angles: NDArray[np.float64],
    radii: ArrayLike,
    sections: int = 64,
) -> trimesh.Trimesh:
    """A tube swept along a circular arc, with a radius that may change on the way.

    Args:
        centre, first, second: (3,) circle centre and orthonormal axes of its plane; angle 0 lies on ``first``, 90
        degrees on ``second``. radius: of the arc.
        angles: (n,) ascending, in radians.
        radii: (n, 2) half axes of the elliptic cross-section, in the arc's plane and across it; (n,) or a number for a
        round one.
    """
    one, two = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    outward = np.cos(angles)[:, None] * one + np.sin(angles)[:, None] * two
    half = np.asarray(radii, dtype=np.float64)
    if half.ndim < 2:
        half = np.broadcast_to(half.reshape(-1, 1), (len(angles), 2))
    # outward x across must point along the path, as side x other does along a lathe's axis.
    return _tube(np.asarray(centre, dtype=np.float64) + radius * outward, outward, np.cross(two, one), half, sections)


def _tube(path: NDArray, side: NDArray, across: NDArray, half: NDArray, sections: int) -> trimesh.Trimesh:
    """Rings of ``sections`` points about ``path`` (n, 3) in the planes of ``side`` (n, 3) and ``across`` (3,), joined
    and capped."""
    turn = 2 * np.pi * np.arange(sections) / sections
    rings = (
        path[:, None]
        + (half[:, :1] * np.cos(turn))[..., None] * side[:, None]
        + (half[:, 1:] * np.sin(turn))[..., None] * across
    )  # (n, sections, 3)
    n = len(path)
    here = (np.arange(n - 1)[:, None] * sections + np.arange(sections)).ravel()
    right = (np.arange(n - 1)[:, None] * sections + (np.arange(sections) + 1) % sections).ravel()
    walls = np.concatenate(
        [np.stack([here, right, right + sections], 1), np.stack([here, right + sections, here + sections], 1)]
    )
    rim, following = np.arange(sections), (np.arange(sections) + 1) % sections
    first, last = n * sections, n * sections + 1
    bottom = np.stack([np.full(sections, first), following, rim], 1)
    top = np.stack([np.full(sections, last), rim + (n - 1) * sections, following + (n - 1) * sections], 1)
    vertices = np.concatenate([rings.reshape(-1, 3), path[:1], path[-1:]])
    # Rings of radius zero (points of cones) collapse to one vertex; `validate` drops the faces that vanish with them.
    return trimesh.Trimesh(vertices, np.concatenate([walls, bottom, top]), process=True, validate=True)


def merged(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """All of them as one mesh, each with vertices of its own even where they touch, so that each stays closed."""
    start = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces.view(np.ndarray) + first for mesh, first in zip(meshes, start[:-1], strict=True)]
    return trimesh.Trimesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces), process=False)


def corner_normals(mesh: trimesh.Trimesh, crease: float = CREASE_DEGREES) -> NDArray[np.float64]:
    """(F, 3, 3) unit normals at each face's corners: the mean over faces around the vertex that turn by less than
    ``crease`` degrees.

    Faces are weighted by their angle at the vertex, so the result does not depend on how a flat part was cut into
    triangles.
    """
    faces, flat = mesh.faces.view(np.ndarray), mesh.face_normals.view(np.ndarray)
    corners, angles = faces.size, mesh.face_angles.view(np.ndarray).ravel()
    around = sparse.csr_matrix(
        (np.ones(corners), (np.arange(corners), faces.ravel())), shape=(corners, len(mesh.vertices))
    )
    touching = around.T.tocsr()
    normals = np.empty((corners, 3))
    for begin in range(0, corners, CORNERS_AT_ONCE):
        pairs = (around[begin : begin + CORNERS_AT_ONCE] @ touching).tocoo()  # corners that share a vertex
        own, other = (begin + pairs.row) // 3, pairs.col // 3
        smooth = (flat[own] * flat[other]).sum(1) > np.cos(np.radians(crease))
        blend = sparse.csr_matrix((angles[pairs.col] * smooth, (pairs.row, other)), shape=(pairs.shape[0], len(faces)))
        normals[begin : begin + CORNERS_AT_ONCE] = blend @ flat
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(
        length > 0, normals / np.where(length > 0, length, 1.0), np.repeat(flat, 3, axis=0)
    )  # of needles, which have no angle
    return normals.reshape(-1, 3, 3)
