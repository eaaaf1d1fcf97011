"""Damaged and malicious files: the package's own errors, little memory, nothing else."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest

from neuprim.core.io.vdb import read_grid, read_header
from tests.core.io.vdb.vdb_bytes import bits, file_head, grid_bytes, one_grid, one_leaf, refused, text

FULL = np.ones(512, bool)
GOOD = one_leaf(FULL, b"\0" + bytes(2048), bytes(4))


def test_not_openvdb(tmp_path: Path) -> None:
    refused(lambda: read_header(tmp_path / "gone.vdb"), "gone.vdb", "not found")
    refused(lambda: read_header(tmp_path), "not a file")
    path = tmp_path / "a.vdb"
    for content, word in ((b"", "empty"), (b"BDV", "starts with"), (b"\x89PNG\r\n\x1a\n" * 9, "starts with")):
        path.write_bytes(content)
        refused(lambda: read_header(path), "a.vdb", word, "OpenVDB file")


def with_lengths(at: int) -> list[tuple[bytes, tuple[str, ...]]]:
    """Files, each with one absurd claim, and words that their refusals must have."""
    head = file_head(1)
    huge = struct.pack("<I", 2**32 - 1)
    good_grid = grid_bytes(at, *GOOD)
    offsets = at + len(text("density") + text("Tree_float_5_4_3") + text(""))
    whole = head + good_grid

    def offset(values: tuple[int, int, int]) -> bytes:
        return whole[:offsets] + struct.pack("<3q", *values) + whole[offsets + 24 :]

    return [
        (file_head(2**32 - 1) + good_grid, ("grid 2 of 4294967295", "truncated")),
        (file_head(0, kept=huge), ("file metadata", "truncated")),
        (head + huge + good_grid, ("name of grid 1 of 1", "4294967295 bytes")),
        (file_head(1, kept=struct.pack("<I", 1) + text("a") + text("string") + huge), ("'a'", "4294967295 bytes")),
        (file_head(1, offsets=0) + good_grid, ("stream",)),
        (offset((0, 0, 0)), ("ascending offsets",)),
        (offset((2**62, 2**62, 2**62)), ("ascending offsets",)),
        (offset((-1, -1, -1)), ("ascending offsets",)),
        (file_head(2) + grid_bytes(at, *GOOD) + grid_bytes(at + len(good_grid), *GOOD), ("two grids", "'density'")),
        (head + grid_bytes(at, *GOOD, flags=8), ("compression bits 0x8",)),
    ]


@pytest.mark.parametrize("number", range(10))
def test_absurd_claims_in_headers(tmp_path: Path, number: int) -> None:
    content, words = with_lengths(len(file_head(1)))[number]
    path = tmp_path / "a.vdb"
    path.write_bytes(content)
    tracemalloc.start()
    try:
        refused(lambda: read_header(path), "a.vdb", *words)
        assert tracemalloc.get_traced_memory()[1] < 2**22
    finally:
        tracemalloc.stop()


def bomb(size: int) -> bytes:
    chunk = zlib.compress(bytes(size), 9)
    return struct.pack("<q", len(chunk)) + chunk


def blosc_claim(size: int) -> bytes:
    chunk = struct.pack("<4B3I", 2, 1, 0x21, 4, size, size, 32) + bytes(16)
    return struct.pack("<q", len(chunk)) + chunk


ZERO = b"\0" + struct.pack("<q", 0)
UPPER = struct.pack("<ifII3i", 1, 0, 0, 1, 0, 0, 0)  # a root with one child


def packed_leaf(values: bytes) -> tuple[bytes, bytes]:
    return one_leaf(FULL, b"\0" + values, bytes(4), ZERO)


TREES: list[tuple[tuple[bytes, bytes], int, tuple[str, ...]]] = [
    ((struct.pack("<ifII", 1, 0, 2**32 - 1, 0), b""), 2, ("4294967295 root tiles", "truncated")),
    ((struct.pack("<ifII", 1, 0, 0, 2**32 - 1), b""), 2, ("root child 1 of 4294967295",)),
    ((struct.pack("<ifII", 7, 0, 0, 0), b""), 2, ("7 buffers",)),
    ((struct.pack("<ifII3i", 1, 0, 0, 1, 5, 0, 0), b""), 2, ("(5, 0, 0)", "multiples of 4096")),
    ((struct.pack("<ifII3ifB3i", 1, 0, 1, 1, 0, 0, 0, 1, 1, 0, 0, 0), b""), 2, ("(0, 0, 0)", "each once")),
    ((UPPER + b"\xff" * 4096 + bytes(4097), b""), 2, ("truncated",)),
    (one_leaf(FULL, b"\0" + bytes(2048), bytes(4), b"\x07"), 2, ("value code 7", "0 to 6")),
    (one_leaf(FULL, b"\x09" + bytes(2048), bytes(4)), 2, ("value code 9", "a leaf")),
    ((GOOD[0], GOOD[1] + b"x"), 2, ("leaf buffers end",)),
    ((GOOD[0] + b"x", GOOD[1]), 2, ("nodes end",)),
    ((GOOD[0], GOOD[1][:-1]), 2, ("2048 bytes", "2047 are left")),
    (packed_leaf(bomb(2**26)), 3, ("unzipped chunk of more than 2048",)),
    (packed_leaf(bomb(2047)), 3, ("unzipped chunk of 2047",)),
    (packed_leaf(struct.pack("<q", 9) + b"not a zip"), 3, ("damaged zip chunk",)),
    (packed_leaf(struct.pack("<q", -(2**62))), 3, (str(2**62), "expected 2048")),
    (packed_leaf(struct.pack("<q", 2**62)), 3, (str(2**62), "truncated")),
    (packed_leaf(blosc_claim(2**31 - 1)), 6, ("Blosc chunk states that 32 bytes unpack to 2147483647",)),
    (packed_leaf(blosc_claim(2048)), 6, ("damaged Blosc chunk",)),
    (packed_leaf(struct.pack("<q", 4) + b"abcd"), 6, ("Blosc chunk of 4 bytes",)),
]


@pytest.mark.parametrize("number", range(len(TREES)))
def test_absurd_trees(tmp_path: Path, number: int) -> None:
    parts, flags, words = TREES[number]
    path = one_grid(tmp_path / "a.vdb", *parts, flags=flags)
    assert len(read_header(path).grids) == 1
    tracemalloc.start()
    try:
        refused(lambda: read_grid(path, "density"), "a.vdb", "'density'", *words)
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


def test_many_leaves_in_few_bytes_are_refused_before_they_take_memory(tmp_path: Path) -> None:
    """A node of 4096 leaves needs 64 bytes for each; with a small limit, nothing of 2 KB each is allocated."""
    upper = np.zeros(32768, bool)
    upper[0] = True
    tree = UPPER + bits(upper) + bytes(4097) + b"\xff" * 512 + bytes(513) + bytes(4096 * 64)
    path = one_grid(tmp_path / "a.vdb", tree, bytes(4096 * 65))
    tracemalloc.start()
    try:
        refused(lambda: read_grid(path, "density", max_bytes=2**20), "4096 leaves", str(2**20))
        assert tracemalloc.get_traced_memory()[1] < 2**21
    finally:
        tracemalloc.stop()
    assert read_grid(path, "density").active_voxels == 0


def test_many_tiles_in_few_bytes_count_too(tmp_path: Path) -> None:
    """One node may hold 32,768 tiles, equal ones in few bytes; in memory they take 21 bytes each."""
    values = struct.pack("<32768f", *range(32768))
    chunk = zlib.compress(values)
    tree = UPPER + bytes(4096) + b"\xff" * 4096 + b"\0" + struct.pack("<q", len(chunk)) + chunk
    path, most = one_grid(tmp_path / "a.vdb", tree, b"", flags=3), 32768 * 21
    refused(lambda: read_grid(path, "density", max_bytes=most - 1), "a.vdb", "'density'", "tiles", str(most - 1))
    grid = read_grid(path, "density", max_bytes=most)
    assert len(grid.tiles) == 32768 and grid.active_voxels == 4096**3 and grid.range == (0.0, 32767.0)


def test_an_instance_of_itself(tmp_path: Path) -> None:
    path = one_grid(tmp_path / "a.vdb", b"", b"", parent="density")
    refused(lambda: read_grid(path, "density"), "a.vdb", "is an instance of grid")
