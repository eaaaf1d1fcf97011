"""A mesh as a scene for ray casting: placed in the unit box, two-sided, with textures and holes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from neuprim.core.errors import DataError
from neuprim.core.notices import warn_once
from neuprim.scenes.raycast import LIFT, Engine, Hits, Scene
from neuprim.scenes.shading import dot
from neuprim.scenes.shapes import Solid, corner_normals, uniform_colour
from neuprim.tasks.static.mesh.materials import SurfacePart, Texture, decode_texture
from neuprim.tasks.static.mesh.model import MAX_TEXELS, Model, Up

FARTHEST = 1.3  # of any vertex from the origin, in scene units: what the cameras of ``solids`` have in view
_DIGITS = 6  # after the point, of positions in scene units that count as one
_LEAST_AREA = 1e-12  # of a face, in square scene units: below that it has no normal in single precision
_LAYERS = 64  # of holes that a ray passes at most
_MOST_AROUND = 64  # faces around a vertex that are smoothed over; work and memory grow with their square

_Pool = dict[tuple[str, tuple[str, str]], Texture]

_Z_FROM_Y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def scene_from_file(parts: Sequence[SurfacePart], upward: Up) -> NDArray[np.float64] | None:
    """(4, 4) transform that turns z up, centres the box and scales it into [-1, 1]^3 and into view.

    None for a model without size. ``upward`` ("y" or "z") is the axis of the file that points up.
    """
    turn = _Z_FROM_Y if upward == "y" else np.eye(3)
    lower = np.min([part.corners.min(axis=(0, 1)) for part in parts], axis=0)
    upper = np.max([part.corners.max(axis=(0, 1)) for part in parts], axis=0)
    middle = lower / 2 + upper / 2
    half = float((upper / 2 - lower / 2).max())
    if not 1e-150 < half < 1e150:
        return None
    radius = max(float(np.sqrt((((part.corners - middle) / half) ** 2).sum(-1).max())) for part in parts)
    matrix = np.eye(4)
    matrix[:3, :3] = turn * (min(1.0, FARTHEST / radius) / half)
    matrix[:3, 3] = -matrix[:3, :3] @ middle
    return matrix


class Surface(Scene):
    """The parts of a model, ready for ray queries.

    ``spacing`` is the distance of neighbouring rays at distance 1, for texture filtering. Raises DataError for a model
    without size, or a texture that cannot be decoded.
    """

    def __init__(
        self, model: Model, parts: Sequence[SurfacePart], upward: Up, spacing: float, engine: Engine = "auto"
    ) -> None:
        matrix = scene_from_file(parts, upward)
        if matrix is None:
            found = "the mesh is a point, or too large for numbers"
            raise DataError(f"{model.path}: {found}; expected a size from 1e-150 to 1e150")
        self.scene_from_file = matrix
        points = np.concatenate([(part.corners @ matrix[:3, :3].T + matrix[:3, 3]).reshape(-1, 3) for part in parts])
        first, same = trimesh.grouping.unique_rows(points, digits=_DIGITS)
        points, faces = points[first], same.reshape(-1, 3)  # vertices at which faces touch are one
        corners = points[faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        double = np.linalg.norm(across, axis=1)
        kept = double > 2 * _LEAST_AREA
        if not kept.all():
            found = f"{model.path}: {(~kept).sum()} of {len(kept)} faces have no area"
            if not kept.any():
                raise DataError(f"{found}; expected triangles")
            warn_once(f"{found}; left out")
        faint = np.concatenate([_transparent_faces(part) for part in parts])
        if not (kept & ~faint).any():
            found = "no face has an opacity of at least 0.5"
            raise DataError(f"{model.path}: {found}; expected a model that is not all clear (alpha, d, Tr)")
        kept &= ~faint
        mesh = _mesh(points, faces[kept])
        turn = matrix[:3, :3].T  # to the axes of the scene; 0 where the file has no normal
        given = [np.zeros_like(part.corners) if part.normals is None else part.normals @ turn for part in parts]
        normals = _smooth(np.concatenate(given)[kept], across[kept], mesh)
        super().__init__([Solid("mesh", mesh, uniform_colour("#ffffff"), 0.0, normals=normals)], engine)
        pool: _Pool = {}
        area = double / spacing**2
        self._base = _Layer(model, parts, kept, area, pool)
        _say_translucent(model, parts, pool)
        glows = [p.glow or replace(p, colour=np.zeros_like(p.colour), uv=None, alpha=None) for p in parts]
        self._glow = _Layer(model, glows, kept, area, pool) if any(p.glow for p in parts) else None
        cutoffs = [np.nan if p.uv is None and p.alpha is None else p.material.cutoff for p in parts]
        self._cutoff = np.repeat(np.array(cutoffs, np.float32), [len(part.colour) for part in parts])[kept]
        self._holes = bool((self._cutoff > 0).any())

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """As of any scene; normals are those of the visible side."""
        hits = super().intersect(origins, directions)
        towards = np.asarray(directions, dtype=np.float32)[hits.hit]
        side = np.where(dot(hits.face, towards) > 0, np.float32(-1), np.float32(1))[:, None]
        albedo = self._base.seen(hits.triangle, hits.weight, hits.distance)[:, :3]
        emission = None if self._glow is None else self._glow.seen(hits.triangle, hits.weight, hits.distance)[:, :3]
        return replace(hits, normal=side * hits.normal, face=side * hits.face, albedo=albedo, emission=emission)

    def occluded(self, points: ArrayLike, directions: ArrayLike, distance: ArrayLike = np.inf) -> NDArray[np.bool_]:
        """As of any scene; holes let light through."""
        if not self._holes:
            return super().occluded(points, directions, distance)
        d = np.ascontiguousarray(directions, dtype=np.float32)
        o = np.ascontiguousarray(np.broadcast_to(np.asarray(points, dtype=np.float32), d.shape))
        triangle, _, _, found = self._first(o, d)
        return (triangle >= 0) & (found < np.broadcast_to(np.asarray(distance, dtype=np.float32), len(o)))

    def _first(self, o: NDArray, d: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        triangle, u, v, distance = (np.array(a) for a in super()._first(o, d))
        if not self._holes:
            return triangle, u, v, distance
        passing = np.flatnonzero(triangle >= 0)
        step = np.float32(LIFT) / np.sqrt(dot(d, d))
        for _ in range(_LAYERS):
            passing = passing[self._open(triangle[passing], u[passing], v[passing], distance[passing])]
            if not len(passing):
                return triangle, u, v, distance
            start = distance[passing] + step[passing]
            t, u[passing], v[passing], further = super()._first(o[passing] + start[:, None] * d[passing], d[passing])
            triangle[passing], distance[passing] = t, start + further
            passing = passing[t >= 0]
        triangle[passing] = -1
        return triangle, u, v, distance

    def _open(self, triangle: NDArray, u: NDArray, v: NDArray, distance: NDArray) -> NDArray[np.bool_]:
        """(M,) whether the texture has a hole there."""
        weight = np.stack([1 - u - v, u, v], axis=1, dtype=np.float32)
        cutoff = self._cutoff[triangle]
        able = np.flatnonzero(cutoff > 0)
        through = np.zeros(len(triangle), dtype=np.bool_)
        through[able] = self._base.seen(triangle[able], weight[able], distance[able])[:, 3] < cutoff[able]
        return through


class _Layer:
    """Colours of the faces that are ``kept`` (F,): values at corners, times textures.

    ``area`` (F,) is twice that of a face, in rays at distance 1. Decoded textures are added to ``pool``.
    """

    def __init__(
        self, model: Model, parts: Sequence[SurfacePart], kept: NDArray[np.bool_], area: NDArray, pool: _Pool
    ) -> None:
        owner = np.full(len(parts), -1, dtype=np.intp)
        for i, part in enumerate(parts):
            name, wrap = part.material.texture, part.material.wrap
            if part.uv is None or name is None:
                continue
            if (name, wrap) not in pool:
                left = MAX_TEXELS - sum(texture.texels for texture in pool.values())
                pool[name, wrap] = Texture(decode_texture(model.path, name, model.images[name], left), wrap)
            owner[i] = list(pool).index((name, wrap))
        self._textures = list(pool.values())
        self._texture = np.repeat(owner, [len(part.colour) for part in parts])[kept]
        rgb = np.concatenate([p.colour for p in parts])[kept]
        alpha = np.concatenate([np.ones(p.colour.shape[:2]) if p.alpha is None else p.alpha for p in parts])[kept]
        self._colour = np.concatenate([rgb, alpha[..., None]], axis=-1).astype(np.float32)
        no_uv = [np.zeros((len(p.colour), 3, 2), np.float32) if p.uv is None else p.uv for p in parts]
        self._uv = np.concatenate(no_uv)[kept]
        # texels per scene unit: the square root of the area in the texture over that in space, of every face
        sides = self._uv[:, 1:] - self._uv[:, :1]
        inside = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
        texels = np.array([texture.texels for texture in self._textures] + [0], np.float64)
        self._blur = np.sqrt(inside * texels[self._texture] / area[kept]).astype(np.float32)

    def seen(self, triangle: NDArray, weight: NDArray[np.float32], distance: NDArray) -> NDArray[np.float32]:
        """(M, 4) linear RGB and alpha."""
        found: NDArray[np.float32] = np.einsum("nk,nkc->nc", weight, self._colour[triangle])
        texture = self._texture[triangle]
        for index in np.unique(texture[texture >= 0]):
            mine = np.flatnonzero(texture == index)
            uv = np.einsum("nk,nkc->nc", weight[mine], self._uv[triangle[mine]])
            found[mine] *= self._textures[index].look_up(uv, self._blur[triangle[mine]] * distance[mine])
        return found


def _transparent_faces(part: SurfacePart) -> NDArray[np.bool_]:
    """(F,) faces that are completely transparent."""
    if part.alpha is None or part.material.cutoff is None:
        return np.zeros(len(part.colour), dtype=np.bool_)
    clear: NDArray[np.bool_] = part.alpha.max(axis=1) < part.material.cutoff
    return clear


def _say_translucent(model: Model, parts: Sequence[SurfacePart], pool: _Pool) -> None:
    """Warn once of translucent faces, which are drawn opaque or left out."""
    soft = {key for key, texture in pool.items() if np.any((0 < texture.alpha) & (texture.alpha < 255))}
    count = 0
    for part in parts:
        if part.material.blend and part.uv is not None and (part.material.texture, part.material.wrap) in soft:
            count += len(part.colour)
        elif part.material.blend and part.alpha is not None:
            count += int(((part.alpha > 0) & (part.alpha < 1)).any(axis=1).sum())
    if count:
        found = f"{count} faces are translucent"
        warn_once(f"{model.path}: {found}; drawn opaque where their opacity is at least 0.5, left out elsewhere")


def _mesh(points: NDArray[np.float64], faces: NDArray[np.int64]) -> trimesh.Trimesh:
    """Give faces their own vertices where too many touch to be smoothed over."""
    around = np.bincount(faces.ravel(), minlength=len(points))
    crowded = around[faces] > _MOST_AROUND
    alone = faces[crowded]
    own = faces.copy()
    own[crowded] = len(points) + np.arange(len(alone))
    return trimesh.Trimesh(np.concatenate([points, points[alone]]), own, process=False)


def _smooth(given: NDArray[np.float64], across: NDArray[np.float64], mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """(F, 3, 3) unit normals: the file's, turned to the side of their face; else from the angles between faces."""
    with np.errstate(all="ignore"):
        length = np.linalg.norm(given, axis=2, keepdims=True)
        unit = given / length
    unit *= np.where(np.einsum("fkc,fc->fk", unit, across) < 0, -1.0, 1.0)[:, :, None]
    usable = np.isfinite(unit).all(axis=2) & (length[..., 0] > 0)
    return unit if usable.all() else np.where(usable[..., None], unit, corner_normals(mesh))
