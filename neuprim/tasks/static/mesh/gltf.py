"""glTF 2 (.gltf, .glb): materials and triangles; every index and size is checked against the bytes that are there.

Animations, lights, cameras, skins and morph targets are ignored, the last two with a note.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import unquote

import numpy as np
import trimesh
from numpy.typing import NDArray

from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.json_reader import load_json
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

_WRAPS = {33071: "clamp", 33648: "mirror"}
_POINTS_AND_LINES, _TRIANGLES, _STRIP, _FAN = (0, 1, 2, 3), 4, 5, 6
_MAX_DEPTH = 200
_GLB, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_COMPONENT_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
# read, or without effect on what is drawn: of KHR_materials_variants the default is drawn, of MSFT_lod the finest
_KNOWN = set(
    "EXT_texture_webp KHR_materials_emissive_strength KHR_materials_unlit KHR_mesh_quantization KHR_texture_transform "
    "EXT_instance_features EXT_lights_ies EXT_lights_image_based EXT_mesh_features EXT_structural_metadata "
    "KHR_animation_pointer KHR_audio_emitter KHR_lights_punctual KHR_materials_variants KHR_xmp_json_ld "
    "MSFT_lod".split()
)
_DRACO, _INSTANCING, _GLOSSY = (
    "KHR_draco_mesh_compression",
    "EXT_mesh_gpu_instancing",
    "KHR_materials_pbrSpecularGlossiness",
)
# refused where they are used; compressed data may have a plain copy beside them
_REFUSED = {_INSTANCING, _DRACO, "EXT_meshopt_compression", "KHR_meshopt_compression"}
_REFUSED |= {"EXT_texture_avif", "KHR_texture_basisu", "MSFT_texture_dds"}
_DAMAGE = (AttributeError, IndexError, KeyError, OverflowError, RecursionError, TypeError, ValueError, struct.error)

_T = TypeVar("_T")


class _GltfPrimitive(NamedTuple):
    """Indexed triangles in the space of their mesh: faces (F, 3), and values per vertex."""

    material: str
    faces: NDArray[np.int64]
    positions: NDArray[np.float64]
    normals: NDArray[np.float64] | None
    colour: NDArray[np.float32] | None
    uv: NDArray[np.float32] | None
    glow_uv: NDArray[np.float32] | None


def read_gltf(folder: MeshFolder) -> Model:
    """Read a .gltf or .glb file; raises DataError if damaged, compressed, or with references that lead nowhere."""

    def read() -> Model:
        reader = _GltfReader(_GltfDocument(folder))
        materials = {str(i): reader.read_material(m) for i, m in enumerate(reader.document.entries("materials"))}
        materials["none"] = Material()
        faces = partial(_refuse_damaged, folder.file, partial(reader.read_faces, materials))
        return Model(folder.file, faces, folder.digest, materials, reader.images, "y", True)

    return _refuse_damaged(folder.file, read)


class _GltfReader:
    """Reads materials and surfaces of one document."""

    def __init__(self, document: _GltfDocument) -> None:
        self.document, self.path = document, document.path
        self.images: dict[str, bytes] = {}
        self.vertices = self.triangles = self.parts = self.skipped = 0

    def read_faces(self, materials: Mapping[str, Material]) -> tuple[list[Faces], int]:
        """Read all triangles of the scene that is shown, in place, and count their vertices."""
        nodes = self.document.entries("nodes")
        check_mesh_limits(self.path, {"nodes": (len(nodes), MAX_PARTS)})
        found: list[Faces] = []
        meshes: dict[int, list[_GltfPrimitive]] = {}
        posed = 0
        for i, matrix in self._node_matrices(nodes).items():
            node = nodes[i]
            if "mesh" not in node:
                continue
            if _INSTANCING in node.get("extensions", {}):
                raise self.document.unsupported(_INSTANCING)
            number = _to_index(node["mesh"])
            if number not in meshes:
                meshes[number] = self._read_gltf_mesh(number, materials)
            mesh = self.document.content["meshes"][number]
            posed += "skin" in node or any(node.get("weights", mesh.get("weights", [])))
            place = np.eye(4) if "skin" in node else matrix  # glTF: the node of a skinned mesh does not move it
            for primitive in meshes[number]:
                self._count_primitive(primitive)
                if len(primitive.faces):
                    found.append(self._place_primitive(primitive, place))
        if posed:
            warn_once(f"{self.path}: {posed} meshes have a skin or morph weights, which are not read; drawn unposed")
        if self.skipped:
            warn_once(f"{self.path}: {self.skipped} parts are points or lines; only triangles are drawn")
        return found, self.vertices

    def _count_primitive(self, primitive: _GltfPrimitive) -> None:
        """Count one use of a primitive against the limits."""
        self.vertices += len(primitive.positions)
        self.triangles += len(primitive.faces)
        self.parts += 1
        vertices, faces, parts = (self.vertices, MAX_VERTICES), (self.triangles, MAX_FACES), (self.parts, MAX_PARTS)
        check_mesh_limits(self.path, {"vertices": vertices, "faces": faces, "parts": parts})

    def _read_gltf_mesh(self, number: int, materials: Mapping[str, Material]) -> list[_GltfPrimitive]:
        """Read the triangles of a mesh."""
        found = []
        for primitive in self.document.content["meshes"][number]["primitives"]:
            mode = primitive.get("mode", _TRIANGLES)
            if mode in _POINTS_AND_LINES:
                self.skipped += 1
                continue
            if mode not in (_TRIANGLES, _STRIP, _FAN):
                raise ValueError(f"a primitive of mode {mode}")
            position = self.document.content["accessors"][_to_index(primitive["attributes"]["POSITION"])]
            if _DRACO in primitive.get("extensions", {}) and "bufferView" not in position:
                raise self.document.unsupported(_DRACO)
            found.append(self._read_primitive(primitive, materials))
        return found

    def _read_primitive(self, primitive: Mapping[str, Any], materials: Mapping[str, Material]) -> _GltfPrimitive:
        attributes: Mapping[str, int] = primitive["attributes"]
        positions = self.document.array(attributes["POSITION"], ["VEC3"])
        count = len(positions)
        index = np.arange(count)
        if "indices" in primitive:
            index = self.document.array(primitive["indices"], ["SCALAR"])[:, 0]
        check_mesh_limits(self.path, {"vertices": (count, MAX_VERTICES), "faces": (len(index) // 3, MAX_FACES)})
        if index.dtype.kind == "f" or (len(index) and index.max() >= count):
            raise ValueError(f"an index of {index.max()}, with {count} vertices")
        name = str(_to_index(primitive["material"])) if "material" in primitive else "none"
        material = materials[name]
        normals, colour, uv, glow_uv = None, None, None, None
        if "NORMAL" in attributes:
            normals = self.document.array(attributes["NORMAL"], ["VEC3"], count).astype(np.float64)
        if "COLOR_0" in attributes:
            colour = self.document.array(attributes["COLOR_0"], ["VEC3", "VEC4"], count)
            colour = (colour / np.float32(1 if colour.dtype.kind == "f" else np.iinfo(colour.dtype).max)).astype("f4")
        if material.texture is not None:
            uv = self._texture_coordinates(primitive, name, "baseColorTexture")
        if material.glow is not None and material.glow.texture is not None:
            glow_uv = self._texture_coordinates(primitive, name, "emissiveTexture")
        faces = _index_triangles(index.astype(np.int64), primitive.get("mode", _TRIANGLES))
        return _GltfPrimitive(name, faces, positions.astype(np.float64), normals, colour, uv, glow_uv)

    def _texture_coordinates(self, primitive: Mapping[str, Any], name: str, key: str) -> NDArray[np.float32] | None:
        """(V, 2) coordinates, v upward, of the set that a texture of a material reads."""
        material = self.document.content["materials"][int(name)]
        holder = material if key == "emissiveTexture" else material.get("pbrMetallicRoughness", {})
        texture = holder.get(key, {})
        moved = texture.get("extensions", {}).get("KHR_texture_transform", {})
        attribute = f"TEXCOORD_{_to_index(moved.get('texCoord', texture.get('texCoord', 0)))}"
        attributes = primitive["attributes"]
        if attribute not in attributes:
            return None
        count = _to_index(self.document.content["accessors"][attributes["POSITION"]]["count"])
        uv = self.document.array(attributes[attribute], ["VEC2"], count).astype(np.float32)
        uv[:, 1] = 1 - uv[:, 1]
        return uv

    def _place_primitive(self, primitive: _GltfPrimitive, matrix: NDArray[np.float64]) -> Faces:
        """Move a primitive to its place in the scene."""
        faces = primitive.faces
        with np.errstate(all="ignore"):
            positions = primitive.positions @ matrix[:3, :3].T + matrix[:3, 3]
            normals = None if primitive.normals is None else primitive.normals @ np.linalg.pinv(matrix[:3, :3])
        check_vertices(self.path, positions, faces)
        values: tuple[NDArray | None, ...] = (normals, primitive.colour, primitive.uv, primitive.glow_uv)
        of_corners = (None if value is None else value[faces] for value in values)
        return Faces(positions[faces], primitive.material, *of_corners)

    def _node_matrices(self, nodes: Sequence[Mapping[str, Any]]) -> dict[int, NDArray[np.float64]]:
        """(4, 4) scene from node, of the nodes of the scene that is shown."""
        children = [[_to_index(child) for child in node.get("children", [])] for node in nodes]
        scenes = self.document.entries("scenes")
        if scenes:
            shown = scenes[_to_index(self.document.content.get("scene", 0))]
            roots = [_to_index(node) for node in shown.get("nodes", [])]
        else:
            roots = sorted(set(range(len(nodes))) - {child for below in children for child in below})
        found: dict[int, NDArray[np.float64]] = {}
        stack = [(root, np.eye(4), 1) for root in roots]
        while stack:
            node, parent, depth = stack.pop()
            if node in found:
                raise ValueError("a node is its own ancestor or has two parents")
            if depth > _MAX_DEPTH:
                raise DataError(f"{self.path}: nodes are nested deeper than {_MAX_DEPTH}; expected fewer levels")
            found[node] = parent @ _node_matrix(nodes[node], f"nodes[{node}]")
            stack += [(child, found[node], depth + 1) for child in children[node]]
        return found

    def read_material(self, material: Mapping[str, Any]) -> Material:
        """Read a material and its textures."""
        base, extensions = material.get("pbrMetallicRoughness", {}), material.get("extensions", {})
        if _GLOSSY in extensions and not base:
            raise self.document.unsupported(_GLOSSY)
        factor = [_finite_number(x) for x in base.get("baseColorFactor", (1.0, 1.0, 1.0))]
        mode = material.get("alphaMode", "OPAQUE")
        cutoff = _finite_number(material.get("alphaCutoff", 0.5)) if mode == "MASK" else 0.5
        opacity = factor[3] if len(factor) > 3 and mode != "OPAQUE" else 1.0
        strength = _finite_number(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
        light = [strength * _finite_number(x) for x in material.get("emissiveFactor", (0.0, 0.0, 0.0))]
        glow = self._textured_material(light, material.get("emissiveTexture")) if any(light) else None
        found = self._textured_material(factor, base.get("baseColorTexture"))
        unlit = "KHR_materials_unlit" in extensions
        found = replace(found, opacity=opacity, cutoff=None if mode == "OPAQUE" else cutoff)
        return replace(found, blend=mode == "BLEND", glow=glow, unlit=unlit)

    def _textured_material(self, factor: Sequence[float], texture_info: Mapping[str, Any] | None) -> Material:
        """A colour factor with the texture that it multiplies."""
        colour = (factor[0], factor[1], factor[2])
        if texture_info is None:
            return Material(colour)
        texture = self.document.content["textures"][_to_index(texture_info["index"])]
        source = texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source")
        if source is None:
            found = ", ".join(texture.get("extensions", {})) or "no image"
            raise DataError(f"{self.path}: a texture has {found[:60]}, which is not read; expected PNG, JPEG or WebP")
        sampler: Mapping[str, int] = {}
        if "sampler" in texture:
            sampler = self.document.content["samplers"][_to_index(texture["sampler"])]
        wrap = _WRAPS.get(sampler.get("wrapS", 0), "repeat"), _WRAPS.get(sampler.get("wrapT", 0), "repeat")
        moved = texture_info.get("extensions", {}).get("KHR_texture_transform")
        transform = None if moved is None else _texture_transform(moved)
        return Material(colour, self._read_gltf_image(_to_index(source)), wrap, transform)

    def _read_gltf_image(self, index: int) -> str | None:
        """Read an image and return its key in :attr:`images`; None where it is missing and that is allowed."""
        name = f"image {index}"
        if name not in self.images:
            image = self.document.content["images"][index]
            if "uri" in image:
                data = self.document.folder.read_optional([_parse_uri(image["uri"])], "texture")
            else:
                data = self.document.view(image["bufferView"])[0]
            if data is None:
                return None
            self.images[name] = data
        return name


def _node_matrix(place: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    """(4, 4) parent from node, of a matrix or of translation, rotation and scale."""
    matrix = np.eye(4)
    lengths = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}
    numbers = {key: [_finite_number(x) for x in place[key]] for key in lengths if key in place}
    if any(len(values) != lengths[key] for key, values in numbers.items()):
        raise ValueError(f"{where} has a transform of another length")
    if "matrix" in numbers:
        matrix = np.reshape(numbers["matrix"], (4, 4)).T
    if "translation" in numbers:
        matrix = matrix @ trimesh.transformations.translation_matrix(numbers["translation"])
    if "rotation" in numbers:
        x, y, z, w = numbers["rotation"]
        matrix = matrix @ trimesh.transformations.quaternion_matrix([w, x, y, z])
    if "scale" in numbers:
        matrix = matrix @ np.diag([*numbers["scale"], 1.0])
    return matrix


def _index_triangles(index: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """(F, 3) triangles of a list, strip or fan of vertices."""
    if mode == _TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    count = max(len(index) - 2, 0)
    if mode == _FAN:
        return np.stack([np.repeat(index[:1], count), index[1:-1][:count], index[2:]], axis=1)
    strip = np.stack([index[:count], index[1 : count + 1], index[2:]], axis=1)
    strip[1::2] = strip[1::2, ::-1]  # every other triangle of a strip turns the other way
    return strip


def _texture_transform(transform: Mapping[str, Any]) -> tuple[tuple[float, ...], ...]:
    """(2, 3) of KHR_texture_transform: scale, then rotation, then offset."""
    (x, y), (u, v) = transform.get("offset", (0.0, 0.0)), transform.get("scale", (1.0, 1.0))
    c, s = math.cos(transform.get("rotation", 0.0)), math.sin(transform.get("rotation", 0.0))
    rows = ((c * u, s * v, x), (-s * u, c * v, y))
    return tuple(tuple(_finite_number(value) for value in row) for row in rows)


# ---------------------------------------------------------------- the document


def _refuse_damaged(path: Path, function: Callable[[], _T]) -> _T:
    """Call a function and turn what damaged documents raise into DataError."""
    try:
        return function()
    except _DAMAGE as error:
        reason = f"nothing called {error}" if isinstance(error, KeyError) else str(error)
        raise DataError(f"{path}: damaged glTF ({' '.join(reason.split())[:160]}); expected glTF 2") from None


def _split_glb(data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON and the binary chunk of a .glb file."""
    magic, version, length, size, kind = struct.unpack_from("<5I", data)
    if magic != _GLB:
        raise ValueError(f"starts with {data[:4]!r}, not with b'glTF'")
    if version != 2:
        raise ValueError(f"version {version}")
    if kind != _JSON:
        raise ValueError("no JSON chunk")
    if length > len(data) or 20 + size > len(data):
        raise ValueError(f"{len(data)} bytes are there, {max(length, 20 + size)} announced")
    text, offset = data[20 : 20 + size], 20 + size
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<2I", data, offset)
        if offset + 8 + size > len(data):
            raise ValueError(f"a chunk of {size} bytes is cut off")
        if kind == _BIN:
            return text, data[offset + 8 : offset + 8 + size]
        offset += 8 + size
    return text, None


class _GltfDocument:
    """A document whose version and extensions are checked, and its arrays."""

    def __init__(self, folder: MeshFolder) -> None:
        data = folder.read_model()
        text, binary = _split_glb(data) if folder.file.suffix.lower() == ".glb" else (data, None)
        document = load_json(text.decode("utf-8-sig"), infinite=True)  # refused later, with the name of the value
        if not isinstance(document, dict):
            raise ValueError(f"top level is a {type(document).__name__}, no object")
        version = str(document["asset"]["version"])
        if version.split(".")[0] != "2":
            raise ValueError(f"version {version[:20]}")
        self.folder, self.path, self.content = folder, folder.file, document
        self._check_extensions()
        self._buffers = [self._read_buffer(i, entry, binary) for i, entry in enumerate(self.entries("buffers"))]

    def entries(self, key: str) -> list[Any]:
        """Return a list of the document; empty where it is missing."""
        return self.content.get(key, [])

    def _check_extensions(self) -> None:
        required = sorted(set(self.content.get("extensionsRequired", [])) - _KNOWN)
        if required:
            raise self.unsupported(required[0])
        used = set(self.content.get("extensionsUsed", []))
        used = used.union(*(m.get("extensions", {}) for m in self.entries("materials")))
        ignored = sorted(used - _KNOWN - _REFUSED)
        if ignored:
            shown = ", ".join(ignored[:6]) + ", ..." * (len(ignored) > 6)
            warn_once(f"{self.path}: uses the glTF extension{'s' * (len(ignored) > 1)} {shown[:300]}; drawn without")

    def unsupported(self, extension: str) -> DataError:
        """Return the error for an extension that is not read."""
        found = f"needs the glTF extension {extension[:60]}, which is not read"
        return DataError(f"{self.path}: {found}; expected a plain export, not compressed")

    def _read_buffer(self, index: int, entry: Mapping[str, Any], binary: bytes | None) -> bytes:
        if "uri" in entry:
            data = self.folder.read_required(_parse_uri(entry["uri"]), "buffer")
        elif binary is not None and index == 0:
            data = binary
        elif entry.get("extensions"):
            raise self.unsupported(next(iter(entry["extensions"])))
        else:
            raise ValueError(f"buffers[{index}] has no uri")
        if len(data) < entry["byteLength"]:
            raise ValueError(f"buffers[{index}] has {len(data)} bytes, {entry['byteLength']} announced")
        return data

    def view(self, index: int) -> tuple[bytes, int]:
        """Return bytes and stride (0: packed) of a buffer view."""
        view = self.content["bufferViews"][_to_index(index)]
        data = self._buffers[_to_index(view["buffer"])]
        start, size = _to_index(view.get("byteOffset", 0)), _to_index(view["byteLength"])
        if start + size > len(data):
            raise ValueError(f"bufferViews[{index}] ends at byte {start + size} of {len(data)}")
        return data[start : start + size], _to_index(view.get("byteStride", 0))

    def array(self, index: int, kinds: Sequence[str], length: int | None = None) -> NDArray:
        """Return (N, C) values of an accessor of one of the types ``kinds``; normalized integers as floats 0..1 or
        -1..1."""
        accessor = self.content["accessors"][_to_index(index)]
        where, count, kind = f"accessors[{index}]", _to_index(accessor["count"]), accessor["type"]
        if kind not in kinds:
            raise ValueError(f"{where} is {str(kind)[:20]}, not {' or '.join(kinds)}")
        if length is not None and count != length:
            raise ValueError(f"{where} has {count} values, {length} vertices")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise DataError(f"{self.path}: {where} is sparse or compressed, which is not read; expected a plain export")
        data, stride = self.view(accessor["bufferView"])
        dtype, width = np.dtype(_COMPONENT_TYPES[accessor["componentType"]]), _WIDTHS[kind]
        start, row = _to_index(accessor.get("byteOffset", 0)), dtype.itemsize * width
        stride = stride or row
        if stride < row:
            raise ValueError(f"{where} has a stride of {stride} bytes")
        if not count:
            return np.zeros((0, width), dtype)
        if start + (count - 1) * stride + row > len(data):
            raise ValueError(f"{where} claims {count} items, {len(data)} bytes are there")
        values: NDArray = np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))
        if accessor.get("normalized") and dtype.kind in "iu":
            return np.maximum(values.astype(np.float32) / np.iinfo(dtype).max, -1.0)
        return values


def _parse_uri(uri: Any) -> str:
    """Return a data URI as it is, and the name of a file unquoted."""
    if not isinstance(uri, str) or not uri or "\0" in uri:
        raise ValueError("a uri is no text")
    return uri if uri.startswith("data:") else unquote(uri)


def _to_index(value: Any) -> int:
    """Return an index or count; refuse -1, with which Python would take the last entry of a list."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"an index is {str(value)[:20]}")
    return value


def _finite_number(value: Any) -> float:
    """Return a number; refuse NaN and infinity."""
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"a number is {number}")
    return number
