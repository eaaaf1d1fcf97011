"""The vertices of a PLY file (Turk 1994), with any scalar properties; for untrusted files.

Read are ASCII and binary files of either byte order; written are binary little-endian ones. Elements after the vertices (faces) are
left alone. No claim in a header makes memory be taken that the file's bytes do not pay for.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from neuprim.core.errors import DataError
from neuprim.core.io.files import atomic_path

__all__ = ["PlyVertices", "read_ply", "write_ply"]

_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_BYTES = 4 * 2**20
_PROPERTIES = 10_000


@dataclass(frozen=True)
class PlyVertices:
    """``rows`` is a structured array (N,) with one field per property, in the file's byte order; ``comments`` without the keyword."""

    rows: np.ndarray
    comments: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        return self.rows.dtype.names or ()

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """(N, len(names)) float64."""
        return np.stack([self.rows[name].astype(np.float64) for name in names], -1) if names else np.zeros((len(self.rows), 0))


def write_ply(path: Path, rows: np.ndarray, comments: Sequence[str] = ()) -> None:
    """Write a structured array as the vertices of a binary little-endian file, atomically.

    Raises:
        ValueError: a comment of more than one line.
    """
    if any("\n" in c or "\r" in c for c in comments):
        raise ValueError("a PLY comment is one line")
    fields = [(name, rows.dtype[name].newbyteorder("<")) for name in rows.dtype.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments), f"element vertex {len(rows)}"]
    lines += [f"property {_NAMES[dtype.str[1:]]} {name}" for name, dtype in fields] + ["end_header", ""]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(lines).encode("utf-8"))
        file.write(np.ascontiguousarray(rows.astype(fields)).tobytes())


def read_ply(path: Path) -> PlyVertices:
    """The vertices of a file.

    Raises:
        DataError: names the file, what was found and what was expected.
    """
    try:
        size = path.stat().st_size
        with open(path, "rb") as file:
            order, count, fields, comments = _header(file, path)
            left = size - file.tell()
            if order:
                dtype = np.dtype([(name, order + kind) for name, kind in fields])
                if count * dtype.itemsize > left:
                    raise DataError(f"{path}: {count} vertices of {dtype.itemsize} bytes; only {left} bytes follow the header")
                rows = np.fromfile(file, dtype, count)
            else:
                rows = _ascii(file, path, count, fields, left)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from error
    if len(rows) != count:
        raise DataError(f"{path}: {count} vertices announced, {len(rows)} found")
    return PlyVertices(rows, comments)


def _header(file: BinaryIO, path: Path) -> tuple[str, int, list[tuple[str, str]], tuple[str, ...]]:
    """Byte order ("" for ASCII), vertex count, (name, type) of the properties, comments."""
    order: str | None = None
    count: int | None = None
    element = ""
    fields: list[tuple[str, str]] = []
    comments: list[str] = []
    budget = _HEADER_BYTES
    for number in range(2**31):
        raw = file.readline(budget + 1)
        budget -= len(raw)
        if budget < 0 or not raw.endswith(b"\n"):
            raise DataError(f"{path}: header has no end_header" + f" in {_HEADER_BYTES} bytes" * (budget < 0) + "; expected a PLY file")
        line = raw.decode("utf-8", "replace").rstrip("\r\n")
        words = line.split()
        if number == 0:
            if line != "ply":
                raise DataError(f"{path}: starts with {line[:40]!r}; expected a PLY file ('ply')")
        elif not words or words[0] == "obj_info":
            continue
        elif words[0] == "comment":
            comments.append(line.partition("comment")[2].removeprefix(" "))
        elif words[0] == "format" and len(words) == 3 and words[1] in _FORMATS and order is None:
            order = _FORMATS[words[1]]
        elif words[0] == "element" and len(words) == 3:
            element = words[1]
            if element == "vertex" and count is None:
                count = _count(words[2], path)
            elif count is None:
                raise DataError(f"{path}: first element is {element!r}; expected vertex")
            elif element == "vertex":
                raise DataError(f"{path}: element vertex twice")
        elif words[0] == "property" and element:
            if element == "vertex":
                fields.append(_property(words, path))
                if len(fields) > _PROPERTIES:
                    raise DataError(f"{path}: more than {_PROPERTIES} properties per vertex")
        elif words == ["end_header"]:
            break
        else:
            raise DataError(f"{path}: header line {number + 1} is {line[:60]!r}; expected format, element, property or comment")
    if order is None or count is None or not fields:
        missing = "format" if order is None else "element vertex" if count is None else "property of the vertices"
        raise DataError(f"{path}: header has no {missing}")
    names = [name for name, _ in fields]
    if len(set(names)) != len(names):
        raise DataError(f"{path}: property {next(n for n in names if names.count(n) > 1)!r} twice")
    return order, count, fields, tuple(comments)


def _count(text: str, path: Path) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 12):
        raise DataError(f"{path}: {text[:20]!r} vertices; expected a count")
    return int(text)


def _property(words: list[str], path: Path) -> tuple[str, str]:
    if len(words) != 3 or words[1] not in _TYPES:
        raise DataError(f"{path}: {' '.join(words)[:60]!r}; expected a scalar property of the vertices, as 'property float x'")
    return words[2], _TYPES[words[1]]


def _ascii(file: BinaryIO, path: Path, count: int, fields: list[tuple[str, str]], left: int) -> np.ndarray:
    if count * (2 * len(fields)) > left + 1:  # a digit and a blank each
        raise DataError(f"{path}: {count} vertices of {len(fields)} numbers; only {left} bytes follow the header")
    rows = np.zeros(count, [(name, "<" + kind) for name, kind in fields])
    if not count:
        return rows
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a file without lines; refused below
            found = np.loadtxt(file, np.float64, max_rows=count, ndmin=2, comments=None, encoding="ascii")
    except (ValueError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: vertices are not numbers ({' '.join(str(error).split())[:120]})") from error
    if found.shape != (count, len(fields)):
        raise DataError(f"{path}: {found.shape[0]} vertices of {found.shape[1]} numbers; expected {count} of {len(fields)}")
    for i, (name, kind) in enumerate(fields):
        info = None if kind[0] == "f" else np.iinfo(kind)
        if info is not None and not ((found[:, i] >= info.min) & (found[:, i] <= info.max)).all():
            raise DataError(f"{path}: {name} has values outside its type; expected {info.min} to {info.max}")
        rows[name] = found[:, i]
    return rows
