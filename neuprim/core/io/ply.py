"""Read untrusted PLY files (Turk 1994), ASCII or binary, with any elements and properties; write vertices.

Memory is allocated only for data that the file's bytes can hold, whatever the header claims.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np

from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.files import atomic_path

_KINDS = ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
_NAMES = dict(zip(_KINDS, ("char", "uchar", "short", "ushort", "int", "uint", "float", "double"), strict=True))
_TYPES = {name: kind for kind, name in _NAMES.items()}
_TYPES |= {np.dtype(kind).name: kind for kind in (*_KINDS, "i8", "u8")}  # "uint8" and the like
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_HEADER_BYTES = 4 * 2**20
_MAX_PROPERTIES = 10_000


@dataclass(frozen=True)
class PlyVertices:
    """The vertices of a PLY file."""

    rows: np.ndarray  # (N,) structured: one field per scalar property, in the file's byte order
    comments: tuple[str, ...] = ()  # text of the comment lines, without the keyword "comment"

    @property
    def names(self) -> tuple[str, ...]:
        return self.rows.dtype.names or ()

    def columns(self, names: Sequence[str]) -> np.ndarray:
        """Return the properties ``names`` of all vertices as (N, len(names)) float64."""
        if not names:
            return np.zeros((len(self.rows), 0))
        return np.stack([self.rows[name].astype(np.float64) for name in names], -1)

    def white(self, names: Sequence[str], path: Path) -> float:
        """Return the number that stands for 1 in the colours ``names``: 1 of floats, else the largest of the type.

        It is 255 for wider types if values look like bytes, which is warned of.
        """
        kind, values = self.rows.dtype[names[0]], self.columns(names)
        most = float(np.max(values, initial=0.0, where=np.isfinite(values)))
        usual = float(np.iinfo(kind).max) if kind.kind in "iu" else 1.0
        if 1.0 < usual <= 255.0 or most <= 2.0 or (usual > 1.0 and most > 255.0):
            return usual
        warn_once(f"{path}: {', '.join(names)} are {kind.name} with values up to {most:g}; read as colours of 0 to 255")
        return 255.0


@dataclass(frozen=True)
class PlyList:
    """A list property: ``values`` joins the lists of all rows of an element; row i has ``sizes[i]`` numbers."""

    sizes: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class PlyElement(PlyVertices):
    """All rows of one element of a PLY file (such as "vertex" or "face"), with its list properties."""

    lists: dict[str, PlyList] = field(default_factory=dict)


@dataclass(frozen=True)
class _ElementHeader:
    name: str
    count: int
    fields: list[tuple[str, str, str]]  # property, type, and the type of a list's length or "" for a scalar


def write_ply(path: Path, rows: np.ndarray, comments: Sequence[str] = ()) -> None:
    """Write a structured array as the vertices of a binary PLY file, atomically; each comment must be one line."""
    if any("\n" in c or "\r" in c for c in comments):
        raise ValueError("a PLY comment is one line")
    fields = [(name, rows.dtype[name].newbyteorder("<")) for name in rows.dtype.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments)]
    lines += [f"element vertex {len(rows)}", *(f"property {_NAMES[dtype.str[1:]]} {name}" for name, dtype in fields)]
    lines += ["end_header", ""]
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join(lines).encode("utf-8"))
        file.write(np.ascontiguousarray(rows.astype(fields)).tobytes())


def read_ply(path: Path) -> PlyVertices:
    """Read the vertices of a PLY file; raises DataError if it is missing or damaged."""
    try:
        with open(path, "rb") as file:
            return read_ply_elements(file, path.stat().st_size, path, ("vertex",))["vertex"]
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from error


def read_ply_elements(file: BinaryIO, size: int, path: Path, wanted: Sequence[str]) -> dict[str, PlyElement]:
    """Read the elements named in ``wanted`` from an open PLY file; elements that the file lacks are left out.

    ``size`` is the size of the file in bytes. Raises DataError, which names ``path``, for a damaged file.
    """
    order, elements, comments = _read_ply_header(file, path)
    result: dict[str, PlyElement] = {}
    missing = set(wanted) & {element.name for element in elements}
    for element in elements:
        if not missing:
            break
        left = size - file.tell()
        if order:
            rows, lists = _read_binary(file, path, element, order, left)
        else:
            rows, lists = _read_ascii(file, path, element, left)
        if element.name in missing:
            result[element.name] = PlyElement(rows, comments, lists)
            missing.remove(element.name)
    return result


def _read_ply_header(file: BinaryIO, path: Path) -> tuple[str, list[_ElementHeader], tuple[str, ...]]:
    """Read a PLY header; return byte order ("" for ASCII), element headers and comments."""
    order: str | None = None
    elements: list[_ElementHeader] = []
    comments: list[str] = []
    budget = _MAX_HEADER_BYTES
    for number in itertools.count():
        raw = file.readline(budget + 1)
        budget -= len(raw)
        if budget < 0 or not raw.endswith(b"\n"):
            within = f" in {_MAX_HEADER_BYTES} bytes" if budget < 0 else ""
            raise DataError(f"{path}: header has no end_header{within}; expected a PLY file")
        line = raw.decode("utf-8", "replace").rstrip("\r\n")
        words = line.split()
        if number == 0:
            if words != ["ply"]:
                raise DataError(f"{path}: starts with {line[:40]!r}; expected a PLY file ('ply')")
        elif not words or words[0] == "obj_info":
            continue
        elif words[0] == "comment":
            comments.append(line.partition("comment")[2].removeprefix(" "))
        elif words[0] == "format" and len(words) == 3 and words[1] in _FORMATS and order is None:
            order = _FORMATS[words[1]]
        elif words[0] == "element" and len(words) == 3:
            if any(element.name == words[1] for element in elements):
                raise DataError(f"{path}: header declares element {words[1][:40]} twice")
            elements.append(_ElementHeader(words[1], _parse_ply_count(words[1], words[2], path), []))
        elif words[0] == "property" and elements:
            elements[-1].fields.append(_parse_property(words, path))
            if sum(len(element.fields) for element in elements) > _MAX_PROPERTIES:
                raise DataError(f"{path}: header declares more than {_MAX_PROPERTIES} properties")
        elif words == ["end_header"]:
            break
        else:
            expected = "format, element, property or comment"
            raise DataError(f"{path}: header line {number + 1} is {line[:60]!r}; expected {expected}")
    vertices = next((element for element in elements if element.name == "vertex"), None)
    if order is None or vertices is None or not vertices.fields:
        missing = "format" if order is None else "element vertex" if vertices is None else "property of the vertices"
        raise DataError(f"{path}: header has no {missing}; expected vertex properties such as 'property float x'")
    for element in elements:
        names = [name for name, _, _ in element.fields]
        if len(set(names)) != len(names):
            raise DataError(f"{path}: header declares property {next(n for n in names if names.count(n) > 1)!r} twice")
    return order, elements, tuple(comments)


def _parse_ply_count(name: str, text: str, path: Path) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 12):
        raise DataError(f"{path}: header states {text[:20]!r} as the count of {name[:20]}; expected a number")
    return int(text)


def _parse_property(words: list[str], path: Path) -> tuple[str, str, str]:
    if len(words) == 3 and words[1] in _TYPES:
        return words[2], _TYPES[words[1]], ""
    if len(words) == 5 and words[1] == "list" and words[3] in _TYPES and _TYPES.get(words[2], "f")[0] != "f":
        return words[4], _TYPES[words[3]], _TYPES[words[2]]
    expected = "a line such as 'property float x' or 'property list uchar int x'"
    raise DataError(f"{path}: {' '.join(words)[:60]!r}; expected {expected}")


_Values = tuple[np.ndarray, dict[str, PlyList]]


def _describe_ply_rows(element: _ElementHeader) -> str:
    return {"vertex": "vertices", "face": "faces"}.get(element.name, f"rows of {element.name[:40]}")


def _read_binary(file: BinaryIO, path: Path, element: _ElementHeader, order: str, left: int) -> _Values:
    """Read the rows of an element of a binary file; return scalar properties, (N,) structured, and lists by name.

    If all rows have the same size, the rows are read at once. If lists differ in length, the rows are read one by one.
    ``order`` is the byte order ("<" or ">"), ``left`` the number of bytes to the end of the file.
    """
    count, fields = element.count, element.fields
    if not count or not fields:
        return np.zeros(0, [(name, order + kind) for name, kind, length in fields if not length]), {}
    start = file.tell()
    sizes = _first_ply_list_lengths(file, fields, order)
    file.seek(start)
    if sizes is not None:
        layout: list[tuple] = []
        for (name, kind, length), size in zip(fields, sizes, strict=True):
            layout += (
                [("#" + name, order + length), (name, order + kind, (size,))] if length else [(name, order + kind)]
            )
        dtype = np.dtype(layout)
        if count * dtype.itemsize <= left:
            data = bytearray(file.read(count * dtype.itemsize))  # writable, unlike bytes
            table = np.frombuffer(data, dtype)
            lists = [(name, size) for (name, _, length), size in zip(fields, sizes, strict=True) if length]
            if all((table["#" + name] == size).all() for name, size in lists):
                scalars = [name for name, _, length in fields if not length]
                rows = table if not lists else np.empty(count, [(name, dtype[name]) for name in scalars])
                for name in scalars if lists else ():
                    rows[name] = table[name]
                return rows, {name: PlyList(np.full(count, size), table[name].reshape(-1)) for name, size in lists}
            file.seek(start)
        elif not any(length for _, _, length in fields):
            found = f"{count} {_describe_ply_rows(element)} of {dtype.itemsize} bytes, but only {left} bytes follow"
            raise DataError(f"{path}: {found}; expected a complete file")
    return _read_row_by_row(file, path, element, order, left)


def _first_ply_list_lengths(file: BinaryIO, fields: list[tuple[str, str, str]], order: str) -> list[int] | None:
    """Read the first row; return the number of values of each property, 1 for scalars.

    The result is None if the length of a list is impossible.
    """
    sizes = []
    for _, kind, length in fields:
        size = 1
        if length:
            raw = file.read(int(length[1]))
            size = int(np.frombuffer(raw, order + length)[0]) if len(raw) == int(length[1]) else -1
            if not 0 <= size < 2**24:
                return None
        file.seek(size * int(kind[1]), 1)
        sizes.append(size)
    return sizes


def _read_row_by_row(file: BinaryIO, path: Path, element: _ElementHeader, order: str, left: int) -> _Values:
    data, place = file.read(left), 0
    start = file.tell() - len(data)
    byteorder = "little" if order == "<" else "big"
    starts: list[list[int]] = [[] for _ in element.fields]
    sizes: list[list[int]] = [[] for _ in element.fields]
    plan = [(int(kind[1]), int(length[1]) if length else 0, length[:1] == "i") for _, kind, length in element.fields]
    for row in range(element.count):
        for i, (width, head, signed) in enumerate(plan):
            size = 1
            if head:
                size = int.from_bytes(data[place : place + head], byteorder, signed=signed)  # type: ignore[arg-type]
                place += head
            starts[i].append(place)
            sizes[i].append(size)
            place += size * width
            if place > len(data) or size < 0:
                raise DataError(
                    f"{path}: header states {element.count} {_describe_ply_rows(element)}, "
                    f"but the file ends in row {row}"
                )
    file.seek(start + place)
    octets = np.frombuffer(data, np.uint8)
    scalars = [(name, order + kind) for name, kind, length in element.fields if not length]
    rows = np.empty(element.count, scalars)
    lists = {}
    for (name, kind, length), begin, many in zip(element.fields, starts, sizes, strict=True):
        long, width = np.array(many), int(kind[1])
        first = np.repeat(np.array(begin) - width * (np.cumsum(long) - long), long) + width * np.arange(long.sum())
        values = octets[first[:, None] + np.arange(width)].reshape(-1).view(order + kind)
        if length:
            lists[name] = PlyList(long, values)
        else:
            rows[name] = values
    return rows, lists


def _read_ascii(file: BinaryIO, path: Path, element: _ElementHeader, left: int) -> _Values:
    count, fields = element.count, element.fields
    if count * (2 * len(fields)) > left + 1:  # a digit and a blank each
        found = f"{count} {_describe_ply_rows(element)} of {len(fields)} numbers, but only {left} bytes follow"
        raise DataError(f"{path}: {found}; expected a complete file")
    scalars = [(name, kind) for name, kind, length in fields if not length]
    if not count or not fields:
        return np.zeros(0, [(name, "<" + kind) for name, kind in scalars]), {}
    lists: dict[str, PlyList] = {}
    try:
        if len(scalars) == len(fields):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a file without lines; refused below
                table = np.loadtxt(file, np.float64, max_rows=count, ndmin=2, comments=None, encoding="ascii")
        else:
            table, lists = _read_ascii_lists(file, element)
    except (ValueError, IndexError) as error:
        reason = " ".join(str(error).split())[:120]
        raise DataError(f"{path}: {_describe_ply_rows(element)} are not numbers ({reason})") from error
    if table.shape != (count, len(scalars)):
        found = f"{table.shape[0]} {_describe_ply_rows(element)} of {table.shape[1]} numbers"
        raise DataError(f"{path}: {found}; expected {count} rows of {len(scalars)} numbers")
    rows = np.zeros(count, [(name, "<" + kind) for name, kind in scalars])
    for i, (name, kind) in enumerate(scalars):
        rows[name] = _cast_ply_column(table[:, i], name, kind, path)
    for name, kind, length in fields:
        if length:
            lists[name] = PlyList(lists[name].sizes, _cast_ply_column(lists[name].values, name, kind, path))
    return rows, lists


def _cast_ply_column(values: np.ndarray, name: str, kind: str, path: Path) -> np.ndarray:
    info = None if kind[0] == "f" else np.iinfo(kind)
    if info is not None and not ((values >= info.min) & (values <= info.max)).all():
        raise DataError(f"{path}: {name} has values outside the range of its type; expected {info.min} to {info.max}")
    with np.errstate(over="ignore"):
        return values.astype(kind)


def _read_ascii_lists(file: BinaryIO, element: _ElementHeader) -> tuple[np.ndarray, dict[str, PlyList]]:
    scalars: list[list[float]] = []
    sizes: dict[str, list[int]] = {name: [] for name, _, length in element.fields if length}
    values: dict[str, list[float]] = {name: [] for name in sizes}
    for line in itertools.islice((line for line in file if not line.isspace()), element.count):
        words, place = [float(word) for word in line.split()], 0
        plain = []
        for name, _, length in element.fields:
            if not length:
                plain.append(words[place])
                place += 1
                continue
            size = int(words[place])
            if not 0 <= size < len(words) - place:
                raise ValueError(f"a list claims {words[place]:g} numbers, but its line has only {len(words)}")
            sizes[name].append(size)
            values[name] += words[place + 1 : place + 1 + size]
            place += 1 + size
        scalars.append(plain)
    width = len(element.fields) - len(sizes)
    table = np.array(scalars, np.float64).reshape(len(scalars), width)
    return table, {name: PlyList(np.array(sizes[name]), np.array(values[name], np.float64)) for name in sizes}
