"""Ray casting with Embree (``embreex``), or with a bounding volume hierarchy in numba where embreex is missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuprim.core.errors import BackendUnavailable
from neuprim.scenes.shapes import Solid, solid_corner_normals

Engine = Literal["auto", "embree", "numba"]

LIFT = 2e-4
"""Offset of shadow ray origins from the surface, scene units; a hundred times the rounding error of float32."""

_LEAF = 4  # most triangles per leaf
_DEPTH = 64  # size of the traversal's stack; median splits of 2^31 triangles need 32


@dataclass(frozen=True)
class Hits:
    """Surface hits of N rays. ``hit`` has one row per ray. The other arrays have M rows, one per hit, in ray order."""

    hit: NDArray[np.bool_]  # (N,) bool
    position: NDArray[np.float32]  # (M, 3) float32, scene units
    distance: NDArray[np.float32]  # (M,) float32, in lengths of the ray direction
    # normal, face: (M, 3) float32 unit normals: the interpolated normal for shading, and the normal of the triangle
    normal: NDArray[np.float32]
    face: NDArray[np.float32]
    albedo: NDArray[np.float32]  # (M, 3) float32 linear RGB
    # gloss, specular: (M,) float32, see :class:`~neuprim.scenes.shapes.Solid`
    gloss: NDArray[np.float32]
    specular: NDArray[np.float32]
    # solid, triangle: (M,) index of the solid that is hit, and index of the triangle among the faces of all solids
    solid: NDArray[np.intp]
    triangle: NDArray[np.integer]
    weight: NDArray[np.float32]  # (M, 3) float32 barycentric coordinates
    emission: NDArray[np.float32] | None = None  # (M, 3) float32 linear RGB of emitted light, if any

    def lifted(self) -> NDArray[np.float32]:
        """Return the hits' (M, 3) positions, moved slightly off the surface: origins for shadow rays."""
        return self.position + np.float32(LIFT) * self.face


class Scene:
    """A set of solids for ray queries. Queries do not change the scene, so threads may share a scene.

    ``engine`` is "embree" or "numba". "auto" chooses Embree if the package embreex is installed, else numba.
    """

    def __init__(self, solids: Sequence[Solid], engine: Engine = "auto") -> None:
        self.solids = tuple(solids)
        meshes = [solid.mesh for solid in self.solids]
        start = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
        vertices = np.concatenate([mesh.vertices.view(np.ndarray) for mesh in meshes]).astype(np.float32)
        faces = [mesh.faces.view(np.ndarray) + first for mesh, first in zip(meshes, start, strict=False)]
        normals = [solid_corner_normals(s.mesh) if s.normals is None else s.normals for s in self.solids]
        self._face_normals = np.concatenate([mesh.face_normals.view(np.ndarray) for mesh in meshes]).astype(np.float32)
        self._corner_normals = np.concatenate(normals).astype(np.float32)
        self._owner = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
        self._gloss = np.array([solid.gloss for solid in self.solids], dtype=np.float32)
        self._specular = np.array([solid.specular for solid in self.solids], dtype=np.float32)
        self.engine, self._search = _open_ray_engine(vertices, np.concatenate(faces).astype(np.int32), engine)

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Return the first hit of each of N rays; ``origins`` in scene units, ``directions`` (N, 3) of any length."""
        o, d = _broadcast_raycast_rays(origins, directions)
        triangle, u, v, distance = self._first_hits(o, d)
        hit = triangle >= 0
        rows = np.flatnonzero(hit)
        triangle, distance = triangle[rows], distance[rows]
        weight = np.stack([1 - u[rows] - v[rows], u[rows], v[rows]], axis=1, dtype=np.float32)
        normal: NDArray[np.float32] = np.einsum("nk,nkc->nc", weight, self._corner_normals[triangle])
        normal /= np.sqrt(np.einsum("nc,nc->n", normal, normal))[:, None]
        position = (o[rows] + distance[:, None] * d[rows]).astype(np.float32, copy=False)
        owner = self._owner[triangle]
        albedo = np.empty_like(position)
        for index in np.unique(owner):
            mine = np.flatnonzero(owner == index)
            albedo[mine] = self.solids[index].albedo(position[mine])
        face, gloss, specular = self._face_normals[triangle], self._gloss[owner], self._specular[owner]
        return Hits(hit, position, distance, normal, face, albedo, gloss, specular, owner, triangle, weight)

    def _first_hits(self, o: NDArray, d: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return the first hits of N rays with origins ``o`` and directions ``d``, both (N, 3), as four (N,) arrays.

        The arrays are the triangle's index (-1 without a hit), barycentric u and v, and distance in lengths of ``d``.
        """
        return self._search.first(o, d)

    def occluded(self, points: ArrayLike, directions: ArrayLike, distance: ArrayLike = np.inf) -> NDArray[np.bool_]:
        """Return (N,) bool: whether a surface lies on the segment from each point along its direction.

        The segment ends at ``distance``, in lengths of the direction. Points must not lie on a surface, because that
        surface might count: use :meth:`Hits.lifted`.
        """
        o, d = _broadcast_raycast_rays(points, directions)
        return self._search.any(o, d, np.broadcast_to(np.asarray(distance, dtype=np.float32), len(o)))


def _broadcast_raycast_rays(
    origins: ArrayLike, directions: ArrayLike
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    d = np.ascontiguousarray(directions, dtype=np.float32)
    return np.ascontiguousarray(np.broadcast_to(np.asarray(origins, dtype=np.float32), d.shape)), d


def _open_ray_engine(vertices: NDArray, faces: NDArray, engine: Engine) -> tuple[Literal["embree", "numba"], Any]:
    if engine != "numba":
        try:
            return "embree", _EmbreeEngine(vertices, faces)
        except ImportError as error:
            if engine == "embree":
                raise BackendUnavailable(
                    f"ray casting with embree needs the package 'embreex' (pip install embreex): {error}"
                ) from error
    return "numba", _BoxHierarchy(vertices, faces)


class _EmbreeEngine:
    def __init__(self, vertices: NDArray, faces: NDArray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.scene = EmbreeScene()
        TriangleMesh(scene=self.scene, vertices=vertices, indices=faces)
        # The first query builds the tree; done here so that threads find it built.
        self.scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))

    def first(self, o: NDArray, d: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        found = self.scene.run(o, d, query="INTERSECT", output=1)
        return found["primID"], found["u"], found["v"], found["tfar"]

    def any(self, o: NDArray, d: NDArray, distance: NDArray) -> NDArray[np.bool_]:
        limit = np.ascontiguousarray(np.minimum(distance, 1e30), dtype=np.float32)
        return self.scene.run(o, d, dists=limit, query="OCCLUDED") >= 0


# ---------------------------------------------------------------- the hierarchy in numba


class _BoxHierarchy:
    """Bounding volume hierarchy of F triangles with vertices (V, 3) and indices (F, 3).

    The methods are the same as those of :class:`_EmbreeEngine`.
    """

    def __init__(self, vertices: NDArray, faces: NDArray) -> None:
        corners = vertices[faces].astype(np.float64)
        self._order, *boxes_and_links = _build_box_tree(corners.min(1), corners.max(1))
        self._tree: Any = (corners[self._order], *boxes_and_links)  # leaves read neighbouring memory

    def first(self, o: NDArray, d: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        index, u, v, distance = self._trace_rays(o, d, np.full(len(o), np.inf), False)
        return np.where(index >= 0, self._order[index], -1), u, v, distance

    def any(self, o: NDArray, d: NDArray, distance: NDArray) -> NDArray[np.bool_]:
        return self._trace_rays(o, d, distance.astype(np.float64), True)[0] >= 0

    def _trace_rays(self, o: NDArray, d: NDArray, limits: NDArray, any_hit: bool) -> Any:
        corners, low, high, links = self._tree
        return _trace_rays(corners, low, high, links, o, d, limits, any_hit)


def _build_box_tree(low: NDArray, high: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
    """Build a bounding volume hierarchy of F triangles, given the corners ``low`` and ``high`` (F, 3) of their boxes.

    Return the (F,) order of the triangles, the lower and upper corners of the nodes' boxes, and the nodes' links. A
    link is (first child, 0) for an inner node, and (first triangle, count) for a leaf.
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
        if end - begin <= _LEAF:
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
def _raycast_box_entry(low, high, node, o, inverse, limit):  # type: ignore[no-untyped-def]
    """Return the distance at which a ray from ``o`` enters a node's box.

    The distance is infinite if the ray misses the box or enters the box beyond the distance ``limit``. ``inverse`` is
    1 / direction of the ray, per axis.
    """
    near, far = 0.0, limit
    for axis in range(3):
        a, b = (low[node, axis] - o[axis]) * inverse[axis], (high[node, axis] - o[axis]) * inverse[axis]
        if a > b:
            a, b = b, a
        near = a if a > near else near
        far = b if b < far else far
    return near if near <= far * (1 + 1e-12) else np.inf


@numba.njit(nogil=True, error_model="numpy")
def _intersect_triangle(corner, o, d):  # type: ignore[no-untyped-def]
    """Intersect the ray ``o`` + t ``d`` with a triangle (3, 3); return barycentric u, v, and t (t = -1: no hit)."""
    ex, ey, ez = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    fx, fy, fz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    px, py, pz = d[1] * fz - d[2] * fy, d[2] * fx - d[0] * fz, d[0] * fy - d[1] * fx
    determinant = ex * px + ey * py + ez * pz
    if determinant == 0:
        return 0.0, 0.0, -1.0
    sx, sy, sz = o[0] - corner[0, 0], o[1] - corner[0, 1], o[2] - corner[0, 2]
    u = (sx * px + sy * py + sz * pz) / determinant
    qx, qy, qz = sy * ez - sz * ey, sz * ex - sx * ez, sx * ey - sy * ex
    v = (d[0] * qx + d[1] * qy + d[2] * qz) / determinant
    t = (fx * qx + fy * qy + fz * qz) / determinant
    return u, v, t if u >= 0 and v >= 0 and u + v <= 1 else -1.0


@numba.njit(nogil=True, error_model="numpy")
def _trace_rays(corners, low, high, links, origins, directions, limits, any_hit):  # type: ignore[no-untyped-def]
    rays = len(origins)
    found = np.full(rays, -1, np.int64)
    us, vs, distances = np.zeros(rays, np.float32), np.zeros(rays, np.float32), np.full(rays, np.inf, np.float32)
    stack, entry = np.empty(_DEPTH, np.int64), np.empty(_DEPTH)
    o, d, inverse = np.empty(3), np.empty(3), np.empty(3)
    for ray in range(rays):
        for axis in range(3):
            o[axis], d[axis] = origins[ray, axis], directions[ray, axis]
            # A huge number instead of infinity: 0 times infinity would be NaN for an origin in the plane of a box.
            inverse[axis] = 1 / d[axis] if abs(d[axis]) > 1e-30 else 1e30
        best = limits[ray]
        stack[0], entry[0], top = 0, _raycast_box_entry(low, high, 0, o, inverse, best), 1
        while top > 0:
            top -= 1
            if entry[top] >= best:
                continue
            node = stack[top]
            if links[node, 1] == 0:
                a = links[node, 0]
                near_a = _raycast_box_entry(low, high, a, o, inverse, best)
                near_b = _raycast_box_entry(low, high, a + 1, o, inverse, best)
                nearer = a if near_a <= near_b else a + 1
                near, far = min(near_a, near_b), max(near_a, near_b)
                if far < best:  # under the nearer one in the stack
                    stack[top], entry[top] = 2 * a + 1 - nearer, far
                    top += 1
                if near < best:
                    stack[top], entry[top] = nearer, near
                    top += 1
                continue
            for i in range(links[node, 0], links[node, 0] + links[node, 1]):
                u, v, t = _intersect_triangle(corners[i], o, d)
                if 0 < t < best:
                    best = t
                    found[ray], us[ray], vs[ray], distances[ray] = i, u, v, t
            if any_hit and found[ray] >= 0:
                break
    return found, us, vs, distances
