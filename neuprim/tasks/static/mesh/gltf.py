"""glTF 2 (.gltf, .glb): what a document says, checked and written anew with nothing in it but surfaces, for trimesh to read.

Accessors are bounded by the bytes that are there, whatever they claim, and unpacked here, quantized ones too. Materials and images are
not passed on, so no decoder runs before its turn. Skins, animations, lights and cameras are left out; skinned meshes stay in their rest pose.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from neuprim.core.errors import DataError
from neuprim.core.io.plain import load_json
from neuprim.core.notices import warn_once
from neuprim.tasks.static.mesh.files import MAX_FACES, MAX_PARTS, MAX_VERTICES, Folder, Material, Model, check_counts

__all__ = ["read_gltf"]

_GLB, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_WRAPS = {33071: "clamp", 33648: "mirror"}
_READ = {"KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", "KHR_lights_punctual"}
_POINTS_AND_LINES, _TRIANGLES, _FAN = (0, 1, 2, 3), (4, 5, 6), 6
_MAX_DEPTH = 200
_WHITE = (1.0, 1.0, 1.0)


def read_gltf(folder: Folder) -> Model:
    """The model of a .gltf or .glb file.

    Raises:
        DataError: damaged, of another version, compressed, or with references that lead nowhere.
    """
    path, data = folder.file, folder.own()
    try:
        text, binary = _chunks(data) if path.suffix.lower() == ".glb" else (data, None)
        document = load_json(text.decode("utf-8-sig"), infinite=True)  # said of the value that has it, below
        if not isinstance(document, dict):
            raise ValueError(f"top level is a {type(document).__name__}, no object")
        return _Document(folder, document, binary).model()
    except (AttributeError, IndexError, KeyError, OverflowError, RecursionError, TypeError, ValueError, struct.error) as error:
        said = f"nothing called {error}" if isinstance(error, KeyError) else str(error)
        raise DataError(f"{path}: damaged glTF ({' '.join(said.split())[:160]}); expected glTF 2") from None


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a .glb file."""
    magic, version, length, size, kind = struct.unpack_from("<5I", data)
    if magic != _GLB:
        raise ValueError(f"starts with {data[:4]!r}, not with b'glTF'")
    if version != 2:
        raise ValueError(f"version {version}")
    if length > len(data) or kind != _JSON or 20 + size > len(data):
        raise ValueError(f"{len(data)} bytes are there, {max(length, 20 + size)} announced" if kind == _JSON else "no JSON chunk")
    text, place = data[20 : 20 + size], 20 + size
    while place + 8 <= length:
        size, kind = struct.unpack_from("<2I", data, place)
        if place + 8 + size > len(data):
            raise ValueError(f"a chunk of {size} bytes is cut off")
        if kind == _BIN:
            return text, data[place + 8 : place + 8 + size]
        place += 8 + size
    return text, None


class _Document:
    """One document while it is written anew."""

    def __init__(self, folder: Folder, document: dict[str, Any], binary: bytes | None) -> None:
        self.folder, self.document, self.path = folder, document, folder.file
        version = str(document["asset"]["version"])
        if version.split(".")[0] != "2":
            raise ValueError(f"version {version[:20]}")
        needed = set(document.get("extensionsRequired", [])) - _READ
        unread = sorted(name for name in needed if not name.startswith("KHR_materials_"))
        if unread:
            raise DataError(
                f"{self.path}: needs the glTF extension {unread[0]}, which is not read; expected a plain export, not compressed"
            )
        self.buffers = [self._buffer(i, entry, binary) for i, entry in enumerate(document.get("buffers", []))]
        self.images: dict[str, bytes] = {}
        self.arrays: list[bytes] = []
        self.accessors: list[dict[str, Any]] = []
        self.vertices = self.corners = self.primitives = self.skipped = 0
        self.skinned = False

    def model(self) -> Model:
        materials = {str(i): self._material(m) for i, m in enumerate(self.document.get("materials", []))}
        materials["none"] = Material()
        order = {name: i for i, name in enumerate(materials)}
        meshes = [self._mesh(m, materials, order) for m in self.document.get("meshes", [])]
        nodes, roots = self._nodes(meshes)
        if self.skipped:
            warn_once(f"{self.path}: {self.skipped} parts are points or lines; only triangles are drawn")
        if self.skinned:
            warn_once(f"{self.path}: a skinned mesh is drawn in its rest pose")
        views, offset = [], 0
        for part in self.arrays:
            views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(part)})
            offset += len(part)
        plain = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": roots}],
            "nodes": nodes,
            "meshes": [{"name": f"mesh {i}", "primitives": p} for i, p in enumerate(meshes)],
            "accessors": self.accessors,
            "bufferViews": views,
            "buffers": [{"uri": "arrays", "byteLength": offset}],
            "materials": [{"name": name} for name in materials],
        }
        parts = {"arrays": b"".join(self.arrays)}
        text = json.dumps(plain, allow_nan=False).encode()
        return Model(self.path, "gltf", text, parts, materials, self.images, "y", True, self.folder.digest)

    # ------------------------------------------------------------ bytes

    def _buffer(self, index: int, entry: Mapping[str, Any], binary: bytes | None) -> bytes:
        if "uri" in entry:
            data = self.folder.required(_name(entry["uri"]), "buffer")
        elif binary is not None and index == 0:
            data = binary
        else:
            raise ValueError(f"buffers[{index}] has no uri")
        if len(data) < entry["byteLength"]:
            raise ValueError(f"buffers[{index}] has {len(data)} bytes, {entry['byteLength']} announced")
        return data

    def _view(self, index: int) -> tuple[bytes, int]:
        """Bytes and stride (0: packed) of a buffer view."""
        view = self.document["bufferViews"][_index(index)]
        data, start, size = self.buffers[_index(view["buffer"])], _count(view.get("byteOffset", 0)), _count(view["byteLength"])
        if start + size > len(data):
            raise ValueError(f"bufferViews[{index}] ends at byte {start + size} of {len(data)}")
        return data[start : start + size], _count(view.get("byteStride", 0))

    def _array(self, index: int, kinds: Sequence[str]) -> NDArray:
        """(N, C) values of an accessor, which must be one of ``kinds``; normalized integers as floats 0..1 or -1..1."""
        accessor = self.document["accessors"][_index(index)]
        where, count, kind = f"accessors[{index}]", _count(accessor["count"]), accessor["type"]
        if kind not in kinds:
            raise ValueError(f"{where} is {str(kind)[:20]}, not {' or '.join(kinds)}")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise DataError(f"{self.path}: {where} is sparse or compressed, which is not read; expected a plain export")
        data, stride = self._view(accessor["bufferView"])
        plain = np.dtype(_TYPES[accessor["componentType"]])
        width = _WIDTHS[kind]
        stride, start = stride or plain.itemsize * width, _count(accessor.get("byteOffset", 0))
        if stride < plain.itemsize * width:
            raise ValueError(f"{where} has a stride of {stride} bytes")
        if count and start + (count - 1) * stride + plain.itemsize * width > len(data):
            raise ValueError(f"{where} claims {count} items, {len(data)} bytes are there")
        if not count:
            return np.zeros((0, width), plain)
        values: NDArray = np.ndarray((count, width), plain, data, start, (stride, plain.itemsize))
        if accessor.get("normalized") and plain.kind in "iu":
            return np.maximum(values.astype(np.float32) / np.iinfo(plain).max, -1.0)
        return values

    def _kept(self, values: NDArray, kind: str) -> int:
        """The index of an accessor with these values in the new document."""
        dtype = "<f4" if kind != "SCALAR" else "<u4"
        view = len(self.arrays)
        self.arrays.append(np.ascontiguousarray(values, dtype=dtype).tobytes())
        component = 5126 if kind != "SCALAR" else 5125
        self.accessors.append({"bufferView": view, "componentType": component, "count": len(values), "type": kind})
        return view

    # ------------------------------------------------------------ surfaces

    def _mesh(self, mesh: Mapping[str, Any], materials: Mapping[str, Material], order: Mapping[str, int]) -> list[dict[str, Any]]:
        found = []
        for primitive in mesh["primitives"]:
            mode, attributes = primitive.get("mode", 4), primitive["attributes"]
            if mode in _POINTS_AND_LINES:
                self.skipped += 1
                continue
            if mode not in _TRIANGLES:
                raise ValueError(f"a primitive of mode {mode}")
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                raise DataError(
                    f"{self.path}: needs the glTF extension KHR_draco_mesh_compression, which is not read; expected a plain export"
                )
            found.append(self._primitive(primitive, attributes, mode, materials, order))
            self.primitives += 1
            check_counts(self.folder, {"parts": (self.primitives, MAX_PARTS)})
        return found

    def _primitive(
        self,
        primitive: Mapping[str, Any],
        attributes: Mapping[str, int],
        mode: int,
        materials: Mapping[str, Material],
        order: Mapping[str, int],
    ) -> dict[str, Any]:
        positions = self._array(attributes["POSITION"], ["VEC3"])
        flat = self._array(primitive["indices"], ["SCALAR"])[:, 0] if "indices" in primitive else np.arange(len(positions))
        self.vertices, self.corners = self.vertices + len(positions), self.corners + len(flat)
        check_counts(self.folder, {"vertices": (self.vertices, MAX_VERTICES), "faces": (self.corners // 3, MAX_FACES)})
        if flat.dtype.kind == "f" or (len(flat) and flat.max() >= len(positions)):
            raise ValueError(f"an index of {flat.max()}, with {len(positions)} vertices")
        if mode == _FAN:
            flat = np.stack([np.repeat(flat[:1], max(len(flat) - 2, 0)), flat[1:-1], flat[2:]], axis=1).ravel()
            mode = 4
        flat = flat if mode != 4 else flat[: len(flat) // 3 * 3]
        name = str(_index(primitive["material"])) if "material" in primitive else "none"
        kept = {"POSITION": self._kept(positions, "VEC3")}
        for attribute, source, kinds in (
            ("NORMAL", "NORMAL", ["VEC3"]),
            ("TEXCOORD_0", f"TEXCOORD_{self._texcoord(name)}", ["VEC2"]),
            ("COLOR_0", "COLOR_0", ["VEC3", "VEC4"]),
        ):
            if source in attributes:
                values = self._array(attributes[source], kinds)
                if len(values) != len(positions):
                    raise ValueError(f"{len(values)} values of {source}, {len(positions)} vertices")
                if attribute == "COLOR_0":
                    values = values[:, :3] if values.dtype.kind == "f" else values[:, :3] / np.float32(np.iinfo(values.dtype).max)
                kept[attribute] = self._kept(values, kinds[0])
        return {"attributes": kept, "indices": self._kept(flat[:, None], "SCALAR"), "mode": mode, "material": order[name]}

    def _texcoord(self, name: str) -> int:
        """Which set of texture coordinates a material reads."""
        if name == "none":
            return 0
        texture = _base(self.document["materials"][int(name)]).get("baseColorTexture", {})
        return _count(texture.get("extensions", {}).get("KHR_texture_transform", {}).get("texCoord", texture.get("texCoord", 0)))

    def _nodes(self, meshes: Sequence[list[dict[str, Any]]]) -> tuple[list[dict[str, Any]], list[int]]:
        """Nodes with nothing but places and meshes, and the roots of the scene that is shown."""
        given = self.document.get("nodes", [])
        check_counts(self.folder, {"nodes": (len(given), MAX_PARTS)})
        self.skinned = any("skin" in node for node in given)
        below = [[_index(child) for child in node.get("children", [])] for node in given]
        scenes = self.document.get("scenes", [])
        if scenes:
            roots = [_index(node) for node in scenes[_index(self.document.get("scene", 0))].get("nodes", [])]
        else:
            roots = sorted(set(range(len(given))) - {child for children in below for child in children})
        seen, level, depth = set[int](), roots, 0
        while level:
            if seen & set(level) or len(set(level)) < len(level):
                raise ValueError("a node is its own ancestor or has two parents")
            if depth >= _MAX_DEPTH:
                raise DataError(f"{self.path}: nodes are nested deeper than {_MAX_DEPTH}; expected fewer levels")
            seen |= set(level)
            level, depth = [child for node in level for child in below[node]], depth + 1
        nodes = []
        for i, node in enumerate(given):
            plain: dict[str, Any] = {k: [_finite(x) for x in node[k]] for k in ("matrix", "translation", "rotation", "scale") if k in node}
            if [len(plain[k]) for k in plain] != [{"matrix": 16, "rotation": 4}.get(k, 3) for k in plain]:
                raise ValueError(f"nodes[{i}] has a transform of another length")
            plain |= {"name": f"node {i}", "children": below[i]}
            if "mesh" in node and meshes[_index(node["mesh"])]:
                plain["mesh"] = node["mesh"]
            nodes.append(plain)
        return nodes, roots

    # ------------------------------------------------------------ colours

    def _material(self, material: Mapping[str, Any]) -> Material:
        base = _base(material)
        factor = tuple(_finite(x) for x in base.get("baseColorFactor", _WHITE)[:3])
        colour = (factor[0], factor[1], factor[2])
        mode = material.get("alphaMode", "OPAQUE")
        cutoff = None if mode == "OPAQUE" else _finite(material.get("alphaCutoff", 0.5)) if mode == "MASK" else 0.5
        if "baseColorTexture" not in base:
            return Material(colour)
        texture = self.document["textures"][_index(base["baseColorTexture"]["index"])]
        source = texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source")
        if source is None:
            found = ", ".join(texture.get("extensions", {})) or "no image"
            raise DataError(f"{self.path}: a texture has {found[:60]}, which is not read; expected PNG, JPEG or WebP")
        name = self._image(_index(source))
        sampler: Mapping[str, int] = self.document["samplers"][_index(texture["sampler"])] if "sampler" in texture else {}
        wrap = _WRAPS.get(sampler.get("wrapS", 0), "repeat"), _WRAPS.get(sampler.get("wrapT", 0), "repeat")
        moved = base["baseColorTexture"].get("extensions", {}).get("KHR_texture_transform")
        return Material(colour, name, wrap, None if moved is None else _moved(moved), cutoff)

    def _image(self, index: int) -> str | None:
        """The image's name among the model's; None where it is missing and that is allowed."""
        name = f"image {index}"
        if name not in self.images:
            image = self.document["images"][index]
            data = self.folder.optional([_name(image["uri"])], "texture") if "uri" in image else self._view(image["bufferView"])[0]
            if data is None:
                return None
            self.images[name] = data
        return name


def _base(material: Mapping[str, Any]) -> Mapping[str, Any]:
    """Base colour and its texture, of either of the two ways to say it."""
    glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness", {})
    renamed = {"diffuseFactor": "baseColorFactor", "diffuseTexture": "baseColorTexture"}
    return material.get("pbrMetallicRoughness") or {renamed[k]: v for k, v in glossy.items() if k in renamed}


def _moved(transform: Mapping[str, Any]) -> tuple[tuple[float, ...], ...]:
    """(2, 3) of KHR_texture_transform: scale, then rotation, then offset."""
    (x, y), (u, v) = transform.get("offset", (0.0, 0.0)), transform.get("scale", (1.0, 1.0))
    c, s = math.cos(transform.get("rotation", 0.0)), math.sin(transform.get("rotation", 0.0))
    rows = ((c * u, s * v, x), (-s * u, c * v, y))
    return tuple(tuple(_finite(value) for value in row) for row in rows)


def _name(uri: Any) -> str:
    if not isinstance(uri, str) or not uri or "\0" in uri:
        raise ValueError("a uri is no text")
    return uri if uri.startswith("data:") else unquote(uri)


def _index(value: Any) -> int:
    """Lists take -1 for their last entry; glTF has no such thing."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"an index is {str(value)[:20]}")
    return value


_count = _index


def _finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"a number is {number}")
    return number
