"""Write OpenVDB files of file version 224."""

from __future__ import annotations

import struct
import uuid
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neuprim.core.errors import DataError, nearest
from neuprim.core.io.files import atomic_path
from neuprim.core.io.vdb.grid import TILE_SIZES, VdbGrid
from neuprim.core.io.vdb.header import BLOSC, MAGIC, MASK, ZIP, blosc_module, vdb_compression_label
from neuprim.core.io.vdb.read import ALL_VALUES, LOWER, UPPER, NodeSlots

COMPRESSIONS = {"none": MASK, "zip": ZIP | MASK, "blosc": BLOSC | MASK}
"""Name of a compression -> the compression bits that a grid's header stores."""

_VERSION = 224
_LIBRARY = (10, 0)
_EMPTY_BOX = ((2**31 - 1,) * 3, (-(2**31),) * 3)
_STALE = ("file_mem_bytes", "file_delayed_load")


def write_vdb(
    path: Path, grids: Sequence[VdbGrid], *, compression: str = "blosc", metadata: Mapping[str, Any] | None = None
) -> None:
    """Write grids to an OpenVDB file, atomically.

    Args:
        grids: one or more grids with different names; values of grids with ``half`` are rounded to 16-bit floats.
        compression: "none", "zip" or "blosc".
        metadata: metadata of the file by name; values are str, bool, int, float, or three ints or floats.

    Raises:
        DataError: the format cannot represent a grid or a metadata value.
        BackendUnavailable: the package ``blosc`` is missing.
    """
    path = Path(path)
    if compression not in COMPRESSIONS:
        raise DataError(f"{path}: unknown compression {compression!r}{nearest(compression, COMPRESSIONS)}")
    names = [grid.name for grid in grids]
    if len(set(names)) != len(names):
        raise DataError(f"{path}: grids named {', '.join(map(repr, names))}; expected different names")
    flags = COMPRESSIONS[compression]
    identifier = str(uuid.uuid4()).encode()
    head = struct.pack("<qIIIB", MAGIC, _VERSION, *_LIBRARY, 1) + identifier + _pack_metadata(metadata or {}, str(path))
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(head + struct.pack("<I", len(grids)))
        for grid in grids:
            where = f"{path}: grid {grid.name!r}"
            writer = _TreeWriter(grid, flags, where)
            kind = ("Tree_vec3s_5_4_3" if grid.channels == 3 else "Tree_float_5_4_3") + "_HalfFloat" * grid.half
            own = (
                struct.pack("<I", flags)
                + _grid_metadata(grid, flags, where)
                + _pack_vdb_transform(grid.transform, where)
            )
            tree = own + writer.topology
            file.write(_pack_text(grid.name) + _pack_text(kind) + _pack_text(""))
            start = file.tell() + 24
            file.write(struct.pack("<3q", start, start + len(tree), start + len(tree) + len(writer.buffers)))
            file.write(tree)
            file.write(writer.buffers)


# ---------------------------------------------------------------- head of a grid


def _pack_text(value: str) -> bytes:
    raw = value.encode()
    return struct.pack("<I", len(raw)) + raw


def _pack_metadata(values: Mapping[str, Any], where: str) -> bytes:
    parts = [struct.pack("<I", len(values))]
    for name, value in values.items():
        kind, raw = _pack_metadatum(value)
        if not kind:
            expected = "text, bool, int (64 bits), float, or three ints or floats"
            raise DataError(f"{where}: metadata {name!r} is {value!r}; expected {expected}")
        parts.append(_pack_text(name) + _pack_text(kind) + struct.pack("<I", len(raw)) + raw)
    return b"".join(parts)


def _pack_metadatum(value: Any) -> tuple[str, bytes]:
    if isinstance(value, str):
        return "string", value.encode()
    if isinstance(value, bool):
        return "bool", struct.pack("<?", value)
    many = isinstance(value, (tuple, list)) and len(value) == 3
    try:
        if isinstance(value, int):
            return "int64", struct.pack("<q", value)
        if isinstance(value, float):
            return "double", struct.pack("<d", value)
        if many and all(isinstance(v, int) for v in value):
            return "vec3i", struct.pack("<3i", *value)
        if many and all(isinstance(v, (int, float)) for v in value):
            return "vec3d", struct.pack("<3d", *value)
    except (struct.error, OverflowError):
        pass
    return "", b""


def _grid_metadata(grid: VdbGrid, flags: int, where: str) -> bytes:
    # values of foreign types are bytes, which cannot be written
    kept = {k: v for k, v in grid.metadata.items() if k not in _STALE and _pack_metadatum(v)[0]}
    box: tuple[tuple[int, ...], tuple[int, ...]] = _EMPTY_BOX
    if grid.bounds:  # OpenVDB's boxes include their upper corner
        box = grid.bounds[0], tuple(v - 1 for v in grid.bounds[1])
    kept |= {"class": grid.kind, "name": grid.name, "file_bbox_min": box[0], "file_bbox_max": box[1]}
    kept |= {"file_voxel_count": grid.active_voxels, "file_compression": vdb_compression_label(flags)}
    kept |= {"is_saved_as_half_float": bool(grid.half)}
    return _pack_metadata(dict(sorted(kept.items())), where)


def _pack_vdb_transform(matrix: np.ndarray, where: str) -> bytes:
    """Encode a (4, 4) index-to-world transform as the simplest class of OpenVDB's maps that represents it exactly."""
    matrix = np.asarray(matrix, np.float64)
    sound = matrix.shape == (4, 4) and np.isfinite(matrix).all() and (matrix[3] == (0, 0, 0, 1)).all()
    if not sound or np.linalg.det(matrix) == 0:
        raise DataError(f"{where}: transform {matrix.tolist()}; expected an invertible affine (4, 4) matrix")
    scale, translation = np.diag(matrix)[:3], matrix[:3, 3]
    if (matrix[:3, :3] != np.diag(scale)).any():
        return _pack_text("AffineMap") + matrix.T.astype("<f8").tobytes()
    name = ("Uniform" if (scale == scale[0]).all() else "") + ("ScaleTranslateMap" if translation.any() else "ScaleMap")
    parts = [scale, np.abs(scale), 1 / scale, 1 / scale**2, 0.5 / scale]
    if translation.any():
        parts.insert(0, translation)
    return _pack_text(name) + np.concatenate(parts).astype("<f8").tobytes()


# ---------------------------------------------------------------- tree


class _TreeWriter:
    """Encoder of a grid's tree as OpenVDB's bytes: ``topology`` (nodes and masks), and ``buffers`` (leaf values)."""

    def __init__(self, grid: VdbGrid, flags: int, where: str) -> None:
        self._grid, self._where = grid, where
        self._pack = _value_packer(flags, (2 if grid.half else 4) * grid.channels)
        self._flags = flags
        self._check()
        self._origins = grid.origins.astype(np.int64)
        self._tile_origins = grid.tiles.origins.astype(np.int64)
        self._leaf_parts = [b""] * len(grid.values)
        self._masks = np.packbits(grid.masks.reshape(-1, 512), axis=1, bitorder="little")
        self._buffers: list[bytes] = []
        self.topology = self._root()
        self.buffers = b"".join(self._buffers)

    def _check(self) -> None:
        grid, tiles = self._grid, self._grid.tiles
        sizes = np.concatenate([np.full(len(grid.origins), 8), tiles.sizes]).astype(np.int64)
        origins = np.concatenate([grid.origins, tiles.origins]).astype(np.int64)
        if not np.isin(sizes, TILE_SIZES).all() or (origins % sizes[:, None]).any():
            found = "leaves and tiles must start at multiples of their size (8, 128 or 4096 voxels)"
            raise DataError(f"{self._where}: {found}")
        for size in TILE_SIZES:
            here = [tuple(p) for p in (origins[sizes == size] // size).tolist()]
            smaller = {tuple(p) for p in (origins[sizes < size] // size).tolist()}
            if len(set(here)) != len(here) or not smaller.isdisjoint(here):
                found = f"leaves or tiles overlap in blocks of {size} voxels"
                raise DataError(f"{self._where}: {found}; expected each voxel once")
        if grid.half:
            for values in (grid.values, tiles.values):
                largest = float(np.abs(values[np.isfinite(values)]).max(initial=0.0))
                if largest >= 65520:  # rounds to infinity
                    found = f"a value of magnitude {largest:g} does not fit a half float (65504 at most)"
                    raise DataError(f"{self._where}: {found}")

    def _root(self) -> bytes:
        grid = self._grid
        root = np.flatnonzero(grid.tiles.sizes == TILE_SIZES[2])
        small = np.flatnonzero(grid.tiles.sizes < TILE_SIZES[2])
        nodes = _group_by_block(TILE_SIZES[2], self._origins, self._tile_origins[small])
        parts = [struct.pack("<i", 1), grid.background.astype("<f4").tobytes()]
        parts.append(struct.pack("<II", len(root), len(nodes)))
        for i in root:
            tile = struct.pack("<3i", *self._tile_origins[i].tolist()) + grid.tiles.values[i].astype("<f4").tobytes()
            parts.append(tile + struct.pack("<?", bool(grid.tiles.active[i])))
        for origin, (leaves, tiles) in nodes:
            parts.append(struct.pack("<3i", *origin))
            self._upper(parts, origin, leaves, small[tiles])
        return b"".join(parts)

    def _upper(self, parts: list[bytes], origin: tuple[int, int, int], leaves: np.ndarray, tiles: np.ndarray) -> None:
        here = tiles[self._grid.tiles.sizes[tiles] == UPPER.edge]
        below = tiles[self._grid.tiles.sizes[tiles] < UPPER.edge]
        nodes = _group_by_block(UPPER.edge, self._origins[leaves], self._tile_origins[below])
        nodes.sort(key=lambda node: _vdb_slot_numbers(np.array([node[0]]), origin, UPPER)[0])
        self._node(
            parts, _vdb_slot_numbers(np.array([n[0] for n in nodes]).reshape(-1, 3), origin, UPPER), origin, here, UPPER
        )
        for corner, (inner, small) in nodes:
            mine = leaves[inner]
            slots = _vdb_slot_numbers(self._origins[mine], corner, LOWER)
            mine = mine[np.argsort(slots)]
            self._node(parts, slots, corner, below[small], LOWER)
            for leaf in mine:
                mask = self._masks[leaf].tobytes()
                parts.append(mask)
                self._buffers.append(mask + self._values(self._grid.values[leaf], self._grid.masks[leaf]))

    def _node(
        self,
        parts: list[bytes],
        children: np.ndarray,
        origin: tuple[int, int, int],
        tiles: np.ndarray,
        slots: NodeSlots,
    ) -> None:
        """Append an internal node to ``parts``: masks of children and of active tiles, and the tiles' values.

        ``children`` are slot numbers of the node at voxel ``origin``; ``tiles`` are indices of the grid's tiles.
        """
        grid = self._grid
        has_child, active = np.zeros(slots.count, bool), np.zeros(slots.count, bool)
        values = np.empty((slots.count, *grid.background.shape), np.float32)
        values[:] = grid.background
        has_child[children] = True
        at = _vdb_slot_numbers(self._tile_origins[tiles], origin, slots)
        active[at] = grid.tiles.active[tiles]
        values[at] = grid.tiles.values[tiles]
        parts += [np.packbits(has_child, bitorder="little").tobytes(), np.packbits(active, bitorder="little").tobytes()]
        parts.append(self._values(values, active))

    def _values(self, values: np.ndarray, active: np.ndarray) -> bytes:
        """Encode the values of a node or leaf: value code, an inactive value if the code needs one, stored values."""
        grid = self._grid
        inactive = values[~active]
        code, extra = 0, b""
        if (inactive != grid.background).any():
            if (inactive == inactive[0]).all():
                code, extra = 2, inactive[0].astype("<f4").tobytes()
            else:
                code = ALL_VALUES
        stored = values if code == ALL_VALUES else values[active]
        if not len(stored) and grid.half and self._flags & (ZIP | BLOSC):
            return bytes([code]) + extra  # OpenVDB stores no length for no half floats
        return bytes([code]) + extra + self._pack(stored.astype("<f2" if grid.half else "<f4").tobytes())


def _group_by_block(
    size: int, leaves: np.ndarray, tiles: np.ndarray
) -> list[tuple[tuple[int, int, int], tuple[np.ndarray, np.ndarray]]]:
    """Group leaves and tiles, given by their lowest voxel indices (N, 3), by aligned cubes of edge ``size`` voxels.

    Returns (lowest corner, (leaf indices, tile indices)) for each cube that contains a leaf or tile.
    """
    corners, inverse = np.unique(np.concatenate([leaves, tiles]) // size * size, axis=0, return_inverse=True)
    order, count = np.argsort(inverse, kind="stable"), len(leaves)
    ends = np.cumsum(np.bincount(inverse.ravel(), minlength=len(corners))).tolist()
    found, start = [], 0
    for (x, y, z), end in zip(corners.tolist(), ends, strict=True):
        part, start = order[start:end], end
        found.append(((x, y, z), (part[part < count], part[part >= count] - count)))
    return found


def _vdb_slot_numbers(corners: np.ndarray, origin: tuple[int, int, int], slots: NodeSlots) -> np.ndarray:
    """Return the (n,) slots, in a node at ``origin``, of children whose lowest voxel indices are ``corners`` (n, 3)."""
    edge = round(slots.count ** (1 / 3))
    x, y, z = ((corners - np.array(origin)) // slots.edge).astype(np.int64).T
    return np.asarray((x * edge + y) * edge + z)


def _value_packer(flags: int, unit: int) -> Callable[[bytes], bytes]:
    """Return a function that compresses the bytes of a node's values, by the compression bits ``flags``.

    A value has ``unit`` bytes. The function puts the length in front of the compressed bytes. If compression does not
    make the bytes smaller, the result is minus the length, then the uncompressed bytes.
    """
    if not flags & (ZIP | BLOSC):
        return lambda raw: raw
    blosc = blosc_module() if flags & BLOSC else None
    # the Blosc library packs no bytes as a header alone, which the Python package refuses to do
    nothing = struct.pack("<4B3I", 2, 1, 0x23, unit, 0, 1, 16)

    def pack(raw: bytes) -> bytes:
        if blosc is None:
            packed = zlib.compress(raw)
        elif raw:
            packed = blosc.compress(raw, typesize=unit, clevel=9, shuffle=blosc.SHUFFLE, cname="lz4")
        else:
            return struct.pack("<q", len(nothing)) + nothing
        if len(packed) < len(raw):
            return struct.pack("<q", len(packed)) + packed
        return struct.pack("<q", -len(raw)) + raw

    return pack
