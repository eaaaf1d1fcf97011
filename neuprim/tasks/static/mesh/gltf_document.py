"""JSON and binary data of a glTF file. All indices and sizes are checked against the available bytes."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.json_reader import load_json
from neuprim.tasks.static.mesh.model import MeshFolder

_GLB, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_COMPONENT_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_READ = set(
    "EXT_mesh_gpu_instancing EXT_texture_webp KHR_materials_emissive_strength KHR_materials_pbrSpecularGlossiness "
    "KHR_materials_unlit KHR_mesh_quantization KHR_texture_transform".split()
)
# KHR_materials_variants: the default is drawn; MSFT_lod: the finest level
_HARMLESS = set(
    "EXT_instance_features EXT_lights_ies EXT_lights_image_based EXT_mesh_features EXT_structural_metadata "
    "KHR_animation_pointer KHR_audio_emitter KHR_lights_punctual KHR_materials_variants KHR_xmp_json_ld "
    "MSFT_lod".split()
)
DRACO = "KHR_draco_mesh_compression"
_COMPRESSION = {DRACO, "EXT_meshopt_compression", "KHR_meshopt_compression"}
_COMPRESSION |= {"EXT_texture_avif", "KHR_texture_basisu", "MSFT_texture_dds"}
_DAMAGE = (AttributeError, IndexError, KeyError, OverflowError, RecursionError, TypeError, ValueError, struct.error)

_T = TypeVar("_T")


def refuse_damaged_gltf(path: Path, function: Callable[[], _T]) -> _T:
    """Return ``function()``, which reads a glTF document; convert exceptions that damage causes to DataError."""
    try:
        return function()
    except _DAMAGE as error:
        reason = f"key {error} is missing" if isinstance(error, KeyError) else str(error)
        raise DataError(f"{path}: damaged glTF ({' '.join(reason.split())[:160]}); expected glTF 2") from None


def _split_glb(data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON chunk and the binary chunk of a .glb file, with None for a missing binary chunk."""
    magic, version, length, size, kind = struct.unpack_from("<5I", data)
    if magic != _GLB:
        raise ValueError(f"starts with {data[:4]!r}, not with b'glTF'")
    if version != 2:
        raise ValueError(f"version {version}")
    if kind != _JSON:
        raise ValueError("no JSON chunk")
    if length > len(data) or 20 + size > len(data):
        raise ValueError(f"the file has {len(data)} bytes, but its header states {max(length, 20 + size)}")
    text, offset = data[20 : 20 + size], 20 + size
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<2I", data, offset)
        if offset + 8 + size > len(data):
            raise ValueError(f"a chunk of {size} bytes is cut off")
        if kind == _BIN:
            return text, data[offset + 8 : offset + 8 + size]
        offset += 8 + size
    return text, None


class GltfDocument:
    """A glTF document with access to its arrays. Version and required extensions are checked."""

    def __init__(self, folder: MeshFolder) -> None:
        data = folder.read_model()
        text, binary = _split_glb(data) if folder.file.suffix.lower() == ".glb" else (data, None)
        document = load_json(text.decode("utf-8-sig"), infinite=True)  # non-finite numbers are refused where used
        if not isinstance(document, dict):
            raise ValueError(f"top level is a {type(document).__name__}, no object")
        version = str(document["asset"]["version"])
        if version.split(".")[0] != "2":
            raise ValueError(f"version {version[:20]}")
        self.folder, self.path, self.content = folder, folder.file, document
        self._check_extensions()
        self._buffers = [self._read_buffer(i, entry, binary) for i, entry in enumerate(self.entries("buffers"))]

    def entries(self, key: str) -> list[Any]:
        """Return the document's top-level list ``key``, or an empty list if it is missing."""
        return self.content.get(key, [])

    def _check_extensions(self) -> None:
        known = _READ | _HARMLESS
        required = sorted(set(self.content.get("extensionsRequired", [])) - known)
        if required:
            raise self.unsupported(required[0])
        used = set(self.content.get("extensionsUsed", []))
        used = used.union(*(m.get("extensions", {}) for m in self.entries("materials")))
        ignored = sorted(used - known - _COMPRESSION)
        if ignored:
            shown = ", ".join(ignored[:6]) + ", ..." * (len(ignored) > 6)
            warn_once(f"{self.path}: ignores the glTF extension{'s' * (len(ignored) > 1)} {shown[:300]} of the file")

    def unsupported(self, extension: str) -> DataError:
        """Return the DataError for an extension that neuprim does not support."""
        found = f"needs the glTF extension {extension[:60]}, which is not supported"
        return DataError(f"{self.path}: {found}; expected a plain export, not compressed")

    def _read_buffer(self, index: int, entry: Mapping[str, Any], binary: bytes | None) -> bytes:
        if "uri" in entry:
            data = self.folder.read_required(parse_gltf_uri(entry["uri"]), "buffer")
        elif binary is not None and index == 0:
            data = binary
        elif entry.get("extensions"):
            raise self.unsupported(next(iter(entry["extensions"])))
        else:
            raise ValueError(f"buffers[{index}] has no uri")
        if len(data) < entry["byteLength"]:
            raise ValueError(f"buffers[{index}] has {len(data)} bytes, but its byteLength is {entry['byteLength']}")
        return data

    def view(self, index: int) -> tuple[bytes, int]:
        """Return the bytes of buffer view ``index``, and its stride in bytes, which is 0 for packed elements."""
        view = self.content["bufferViews"][to_gltf_index(index)]
        data = self._buffers[to_gltf_index(view["buffer"])]
        start, size = to_gltf_index(view.get("byteOffset", 0)), to_gltf_index(view["byteLength"])
        if start + size > len(data):
            raise ValueError(f"bufferViews[{index}] ends at byte {start + size}, but its buffer has {len(data)} bytes")
        return data[start : start + size], to_gltf_index(view.get("byteStride", 0))

    def array(self, index: int, kinds: Sequence[str], length: int | None = None) -> NDArray:
        """Return the (N, C) values of accessor ``index``; raise ValueError unless its type is in ``kinds``.

        ``kinds`` are glTF types such as "VEC3". If ``length`` is given, N must equal it. Normalized integers become
        floats 0..1 or -1..1.
        """
        accessor = self.content["accessors"][to_gltf_index(index)]
        where, count, kind = f"accessors[{index}]", to_gltf_index(accessor["count"]), accessor["type"]
        if kind not in kinds:
            raise ValueError(f"{where} is {str(kind)[:20]}, not {' or '.join(kinds)}")
        if length is not None and count != length:
            raise ValueError(f"{where} has {count} values for {length} vertices")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise DataError(
                f"{self.path}: {where} is sparse or compressed; "
                "expected an export without sparse accessors and without compression"
            )
        data, stride = self.view(accessor["bufferView"])
        dtype, width = np.dtype(_COMPONENT_TYPES[accessor["componentType"]]), _WIDTHS[kind]
        start, row = to_gltf_index(accessor.get("byteOffset", 0)), dtype.itemsize * width
        stride = stride or row
        if stride < row:
            raise ValueError(f"{where} has a stride of {stride} bytes")
        if not count:
            return np.zeros((0, width), dtype)
        if start + (count - 1) * stride + row > len(data):
            raise ValueError(f"{where} needs {start + (count - 1) * stride + row} bytes, but its view has {len(data)}")
        values: NDArray = np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))
        if accessor.get("normalized") and dtype.kind in "iu":
            return np.maximum(values.astype(np.float32) / np.iinfo(dtype).max, -1.0)
        return values


def parse_gltf_uri(uri: Any) -> str:
    """Return a data URI unchanged, or a file name with percent-encoding decoded."""
    if not isinstance(uri, str) or not uri or "\0" in uri:
        raise ValueError("a uri is not text")
    return uri if uri.startswith("data:") else unquote(uri)


def to_gltf_index(value: Any) -> int:
    """Return a JSON value that is an index or a count; raise ValueError unless it is an integer of at least 0."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"an index or count is {str(value)[:20]}")
    return value


def finite_gltf_number(value: Any) -> float:
    """Return a JSON value as a float; raise ValueError if it is not finite."""
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"a number is {number}")
    return number
