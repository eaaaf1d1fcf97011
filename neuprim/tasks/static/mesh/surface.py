"""Mesh for ray casting: triangles with colours, opacity and filtered textures, scaled to fit into [-1, 1]^3."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from numpy.typing import ArrayLike, NDArray
from PIL import Image

from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.exr import MAX_PIXELS
from neuprim.core.io.images import srgb_to_linear
from neuprim.scenes.raycast import LIFT, Engine, Hits, Scene
from neuprim.scenes.shading import shading_dot
from neuprim.scenes.shapes import Solid, parse_solid_srgb, solid_corner_normals, uniform_colour
from neuprim.tasks.static.mesh.model import (
    MAX_FACES,
    MAX_PARTS,
    MAX_TEXELS,
    MAX_VERTICES,
    Faces,
    Material,
    Model,
    Up,
    check_mesh_limits,
)

GREY = parse_solid_srgb("#b4b4b4")  # colour of faces without a colour in the file
_FARTHEST_UV = 1e6  # float32 has steps of 1/16 there; coordinates beyond, and NaN, become 0


@dataclass(frozen=True)
class SurfacePart:
    """Triangles of one material, with final colours."""

    corners: NDArray[np.float64]  # (F, 3, 3) positions in the units and axes of the file, finite
    normals: NDArray[np.float64] | None  # (F, 3, 3) from the file; None if the file has no normals
    colour: NDArray[np.float32]  # (F, 3, 3) linear RGB
    uv: NDArray[np.float32] | None  # (F, 3, 2), v upward, if there is a texture
    material: Material  # provides the texture
    bare: bool  # whether the file has no colour for these triangles
    alpha: NDArray[np.float32] | None = None  # (F, 3) 0..1; None for opaque
    glow: SurfacePart | None = None  # emitted light, as the colour, uv and material of a further part


def read_surfaces(model: Model) -> list[SurfacePart]:
    """Return the triangles of a mesh with their final colours, in parts of one material each.

    Raises DataError if the mesh is damaged, or has no or too many triangles.
    """
    faces, vertices = model.read_faces()
    count = sum(len(part.corners) for part in faces)
    if not count:
        found = f"{vertices} points and no faces" if vertices else "no faces"
        raise DataError(f"{model.path}: has {found}; expected a mesh with triangles")
    parts = (len(faces), MAX_PARTS)
    check_mesh_limits(model.path, {"faces": (count, MAX_FACES), "vertices": (vertices, MAX_VERTICES), "parts": parts})
    surfaces = [_make_surface_part(model, part) for part in faces]
    bare = sum(len(part.colour) for part in surfaces if part.bare)
    if bare:
        warn_once(f"{model.path}: {bare} of {count} faces have no colour; drawn grey")
    return surfaces


def _make_surface_part(model: Model, faces: Faces) -> SurfacePart:
    material = model.materials.get(faces.material, model.materials.get("", Material()))
    uv = _texture_coordinates(model, faces.uv, material, len(faces.corners))
    shape, own = faces.corners.shape, faces.colour
    bare = own is None and material.colour is None
    colour = np.broadcast_to(GREY if bare else np.array(material.colour or (1.0, 1.0, 1.0), np.float32), shape)
    alpha = np.full(shape[:2], material.opacity, np.float32) if material.opacity < 1 else None
    if own is not None:
        rgb = np.clip(np.nan_to_num(own[..., :3]), 0, 1)
        # formats other than glTF: vertex colours replace the colour of the material, which exporters write anyway
        colour = rgb * colour if model.linear else srgb_to_linear(torch.from_numpy(rgb)).numpy()
        if own.shape[2] == 4:
            alpha = (np.float32(material.opacity) * np.clip(np.nan_to_num(own[..., 3]), 0, 1)).astype(np.float32)
    glow = None
    if material.unlit:
        glow, colour = SurfacePart(faces.corners, None, colour, uv, material, False), np.zeros(shape, np.float32)
    elif material.glow is not None:
        light = np.broadcast_to(np.array(material.glow.colour or (0.0, 0.0, 0.0), np.float32), shape)
        places = _texture_coordinates(model, faces.glow_uv, material.glow, len(faces.corners))
        glow = SurfacePart(faces.corners, None, light, places, material.glow, False)
    return SurfacePart(faces.corners, faces.normals, colour, uv, material, bare, alpha, glow)


def _texture_coordinates(
    model: Model, uv: NDArray[np.floating] | None, material: Material, faces: int
) -> NDArray[np.float32] | None:
    """Return the (F, 3, 2) ``uv`` after the material's texture transform; None if texture or ``uv`` are missing.

    ``faces`` is the number F, which the warning about missing coordinates states.
    """
    if material.texture is None:
        return None
    if uv is None:
        found = f"a part of {faces} faces has no coordinates for texture {material.texture[:80]!r}"
        warn_once(f"{model.path}: {found}; drawn without it")
        return None
    with np.errstate(all="ignore"):
        moved = _transform_texture_coordinates(np.asarray(uv, np.float32), material)
    return np.where(np.abs(moved) < _FARTHEST_UV, moved, np.float32(0))


def _transform_texture_coordinates(uv: NDArray[np.float32], material: Material) -> NDArray[np.float32]:
    """Apply the material's texture transform, which is defined for a downward v, to coordinates with upward v."""
    if material.transform is None:
        return uv
    matrix = np.array(material.transform, np.float32)
    down = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1) @ matrix[:, :2].T + matrix[:, 2]
    return np.stack([down[..., 0], 1 - down[..., 1]], axis=-1)


FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF")  # formats that Pillow may decode; others run programs

_LINEAR: NDArray[np.float32] = srgb_to_linear(torch.arange(256) / 255.0).numpy()
_ROWS = 256


class MeshTexture:
    """A mip-mapped texture, (H, W, 4) uint8 sRGB with straight alpha. Each level has half the size of the previous."""

    def __init__(self, pixels: NDArray[np.uint8], wrap: tuple[str, str] = ("repeat", "repeat")) -> None:
        self.wrap = wrap
        self.levels: list[NDArray] = [pixels]
        while max(self.levels[-1].shape[:2]) > 1:
            self.levels.append(_halve_texture(self.levels[-1]))

    @property
    def texels(self) -> int:
        return self.levels[0].shape[0] * self.levels[0].shape[1]

    @property
    def alpha(self) -> NDArray:
        return self.levels[0][..., 3]

    def look_up(self, uv: NDArray[np.float32], blur: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return (M, 4) linear RGBA at (M, 2) ``uv``, v upward.

        ``blur`` (M,) is the width of each ray at the surface, in texels. This width selects the mip level.
        """
        level = np.clip(np.round(np.log2(np.maximum(blur, 1.0))), 0, len(self.levels) - 1).astype(np.intp)
        found = np.empty((len(uv), 4), dtype=np.float32)
        for index in np.unique(level):
            mine = np.flatnonzero(level == index)
            found[mine] = self._sample_bilinear(self.levels[index], uv[mine])
        return found

    def _sample_bilinear(self, image: NDArray, uv: NDArray[np.float32]) -> NDArray[np.float32]:
        height, width = image.shape[:2]
        x, y = uv[:, 0].astype(np.float64) * width - 0.5, (1.0 - uv[:, 1].astype(np.float64)) * height - 0.5
        left, top = np.floor(x), np.floor(y)
        across, down = (x - left).astype(np.float32)[:, None], (y - top).astype(np.float32)[:, None]
        x0, x1 = (_wrap_mesh_texels(left + i, width, self.wrap[0]) for i in (0, 1))
        y0, y1 = (_wrap_mesh_texels(top + i, height, self.wrap[1]) for i in (0, 1))
        upper = (1 - across) * _linear_texels(image[y0, x0]) + across * _linear_texels(image[y0, x1])
        lower = (1 - across) * _linear_texels(image[y1, x0]) + across * _linear_texels(image[y1, x1])
        mixed: NDArray[np.float32] = (1 - down) * upper + down * lower
        return mixed


def _wrap_mesh_texels(index: NDArray[np.float64], size: int, wrap: str) -> NDArray[np.intp]:
    if wrap == "clamp":
        return np.clip(index, 0, size - 1).astype(np.intp)
    if wrap == "mirror":
        folded = np.mod(index, 2 * size)
        return np.minimum(folded, 2 * size - 1 - folded).astype(np.intp)
    return np.minimum(np.mod(index, size), size - 1).astype(np.intp)


def _linear_texels(pixels: NDArray) -> NDArray[np.float32]:
    """Convert uint8 sRGB texels to (..., 4) float32 linear values; float texels are already linear."""
    if pixels.dtype != np.uint8:
        return pixels.astype(np.float32)
    values = np.empty(pixels.shape, np.float32)
    values[..., :3] = _LINEAR[pixels[..., :3]]
    values[..., 3] = pixels[..., 3] / np.float32(255)
    return values


def _halve_texture(image: NDArray) -> NDArray[np.float16]:
    """Halve a texture: average 2 x 2 pixels in linear light; the last row or column of an odd size counts twice."""
    height, width = image.shape[:2]
    half = np.empty(((height + 1) // 2, (width + 1) // 2, 4), np.float16)
    for top in range(0, len(half), _ROWS):
        rows = np.minimum(np.arange(2 * top, min(2 * (top + _ROWS), 2 * len(half))), height - 1)
        columns = np.minimum(np.arange(2 * half.shape[1]), width - 1)
        part = _linear_texels(image[rows][:, columns])
        half[top : top + _ROWS] = part.reshape(len(rows) // 2, 2, half.shape[1], 2, 4).mean(axis=(1, 3))
    return half


def decode_texture(path: Path, name: str, data: bytes, left: int = MAX_TEXELS) -> NDArray[np.uint8]:
    """Decode an image to (H, W, 4) uint8, sRGB with straight alpha, of at most ``left`` pixels.

    Raises DataError if the image is damaged, of another format, or too large; the message names model and image.
    """
    where = f"{path}: texture {name[:80]!r}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                size = image.width * image.height
                if size > min(MAX_PIXELS, left):
                    most = f"{MAX_PIXELS}" if size > MAX_PIXELS else f"{MAX_TEXELS} in all textures together"
                    raise DataError(f"{where} has {image.width}x{image.height} pixels; at most {most} are accepted")
                if image.mode == "F":
                    raise DataError(f"{where} has float pixels; expected 8 or 16 bits")
                if image.mode.startswith("I"):  # 16 bits of grey, which Pillow would cut off at 255
                    grey = (np.asarray(image, np.int64) >> 8).clip(0, 255).astype(np.uint8)
                    return np.array(Image.fromarray(grey).convert("RGBA"))
                return np.array(image.convert("RGBA"))
    except (DataError, MemoryError):
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise DataError(f"{where} claims more than {MAX_PIXELS} pixels; expected fewer") from None
    except Exception as error:  # Pillow's decoders raise OSError, SyntaxError, ValueError, struct.error, ...
        reason, expected = " ".join(str(error).split())[:120], f"{', '.join(FORMATS[:-1])} or {FORMATS[-1]}"
        raise DataError(f"{where} cannot be decoded ({reason}); expected {expected}") from None


FARTHEST = 1.3  # largest distance of a vertex from the origin, scene units: the cameras of ``solids`` see it
_DIGITS = 6  # decimals of positions, scene units; vertices that agree in them are merged
_LEAST_AREA = 1e-12  # of a face, in square scene units: below that it has no normal in single precision
_MAX_HOLES = 64  # most holes that a ray passes
_MOST_AROUND = 64  # most faces around a vertex with smooth normals; work and memory grow with their square

_Pool = dict[tuple[str, tuple[str, str]], MeshTexture]

_Z_FROM_Y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def scene_from_mesh_file(parts: Sequence[SurfacePart], upward: Up) -> NDArray[np.float64] | None:
    """Return the (4, 4) matrix from the axes of a mesh file to scene coordinates.

    The matrix turns the mesh so that z is up, centres the mesh, and scales it to fit into [-1, 1]^3 and into all
    images. The result is None if the size of the mesh is 0 or out of range.
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


class MeshSurface(Scene):
    """Mesh for ray casting, in scene coordinates.

    ``spacing`` is the distance between neighbouring rays at distance 1 from the camera. Textures are filtered to this
    resolution.
    """

    def __init__(
        self, model: Model, parts: Sequence[SurfacePart], upward: Up, spacing: float, engine: Engine = "auto"
    ) -> None:
        matrix = scene_from_mesh_file(parts, upward)
        if matrix is None:
            found = "the mesh is a single point or too large"
            raise DataError(f"{model.path}: {found}; expected a mesh of size 1e-150 to 1e150")
        self.scene_from_file = matrix
        points = np.concatenate([(part.corners @ matrix[:3, :3].T + matrix[:3, 3]).reshape(-1, 3) for part in parts])
        first, same = trimesh.grouping.unique_rows(points, digits=_DIGITS)
        points, faces = points[first], same.reshape(-1, 3)  # merge the vertices of touching faces
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
            raise DataError(f"{model.path}: {found}; expected a mesh that is not fully transparent (alpha, d, Tr)")
        kept &= ~faint
        mesh = _separate_crowded_vertices(points, faces[kept])
        turn = matrix[:3, :3].T  # to the axes of the scene; 0 where the file has no normal
        given = [np.zeros_like(part.corners) if part.normals is None else part.normals @ turn for part in parts]
        normals = _smooth_normals(np.concatenate(given)[kept], across[kept], mesh)
        super().__init__([Solid("mesh", mesh, uniform_colour("#ffffff"), 0.0, normals=normals)], engine)
        pool: _Pool = {}
        area = double / spacing**2
        self._base = _MeshColourLayer(model, parts, kept, area, pool)
        _warn_of_translucent_faces(model, parts, pool)
        glows = [p.glow or replace(p, colour=np.zeros_like(p.colour), uv=None, alpha=None) for p in parts]
        self._glow = _MeshColourLayer(model, glows, kept, area, pool) if any(p.glow for p in parts) else None
        cutoffs = [np.nan if p.uv is None and p.alpha is None else p.material.cutoff for p in parts]
        self._cutoff = np.repeat(np.array(cutoffs, np.float32), [len(part.colour) for part in parts])[kept]
        self._holes = bool((self._cutoff > 0).any())

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """Return the first hits as :meth:`Scene.intersect` does; normals point to the side that the ray comes from."""
        hits = super().intersect(origins, directions)
        towards = np.asarray(directions, dtype=np.float32)[hits.hit]
        side = np.where(shading_dot(hits.face, towards) > 0, np.float32(-1), np.float32(1))[:, None]
        albedo = self._base.sample_colours(hits.triangle, hits.weight, hits.distance)[:, :3]
        emission = (
            None if self._glow is None else self._glow.sample_colours(hits.triangle, hits.weight, hits.distance)[:, :3]
        )
        return replace(hits, normal=side * hits.normal, face=side * hits.face, albedo=albedo, emission=emission)

    def occluded(self, points: ArrayLike, directions: ArrayLike, distance: ArrayLike = np.inf) -> NDArray[np.bool_]:
        """Return (N,) bool: whether the mesh blocks each segment, as :meth:`Scene.occluded`; holes do not block."""
        if not self._holes:
            return super().occluded(points, directions, distance)
        d = np.ascontiguousarray(directions, dtype=np.float32)
        o = np.ascontiguousarray(np.broadcast_to(np.asarray(points, dtype=np.float32), d.shape))
        triangle, _, _, found = self._first_hits(o, d)
        return (triangle >= 0) & (found < np.broadcast_to(np.asarray(distance, dtype=np.float32), len(o)))

    def _first_hits(self, o: NDArray, d: NDArray) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        triangle, u, v, distance = (np.array(a) for a in super()._first_hits(o, d))
        if not self._holes:
            return triangle, u, v, distance
        passing = np.flatnonzero(triangle >= 0)
        step = np.float32(LIFT) / np.sqrt(shading_dot(d, d))
        for _ in range(_MAX_HOLES):
            passing = passing[self._is_hole(triangle[passing], u[passing], v[passing], distance[passing])]
            if not len(passing):
                return triangle, u, v, distance
            start = distance[passing] + step[passing]
            t, u[passing], v[passing], further = super()._first_hits(
                o[passing] + start[:, None] * d[passing], d[passing]
            )
            triangle[passing], distance[passing] = t, start + further
            passing = passing[t >= 0]
        triangle[passing] = -1
        return triangle, u, v, distance

    def _is_hole(self, triangle: NDArray, u: NDArray, v: NDArray, distance: NDArray) -> NDArray[np.bool_]:
        """Return (M,) bool: whether each hit is a hole of the mesh, where alpha is below the material's cutoff.

        A hit is given by its triangle, its barycentric coordinates ``u`` and ``v``, and its distance along the ray.
        """
        weight = np.stack([1 - u - v, u, v], axis=1, dtype=np.float32)
        cutoff = self._cutoff[triangle]
        able = np.flatnonzero(cutoff > 0)
        through = np.zeros(len(triangle), dtype=np.bool_)
        through[able] = self._base.sample_colours(triangle[able], weight[able], distance[able])[:, 3] < cutoff[able]
        return through


class _MeshColourLayer:
    """Surface colours at ray hits: interpolated corner colours times textures.

    ``kept`` (F,) selects the faces that can be hit. ``area`` (F,) is twice the area of each face, divided by the
    squared distance of neighbouring rays at distance 1 from the camera. Layers share the decoded textures in ``pool``.
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
                pool[name, wrap] = MeshTexture(decode_texture(model.path, name, model.images[name], left), wrap)
            owner[i] = list(pool).index((name, wrap))
        self._textures = list(pool.values())
        self._texture = np.repeat(owner, [len(part.colour) for part in parts])[kept]
        rgb = np.concatenate([p.colour for p in parts])[kept]
        alpha = np.concatenate([np.ones(p.colour.shape[:2]) if p.alpha is None else p.alpha for p in parts])[kept]
        self._colour = np.concatenate([rgb, alpha[..., None]], axis=-1).astype(np.float32)
        no_uv = [np.zeros((len(p.colour), 3, 2), np.float32) if p.uv is None else p.uv for p in parts]
        self._uv = np.concatenate(no_uv)[kept]
        # texels along a ray's width at distance 1: root of a face's area in texels over its area in rays
        sides = self._uv[:, 1:] - self._uv[:, :1]
        inside = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
        texels = np.array([texture.texels for texture in self._textures] + [0], np.float64)
        self._blur = np.sqrt(inside * texels[self._texture] / area[kept]).astype(np.float32)

    def sample_colours(self, triangle: NDArray, weight: NDArray[np.float32], distance: NDArray) -> NDArray[np.float32]:
        """Return (M, 4) linear RGB and alpha of hits on triangles (M,) with barycentric weights (M, 3).

        ``distance`` (M,) is the distance of each hit from the ray's origin. The blur of textures grows in proportion to
        this distance.
        """
        found: NDArray[np.float32] = np.einsum("nk,nkc->nc", weight, self._colour[triangle])
        texture = self._texture[triangle]
        for index in np.unique(texture[texture >= 0]):
            mine = np.flatnonzero(texture == index)
            uv = np.einsum("nk,nkc->nc", weight[mine], self._uv[triangle[mine]])
            found[mine] *= self._textures[index].look_up(uv, self._blur[triangle[mine]] * distance[mine])
        return found


def _transparent_faces(part: SurfacePart) -> NDArray[np.bool_]:
    """Return (F,) bool: whether a face is invisible, since its alpha is below the material's cutoff at all corners."""
    if part.alpha is None or part.material.cutoff is None:
        return np.zeros(len(part.colour), dtype=np.bool_)
    clear: NDArray[np.bool_] = part.alpha.max(axis=1) < part.material.cutoff
    return clear


def _warn_of_translucent_faces(model: Model, parts: Sequence[SurfacePart], pool: _Pool) -> None:
    """Warn once if a mesh has translucent faces, because these are drawn opaque or left out."""
    soft = {key for key, texture in pool.items() if np.any((0 < texture.alpha) & (texture.alpha < 255))}
    count = 0
    for part in parts:
        if part.material.blend and part.uv is not None and (part.material.texture, part.material.wrap) in soft:
            count += len(part.colour)
        elif part.material.blend and part.alpha is not None:
            count += int(((part.alpha > 0) & (part.alpha < 1)).any(axis=1).sum())
    if count:
        found = f"{count} faces are translucent"
        warn_once(f"{model.path}: {found}; they are opaque where their opacity is at least 0.5, and left out elsewhere")


def _separate_crowded_vertices(points: NDArray[np.float64], faces: NDArray[np.int64]) -> trimesh.Trimesh:
    """Return a mesh in which vertices that more than 64 faces share are duplicated, one copy per corner.

    Duplication limits the cost of smooth normals, which grows with the square of the number of faces at a vertex. Faces
    at a copy get their own normals.
    """
    around = np.bincount(faces.ravel(), minlength=len(points))
    crowded = around[faces] > _MOST_AROUND
    alone = faces[crowded]
    own = faces.copy()
    own[crowded] = len(points) + np.arange(len(alone))
    return trimesh.Trimesh(np.concatenate([points, points[alone]]), own, process=False)


def _smooth_normals(
    given: NDArray[np.float64], across: NDArray[np.float64], mesh: trimesh.Trimesh
) -> NDArray[np.float64]:
    """Return (F, 3, 3) unit corner normals: the file's normals, or :func:`solid_corner_normals` where it has none.

    ``given`` (F, 3, 3) are the file's normals, 0 where missing. The file's normals are flipped to the side to which the
    face normal points. ``across`` (F, 3) are the face normals, of any length.
    """
    with np.errstate(all="ignore"):
        length = np.linalg.norm(given, axis=2, keepdims=True)
        unit = given / length
    unit *= np.where(np.einsum("fkc,fc->fk", unit, across) < 0, -1.0, 1.0)[:, :, None]
    usable = np.isfinite(unit).all(axis=2) & (length[..., 0] > 0)
    return unit if usable.all() else np.where(usable[..., None], unit, solid_corner_normals(mesh))
