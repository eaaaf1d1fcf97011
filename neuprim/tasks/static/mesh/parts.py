"""A model's surfaces: every part in its place, with the colours of each corner of each face, whatever read its
geometry."""

from __future__ import annotations

import io
import logging
import warnings
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
from neuprim.tasks.static.mesh.files import MAX_FACES, MAX_PARTS, MAX_VERTICES, Faces, Material, Model, check_vertices
from neuprim.tasks.static.mesh.gltf import GLOW_UV
from neuprim.tasks.static.mesh.obj import obj_faces
from neuprim.tasks.static.mesh.scans import ply_faces, stl_faces

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
        normals: (F, 3, 3) normals of the file; None where it has none.
        colour: (F, 3, 3) float32 linear RGB.
        uv: (F, 3, 2) float32, v upward; None without a texture.
        material: whose texture it is.
        bare: whether the file says nothing of its colour.
        alpha: (F, 3) float32 0..1; None: opaque.
        glow: the light that it emits, ``colour``, ``uv`` and ``material`` in a part of its own; None: none.
    """

    corners: NDArray[np.float64]
    normals: NDArray[np.float64] | None
    colour: NDArray[np.float32]
    uv: NDArray[np.float32] | None
    material: Material
    bare: bool
    alpha: NDArray[np.float32] | None = None
    glow: Part | None = None


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
        DataError: geometry that cannot be read, no triangles, too many, vertices that are no finite numbers, or faces
        without them.
    """
    readers = {"obj": obj_faces, "ply": ply_faces, "stl": stl_faces}
    faces, vertices = readers.get(model.kind, _trimesh_faces)(model)
    _check_counts(model, sum(len(part.corners) for part in faces), vertices, len(faces))
    found = [_part(model, part) for part in faces]
    bare = sum(len(part.colour) for part in found if part.bare)
    if bare:
        warn_once(f"{model.path}: {bare} of {sum(len(part.colour) for part in found)} faces have no colour; drawn grey")
    return found


def _trimesh_faces(model: Model) -> tuple[list[Faces], int]:
    """All triangles as trimesh reads them, each part in its place, and the number of vertices."""
    level = trimesh.util.log.level
    try:
        trimesh.util.log.setLevel(logging.CRITICAL + 1)  # it tells tracebacks of what it works around
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            data, parts = io.BytesIO(model.data), _Parts(model.parts)
            scene: Any = trimesh.load(
                data, file_type=model.kind, resolver=parts, force="scene", process=False, validate=False
            )
    except MemoryError:
        raise
    except Exception as error:  # trimesh's readers raise whatever their arrays do
        said = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
        raise DataError(
            f"{model.path}: cannot be read as {model.kind[:4].upper()} ({said}); expected a complete file"
        ) from None
    finally:
        trimesh.util.log.setLevel(level)
    placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
    used = [(np.asarray(matrix, np.float64), scene.geometry[name]) for matrix, name in placed]
    meshes = [(matrix, mesh) for matrix, mesh in used if isinstance(mesh, trimesh.Trimesh)]
    _check_counts(
        model, sum(len(mesh.faces) for _, mesh in meshes), sum(len(mesh.vertices) for _, mesh in used), len(meshes)
    )
    return [_placed(model, matrix, mesh) for matrix, mesh in meshes if len(mesh.faces)], sum(
        len(mesh.vertices) for _, mesh in used
    )


def _check_counts(model: Model, faces: int, vertices: int, parts: int) -> None:
    if not faces:
        found = f"{vertices} points and no faces" if vertices else "no faces"
        raise DataError(f"{model.path}: has {found}; expected a mesh with triangles")
    for what, count, most in (
        ("faces", faces, MAX_FACES),
        ("vertices", vertices, MAX_VERTICES),
        ("parts", parts, MAX_PARTS),
    ):
        if count > most:
            raise DataError(f"{model.path}: {count} {what}, each use of a part counting; expected at most {most}")


def _placed(model: Model, matrix: NDArray[np.float64], mesh: trimesh.Trimesh) -> Faces:
    vertices, faces = mesh.vertices.view(np.ndarray), mesh.faces.view(np.ndarray)
    if vertices.shape[1] != 3 or faces.shape[1] != 3:
        raise DataError(
            f"{model.path}: vertices of {vertices.shape[1]} numbers, faces of {faces.shape[1]}; expected 3 of each"
        )
    normals = None
    with np.errstate(all="ignore"):
        moved = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        # The property would make smooth ones up; the cache says whether the file has any, as trimesh's own writers ask.
        if "vertex_normals" in mesh._cache:
            normals = mesh.vertex_normals.view(np.ndarray) @ np.linalg.pinv(matrix[:3, :3])
    check_vertices(model.path, moved, faces)
    name = getattr(getattr(mesh.visual, "material", None), "name", None)
    uv, colour = getattr(mesh.visual, "uv", None), getattr(mesh.visual, "vertex_attributes", {}).get("color")
    glow_uv = mesh.vertex_attributes.get(GLOW_UV)
    glow_uv = (
        None if glow_uv is None else np.array([0, 1]) - np.array([-1, 1]) * glow_uv
    )  # v upward, as trimesh turns the other
    uv, colour, glow_uv = (
        None if value is None else np.asarray(value, np.float32)[faces] for value in (uv, colour, glow_uv)
    )
    normals = None if normals is None else normals[faces]
    return Faces(moved[faces], name if isinstance(name, str) else "", normals, colour, uv, glow_uv)


def _part(model: Model, faces: Faces) -> Part:
    material = model.materials.get(faces.material, model.materials.get("", Material()))
    uv = _coordinates(model, faces.uv, material, len(faces.corners))
    shape, own = faces.corners.shape, faces.colour
    bare = own is None and material.colour is None
    colour = np.broadcast_to(GREY if bare else np.array(material.colour or (1.0, 1.0, 1.0), np.float32), shape)
    alpha = np.full(shape[:2], material.opacity, np.float32) if material.opacity < 1 else None
    if own is not None:
        rgb = np.clip(np.nan_to_num(own[..., :3]), 0, 1)
        # exporters of formats other than glTF write some colour of a material beside those of the vertices
        colour = rgb * colour if model.linear else srgb_to_linear(torch.from_numpy(rgb)).numpy()
        if own.shape[2] == 4:
            alpha = (np.float32(material.opacity) * np.clip(np.nan_to_num(own[..., 3]), 0, 1)).astype(np.float32)
    glow = None
    if material.unlit:
        glow, colour = Part(faces.corners, None, colour, uv, material, False), np.zeros(shape, np.float32)
    elif material.glow is not None:
        light = np.broadcast_to(np.array(material.glow.colour or (0.0, 0.0, 0.0), np.float32), shape)
        places = _coordinates(model, faces.glow_uv, material.glow, len(faces.corners))
        glow = Part(faces.corners, None, light, places, material.glow, False)
    return Part(faces.corners, faces.normals, colour, uv, material, bare, alpha, glow)


def _coordinates(
    model: Model, uv: NDArray[np.floating] | None, material: Material, faces: int
) -> NDArray[np.float32] | None:
    """(F, 3, 2) places of the corners in the material's texture; None without one."""
    if material.texture is None:
        return None
    if uv is None:
        warn_once(
            f"{model.path}: texture {material.texture[:80]!r} has no coordinates on a part of {faces} faces; drawn without it"
        )
        return None
    with np.errstate(all="ignore"):
        moved = _moved(np.asarray(uv, np.float32), material)
    return np.where(np.abs(moved) < _FARTHEST_UV, moved, np.float32(0))


def _moved(uv: NDArray[np.float32], material: Material) -> NDArray[np.float32]:
    """Texture coordinates after the material's transform, which is written for a v that runs down."""
    if material.transform is None:
        return uv
    matrix = np.array(material.transform, np.float32)
    down = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1) @ matrix[:, :2].T + matrix[:, 2]
    return np.stack([down[..., 0], 1 - down[..., 1]], axis=-1)
