"""Readers of mesh files: OBJ with material libraries (.mtl), PLY with colours or a texture, and STL.

Textures and colours (also those of STL files) are sRGB. Counts in headers are checked before memory is allocated.
"""

from __future__ import annotations

import io
import re
from array import array
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from numpy.typing import NDArray

from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.images import srgb_to_linear
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
    triangulate_polygons,
)

# texture options with at most this many numbers after them, and texture options with one word after them
_NUMBERS = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}
_WORDS = {"-blendu", "-blendv", "-bm", "-boost", "-cc", "-clamp", "-imfchan", "-texres", "-type"}

# least and most numbers read per vertex (x y z, then a colour or a weight), texture coordinate and normal
_WIDTHS = {"v": (3, 8), "vt": (1, 3), "vn": (3, 3)}
_NONE = -1  # index of missing texture coordinates or normals


def read_obj(folder: MeshFolder) -> Model:
    """Read an .obj file and its material libraries; raise DataError if a file is missing, refused or too large."""
    text = folder.read_model().decode("utf-8", "replace")
    found = {"vertices": (text.count("\nv "), MAX_VERTICES), "faces": (text.count("\nf "), MAX_FACES)}
    check_mesh_limits(folder.file, {**found, "changes of material": (text.count("usemtl "), MAX_PARTS)})
    materials: dict[str, Material] = {}
    images: dict[str, bytes] = {}
    libraries: dict[str, None] = {}
    for line in re.findall(r"(?m)^[ \t\r\f\v]*mtllib[ \t]+(.+?)\s*$", text):
        names = re.findall(r"(?i).+?\.mtl(?=\s|$)", line) or [line]  # names may hold blanks
        libraries.update((name.strip(), None) for name in names)
    for library in libraries:
        content = folder.read_optional([library, PurePosixPath(library.replace("\\", "/")).name], "material file")
        if content is not None:
            materials |= _read_mtl_library(content.decode("utf-8", "replace"), folder, images)
    faces = partial(_read_obj_faces, folder.file, text)
    return Model(folder.file, faces, folder.digest, materials, images, "y")


def _read_obj_faces(path: Path, text: str) -> tuple[list[Faces], int]:
    """Parse the text of an .obj file: return the triangles of each material, and the number of vertices."""
    text = re.sub(r"\\\r?\n", " ", text)
    numbers, lengths = {key: array("d") for key in _WIDTHS}, {key: array("q") for key in _WIDTHS}
    indices, sizes, owners = array("q"), array("q"), array("q")
    names = {"": 0}
    material = 0
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        key = words[0] if words else ""
        if key == "usemtl":
            material = names.setdefault(" ".join(words[1:]), len(names))
        if key != "f" and key not in _WIDTHS:
            continue
        if "#" in line:
            words = line.partition("#")[0].split()
        try:
            if key in _WIDTHS:
                if len(words) <= _WIDTHS[key][0]:
                    raise ValueError(f"{len(words) - 1} numbers, at least {_WIDTHS[key][0]} expected")
                numbers[key].extend(map(float, words[1:]))
                lengths[key].append(len(words) - 1)
            elif len(words) > 3:
                for word in words[1:]:
                    for name, value in zip(_WIDTHS, (*word.split("/"), "", "")[:3], strict=True):
                        index, count = int(value or 0), len(lengths[name])
                        if (index == 0 and (value or name == "v")) or index < -count:
                            raise ValueError(f"index {value or 'missing'}, but {name} has {count} entries")
                        indices.append(index - 1 if index > 0 else count + index if value else _NONE)
                sizes.append(len(words) - 1)
                owners.append(material)
        except (ValueError, OverflowError) as error:
            found = f"{' '.join(line.split())[:60]!r} ({' '.join(str(error).split())[:80]})"
            expected = "numbers, or f v/vt/vn ... with existing vertices"
            raise DataError(f"{path}: line {number} is {found}; expected {expected}") from None
    v, vt, vn = (_obj_number_table(key, np.array(numbers.pop(key)), np.array(lengths.pop(key))) for key in _WIDTHS)
    used = np.array(indices, np.int64).reshape(-1, 3)
    check_vertices(path, v[:, :3], used[:, 0])
    for column, table, what in ((1, vt, "texture coordinates (vt)"), (2, vn, "normals (vn)")):
        if len(used) and used[:, column].max() >= len(table):
            found = f"a face uses number {used[:, column].max() + 1} of the {what}"
            raise DataError(f"{path}: {found}, but the file has only {len(table)} of them")
    faces, polygon = triangulate_polygons(path, v[used[:, 0], :3], np.array(sizes, np.int64))
    owner = np.array(owners, np.int64)[polygon]
    colours = _obj_vertex_colours(path, v)
    parts = []
    for name, index in names.items():
        mine = used[faces[owner == index]]
        if len(mine):
            normals = _look_up_obj_corners(vn, mine[..., 2], 0.0) if len(vn) else None
            uv = _look_up_obj_corners(vt[:, :2], mine[..., 1], np.nan) if (mine[..., 1] != _NONE).any() else None
            colour = None if colours is None else colours[mine[..., 0]]
            parts.append(Faces(v[mine[..., 0], :3], name, normals, colour, uv, uv))
    return parts, len(v)


def _look_up_obj_corners(table: NDArray[np.float64], index: NDArray[np.int64], missing: float) -> NDArray[np.float64]:
    return np.where((index == _NONE)[..., None], missing, table[index])


def _obj_number_table(key: str, numbers: NDArray[np.float64], lengths: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return a table with the numbers of the N lines that start with ``key`` ("v", "vt" or "vn"), one row per line.

    ``numbers`` are the numbers of all N lines, concatenated; ``lengths`` (N,) is the count of numbers of each line.
    Missing numbers become NaN, or 0 for "vt".
    """
    width = min(max(2, int(lengths.max(initial=2))), _WIDTHS[key][1])
    table = np.full((len(lengths), width), 0.0 if key == "vt" else np.nan)
    first = np.cumsum(lengths) - lengths
    for column in range(width):
        there = lengths > column
        table[there, column] = numbers[first[there].astype(np.int64) + column]
    return table


def _obj_vertex_colours(path: Path, v: NDArray[np.float64]) -> NDArray[np.float32] | None:
    """Return (V, 3) vertex colours 0..1, the columns of ``v`` after x, y, z; None unless all vertices have a colour."""
    if v.shape[1] < 6:
        return None
    found = v[:, 3:6]
    without = int(np.isnan(found).any(axis=1).sum())
    if without:
        warn_once(f"{path}: {without} of {len(v)} vertices have no colour; the colours of the others are ignored")
        return None
    scale = 255.0 if found.max(initial=0.0) > 2 else 1.0
    return np.clip(found / scale, 0, 1).astype(np.float32)


def _read_mtl_library(text: str, folder: MeshFolder, images: dict[str, bytes]) -> dict[str, Material]:
    found: dict[str, Material] = {}
    name = ""
    with_d = set[str]()  # materials whose d is known, which wins over Tr
    for line in text.splitlines():
        key, _, rest = line.strip().replace("\t", " ").partition(" ")
        key, words = key.lower(), rest.split()
        if key == "newmtl":
            name = " ".join(words)
            found[name] = Material()
        if name not in found or not words:
            continue
        old = found[name]
        glow = old.glow or Material()
        if key == "kd" and len(words) >= 3:
            found[name] = replace(old, colour=_mtl_colour(words, folder, name))
        elif key == "ke" and len(words) >= 3:
            found[name] = replace(old, glow=replace(glow, colour=_mtl_colour(words, folder, name)))
        elif key in ("map_kd", "map_ke"):
            image = _read_mtl_texture(words, rest, folder, images)
            if image is not None and key == "map_kd":
                own = replace(image, colour=old.colour, opacity=old.opacity, glow=old.glow)
                found[name] = replace(own, cutoff=0.5, blend=True)
            elif image is not None:
                found[name] = replace(old, glow=replace(image, colour=glow.colour))
        elif key == "d" or (key == "tr" and name not in with_d):
            value = _mtl_opacity(words[-1], folder, name)
            with_d |= {name} if key == "d" else set()
            found[name] = replace(old, opacity=value if key == "d" else 1 - value, cutoff=0.5, blend=True)
        elif key == "map_d" and _mtl_texture_file_name(words, rest)[0] != old.texture:
            what = f"map_d of material {name[:40]!r} is not read"
            warn_once(f"{folder.file}: {what}; opacity comes from d and the alpha of map_Kd")
    return {name: _finish_mtl_material(material) for name, material in found.items()}


def _finish_mtl_material(material: Material) -> Material:
    """Return a .mtl material in its final form: colours become white where there is a texture; black emission, None."""
    white = (1.0, 1.0, 1.0)
    glow = material.glow
    if glow is not None and glow.texture is not None:
        glow = replace(glow, colour=white)
    elif glow is not None and not any(glow.colour or ()):
        glow = None
    return replace(material, colour=white if material.texture is not None else material.colour, glow=glow)


def _read_mtl_texture(words: list[str], rest: str, folder: MeshFolder, images: dict[str, bytes]) -> Material | None:
    """Read the texture of a .mtl line into ``images``; return a material with the texture's name, wrap and transform.

    ``rest`` is the line without its keyword; ``words`` is ``rest`` split at blanks. The result is None if the file is
    missing and ``skip_missing`` is set.
    """
    image, options = _mtl_texture_file_name(words, rest)
    spellings = [image, PurePosixPath(image.replace("\\", "/")).name]
    if image not in images:
        data = folder.read_optional(spellings[:1] if spellings[0] == spellings[1] else spellings, "texture")
        if data is None:
            return None
        images[image] = data
    (su, sv), (ou, ov) = options.get("-s", (1.0, 1.0)), options.get("-o", (0.0, 0.0))
    moved = (su, sv, ou, ov) != (1.0, 1.0, 0.0, 0.0)
    wrap = ("clamp", "clamp") if "-clamp" in options else ("repeat", "repeat")
    # scale and offset are for a v that points up
    return Material(texture=image, wrap=wrap, transform=((su, 0.0, ou), (0.0, sv, 1 - sv - ov)) if moved else None)


def _mtl_texture_file_name(words: list[str], rest: str) -> tuple[str, dict[str, tuple[float, float]]]:
    """Return the file name in a .mtl texture line, and a mapping: option -> the option's first two numbers.

    ``rest`` is the line without its keyword; ``words`` is ``rest`` split at blanks. Options precede the file name. The
    file name may contain blanks.
    """
    place, last = 0, len(words) - 1
    options: dict[str, tuple[float, float]] = {}
    while place < last and words[place] in {*_NUMBERS, *_WORDS}:
        option, place = words[place], place + 1
        if option in _WORDS:
            if option == "-clamp" and words[place].lower() == "on":
                options[option] = (0.0, 0.0)
            place += 1
            continue
        values: list[float] = []
        while len(values) < _NUMBERS[option] and place < last and _is_mtl_number(words[place]):
            values.append(float(words[place]))
            place += 1
        default = 1.0 if option == "-s" else 0.0
        options[option] = ((*values, default, default)[0], (*values, default, default)[1])
    return rest.strip() if place == 0 else " ".join(words[place:]), options


def _is_mtl_number(word: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d{1,3})?", word) is not None


def _mtl_opacity(word: str, folder: MeshFolder, name: str) -> float:
    if not _is_mtl_number(word):
        found = f"material {name[:40]!r} has the opacity {word[:20]!r}"
        raise DataError(f"{folder.file}: {found}; expected a number from 0 to 1")
    return min(max(float(word), 0.0), 1.0)


def _mtl_colour(words: list[str], folder: MeshFolder, name: str) -> tuple[float, float, float]:
    try:
        values = torch.tensor([float(word) for word in words[:3]])
        if not values.isfinite().all():
            raise ValueError
    except ValueError:
        found = f"material {name[:40]!r} has the colour {' '.join(words)[:40]!r}"
        raise DataError(f"{folder.file}: {found}; expected three numbers") from None
    r, g, b = srgb_to_linear(values.clamp(0, 1)).tolist()
    return r, g, b


# ---------------------------------------------------------------- PLY and STL

_HEADER = 2**16
_RGB = ("red", "green", "blue")
_UV = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_ply_mesh(folder: MeshFolder) -> Model:
    """Read a .ply file with faces, and the texture that its comment ``TextureFile`` names."""
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
    return Model(folder.file, partial(_read_mesh_faces_of_ply, folder.file, data), folder.digest, materials, images)


def _read_mesh_faces_of_ply(path: Path, data: bytes) -> tuple[list[Faces], int]:
    """Parse a .ply file: return all triangles and the number of vertices."""
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
            raise DataError(f"{path}: faces are stored as {found}; expected a list vertex_indices for every face")
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
    """Return (N, 3) colours 0..1 of ``element``, the vertices or faces of a .ply file; None if it has no colours."""
    if not set(_RGB) <= set(element.names):
        return None
    most = element.white(_RGB, path)
    if "alpha" in element.names and (element.rows["alpha"] < most).any():
        warn_once(f"{path}: the alpha of colours is ignored; the mesh is drawn opaque")
    return np.clip(np.nan_to_num(element.columns(_RGB) / most), 0, 1).astype(np.float32)


def read_stl(folder: MeshFolder) -> Model:
    """Read an .stl file.

    If the file's length matches the face count at byte 80, the file is read as binary, even if it starts with "solid".
    Otherwise, the file is read as text.
    """
    data = folder.read_model()
    count = int.from_bytes(data[80:84], "little")
    text = len(data) != 84 + 50 * count or len(data) < 84
    if text:
        if data[:5].lower() != b"solid" or b"facet" not in data[:_HEADER]:
            expected = f"{84 + 50 * count} bytes for them, but the file has {len(data)}"
            raise DataError(f"{folder.file}: the header states {count} faces; expected {expected}")
        check_mesh_limits(folder.file, {"solids": (data.lower().count(b"endsolid"), MAX_PARTS)})
        count = data.lower().count(b"endfacet")
    check_mesh_limits(folder.file, {"faces": (count, MAX_FACES)})
    read_faces = _read_stl_text if text else _read_stl_binary
    return Model(folder.file, partial(read_faces, folder.file, data), folder.digest)


def _read_stl_text(path: Path, data: bytes) -> tuple[list[Faces], int]:
    """Parse a text .stl file: return all triangles and the number of corners."""
    words = re.findall(rb"(?i)^\s*vertex\s+(\S+)[ \t]+(\S+)[ \t]+(\S+)", data, re.MULTILINE)
    try:
        corners = np.array(words, dtype=np.float64).reshape(-1, 3, 3)
    except ValueError as error:
        raise DataError(f"{path}: bad number or incomplete face ({error}); expected valid STL text") from None
    check_vertices(path, corners.reshape(-1, 3), np.arange(len(words)))
    return [Faces(corners)] if len(corners) else [], len(words)


def _read_stl_binary(path: Path, data: bytes) -> tuple[list[Faces], int]:
    """Parse a binary .stl file: return all triangles and the number of corners.

    Face colours are read in two formats: VisCAM (bit 15 of a face's attribute marks a colour) and Materialise Magics
    (the header contains "COLOR=").
    """
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
