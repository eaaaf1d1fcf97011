"""PLY, with colours of vertices or faces or a texture, and STL, which may have colours; headers are not trusted."""

from __future__ import annotations

import io
import re
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.ply import PlyElement, read_ply_elements
from neuprim.tasks.static.mesh.model import (
    MAX_FACES,
    MAX_PARTS,
    MAX_VERTICES,
    Faces,
    Material,
    MeshFolder,
    Model,
    check_mesh_limits,
    check_vertices,
)
from neuprim.tasks.static.mesh.polygons import triangulate_polygons

_HEADER = 2**16
_RGB = ("red", "green", "blue")
_UV = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_ply_mesh(folder: MeshFolder) -> Model:
    """Read a .ply file with its faces, and the texture that a comment ``TextureFile`` names."""
    data = folder.read_model()
    end = data.find(b"end_header", 0, _HEADER)
    if not data.startswith(b"ply"):
        raise DataError(f"{folder.file}: starts with {data[:12]!r}; expected a PLY file")
    if end < 0:
        raise DataError(f"{folder.file}: has no end_header in its first {_HEADER} bytes; expected a PLY file")
    header = data[:end].decode("utf-8", "replace")
    counts = {name: int(count) for name, count in re.findall(r"(?m)^element[ \t]+(\S+)[ \t]+(\d{1,18})\s*$", header)}
    vertices, faces = (counts.get("vertex", 0), MAX_VERTICES), (counts.get("face", 0), MAX_FACES)
    check_mesh_limits(folder.file, {"vertices": vertices, "faces": faces})
    materials: dict[str, Material] = {}
    images: dict[str, bytes] = {}
    texture = re.search(r"(?mi)^comment[ \t]+TextureFile[ \t]+(.+?)\s*$", header)
    if texture:
        image = folder.read_optional([texture[1]], "texture")
        if image is not None:
            images[texture[1]] = image
            materials[""] = Material((1.0, 1.0, 1.0), texture[1], cutoff=0.5, blend=True)
    return Model(folder.file, partial(_read_ply_mesh_faces, folder.file, data), folder.digest, materials, images)


def _read_ply_mesh_faces(path: Path, data: bytes) -> tuple[list[Faces], int]:
    """Read all triangles and count the vertices."""
    elements = read_ply_elements(io.BytesIO(data), len(data), path, ("vertex", "face", "tristrips"))
    vertices = elements["vertex"]
    if not {"x", "y", "z"} <= set(vertices.names):
        raise DataError(f"{path}: vertices have no x, y, z but {', '.join(vertices.names)[:80]}; expected a mesh")
    count = len(vertices.rows)
    face = elements.get("face")
    lists = face.lists if face is not None else {}
    corners = next((lists[name] for name in ("vertex_indices", "vertex_index") if name in lists), None)
    if face is None or corners is None:
        strips = elements["tristrips"].lists if "tristrips" in elements else {}
        if strips or lists:
            found = ", ".join([*strips, *lists])[:60]
            raise DataError(f"{path}: faces are {found}; expected a list vertex_indices of every face")
        return [], count
    index = corners.values.astype(np.int64)
    xyz = vertices.columns(("x", "y", "z"))
    check_vertices(path, xyz, index)
    triangles, polygon = triangulate_polygons(path, xyz[index], corners.sizes)
    used = index[triangles]
    normals = vertices.columns(("nx", "ny", "nz"))[used] if {"nx", "ny", "nz"} <= set(vertices.names) else None
    colour = _ply_mesh_colours(vertices, path)
    colour = None if colour is None else colour[used]
    if colour is None and (of_faces := _ply_mesh_colours(face, path)) is not None:
        colour = np.repeat(of_faces[polygon][:, None], 3, axis=1)
    uv: NDArray[np.float64] | None = None
    coordinates = lists.get("texcoord")
    if coordinates is not None and np.array_equal(coordinates.sizes, 2 * corners.sizes):
        uv = coordinates.values.astype(np.float64).reshape(-1, 2)[triangles]
    elif (pair := next((pair for pair in _UV if set(pair) <= set(vertices.names)), None)) is not None:
        uv = vertices.columns(pair)[used]
    if "texnumber" in face.names and face.rows["texnumber"].any():
        raise DataError(f"{path}: has several textures (texnumber); expected one, or a glTF or OBJ file")
    return [Faces(xyz[used], "", normals, colour, uv)], count


def _ply_mesh_colours(element: PlyElement, path: Path) -> NDArray[np.float32] | None:
    """(N, 3) 0..1 of vertices or faces; None without."""
    if not set(_RGB) <= set(element.names):
        return None
    kind = element.rows.dtype["red"]
    most = np.iinfo(kind).max if kind.kind in "iu" else 1.0
    if "alpha" in element.names and (element.rows["alpha"] < most).any():
        warn_once(f"{path}: colours have an alpha, which is not read; drawn opaque")
    return np.clip(np.nan_to_num(element.columns(_RGB) / most), 0, 1).astype(np.float32)


def read_stl(folder: MeshFolder) -> Model:
    """Read an .stl file: binary where its length is what byte 80 announces, whatever it starts with, else text."""
    data = folder.read_model()
    count = int.from_bytes(data[80:84], "little")
    text = len(data) != 84 + 50 * count or len(data) < 84
    if text:
        if data[:5].lower() != b"solid" or b"facet" not in data[:_HEADER]:
            expected = f"{84 + 50 * count} bytes for them, found {len(data)}"
            raise DataError(f"{folder.file}: {count} faces announced; expected {expected}")
        check_mesh_limits(folder.file, {"solids": (data.lower().count(b"endsolid"), MAX_PARTS)})
        count = data.lower().count(b"endfacet")
    check_mesh_limits(folder.file, {"faces": (count, MAX_FACES)})
    read_faces = _read_stl_text if text else _read_stl_binary
    return Model(folder.file, partial(read_faces, folder.file, data), folder.digest)


def _read_stl_text(path: Path, data: bytes) -> tuple[list[Faces], int]:
    """Read all triangles of a text file and count their corners."""
    words = re.findall(rb"(?i)^\s*vertex\s+(\S+)[ \t]+(\S+)[ \t]+(\S+)", data, re.MULTILINE)
    try:
        corners = np.array(words, dtype=np.float64).reshape(-1, 3, 3)
    except ValueError as error:
        raise DataError(f"{path}: cannot be read as STL ({error}); expected a complete file") from None
    check_vertices(path, corners.reshape(-1, 3), np.arange(len(words)))
    return [Faces(corners)] if len(corners) else [], len(words)


def _read_stl_binary(path: Path, data: bytes) -> tuple[list[Faces], int]:
    """Read triangles of a binary file, with the colours of VisCAM (bit 15 set) or Materialise Magics (COLOR=)."""
    rows = np.frombuffer(data, _STL, offset=84)
    bits = rows["attribute"].astype(np.int64)
    fives = np.stack([(bits >> shift & 31) / 31 for shift in (10, 5, 0)], axis=-1)
    own = bits >> 15 == 1
    place = data.find(b"COLOR=", 0, 80 - 9)
    if place >= 0:
        whole = np.frombuffer(data, np.uint8, 3, place + 6) / 255
        fives, own = np.where(own[:, None], whole, fives[:, ::-1]), np.ones_like(own)
    corners = rows["corners"].astype(np.float64)
    check_vertices(path, corners.reshape(-1, 3), np.arange(3 * len(rows)))
    found = []
    for mine, colour in ((own, np.repeat(fives[own][:, None], 3, axis=1).astype(np.float32)), (~own, None)):
        if mine.any():
            found.append(Faces(corners[mine], colour=colour))
    return found, 3 * len(rows)
