"""OpenVDB files assembled byte by byte, independently of the package's writer, and ways to spoil them."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuprim.core.errors import NeuprimError
from neuprim.core.io.vdb import VdbGrid, VdbTiles, read_grid, read_header, vdb_scale_transform, write_vdb

LEAF_CORNER = (8, 0, 16)


def text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def metadata(values: Mapping[str, tuple[str, bytes]]) -> bytes:
    return struct.pack("<I", len(values)) + b"".join(
        text(k) + text(t) + struct.pack("<I", len(v)) + v for k, (t, v) in values.items()
    )


def bits(flags: np.ndarray) -> bytes:
    return np.packbits(flags.ravel(), bitorder="little").tobytes()


def one_leaf(mask: np.ndarray, body: bytes, background: bytes, node_values: bytes = b"\0") -> tuple[bytes, bytes]:
    """Tree and buffers of a single leaf at LEAF_CORNER; ``body`` is what follows its mask, from the value code on."""
    upper, lower = np.zeros(32**3, bool), np.zeros(16**3, bool)
    upper[0] = True
    lower[(1 * 16 + 0) * 16 + 2] = True
    tree = struct.pack("<i", 1) + background + struct.pack("<II3i", 0, 1, 0, 0, 0)
    tree += bits(upper) + bytes(4096) + node_values + bits(lower) + bytes(512) + node_values + bits(mask)
    return tree, bits(mask) + body


def grid_bytes(
    at: int,
    tree: bytes,
    buffers: bytes,
    *,
    name: str = "density",
    kind: str = "Tree_float_5_4_3",
    parent: str = "",
    flags: int = 2,
    mapping: bytes | None = None,
    kept: Mapping[str, tuple[str, bytes]] | None = None,
) -> bytes:
    """A grid whose descriptor starts at byte ``at``."""
    mapping = (
        text("UniformScaleMap") + struct.pack("<15d", *[0.5] * 6, *[2.0] * 3, *[4.0] * 3, *[1.0] * 3)
        if mapping is None
        else mapping
    )
    head = text(name) + text(kind) + text(parent)
    body = struct.pack("<I", flags) + metadata(kept or {}) + mapping
    start = at + len(head) + 24
    block = start + len(body) + len(tree)
    return head + struct.pack("<3q", start, 0 if parent else block, block + len(buffers)) + body + tree + buffers


def file_head(count: int, version: int = 224, offsets: int = 1, kept: bytes | None = None) -> bytes:
    head = struct.pack("<qIIIB", 0x56444220, version, 9, 1, offsets) + b"0" * 36
    return head + (metadata({}) if kept is None else kept) + struct.pack("<I", count)


def one_grid(path: Path, tree: bytes, buffers: bytes, version: int = 224, **options: Any) -> Path:
    head = file_head(1, version)
    path.write_bytes(head + grid_bytes(len(head), tree, buffers, **options))
    return path


def random_grid(
    rng: np.random.Generator, *, half: bool = False, channels: int = 1, tiles: bool = True, name: str = "density"
) -> VdbGrid:
    """Scattered leaves on both sides of the origin, partly active, and tiles of all three sizes, one of each
    inactive."""
    corners = np.unique(rng.integers(-40, 40, (30, 3)), axis=0) * 8
    shape = (len(corners), 8, 8, 8, *([3] if channels == 3 else []))
    masks = rng.random(shape[:4]) < rng.random((len(corners), 1, 1, 1))
    values = rng.normal(size=shape).astype(np.float32)
    values = values.astype(np.float16).astype(np.float32) if half else values
    values[~masks] = 0.0
    flat = VdbTiles.none(channels)
    if tiles:
        origins = [(4096, 0, 0), (-8192, 4096, 0), (1024, 1024, 1024), (1152, 1024, 1024), (2048, 0, 8), (2048, 0, 16)]
        sizes = [4096, 4096, 128, 128, 8, 8]
        numbers = np.array([1.5, -0.25, 3.0, 0.5, 2.0, -1.0], np.float32)
        numbers = np.stack([numbers, -numbers, 2 * numbers], 1) if channels == 3 else numbers
        active = np.array([True, False] * 3)
        flat = VdbTiles(np.array(origins, np.int32), np.array(sizes, np.int32), numbers, active)
    background = np.zeros((3,) if channels == 3 else (), np.float32)
    transform = vdb_scale_transform(0.5, (1.0, 2.0, 3.0))
    arrays = (background, corners.astype(np.int32), values, masks, flat)
    return VdbGrid(name, transform, *arrays, half=half, metadata={"creator": "test"})


def sorted_tiles(tiles: VdbTiles) -> list[tuple[Any, ...]]:
    rows = zip(tiles.origins.tolist(), tiles.sizes.tolist(), tiles.values.tolist(), tiles.active.tolist(), strict=True)
    return sorted((tuple(o), s, str(v), a) for o, s, v, a in rows)


def same(a: VdbGrid, b: VdbGrid) -> None:
    """Equal in every voxel, whatever the order of leaves and tiles."""
    np.testing.assert_array_equal(a.transform, b.transform)
    np.testing.assert_array_equal(a.background, b.background)
    i, j = np.lexsort(a.origins.T), np.lexsort(b.origins.T)
    np.testing.assert_array_equal(a.origins[i], b.origins[j])
    np.testing.assert_array_equal(a.masks[i], b.masks[j])
    np.testing.assert_array_equal(a.values[i], b.values[j])
    assert sorted_tiles(a.tiles) == sorted_tiles(b.tiles)
    assert (a.name, a.kind, a.half) == (b.name, b.kind, b.half)


def small_files(folder: Path) -> list[Path]:
    """One file per compression, with half, float and vec3s grids."""
    rng = np.random.default_rng(3)
    paths = []
    for compression in ("none", "zip", "blosc"):
        paths.append(folder / f"{compression}.vdb")
        grids = [random_grid(rng, name="a"), random_grid(rng, half=True, name="b")]
        grids.append(random_grid(rng, channels=3, name="c"))
        write_vdb(paths[-1], grids, compression=compression)
    return paths


def read_all(path: Path) -> int:
    """Reads everything that is readable in a file, and uses it; the number of grids."""
    header = read_header(path)
    for entry in header.grids:
        if entry.undecodable() is None:
            grid = read_grid(path, entry.name, level_sets=True, max_bytes=2**28)
            _ = grid.bounds, grid.world_bounds(), grid.active_voxels, grid.range, grid.non_finite
            if grid.dense_bytes < 2**20:
                grid.to_dense()
    return len(header.grids)


def real_folder(name: str) -> Path:
    """A folder of real files, where the developer has it."""
    root = Path(os.environ.get("NEUPRIM_TEST_DATA") or Path(__file__).parents[5] / "shared" / "data")
    path = root / name
    if not path.is_dir():
        pytest.skip(f"needs real data: no {path} (set NEUPRIM_TEST_DATA to a folder with {name})")
    return path


def refused(call: Callable[[], object], *words: str) -> str:
    """The message of the package's own error; it must contain ``words``."""
    with pytest.raises(NeuprimError) as caught:
        call()
    message = str(caught.value)
    for word in words:
        assert word in message, message
    return message
