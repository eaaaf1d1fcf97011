"""The numbers of a glTF document: buffers, views and accessors, bounded by the bytes that are there, whatever they
claim."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from neuprim.core.errors import DataError
from neuprim.tasks.static.mesh.files import Folder

__all__ = ["PLAIN", "Accessors", "count_of", "file_name", "finite", "index_of"]

PLAIN = "expected a plain export"
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Accessors:
    """Reads what a document's accessors and buffer views name.

    Args:
        binary: the binary chunk of a .glb file.
    """

    def __init__(self, folder: Folder, document: Mapping[str, Any], binary: bytes | None) -> None:
        self.folder, self.document, self.path = folder, document, folder.file
        self.buffers = [self._buffer(i, entry, binary) for i, entry in enumerate(document.get("buffers", []))]

    def _buffer(self, index: int, entry: Mapping[str, Any], binary: bytes | None) -> bytes:
        if "uri" in entry:
            data = self.folder.required(file_name(entry["uri"]), "buffer")
        elif binary is not None and index == 0:
            data = binary
        elif entry.get("extensions"):
            raise DataError(
                f"{self.path}: needs the glTF extension {next(iter(entry['extensions']))[:60]}, which is not read; {PLAIN}"
            )
        else:
            raise ValueError(f"buffers[{index}] has no uri")
        if len(data) < entry["byteLength"]:
            raise ValueError(f"buffers[{index}] has {len(data)} bytes, {entry['byteLength']} announced")
        return data

    def view(self, index: int) -> tuple[bytes, int]:
        """Bytes and stride (0: packed) of a buffer view."""
        view = self.document["bufferViews"][index_of(index)]
        data, start, size = (
            self.buffers[index_of(view["buffer"])],
            count_of(view.get("byteOffset", 0)),
            count_of(view["byteLength"]),
        )
        if start + size > len(data):
            raise ValueError(f"bufferViews[{index}] ends at byte {start + size} of {len(data)}")
        return data[start : start + size], count_of(view.get("byteStride", 0))

    def array(self, index: int, kinds: Sequence[str]) -> NDArray:
        """(N, C) values of an accessor, which must be one of ``kinds``; normalized integers as floats 0..1 or -1..1."""
        accessor = self.document["accessors"][index_of(index)]
        where, count, kind = f"accessors[{index}]", count_of(accessor["count"]), accessor["type"]
        if kind not in kinds:
            raise ValueError(f"{where} is {str(kind)[:20]}, not {' or '.join(kinds)}")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise DataError(f"{self.path}: {where} is sparse or compressed, which is not read; expected a plain export")
        data, stride = self.view(accessor["bufferView"])
        plain = np.dtype(_TYPES[accessor["componentType"]])
        width = _WIDTHS[kind]
        stride, start = stride or plain.itemsize * width, count_of(accessor.get("byteOffset", 0))
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


def file_name(uri: Any) -> str:
    if not isinstance(uri, str) or not uri or "\0" in uri:
        raise ValueError("a uri is no text")
    return uri if uri.startswith("data:") else unquote(uri)


def index_of(value: Any) -> int:
    """Lists take -1 for their last entry; glTF has no such thing."""
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise ValueError(f"an index is {str(value)[:20]}")
    return value


count_of = index_of


def finite(value: Any) -> float:
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"a number is {number}")
    return number
