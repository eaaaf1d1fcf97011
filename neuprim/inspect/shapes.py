"""Ellipsoids as triangles: whole ones, and one with a quarter cut away."""

from __future__ import annotations

import numpy as np

__all__ = ["cut_ball", "ellipsoids", "level_lines", "unit_sphere"]


def unit_sphere(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) float64 points of norm 1 and (F, 3) int64 triangles, seen from outside anticlockwise."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions)
    return np.asarray(ball.vertices), np.asarray(ball.faces, np.int64)


def ellipsoids(centres: np.ndarray, axes: np.ndarray, subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
    """(N V, 3) float32 points on the surfaces of N ellipsoids and (N F, 3) int64 triangles, ellipsoid by ellipsoid.

    Args:
        centres: (N, 3).
        axes: (N, 3, 3) semi-axes as rows.
    """
    points, faces = unit_sphere(subdivisions)
    placed = centres.astype(np.float64)[:, None, :] + np.einsum("nka,vk->nva", axes.astype(np.float64), points)
    shifted = faces[None] + (np.arange(len(centres)) * len(points))[:, None, None]
    return placed.reshape(-1, 3).astype(np.float32), shifted.reshape(-1, 3)


def cut_ball(rings: int = 48) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The unit ball without the quarter x > 0 > y: (P, 3) float64 points through all of it, (F, 3) int64 triangles of
    its surface, and (P, 3) float64 normals outward, 0 inside.

    The sphere and the two planes of the cut share no points, so that the edges between them stay sharp.
    """
    radius, around, down = (
        np.linspace(0, 1, rings // 2),
        np.radians(np.linspace(0, 270, 2 * rings + 1)),
        np.linspace(0, np.pi, rings),
    )
    r, a, d = np.meshgrid(radius, around, down, indexing="ij")
    solid = np.stack([r * np.sin(d) * np.cos(a), r * np.sin(d) * np.sin(a), r * np.cos(d)], -1)
    index = np.arange(r.size).reshape(r.shape)
    edges = np.concatenate(
        [solid[-1, 0], solid[-1, -1]]
    )  # the planes' own copies of the points where they meet the sphere
    first, last = index[:, 0].copy(), index[:, -1].copy()
    first[-1], last[-1] = r.size + np.arange(rings), r.size + rings + np.arange(rings)
    faces = [_triangles(index[-1].T), _triangles(first.T), _triangles(last)]
    points = np.concatenate([solid.reshape(-1, 3), edges])
    normals = np.zeros_like(points)
    normals[index[-1]], normals[first], normals[last] = solid[-1], (0, -1, 0), (1, 0, 0)
    return points, np.concatenate(faces), normals


def _triangles(index: np.ndarray) -> np.ndarray:
    """(2 (A - 1) (B - 1), 3) triangles of an (A, B) sheet of points."""
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def level_lines(
    points: np.ndarray, faces: np.ndarray, values: np.ndarray, level: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """(2 S, 3) ends and (S, 2) int64 pairs of the straight pieces along which a surface has a value, linear inside each
    triangle.

    Args:
        values: (P,) at the points.
    """
    above = values[faces] > level
    crossed = faces[(above.any(1)) & (~above.all(1))]
    above = values[crossed] > level
    odd = np.where(above.sum(1) == 1, above.argmax(1), (~above).argmax(1))  # the corner on its own side
    rows = np.arange(len(crossed))
    apex = crossed[rows, odd]
    ends = []
    for step in (1, 2):
        other = crossed[rows, (odd + step) % 3]
        part = ((level - values[apex]) / (values[other] - values[apex]))[:, None]
        ends.append(points[apex] * (1 - part) + points[other] * part)
    return np.stack(ends, 1).reshape(-1, 3), np.arange(2 * len(crossed)).reshape(-1, 2)
