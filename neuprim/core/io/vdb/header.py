"""Read the headers of OpenVDB files. Every length is checked before memory is allocated."""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuprim.core.errors import BackendUnavailable, DataError, nearest

ZIP, MASK, BLOSC = 1, 2, 4  # the bits of a grid's compression word
_BLOSC_HEADER = struct.Struct("<4xI4xI")  # first 16 bytes of a chunk: unpacked size, packed size


class VdbCursor:
    """A read position ``at`` in the ``data`` of an OpenVDB file; reads cannot go beyond ``end``."""

    __slots__ = ("at", "data", "end", "path")

    def __init__(self, path: Path, data: bytes | mmap.mmap, at: int = 0, end: int | None = None) -> None:
        self.path, self.data, self.at = path, data, at
        self.end = len(data) if end is None else end

    def fail(self, text: str) -> DataError:
        """Return (do not raise) a DataError with the message ``text``, which names the file."""
        return DataError(f"{self.path}: {text}")

    def need(self, count: int, what: str) -> None:
        """Raise DataError unless ``count`` more bytes follow; ``what`` names these bytes in the message."""
        if not 0 <= count <= self.end - self.at:
            found = f"{what} at byte {self.at} needs {count} bytes, but {self.end - self.at} are left there"
            raise self.fail(f"{found}; truncated or damaged OpenVDB file")

    def take(self, count: int, what: str) -> bytes:
        self.need(count, what)
        self.at += count
        return self.data[self.at - count : self.at]

    def skip(self, count: int, what: str) -> None:
        self.need(count, what)
        self.at += count

    def unpack(self, layout: str, what: str) -> tuple[Any, ...]:
        """Read little-endian values without padding; ``layout`` as in :mod:`struct`."""
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout), what))

    def text(self, what: str) -> str:
        """Read a string: its length (uint32), then UTF-8 bytes. Invalid bytes become U+FFFD."""
        (length,) = self.unpack("I", f"length of {what}")
        return self.take(length, what).decode("utf-8", errors="replace")


@contextmanager
def open_cursor(path: Path) -> Iterator[VdbCursor]:
    """Yield a cursor at the start of a memory-mapped file; raises DataError if the file cannot be read."""
    if not path.exists():
        raise DataError(f"{path}: file not found; expected an OpenVDB file")
    if not path.is_file():
        raise DataError(f"{path}: not a file; expected an OpenVDB file")
    try:
        with open(path, "rb") as file:
            if not file.read(1):
                raise DataError(f"{path}: file is empty; expected an OpenVDB file")
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error}); expected an OpenVDB file") from None
    with data:
        yield VdbCursor(path, data)


def vdb_compression_label(flags: int) -> str:
    """Return OpenVDB's name for the compression ``flags``, for example ``blosc + active values``."""
    codec = "blosc" if flags & BLOSC else "zip" if flags & ZIP else ""
    return " + ".join(word for word in (codec, "active values" if flags & MASK else "") if word) or "none"


def blosc_module() -> Any:
    """Import the package ``blosc``, limited to one thread, because starting threads for every leaf of 2 KB is slow."""
    try:
        import blosc
    except ImportError as error:
        what = f"Blosc-compressed OpenVDB files need the package blosc ({error}): pip install blosc"
        raise BackendUnavailable(what) from None
    blosc.set_nthreads(1)
    return blosc


def vdb_decompressor(flags: int) -> Callable[[bytes, int], bytes]:
    """Return a function (chunk, size) -> ``size`` bytes, which decompresses data of a grid with compression ``flags``.

    The function decompresses Blosc if ``flags`` has the Blosc bit, else zip. It raises ValueError for a damaged chunk
    or another size.
    """
    if not flags & BLOSC:
        return _unzip_vdb_chunk
    blosc = blosc_module()
    decompress, sizes = blosc.decompress, _BLOSC_HEADER.unpack_from

    def unblosc(chunk: bytes, size: int) -> bytes:
        if len(chunk) < 16:
            raise ValueError(f"a Blosc chunk of {len(chunk)} bytes; expected at least 16")
        claimed, length = sizes(chunk)
        if claimed != size or length != len(chunk):  # also what keeps the library from allocating gigabytes
            raise ValueError(
                f"a Blosc chunk states that {length} bytes unpack to {claimed}; "
                f"expected {len(chunk)} bytes that unpack to {size}"
            )
        if not size:
            return b""
        try:
            values: bytes = decompress(chunk)
        except MemoryError:
            raise
        except Exception as error:  # the extension has an error class of its own
            raise ValueError(f"a damaged Blosc chunk ({error})") from None
        if len(values) != size:
            raise ValueError(f"a Blosc chunk of {len(values)} bytes; expected {size}")
        return values

    return unblosc


def _unzip_vdb_chunk(chunk: bytes, size: int) -> bytes:
    try:
        values = zlib.decompressobj().decompress(chunk, size + 1)
    except zlib.error as error:
        raise ValueError(f"a damaged zip chunk ({error})") from None
    if len(values) != size:
        found = f"more than {size}" if len(values) > size else f"{len(values)}"
        raise ValueError(f"an unzipped chunk of {found} bytes; expected {size}")
    return values


# ---------------------------------------------------------------- headers

MAGIC = 0x56444220
VERSIONS = (222, 224)
"""Oldest and newest file version read. 222 introduced the present nodes, 223 Blosc; 224 changed only point grids."""

_CHANNELS = {"Tree_float_5_4_3": 1, "Tree_vec3s_5_4_3": 3, "Tree_double_5_4_3": 1, "Tree_vec3d_5_4_3": 3}
_DOUBLE_TREES = ("Tree_double_5_4_3", "Tree_vec3d_5_4_3")
_HALF = "_HalfFloat"
_DOUBLES = {"UniformScaleMap": 15, "ScaleMap": 15, "UniformScaleTranslateMap": 18, "ScaleTranslateMap": 18}
_DOUBLES |= {"TranslationMap": 3, "AffineMap": 16, "UnitaryMap": 16}  # how many numbers store a map
_METADATA = {
    "bool": "?", "int32": "i", "int64": "q", "float": "f", "double": "d",
    "vec2i": "2i", "vec2s": "2f", "vec2d": "2d", "vec3i": "3i", "vec3s": "3f", "vec3d": "3d",
}  # fmt: skip


@dataclass(frozen=True)
class GridHeader:
    """Header of one grid of an OpenVDB file."""

    name: str  # unique in the file: further grids with the same name get [1], [2], ... as in OpenVDB
    type: str  # OpenVDB's tree type, without the suffix for half floats
    half: bool  # whether values are stored as 16-bit floats
    flags: int  # compression bits
    metadata: Mapping[str, Any]  # name -> value; values of unknown types stay bytes
    map: str  # name of the transform's class
    transform: np.ndarray | None  # (4, 4) float64, index to world, acting on column vectors; None if unknown
    parent: str  # name of the grid whose tree this grid shares; empty for nearly all grids
    tree_at: int  # byte offset of the tree
    block: int  # byte offset of the leaf buffers
    end: int  # byte offset of the first byte after the grid

    @property
    def kind(self) -> str:
        """Grid class: ``fog volume``, ``level set``, ``staggered`` or ``unknown``."""
        value = self.metadata.get("class")
        return value if isinstance(value, str) and value else "unknown"

    @property
    def channels(self) -> int:
        """Number of values per voxel: 1 for numbers, 3 for vectors, 0 for types that neuprim cannot read."""
        return _CHANNELS.get(self.type, 0)

    @property
    def number(self) -> np.dtype[Any]:
        """Type of the tree's numbers, float32 or float64, where these are not stored as 16-bit floats."""
        return np.dtype("<f8" if self.type in _DOUBLE_TREES else "<f4")

    @property
    def compression(self) -> str:
        return vdb_compression_label(self.flags)

    @property
    def voxel_size(self) -> tuple[float, float, float] | None:
        """Edge lengths of a voxel in world units."""
        if self.transform is None:
            return None
        x, y, z = np.linalg.norm(self.transform[:3, :3], axis=0).tolist()
        return x, y, z

    def undecodable(self) -> str | None:
        """Return why neuprim cannot decode the voxels of the grid; None if it can."""
        if "ptdataidx" in self.type or "ptidx" in self.type:
            return f"holds points ({self.type}), which have no density; rasterise them to a fog volume first"
        if not self.channels:
            return f"has values of type {self.type}; expected one of {', '.join(_CHANNELS)} (also as half floats)"
        if self.transform is None:
            return f"has a transform of class {self.map}; expected one of {', '.join(_DOUBLES)}"
        return None

    def refusal(self) -> str | None:
        """Return why neuprim cannot use the grid as a volume; None if it can."""
        if self.kind == "level set":
            return "is a level set: distances to a surface, not densities; scene.grids.density=NAME reads it as fog"
        return self.undecodable()


@dataclass(frozen=True)
class FileHeader:
    """Header of an OpenVDB file, with the headers of its grids in file order."""

    path: Path
    version: int
    library: tuple[int, int]
    metadata: Mapping[str, Any]
    grids: tuple[GridHeader, ...]

    def grid(self, name: str) -> GridHeader:
        """Return the header of the grid ``name``; raises DataError, which suggests similar names, if there is none."""
        for grid in self.grids:
            if grid.name == name:
                return grid
        names = [grid.name for grid in self.grids]
        raise DataError(f"{self.path}: no grid {name!r}{nearest(name, names) or '; the file has no grids'}")


def read_header(path: Path) -> FileHeader:
    """Return the header of an OpenVDB file without decoding voxels; raises DataError."""
    with open_cursor(Path(path)) as cursor:
        return parse_header(cursor)


def parse_header(cursor: VdbCursor) -> FileHeader:
    """Return the header of an open file, whose cursor is at the start; see :func:`read_header`."""
    if cursor.end < 8 or cursor.unpack("q", "the magic number") != (MAGIC,):
        expected = f"{MAGIC.to_bytes(8, 'little').hex(' ')} (an OpenVDB file)"
        raise cursor.fail(f"starts with {cursor.data[:8].hex(' ')}; expected {expected}")
    (version,) = cursor.unpack("I", "the file version")
    if not VERSIONS[0] <= version <= VERSIONS[1]:
        raise cursor.fail(f"OpenVDB file version {version}; expected {VERSIONS[0]} to {VERSIONS[1]}")
    major, minor, offsets = cursor.unpack("IIB", "the library version")
    if not offsets:
        raise cursor.fail("an OpenVDB stream without grid offsets; expected a file (save it again with OpenVDB)")
    cursor.skip(36, "the file's identifier")
    metadata = _parse_metadata(cursor, "file metadata")
    (count,) = cursor.unpack("I", "the number of grids")
    grids: list[GridHeader] = []
    for i in range(count):
        grids.append(_parse_grid(cursor, f"grid {i + 1} of {count}"))
        cursor.at = grids[-1].end
    names = [grid.name for grid in grids]
    if len(set(names)) != len(names):
        repeated = next(n for n in names if names.count(n) > 1)
        raise cursor.fail(f"two grids have the name {repeated!r}; expected unique names")
    return FileHeader(cursor.path, version, (major, minor), metadata, tuple(grids))


def _unique_vdb_grid_name(text: str) -> str:
    name, _, number = text.partition("\x1e")  # OpenVDB's mark between a name and its number
    return f"{name}[{number}]" if number else name


def _parse_grid(cursor: VdbCursor, what: str) -> GridHeader:
    name = _unique_vdb_grid_name(cursor.text(f"name of {what}"))
    what = f"grid {name!r}"
    kind, parent = cursor.text(f"type of {what}"), cursor.text(f"parent of {what}")
    start, block, end = cursor.unpack("3q", f"offsets of {what}")
    if parent:
        block = end  # OpenVDB leaves it 0: the tree is the parent's
    if not cursor.at <= start <= block <= end <= len(cursor.data):
        expected = f"ascending offsets from {cursor.at} to at most {len(cursor.data)}"
        raise cursor.fail(f"{what} has the offsets {start}, {block} and {end}; expected {expected}")
    inner = VdbCursor(cursor.path, cursor.data, start, end)
    (flags,) = inner.unpack("I", f"compression of {what}")
    if flags & ~(ZIP | MASK | BLOSC):
        expected = "a sum of 1 (zip), 2 (active values) and 4 (blosc)"
        raise inner.fail(f"{what} has compression bits {flags:#x}; expected {expected}")
    metadata = _parse_metadata(inner, f"metadata of {what}")
    mapping, transform = _parse_vdb_transform(inner, what)
    tree, half, parent = kind.removesuffix(_HALF), kind.endswith(_HALF), _unique_vdb_grid_name(parent)
    return GridHeader(name, tree, half, flags, metadata, mapping, transform, parent, inner.at, block, end)


def _parse_metadata(cursor: VdbCursor, what: str) -> dict[str, Any]:
    (count,) = cursor.unpack("I", f"count of {what}")
    found: dict[str, Any] = {}
    for _ in range(count):
        name, kind = cursor.text(f"a name in {what}"), cursor.text(f"a type in {what}")
        (size,) = cursor.unpack("I", f"size of {name!r} in {what}")
        raw = cursor.take(size, f"value of {name!r} in {what}")
        layout = _METADATA.get(kind)
        if kind == "string":
            found[name] = raw.decode("utf-8", errors="replace")
        elif layout is None:
            found[name] = raw
        elif size != struct.calcsize("<" + layout):
            expected = f"{struct.calcsize('<' + layout)} for a {kind}"
            raise cursor.fail(f"{name!r} in {what} has {size} bytes; expected {expected}")
        else:
            values = struct.unpack("<" + layout, raw)
            found[name] = values if len(values) > 1 else values[0]
    return found


def _parse_vdb_transform(cursor: VdbCursor, what: str) -> tuple[str, np.ndarray | None]:
    mapping = cursor.text(f"transform of {what}")
    if mapping not in _DOUBLES:
        return mapping, None
    values = np.array(cursor.unpack(f"{_DOUBLES[mapping]}d", f"{mapping} of {what}"))
    matrix = np.eye(4)
    if _DOUBLES[mapping] == 16:
        matrix = values.reshape(4, 4).T.copy()  # OpenVDB multiplies row vectors from the left
    elif mapping == "TranslationMap":
        matrix[:3, 3] = values
    else:
        moved = 3 * mapping.endswith("TranslateMap")
        matrix[:3, 3] = values[:moved] if moved else 0.0
        matrix[range(3), range(3)] = values[moved : moved + 3]
    with np.errstate(all="ignore"):
        size = np.linalg.norm(matrix[:3, :3], axis=0)
        sound = bool(np.isfinite(matrix).all() and np.isfinite(size).all() and (size > 0).all())
        sound = sound and abs(np.linalg.det(matrix[:3, :3] / size)) > 1e-12 and bool((matrix[3] == (0, 0, 0, 1)).all())
    if not sound:
        found = f"the transform {np.array2string(matrix, separator=', ')}"
        raise cursor.fail(f"{what} has {found}; expected an invertible affine matrix of finite numbers")
    return mapping, matrix
