"""Every way of storing values, versions, maps and tree levels, from bytes put together by hand."""

from __future__ import annotations

import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from neuprim.core.io.vdb import read_grid, read_grids, read_header, vdb_scale_transform
from tests.core.io.vdb.vdb_bytes import LEAF_CORNER, bits, file_head, grid_bytes, one_grid, one_leaf, refused, text

RNG = np.random.default_rng(11)
MASK = RNG.random(512) < 0.3
CHOSEN = RNG.random(512) < 0.5
VALUES = RNG.normal(size=512).astype("<f4")
BACKGROUND = 0.75


def floats(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}f", *values)


ENCODINGS: dict[int, tuple[bytes, float, float]] = {
    0: (b"", BACKGROUND, BACKGROUND),
    1: (b"", -BACKGROUND, -BACKGROUND),
    2: (floats(3.0), 3.0, 3.0),
    3: (bits(CHOSEN), -BACKGROUND, BACKGROUND),
    4: (floats(3.0) + bits(CHOSEN), 3.0, BACKGROUND),
    5: (floats(3.0, 4.0) + bits(CHOSEN), 3.0, 4.0),
}
"""Code -> what follows it, the inactive value where the selection mask is off, and where it is on."""


def packed(raw: bytes, flags: int) -> bytes:
    if flags & 4:
        import blosc

        chunk = blosc.compress(raw, typesize=4, cname="lz4")
        return struct.pack("<q", len(chunk)) + chunk
    if flags & 1:
        chunk = zlib.compress(raw)
        return struct.pack("<q", len(chunk)) + chunk
    return raw


def nothing(flags: int) -> bytes:
    """An internal node with masks but no values: code 0, and a length of 0 where values are packed."""
    return b"\0" + (struct.pack("<q", 0) if flags & 5 else b"")


@pytest.mark.parametrize("flags", [2, 3, 6])
@pytest.mark.parametrize("code", range(6))
def test_inactive_values(tmp_path: Path, code: int, flags: int) -> None:
    extra, off, on = ENCODINGS[code]
    body = bytes([code]) + extra + packed(VALUES[MASK].tobytes(), flags)
    path = one_grid(tmp_path / "a.vdb", *one_leaf(MASK, body, floats(BACKGROUND), nothing(flags)), flags=flags)
    grid = read_grid(path, "density")
    assert grid.origins.tolist() == [list(LEAF_CORNER)] and grid.background == BACKGROUND
    np.testing.assert_array_equal(grid.masks.ravel(), MASK)
    expected = np.where(MASK, VALUES, np.where(CHOSEN, on, off).astype(np.float32))
    np.testing.assert_array_equal(grid.values.ravel(), expected)


@pytest.mark.parametrize("flags", [0, 1, 2, 3, 4, 6])
def test_all_values_stored(tmp_path: Path, flags: int) -> None:
    """Code 6, or no mask compression at all: inactive values are in the file."""
    raw = packed(VALUES.tobytes(), flags)
    nodes = nothing(flags)
    tree, buffers = one_leaf(MASK, b"\x06" + raw, floats(0.0), nodes)
    if not flags & 2:  # internal nodes then store all of their values as well
        upper, lower = (b"\x06" + packed(bytes(4 * n), flags) for n in (32768, 4096))
        first = 4 + 4 + 8 + 12 + 8192
        second = first + len(nodes) + 1024
        tree = tree[:first] + upper + tree[first + len(nodes) : second] + lower + tree[second + len(nodes) :]
    grid = read_grid(one_grid(tmp_path / "a.vdb", tree, buffers, flags=flags), "density")
    np.testing.assert_array_equal(grid.values.ravel(), VALUES)
    assert grid.active_voxels == MASK.sum() and len(grid.tiles) == 0


def test_half_floats_and_their_missing_lengths(tmp_path: Path) -> None:
    """Inactive values stay 32-bit floats; no active half floats have no length at all."""
    half = VALUES.astype("<f2")
    body = b"\x02" + floats(0.1) + packed(half[MASK].tobytes(), 3)
    kind = "Tree_float_5_4_3_HalfFloat"
    grid = read_grid(one_grid(tmp_path / "a.vdb", *one_leaf(MASK, body, floats(0.0)), flags=3, kind=kind), "density")
    np.testing.assert_array_equal(grid.values.ravel(), np.where(MASK, half.astype(np.float32), np.float32(0.1)))
    assert grid.half


def test_vectors(tmp_path: Path) -> None:
    vectors = RNG.normal(size=(512, 3)).astype("<f4")
    body = b"\x05" + floats(1, 2, 3, 4, 5, 6) + bits(CHOSEN) + vectors[MASK].tobytes()
    leaf = one_leaf(MASK, body, floats(0, 0, 0))
    grid = read_grid(one_grid(tmp_path / "a.vdb", *leaf, kind="Tree_vec3s_5_4_3"), "density")
    expected = np.where(MASK[:, None], vectors, np.where(CHOSEN[:, None], (4, 5, 6), (1, 2, 3)).astype(np.float32))
    np.testing.assert_array_equal(grid.values.reshape(512, 3), expected)
    assert grid.channels == 3 and grid.to_dense(((8, 0, 16), (16, 8, 24))).shape == (8, 8, 8, 3)


@pytest.mark.parametrize("flags", [2, 3, 6])
def test_doubles_become_floats(tmp_path: Path, flags: int) -> None:
    """Values beyond the range of float32 become infinite, which the grid counts."""
    doubles = np.where(np.arange(512) == np.flatnonzero(MASK)[0], 1e300, RNG.normal(size=512)).astype("<f8")
    body = b"\x02" + struct.pack("<d", 0.1) + packed(doubles[MASK].tobytes(), flags)
    leaf = one_leaf(MASK, body, struct.pack("<d", 0.5), nothing(flags))
    grid = read_grid(one_grid(tmp_path / "a.vdb", *leaf, flags=flags, kind="Tree_double_5_4_3"), "density")
    with np.errstate(over="ignore"):
        expected = np.where(MASK, doubles, 0.1).astype(np.float32)
    np.testing.assert_array_equal(grid.values.ravel(), expected)
    assert grid.background == np.float32(0.5) and grid.non_finite == 1 and not grid.half


def test_half_doubles_and_double_vectors(tmp_path: Path) -> None:
    """Background and inactive values stay doubles when active values are half floats."""
    vectors = RNG.normal(size=(512, 3)).astype("<f2")
    body = b"\x02" + struct.pack("<3d", 1, 2, 3) + vectors[MASK].tobytes()
    leaf = one_leaf(MASK, body, struct.pack("<3d", 0.1, 0.2, 0.3))
    grid = read_grid(one_grid(tmp_path / "a.vdb", *leaf, kind="Tree_vec3d_5_4_3_HalfFloat"), "density")
    np.testing.assert_array_equal(
        grid.values.reshape(512, 3), np.where(MASK[:, None], vectors.astype(np.float32), np.float32([1, 2, 3]))
    )
    assert grid.half and grid.channels == 3 and grid.background.tolist() == np.float32([0.1, 0.2, 0.3]).tolist()


def test_tiles_of_all_levels(tmp_path: Path) -> None:
    tree = struct.pack("<if", 1, 0.0) + struct.pack("<II", 2, 1)
    tree += struct.pack("<3ifB", 4096, 0, 0, 1.5, 1)
    tree += struct.pack("<3ifB", -4096, 0, 0, 0.0, 0)  # says nothing
    upper_child, upper_active, lower_active = np.zeros(32768, bool), np.zeros(32768, bool), np.zeros(4096, bool)
    upper_child[0], upper_active[32768 - 1], lower_active[[1, 256]] = True, True, True
    tree += struct.pack("<3i", 0, 0, 0) + bits(upper_child) + bits(upper_active) + b"\0" + floats(2.5)
    tree += bytes(512) + bits(lower_active) + b"\x02" + floats(9.0) + floats(3.5, 4.5)
    grid = read_grid(one_grid(tmp_path / "a.vdb", tree, b""), "density")
    rows = {tuple(o): (s, v, a) for o, s, v, a in zip(*(x.tolist() for x in vars(grid.tiles).values()), strict=True)}
    assert rows[4096, 0, 0] == (4096, 1.5, True) and rows[3968, 3968, 3968] == (128, 2.5, True)
    assert rows[0, 0, 8] == (8, 3.5, True) and rows[8, 0, 0] == (8, 4.5, True)
    # inactive tiles that are not the background count
    assert rows[0, 0, 0] == (8, 9.0, False) and len(rows) == 2 + 4096
    assert grid.active_voxels == 4096**3 + 128**3 + 2 * 8**3


LEAF = one_leaf(MASK, b"\0" + VALUES[MASK].tobytes(), floats(0.0))


@pytest.mark.parametrize("version", [0, 221, 222, 223, 224, 225, 2**32 - 1])
def test_versions(tmp_path: Path, version: int) -> None:
    path = one_grid(tmp_path / "a.vdb", *LEAF, version=version)
    if 222 <= version <= 224:
        assert read_header(path).version == version and read_grid(path, "density").active_voxels == MASK.sum()
        return
    refused(lambda: read_header(path), "a.vdb", str(version), "222 to 224")


MATRIX = np.array([[0.0, -2.0, 0.0, 5.0], [1.0, 0.0, 0.3, 6.0], [0.0, 0.0, 3.0, 7.0], [0.0, 0.0, 0.0, 1.0]])
MAPS: dict[str, tuple[list[float], np.ndarray]] = {
    "UniformScaleMap": ([0.5] * 15, vdb_scale_transform(0.5)),
    "ScaleMap": ([1, 2, 3] + [9] * 12, vdb_scale_transform((1, 2, 3))),
    "UniformScaleTranslateMap": ([5, 6, 7, 2, 2, 2] + [9] * 12, vdb_scale_transform(2, (5, 6, 7))),
    "ScaleTranslateMap": ([5, 6, 7, 1, 2, 3] + [9] * 12, vdb_scale_transform((1, 2, 3), (5, 6, 7))),
    "TranslationMap": ([5, 6, 7], vdb_scale_transform(1, (5, 6, 7))),
    "AffineMap": (MATRIX.T.ravel().tolist(), MATRIX),
}


@pytest.mark.parametrize("name", MAPS)
def test_maps(tmp_path: Path, name: str) -> None:
    numbers, matrix = MAPS[name]
    path = one_grid(tmp_path / "a.vdb", *LEAF, mapping=text(name) + struct.pack(f"<{len(numbers)}d", *numbers))
    np.testing.assert_array_equal(read_grid(path, "density").transform, matrix)


@pytest.mark.parametrize(
    "numbers", [[0.0] * 15, [float("nan")] * 15, [float("inf")] * 15, [1.0, 1.0, 0.0] + [1.0] * 12]
)
def test_impossible_maps(tmp_path: Path, numbers: list[float]) -> None:
    path = one_grid(tmp_path / "a.vdb", *LEAF, mapping=text("ScaleMap") + struct.pack("<15d", *numbers))
    refused(lambda: read_header(path), "a.vdb", "'density'", "transform")


def test_unknown_maps_are_listed_and_refused(tmp_path: Path) -> None:
    path = one_grid(tmp_path / "a.vdb", *LEAF, mapping=text("NonlinearFrustumMap") + bytes(300))
    (entry,) = read_header(path).grids
    assert entry.transform is None and entry.voxel_size is None
    refused(lambda: read_grid(path, "density"), "a.vdb", "NonlinearFrustumMap")


def test_foreign_grids_are_skipped_unread(tmp_path: Path) -> None:
    """Their trees are noise here, and nobody notices; the grid behind them is read."""
    data = file_head(5)
    foreign = {"flags": "Tree_int32_5_4_3", "inside": "Tree_bool_5_4_3", "pts": "Tree_ptdataidx32_5_4_3_Mask"}
    for name, kind in foreign.items():
        data += grid_bytes(len(data), b"noise" * 100, b"more noise", name=name, kind=kind)
    data += grid_bytes(len(data), *LEAF, name="sdf", kept={"class": ("string", b"level set")})
    data += grid_bytes(len(data), *LEAF)
    path = tmp_path / "a.vdb"
    path.write_bytes(data)
    assert [g.name for g in read_header(path).grids] == ["flags", "inside", "pts", "sdf", "density"]
    assert read_grid(path, "density").active_voxels == MASK.sum()
    refused(lambda: read_grid(path, "flags"), "a.vdb", "'flags'", "Tree_int32_5_4_3")
    refused(lambda: read_grid(path, "pts"), "'pts'", "holds points")
    refused(lambda: read_grid(path, "sdf"), "'sdf'", "level set", "distances to a surface")
    assert read_grid(path, "sdf", level_sets=True).kind == "level set"
    assert [g.name for g in read_grids(path)] == ["density"]
    assert [g.name for g in read_grids(path, level_sets=True)] == ["sdf", "density"]
    assert [g.name for g in read_grids(path, ["density", "sdf"], level_sets=True)] == ["density", "sdf"]
    refused(lambda: list(read_grids(path, ["density", "pts"])), "'pts'", "holds points")
    refused(lambda: read_grid(path, "densty"), "a.vdb", "'densty'", "did you mean 'density'")


def test_names_that_repeat_and_instances(tmp_path: Path) -> None:
    data = file_head(3)
    data += grid_bytes(len(data), *LEAF, name="density\x1e0")
    data += grid_bytes(len(data), *LEAF, name="density\x1e1", flags=2)
    moved = text("TranslationMap") + struct.pack("<3d", 1, 2, 3)
    data += grid_bytes(len(data), b"", b"", name="copy", parent="density\x1e0", mapping=moved)
    path = tmp_path / "a.vdb"
    path.write_bytes(data)
    assert [g.name for g in read_header(path).grids] == ["density[0]", "density[1]", "copy"]
    grid = read_grid(path, "copy")
    assert grid.active_voxels == MASK.sum() and grid.transform[:3, 3].tolist() == [1, 2, 3]


def test_metadata_types(tmp_path: Path) -> None:
    kept = {
        "class": ("string", b"fog volume"),
        "flag": ("bool", b"\1"),
        "count": ("int64", struct.pack("<q", -5)),
        "time": ("float", struct.pack("<f", 0.5)),
        "box": ("vec3i", struct.pack("<3i", 1, 2, 3)),
        "other": ("__delayedload", b"abc"),
    }
    path = one_grid(tmp_path / "a.vdb", *LEAF, kept=kept)
    found = read_grid(path, "density").metadata
    assert found == {"class": "fog volume", "flag": True, "count": -5, "time": 0.5, "box": (1, 2, 3), "other": b"abc"}
    path = one_grid(tmp_path / "a.vdb", *LEAF, kept={"time": ("float", b"abc")})
    refused(lambda: read_header(path), "a.vdb", "'time'", "3 bytes", "expected 4")


def test_a_missing_blosc_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "blosc", None)
    body = b"\0" + struct.pack("<q", -4 * MASK.sum()) + VALUES[MASK].tobytes()
    path = one_grid(tmp_path / "a.vdb", *one_leaf(MASK, body, floats(0.0), nothing(6)), flags=6)
    assert read_header(path).grids[0].compression == "blosc + active values"
    refused(lambda: read_grid(path, "density"), "pip install blosc")
