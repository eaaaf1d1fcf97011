"""Rays against triangles compiled with numba: a bounding volume hierarchy for machines embree has no package for.

Median splits along the longest axis, nearest child first, Möller and Trumbore's intersection in double precision
("Fast, minimum storage ray-triangle intersection", 1997), both sides of a triangle counting.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["Hierarchy"]

LEAF = 4
DEPTH = 64  # of the traversal's stack; median splits of 2^31 triangles need 32


class Hierarchy:
    """Triangles ``faces`` (F, 3) of ``vertices`` (V, 3) ready for queries, which release the interpreter lock."""

    def __init__(self, vertices: NDArray, faces: NDArray) -> None:
        corners = vertices[faces].astype(np.float64)
        self._order, self._low, self._high, self._links = _build(corners.min(1), corners.max(1))
        self._corners = corners[self._order]  # leaves read neighbouring memory

    def first(self, o: NDArray, d: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """(N,) each: triangle or -1, the weights u and v of its second and third corner, distance in lengths of ``d``
        (N, 3)."""
        limit = np.full(len(o), np.inf)
        index, u, v, distance = _trace(self._corners, self._low, self._high, self._links, o, d, limit, False)
        return np.where(index >= 0, self._order[index], -1), u, v, distance

    def any(self, o: NDArray, d: NDArray, distance: NDArray) -> NDArray[np.bool_]:
        """(N,) whether a triangle is nearer than ``distance`` (N,)."""
        return (
            _trace(self._corners, self._low, self._high, self._links, o, d, distance.astype(np.float64), True)[0] >= 0
        )


def _build(low: NDArray, high: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Order of the triangles, node boxes, and per node (first child, 0) or (first triangle, count); children are
    neighbours.

    Plain numpy: compiling a sort takes longer than this takes.
    """
    order = np.arange(len(low))
    middle = (low + high) / 2
    boxes: list[tuple[NDArray, NDArray]] = [(low[:0], high[:0])]
    links = [(0, 0)]
    pending = [(0, 0, len(low))]
    while pending:
        node, begin, end = pending.pop()
        part = order[begin:end]
        box = low[part].min(0), high[part].max(0)
        boxes[node] = box
        if end - begin <= LEAF:
            links[node] = begin, end - begin
            continue
        half = (end - begin) // 2
        longest = int(np.argmax(box[1] - box[0]))
        order[begin:end] = part[np.argpartition(middle[part, longest], half)]
        child = len(boxes)
        links[node] = child, 0
        boxes += [box, box]
        links += [(0, 0), (0, 0)]
        pending += [(child, begin, begin + half), (child + 1, begin + half, end)]
    return order, np.array([b[0] for b in boxes]), np.array([b[1] for b in boxes]), np.array(links, dtype=np.int64)


@numba.njit(nogil=True, error_model="numpy")
def _box(low, high, node, o, inverse, limit):  # type: ignore[no-untyped-def]
    """Distance at which a ray enters a node's box, or infinity."""
    near, far = 0.0, limit
    for axis in range(3):
        a, b = (low[node, axis] - o[axis]) * inverse[axis], (high[node, axis] - o[axis]) * inverse[axis]
        if a > b:
            a, b = b, a
        near = a if a > near else near
        far = b if b < far else far
    return near if near <= far * (1 + 1e-12) else np.inf


@numba.njit(nogil=True, error_model="numpy")
def _trace(corners, low, high, links, origins, directions, limits, any_hit):  # type: ignore[no-untyped-def]
    rays = len(origins)
    found = np.full(rays, -1, np.int64)
    us, vs, distances = np.zeros(rays, np.float32), np.zeros(rays, np.float32), np.full(rays, np.inf, np.float32)
    stack, entry = np.empty(DEPTH, np.int64), np.empty(DEPTH)
    o, d, inverse = np.empty(3), np.empty(3), np.empty(3)
    for ray in range(rays):
        for axis in range(3):
            o[axis], d[axis] = origins[ray, axis], directions[ray, axis]
            # A huge number instead of infinity: 0 times infinity would be NaN for an origin in the plane of a box.
            inverse[axis] = 1 / d[axis] if abs(d[axis]) > 1e-30 else 1e30
        best = limits[ray]
        stack[0], entry[0], top = 0, _box(low, high, 0, o, inverse, best), 1
        while top > 0:
            top -= 1
            if entry[top] >= best:
                continue
            node = stack[top]
            if links[node, 1] == 0:
                a = links[node, 0]
                near_a, near_b = _box(low, high, a, o, inverse, best), _box(low, high, a + 1, o, inverse, best)
                nearer = a if near_a <= near_b else a + 1
                near, far = min(near_a, near_b), max(near_a, near_b)
                if far < best:  # below the nearer one
                    stack[top], entry[top] = 2 * a + 1 - nearer, far
                    top += 1
                if near < best:
                    stack[top], entry[top] = nearer, near
                    top += 1
                continue
            for i in range(links[node, 0], links[node, 0] + links[node, 1]):
                e1x, e1y, e1z = (
                    corners[i, 1, 0] - corners[i, 0, 0],
                    corners[i, 1, 1] - corners[i, 0, 1],
                    corners[i, 1, 2] - corners[i, 0, 2],
                )
                e2x, e2y, e2z = (
                    corners[i, 2, 0] - corners[i, 0, 0],
                    corners[i, 2, 1] - corners[i, 0, 1],
                    corners[i, 2, 2] - corners[i, 0, 2],
                )
                px, py, pz = d[1] * e2z - d[2] * e2y, d[2] * e2x - d[0] * e2z, d[0] * e2y - d[1] * e2x
                determinant = e1x * px + e1y * py + e1z * pz
                if determinant == 0:
                    continue
                sx, sy, sz = o[0] - corners[i, 0, 0], o[1] - corners[i, 0, 1], o[2] - corners[i, 0, 2]
                u = (sx * px + sy * py + sz * pz) / determinant
                qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
                v = (d[0] * qx + d[1] * qy + d[2] * qz) / determinant
                t = (e2x * qx + e2y * qy + e2z * qz) / determinant
                if u >= 0 and v >= 0 and u + v <= 1 and 0 < t < best:
                    best = t
                    found[ray], us[ray], vs[ray], distances[ray] = i, u, v, t
            if any_hit and found[ray] >= 0:
                break
    return found, us, vs, distances
