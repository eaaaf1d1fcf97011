"""A model's surfaces: its geometry as trimesh reads it, every part in its place, with the colours of each corner of each face."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from neuprim.core.errors import DataError
from neuprim.core.io.images import srgb_to_linear
from neuprim.core.notices import warn_once
from neuprim.scenes.shapes import srgb
from neuprim.tasks.static.mesh.files import MAX_FACES, MAX_PARTS, MAX_VERTICES, Material, Model

__all__ = ["GREY", "Part", "read_parts"]

GREY = srgb("#b4b4b4")
"""Of what the file says no colour of."""

_FARTHEST_UV = 1e6
"""Of texture coordinates: single precision has no fraction left there. What is beyond, or no number, is taken for 0."""


@dataclass(frozen=True)
class Part:
    """One piece of the surface.

    Attributes:
        corners: (F, 3, 3) float64 positions in the file's units and axes, all finite.
        normals: (F, 3, 3) unit normals of the file; None where it has none.
        colour: (F, 3, 3) float32 linear RGB.
        uv: (F, 3, 2) float32, v upward; None without a texture.
        material: whose texture it is.
        bare: whether the file says nothing of its colour.
    """

    corners: NDArray[np.float64]
    normals: NDArray[np.float64] | None
    colour: NDArray[np.float32]
    uv: NDArray[np.float32] | None
    material: Material
    bare: bool


class _Parts(trimesh.resolvers.Resolver):
    """What trimesh may ask for by name: bytes that were read and checked already."""

    def __init__(self, parts: dict[str, bytes]) -> None:
        self.parts = parts

    def get(self, key: str) -> bytes:
        found = self.parts.get(key, self.parts.get(""))
        if found is None:
            raise FileNotFoundError(key)
        return found

    def keys(self) -> list[str]:
        return list(self.parts)

    def write(self, name: str, data: Any) -> None:
        raise NotImplementedError

    def namespaced(self, namespace: str) -> _Parts:
        return self


def read_parts(model: Model) -> list[Part]:
    """All triangles of a model.

    Raises:
        DataError: geometry that trimesh cannot read, no triangles, too many, vertices that are no finite numbers, or faces without them.
    """
    level = trimesh.util.log.level
    try:
        trimesh.util.log.setLevel(logging.CRITICAL + 1)  # it tells tracebacks of what it works around
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            data, parts = io.BytesIO(model.data), _Parts(model.parts)
            scene: Any = trimesh.load(data, file_type=model.kind, resolver=parts, force="scene", process=False, validate=False)
    except MemoryError:
        raise
    except Exception as error:  # trimesh's readers raise whatever their arrays do
        said = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
        raise DataError(f"{model.path}: cannot be read as {model.kind.upper()} ({said}); expected a complete file") from None
    finally:
        trimesh.util.log.setLevel(level)
    placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
    used = [(np.asarray(matrix, np.float64), scene.geometry[name]) for matrix, name in placed]
    meshes = [(matrix, mesh) for matrix, mesh in used if isinstance(mesh, trimesh.Trimesh)]
    _check(model, [mesh for _, mesh in used], [mesh for _, mesh in meshes])
    found = [part for matrix, mesh in meshes for part in _part(model, matrix, mesh)]
    bare = sum(len(part.colour) for part in found if part.bare)
    if bare:
        warn_once(f"{model.path}: {bare} of {sum(len(part.colour) for part in found)} faces have no colour; drawn grey")
    return found


def _check(model: Model, everything: list[Any], meshes: list[trimesh.Trimesh]) -> None:
    faces, vertices = sum(len(mesh.faces) for mesh in meshes), sum(len(mesh.vertices) for mesh in meshes)
    if not faces:
        points = sum(len(thing.vertices) for thing in everything)
        found = f"{points} points and no faces" if points else "no faces"
        raise DataError(f"{model.path}: has {found}; expected a mesh with triangles")
    for what, count, most in (("faces", faces, MAX_FACES), ("vertices", vertices, MAX_VERTICES), ("parts", len(meshes), MAX_PARTS)):
        if count > most:
            raise DataError(f"{model.path}: {count} {what}, each use of a part counting; expected at most {most}")


def _part(model: Model, matrix: NDArray[np.float64], mesh: trimesh.Trimesh) -> Iterator[Part]:
    vertices, faces = mesh.vertices.view(np.ndarray), mesh.faces.view(np.ndarray)
    if not len(faces):
        return
    if vertices.shape[1] != 3 or faces.shape[1] != 3:
        raise DataError(f"{model.path}: vertices of {vertices.shape[1]} numbers, faces of {faces.shape[1]}; expected 3 of each")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise DataError(f"{model.path}: a face has the vertex {faces.max() if faces.min() >= 0 else faces.min()} of {len(vertices)}")
    with np.errstate(all="ignore"):
        moved = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    bad = np.flatnonzero(~np.isfinite(moved).all(axis=1) & np.isin(np.arange(len(moved)), faces))
    if len(bad):
        raise DataError(f"{model.path}: vertex {bad[0]} is at {vertices[bad[0]].tolist()}; expected finite numbers")
    normals = None
    # The property would make smooth ones up; the cache says whether the file has any, as trimesh's own writers ask.
    if "vertex_normals" in mesh._cache:
        with np.errstate(all="ignore"):
            normals = (mesh.vertex_normals.view(np.ndarray) @ np.linalg.pinv(matrix[:3, :3]))[faces]
    name = getattr(getattr(mesh.visual, "material", None), "name", None)
    material = model.materials.get(name if isinstance(name, str) else "", model.materials.get("", Material()))
    uv, own = _coordinates(model, mesh, material), _own_colours(mesh)
    given = np.array(material.colour or (1.0, 1.0, 1.0), np.float32)
    if own is None:
        bare = material.colour is None
        yield Part(moved[faces], normals, np.broadcast_to(GREY if bare else given, (*faces.shape, 3)), uv, material, bare)
        return
    if not model.linear:
        own = srgb_to_linear(torch.from_numpy(own)).numpy()
        given = np.ones(3, np.float32)  # exporters write some colour of a material beside those of the vertices
    yield Part(moved[faces], normals, (own if own.ndim == 3 else own[faces]) * given, uv, material, False)


def _coordinates(model: Model, mesh: trimesh.Trimesh, material: Material) -> NDArray[np.float32] | None:
    """(F, 3, 2) places of the corners in the material's texture; None without one."""
    uv, faces = getattr(mesh.visual, "uv", None), mesh.faces.view(np.ndarray)
    if material.texture is None:
        return None
    if uv is None or np.shape(uv) != (len(mesh.vertices), 2):
        warn_once(f"{model.path}: texture {material.texture[:80]!r} has no coordinates on a part of {len(faces)} faces; drawn without it")
        return None
    with np.errstate(all="ignore"):
        moved = _moved(np.asarray(uv, np.float32)[faces], material)
    return np.where(np.abs(moved) < _FARTHEST_UV, moved, np.float32(0))


def _own_colours(mesh: trimesh.Trimesh) -> NDArray[np.float32] | None:
    """(V, 3) of the vertices or (F, 3, 3) of the faces, 0..1; None where there are none."""
    visual: Any = mesh.visual
    found = getattr(visual, "vertex_attributes", {}).get("color") if visual.kind == "texture" else None
    if found is None and visual.kind == "texture":
        found = mesh.vertex_attributes.get("color")
    if visual.kind == "vertex":
        found = visual.vertex_colors
    elif visual.kind == "face":
        found = visual.face_colors
    if found is None or np.ndim(found) != 2 or len(found) != len(mesh.faces if visual.kind == "face" else mesh.vertices):
        return None
    values = np.asarray(found)[:, :3]
    scale = 1.0 if values.dtype.kind == "f" else 1.0 / np.iinfo(values.dtype).max
    plain = np.clip(np.nan_to_num(values.astype(np.float32) * np.float32(scale)), 0, 1)
    return np.repeat(plain[:, None], 3, axis=1) if visual.kind == "face" else plain


def _moved(uv: NDArray[np.float32], material: Material) -> NDArray[np.float32]:
    """Texture coordinates after the material's transform, which is written for a v that runs down."""
    if material.transform is None:
        return uv
    matrix = np.array(material.transform, np.float32)
    down = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1) @ matrix[:, :2].T + matrix[:, 2]
    return np.stack([down[..., 0], 1 - down[..., 1]], axis=-1)
