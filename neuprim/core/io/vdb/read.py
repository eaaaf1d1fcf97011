"""Read the grids of OpenVDB files.

A grid is a tree: a root, upper nodes with 32³ slots of 128³ voxels, lower nodes with 16³ slots of 8³ voxels, and leaves
of 8³ voxels. The layout is OpenVDB's (``RootNode``, ``InternalNode``, ``LeafNode``, ``io/Compression.h``), versions 222
to 224. First comes the topology, depth first, where a leaf is a mask of 64 bytes. Then come the values of all leaves in
the same order.
"""

from __future__ import annotations

import itertools
import re
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neuprim.core.errors import DataError
from neuprim.core.io.vdb.grid import TILE_SIZES, VdbGrid, VdbTiles
from neuprim.core.io.vdb.header import (
    BLOSC,
    MASK,
    ZIP,
    FileHeader,
    GridHeader,
    VdbCursor,
    open_cursor,
    parse_header,
    vdb_decompressor,
)

LEAF_LIMIT = 4 * 2**30
"""Most bytes of decoded leaves and tiles that :func:`read_grid` accepts by default: 4 GiB."""


def read_grid(path: Path, name: str, *, max_bytes: int = LEAF_LIMIT, level_sets: bool = False) -> VdbGrid:
    """Read only the grid ``name`` of an OpenVDB file. Arguments and errors are as in :func:`read_grids`."""
    return next(read_grids(path, (name,), max_bytes=max_bytes, level_sets=level_sets))


def read_grids(
    path: Path, names: Sequence[str] | None = None, *, max_bytes: int = LEAF_LIMIT, level_sets: bool = False
) -> Iterator[VdbGrid]:
    """Read several grids of an OpenVDB file, decoded one at a time.

    Args:
        names: names of the grids to read, in this order; None for all that neuprim can decode, in file order.
        max_bytes: memory limit for the leaves and tiles of each grid.
        level_sets: also accept level sets (signed distances), for inspection.

    Raises:
        DataError: the file is damaged or too large, or has no such grid.
        BackendUnavailable: the package ``blosc`` is missing.
    """
    with open_cursor(Path(path)) as cursor:
        file = parse_header(cursor)
        if names is None:
            names = [g.name for g in file.grids if not (g.undecodable() if level_sets else g.refusal())]
        for name in names:
            yield _decode_grid(cursor, file, file.grid(name), max_bytes, level_sets)


def _decode_grid(cursor: VdbCursor, file: FileHeader, header: GridHeader, max_bytes: int, level_sets: bool) -> VdbGrid:
    what = f"grid {header.name!r}"
    refusal = header.undecodable() if level_sets else header.refusal()
    if refusal or header.transform is None:
        raise cursor.fail(f"{what} {refusal}")
    source = header
    if header.parent:  # an instance: own transform and metadata, another grid's tree
        source = file.grid(header.parent)
        if source.parent or source.type != header.type:
            found = f"is an instance of grid {header.parent!r}, but that grid"
            raise cursor.fail(f"{what} {found} is an instance itself or has another type")
    tree = _TreeReader(cursor, source, what, max_bytes)
    arrays = (tree.background, tree.origins, tree.values, tree.masks, tree.tiles)
    return VdbGrid(header.name, header.transform, *arrays, header.kind, header.half, dict(header.metadata))


# ---------------------------------------------------------------- trees

ALL_VALUES = 6
"""Value code of a node that stores the values of all its voxels. With the codes 0 to 5, only active values are stored.

The codes 0 to 5 define the inactive values. 0: the background; 1: minus the background; 2: one stored value; 3: the
background or its negative; 4: the background or a stored value; 5: one of two stored values. For 3 to 5, a mask chooses
between the two values per voxel.
"""

_CHUNK = 1024  # leaves decoded together: 2 MB of float32, which stay in a core's cache
_LEAF = 512  # voxels


class NodeSlots:
    """Layout of the slots of an internal tree node, which has 2^``log2`` slots per axis.

    ``count`` is the number of slots, ``edge`` the edge length of a slot in voxels. ``offsets`` (count, 3) are the
    lowest voxel indices of the slots, relative to the node.
    """

    def __init__(self, log2: int, edge: int) -> None:
        self.count, self.edge = 1 << 3 * log2, edge
        axes = np.unravel_index(np.arange(self.count), (1 << log2,) * 3)
        self.offsets = np.stack(axes, 1).astype(np.int32) * np.int32(edge)


UPPER, LOWER = NodeSlots(5, 128), NodeSlots(4, 8)


class _TreeReader:
    """Decoder of a grid's tree to the arrays of a VdbGrid, at most ``max_bytes`` in total.

    Errors name the grid ``what``.
    """

    def __init__(self, file: VdbCursor, source: GridHeader, what: str, max_bytes: int) -> None:
        self._buffers = VdbCursor(file.path, file.data, source.block, source.end)
        self._cursor = cursor = VdbCursor(file.path, file.data, source.tree_at, source.block)
        self._flags, self._half, self._what = source.flags, source.half, what
        self._shape = (3,) if source.channels == 3 else ()
        self._full = source.number
        self._stored = np.dtype("<f2") if source.half else self._full
        self._stored_size, self._full_size = (kind.itemsize * source.channels for kind in (self._stored, self._full))
        self._packed = bool(source.flags & (ZIP | BLOSC))
        self._unpack = vdb_decompressor(source.flags)
        self._leaf_origins: list[np.ndarray] = []
        self._tiles: list[tuple[np.ndarray, int, np.ndarray, np.ndarray]] = []
        self._limit = max_bytes
        self._left = max_bytes  # bytes that tiles have not used yet
        self._topology()
        self.origins = np.concatenate(self._leaf_origins) if self._leaf_origins else np.zeros((0, 3), np.int32)
        self.tiles = self._collect_tiles(source.channels)
        count = len(self.origins)
        size = count * _LEAF * (4 * source.channels + 1)  # as float32, with the masks
        if size > self._left:
            found = f"{count} leaves, which take {size} bytes in memory"
            raise cursor.fail(f"{what} has {found}; at most {self._left} are allowed")
        self.values: np.ndarray = np.empty((count, _LEAF, *self._shape), np.float32)
        self.masks: np.ndarray = np.empty((count, _LEAF), bool)
        for first in range(0, count, _CHUNK):
            self._leaves(first, min(first + _CHUNK, count))
        if self._buffers.at != self._buffers.end:
            found = f"leaf buffers end at byte {self._buffers.at}, not {self._buffers.end}"
            raise cursor.fail(f"{what}: {found}; damaged OpenVDB file")
        self.values = self.values.reshape(count, 8, 8, 8, *self._shape)
        self.masks = self.masks.reshape(count, 8, 8, 8)

    def _topology(self) -> None:
        cursor, what = self._cursor, self._what
        (buffers,) = cursor.unpack("i", f"number of buffers of {what}")
        if buffers != 1:
            raise cursor.fail(f"{what} has {buffers} buffers per leaf; expected 1")
        self.background = self._floats(cursor.take(self._full_size, f"background of {what}"))
        tiles, children = cursor.unpack("II", f"root of {what}")
        layout = np.dtype([("origin", "<i4", 3), ("value", self._full, self._shape), ("active", "u1")])
        found = np.frombuffer(cursor.take(tiles * layout.itemsize, f"{tiles} root tiles of {what}"), layout)
        self._keep_tiles(found["origin"], TILE_SIZES[2], _to_float32(found["value"]), found["active"] != 0)
        seen: set[tuple[int, ...]] = set()
        for entry in found["origin"].tolist():
            self._root_entry(seen, tuple(entry))
        for i in range(children):
            origin = cursor.unpack("3i", f"root child {i + 1} of {children} of {what}")
            self._root_entry(seen, origin)
            self._upper(np.array(origin, np.int32))
        if cursor.at != cursor.end:
            raise cursor.fail(f"{what}: nodes end at byte {cursor.at}, not {cursor.end}; damaged OpenVDB file")

    def _root_entry(self, seen: set[tuple[int, ...]], origin: tuple[int, ...]) -> None:
        if origin in seen or any(v % TILE_SIZES[2] for v in origin):
            expected = f"multiples of {TILE_SIZES[2]}, each once"
            raise self._cursor.fail(f"{self._what} has a root entry at {origin}; expected {expected}")
        seen.add(origin)

    def _upper(self, origin: np.ndarray) -> None:
        for child in UPPER.offsets[self._node(origin, UPPER)]:
            lower = origin + child
            leaves = LOWER.offsets[self._node(lower, LOWER)]
            # the masks are repeated with the buffers
            self._cursor.skip(64 * len(leaves), f"masks of {len(leaves)} leaves of {self._what}")
            self._leaf_origins.append(lower + leaves)

    def _node(self, origin: np.ndarray, slots: NodeSlots) -> np.ndarray:
        """Read the internal node at voxel ``origin`` and store its tiles; return the indices of slots with children."""
        cursor, what = self._cursor, f"a node of {self._what}"
        children, active = (_unpack_vdb_mask(cursor.take(slots.count // 8, f"masks of {what}")) for _ in range(2))
        values = self._values(active, slots.count, what)
        if values is not None:
            kept = np.flatnonzero(~children)
            self._keep_tiles(origin + slots.offsets[kept], slots.edge, values[kept], active[kept])
        return np.flatnonzero(children)

    def _keep_tiles(self, origins: np.ndarray, size: int, values: np.ndarray, active: np.ndarray) -> None:
        different = (values != self.background).any(-1) if self._shape else values != self.background
        kept = active | different  # the others are inactive background, which is not stored
        if kept.any():
            self._left -= int(np.count_nonzero(kept)) * (17 + self._full_size)
            if self._left < 0:
                found = f"tiles that take more bytes in memory than the {self._limit} allowed"
                raise self._cursor.fail(f"{self._what} has {found}")
            self._tiles.append((origins[kept], size, values[kept], active[kept]))

    def _collect_tiles(self, channels: int) -> VdbTiles:
        if not self._tiles:
            return VdbTiles.none(channels)
        origins, sizes, values, active = zip(*self._tiles, strict=True)
        repeated = np.repeat(np.array(sizes, np.int32), [len(a) for a in active])
        places, numbers = np.concatenate(origins).astype(np.int32), np.concatenate(values).astype(np.float32)
        return VdbTiles(places, repeated, numbers, np.concatenate(active))

    def _values(self, active: np.ndarray, count: int, what: str) -> np.ndarray | None:
        """Read the values of a node's ``count`` slots, (count,) or (count, 3) float32.

        ``active`` is the (count,) mask of active slots. Returns None if all slots are inactive and have the background
        value.
        """
        cursor = self._cursor
        code, low, high, chosen = self._inactive(cursor, count, what)
        whole = not self._flags & MASK or code == ALL_VALUES
        stored = count if whole else int(np.count_nonzero(active))
        found = self._decoded(self._payload(cursor, stored, what))
        if whole:
            return found
        if code == 0 and not stored:
            return None
        values = np.empty((count, *self._shape), np.float32)
        values[:] = low
        if chosen is not None:
            values[_unpack_vdb_mask(chosen)] = high
        values[active] = found
        return values

    def _inactive(self, cursor: VdbCursor, count: int, what: str) -> tuple[int, np.ndarray, np.ndarray, bytes | None]:
        """Read the value code of a node (see ALL_VALUES) and the data that define its inactive values.

        Returns the code, two inactive values, and the mask of the voxels with the second value. The mask is None if all
        inactive voxels have the first value.
        """
        code = cursor.take(1, f"value code of {what}")[0]
        if code > ALL_VALUES:
            raise cursor.fail(f"{what} has the value code {code} at byte {cursor.at - 1}; expected 0 to {ALL_VALUES}")
        low, high = self.background if code == 0 else -self.background, self.background
        if code in (2, 4, 5):
            low = self._floats(cursor.take(self._full_size, f"inactive value of {what}"))
        if code == 5:
            high = self._floats(cursor.take(self._full_size, f"inactive value of {what}"))
        return code, low, high, cursor.take(count // 8, f"selection mask of {what}") if code in (3, 4, 5) else None

    def _payload(self, cursor: VdbCursor, count: int, what: str) -> bytes:
        """Read and decompress the bytes of ``count`` stored values."""
        size = count * self._stored_size
        if not self._packed:
            return cursor.take(size, f"values of {what}")
        if self._half and not count:
            return b""  # OpenVDB then writes no length either
        (length,) = cursor.unpack("q", f"size of the values of {what}")
        if length <= 0:  # the values are not packed; this is minus their size
            if -length != size:
                raise cursor.fail(f"{what} has {-length} bytes of values; expected {size}")
            return cursor.take(size, f"values of {what}")
        chunk = cursor.take(length, f"values of {what}")
        try:
            return self._unpack(chunk, size)
        except ValueError as error:
            raise self._bad(cursor, what, error) from None

    def _bad(self, cursor: VdbCursor, what: str, error: Exception) -> DataError:
        return cursor.fail(f"{what} has, before byte {cursor.at}, {error}")

    def _decoded(self, raw: bytes) -> np.ndarray:
        return _to_float32(np.frombuffer(raw, self._stored)).reshape(-1, *self._shape)

    def _floats(self, raw: bytes) -> np.ndarray:
        return _to_float32(np.frombuffer(raw, self._full)).reshape(self._shape)

    def _leaves(self, first: int, last: int) -> None:
        """Decode leaves ``first`` to ``last`` - 1 into ``values`` and ``masks``; convert all values at once."""
        masks, special, whole, payloads = self._leaf_bytes(first, last)
        active = _unpack_vdb_mask(masks).reshape(-1, _LEAF)
        values = self.values[first:last]
        values[:] = self.background
        for i, low, high, chosen in special:
            values[i] = low
            if chosen is not None:
                values[i, _unpack_vdb_mask(chosen)] = high
        stored = active
        if whole:
            stored = active.copy()
            stored[whole] = True
        found = self._decoded(payloads)
        if len(found) == values.shape[0] * _LEAF:
            values[:] = found.reshape(values.shape)
        else:
            values[stored] = found
        self.masks[first:last] = active

    def _leaf_bytes(
        self, first: int, last: int
    ) -> tuple[bytes, list[tuple[int, Any, Any, bytes | None]], list[int], bytes]:
        """Read and decompress the bytes of leaves ``first`` to ``last`` - 1.

        Returns the leaves' masks; a list of the leaves whose inactive values are not the background, as (index, two
        values, mask of the second value or None); the indices of leaves that store all values; and the stored values.
        Indices are relative to ``first``.
        """
        cursor, what = self._buffers, f"a leaf of {self._what}"
        data, unpack, size_at = cursor.data, self._unpack, struct.Struct("<q").unpack_from
        unit, masked, packed, nothing = self._stored_size, self._flags & MASK, self._packed, self._half
        masks: list[bytes] = []
        payloads: list[bytes] = []
        special: list[tuple[int, Any, Any, bytes | None]] = []
        whole: list[int] = []
        at, end = cursor.at, cursor.end
        for i in range(last - first):
            if at + 65 > end:
                cursor.at = at
                cursor.need(65, f"mask and value code of {what}")
            mask = data[at : at + 64]
            masks.append(mask)
            code = data[at + 64]
            at += 65
            if masked and code != ALL_VALUES:
                count = int.from_bytes(mask, "little").bit_count()
            else:
                count = _LEAF
                whole.append(i)
            if code and code != ALL_VALUES:
                cursor.at = at - 1
                _, low, high, chosen = self._inactive(cursor, _LEAF, what)
                at = cursor.at
                special.append((i, low, high, chosen))
            if packed and at + 8 <= end and (count or not nothing):
                (length,) = size_at(data, at)
                if 0 < length <= end - at - 8:
                    at += 8 + length
                    try:
                        payloads.append(unpack(data[at - length : at], count * unit))
                    except ValueError as error:
                        cursor.at = at
                        raise self._bad(cursor, what, error) from None
                    continue
            cursor.at = at  # the rarer cases, and all errors
            payloads.append(self._payload(cursor, count, what))
            at = cursor.at
        cursor.at = at
        return b"".join(masks), special, whole, b"".join(payloads)


def _to_float32(values: np.ndarray) -> np.ndarray:
    """Convert to float32. Doubles beyond float32's range become infinite; :attr:`VdbGrid.non_finite` counts these."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32, copy=False)


def _unpack_vdb_mask(raw: bytes) -> np.ndarray:
    return np.unpackbits(np.frombuffer(raw, np.uint8), bitorder="little").view(bool)


@dataclass(frozen=True)
class VdbFrame:
    """One .vdb file of a sequence of time steps."""

    number: int  # number in the name of the file
    path: Path


@dataclass(frozen=True)
class VdbSequence:
    """The .vdb files of a folder, one per time step, in the order of the numbers in their names."""

    folder: Path
    frames: tuple[VdbFrame, ...]  # one or more
    gaps: tuple[tuple[int, int], ...]  # first and last number of each series of missing frames

    def __len__(self) -> int:
        return len(self.frames)


_FRAME_PATTERN = re.compile(r"%[0-9]*d|#+|@+|\*")


def list_vdb_files(path: Path) -> VdbSequence:
    """Return the .vdb files of a sequence, ordered by the last number in each name.

    Args:
        path: a folder with one sequence, one of its files, or its name with ``%04d``, ``####``, ``@`` or ``*`` instead
            of the number.

    Raises:
        DataError: no file, a name without a number, several sequences, or one number twice.
    """
    folder, chosen = Path(path), None
    expected = "expected a folder with .vdb files, a numbered file like fire_12.vdb, or a name like fire.####.vdb"
    try:
        if not folder.is_dir():
            chosen = _split_frame_number(_FRAME_PATTERN.sub("0", folder.name, count=1))
            if folder.suffix.lower() != ".vdb" or chosen is None or not folder.parent.is_dir():
                raise DataError(f"{folder}: {'is a file' if folder.exists() else 'no such folder'}; {expected}")
            folder = folder.parent
        paths = sorted(p for p in folder.iterdir() if p.suffix.lower() == ".vdb" and p.is_file())
    except OSError as error:  # no permission, a name that is too long
        raise DataError(f"{folder}: cannot be read ({error.strerror or error}); {expected}") from error
    found: dict[str, list[VdbFrame]] = {}
    odd: list[str] = []
    for file in paths:
        split = _split_frame_number(file.name)
        if split is None:
            odd.append(file.name)
        elif chosen is None or split[0] == chosen[0]:
            found.setdefault(split[0], []).append(VdbFrame(split[1], file))
    if chosen is not None:
        odd = []
    if not found and not odd:
        raise DataError(f"{path}: no .vdb files found; expected names like fire_12.vdb")
    if odd:
        raise DataError(f"{folder / odd[0]}: no frame number in the name; expected names like fire_12.vdb")
    if len(found) > 1:
        names = ", ".join(repr(name) for name in sorted(found))
        raise DataError(f"{folder}: files of several sequences: {names}; choose one by the path of one of its files")
    frames = sorted(next(iter(found.values())), key=lambda frame: frame.number)
    gaps: list[tuple[int, int]] = []
    for before, after in itertools.pairwise(frames):
        if before.number == after.number:
            raise DataError(
                f"{after.path}: frame {after.number} also exists as {before.path.name}; expected one file per frame"
            )
        if after.number > before.number + 1:
            gaps.append((before.number + 1, after.number - 1))
    return VdbSequence(folder, tuple(frames), tuple(gaps))


def _split_frame_number(name: str) -> tuple[str, int] | None:
    """Split a file name into the sequence's name (without suffix and number) and the last number.

    The result is None if the file name has no number.
    """
    match = re.fullmatch(r"(.*?)([0-9]+)([^0-9]*)", Path(name).stem, re.DOTALL)
    if match is None or len(match[2]) > 18:
        return None
    return match[1] + "*" * bool(match[3]) + match[3], int(match[2])
