"""What is written is what is read, and grids in memory say the truth about themselves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from neuprim.core.io.vdb import VdbGrid, VdbTiles, read_grid, read_header, vdb_scale_transform, write_vdb
from tests.core.io.vdb.vdb_bytes import random_grid, refused, same


@pytest.mark.parametrize("compression", ["none", "zip", "blosc"])
@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("channels", [1, 3])
def test_random_grids(tmp_path: Path, compression: str, half: bool, channels: int) -> None:
    grid = random_grid(np.random.default_rng(1), half=half, channels=channels)
    grid.values[0][~grid.masks[0]] = 7.0  # inactive values that are not the background: one
    grid.values[1] = 2.0 + np.arange(512).reshape(8, 8, 8, *[1] * (channels == 3))  # and many
    write_vdb(tmp_path / "a.vdb", [grid], compression=compression, metadata={"creator": "neuprim", "frame": 7})
    header = read_header(tmp_path / "a.vdb")
    assert header.version == 224 and header.metadata == {"creator": "neuprim", "frame": 7}
    (entry,) = header.grids
    assert entry.compression == {"none": "active values"}.get(compression, f"{compression} + active values")
    assert entry.type == ("Tree_float_5_4_3" if channels == 1 else "Tree_vec3s_5_4_3") and entry.half == half
    found = read_grid(tmp_path / "a.vdb", "density")
    same(grid, found)
    assert found.metadata["creator"] == "test"
    assert found.metadata["file_voxel_count"] == found.active_voxels == grid.active_voxels


@pytest.mark.parametrize("lower", [(0, 0, 0), (-13, 5, 4090), (-4100, -1, 7)])
def test_dense_arrays_anywhere(tmp_path: Path, lower: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(2)
    array = rng.random((21, 9, 30), np.float32) * (rng.random((21, 9, 30)) < 0.1)
    grid = VdbGrid.from_dense("density", array, lower=lower)
    write_vdb(tmp_path / "a.vdb", [grid])
    found = read_grid(tmp_path / "a.vdb", "density")
    box = (lower, (lower[0] + 21, lower[1] + 9, lower[2] + 30))
    np.testing.assert_array_equal(found.to_dense(box), array)
    assert found.active_voxels == np.count_nonzero(array)
    where = np.argwhere(array) + lower
    assert found.bounds == (tuple(where.min(0).tolist()), tuple((where.max(0) + 1).tolist()))
    assert found.range == (array[array > 0].min(), array.max())


def test_empty(tmp_path: Path) -> None:
    write_vdb(tmp_path / "a.vdb", [VdbGrid.from_dense("density", np.zeros((5, 5, 5)))])
    grid = read_grid(tmp_path / "a.vdb", "density")
    assert grid.bounds is None and grid.world_bounds() is None and grid.range is None
    assert grid.active_voxels == grid.dense_bytes == 0 and grid.to_dense().shape == (0, 0, 0)
    assert (grid.to_dense(((0, 0, 0), (3, 4, 5))) == np.zeros((3, 4, 5))).all()
    assert grid.metadata["file_bbox_min"] == (2**31 - 1,) * 3 and grid.metadata["file_bbox_max"] == (-(2**31),) * 3
    write_vdb(tmp_path / "none.vdb", [])
    assert read_header(tmp_path / "none.vdb").grids == ()
    refused(lambda: read_grid(tmp_path / "none.vdb", "density"), "none.vdb", "no grids")


def test_tiles_are_in_the_dense_array() -> None:
    grid = random_grid(np.random.default_rng(5))
    dense = grid.to_dense(((1020, 1022, 1021), (1160, 1030, 1030)))
    expected = np.zeros((140, 8, 9), np.float32)
    expected[4:132, 2:, 3:], expected[132:, 2:, 3:] = 3.0, 0.5
    np.testing.assert_array_equal(dense, expected)
    eights = grid.to_dense(((2048, 0, 6), (2050, 1, 18)))
    assert eights[0, 0].tolist() == [0.0] * 2 + [2.0] * 8 + [-1.0] * 2
    assert (grid.to_dense(((5000, 10, 10), (5002, 12, 12))) == 1.5).all()
    assert grid.bounds is not None and grid.bounds[1][0] == 8192
    assert grid.active_voxels == np.count_nonzero(grid.masks) + 4096**3 + 128**3 + 8**3


def test_dense_says_how_much_it_would_take() -> None:
    grid = random_grid(np.random.default_rng(5))
    assert grid.bounds is not None
    sides = [b - a for a, b in zip(*grid.bounds, strict=True)]
    assert grid.dense_bytes == 4 * sides[0] * sides[1] * sides[2] > 2**33
    refused(grid.to_dense, "'density'", "bytes when dense", str(2 * 2**30))
    refused(lambda: grid.to_dense(((0, 0, 0), (8, 8, 8)), max_bytes=2047), "8 x 8 x 8", "2048", "2047")
    assert grid.to_dense(((0, 0, 0), (8, 8, 8)), max_bytes=2048).nbytes == 2048
    refused(lambda: grid.to_dense(((8, 0, 0), (0, 8, 8))), "lower corner first")


def test_non_finite_values_are_kept_counted_and_replaced_on_request(tmp_path: Path) -> None:
    array = np.ones((8, 8, 8), np.float32)
    array[0, 0, :3] = np.nan, np.inf, -np.inf
    write_vdb(tmp_path / "a.vdb", [VdbGrid.from_dense("density", array)])
    grid = read_grid(tmp_path / "a.vdb", "density")
    assert grid.non_finite == 3 and grid.range == (1.0, 1.0) and grid.active_voxels == 512
    np.testing.assert_array_equal(grid.to_dense(), array)
    replaced = grid.to_dense(non_finite=0.0)
    assert replaced[0, 0, :4].tolist() == [0.0, 0.0, 0.0, 1.0] and replaced.sum() == 509


TRANSFORMS = {
    "UniformScaleMap": vdb_scale_transform(0.25),
    "UniformScaleTranslateMap": vdb_scale_transform(0.25, (1, 2, 3)),
    "ScaleMap": vdb_scale_transform((0.25, 0.5, 2.0)),
    "ScaleTranslateMap": vdb_scale_transform((0.25, -0.5, 2.0), (0, 0, -9)),
    "AffineMap": np.array([[0.0, -2.0, 0.0, 5.0], [1.0, 0.0, 0.3, 6.0], [0.0, 0.0, 3.0, 7.0], [0.0, 0.0, 0.0, 1.0]]),
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_transforms(tmp_path: Path, name: str) -> None:
    matrix = TRANSFORMS[name]
    write_vdb(tmp_path / "a.vdb", [VdbGrid.from_dense("density", np.ones((2, 3, 4)), transform=matrix)])
    (entry,) = read_header(tmp_path / "a.vdb").grids
    assert entry.map == name
    grid = read_grid(tmp_path / "a.vdb", "density")
    np.testing.assert_array_equal(grid.transform, matrix)
    np.testing.assert_allclose(grid.voxel_size, np.linalg.norm(matrix[:3, :3], axis=0))
    corners = np.array([[x, y, z, 1] for x in (-0.5, 1.5) for y in (-0.5, 2.5) for z in (-0.5, 3.5)]) @ matrix.T
    np.testing.assert_allclose(grid.world_bounds(), [corners.min(0)[:3], corners.max(0)[:3]])


def test_writer_refuses(tmp_path: Path) -> None:
    path, good = tmp_path / "a.vdb", VdbGrid.from_dense("density", np.ones((8, 8, 8)))
    write_vdb(path, [good])
    before = path.read_bytes()

    def grid(**changes: object) -> VdbGrid:
        return replace(good, **changes)  # type: ignore[arg-type]

    def tile(origin: tuple[int, int, int], size: int) -> VdbTiles:
        return VdbTiles(
            np.array([origin], np.int32), np.array([size], np.int32), np.ones(1, np.float32), np.ones(1, bool)
        )

    refused(lambda: write_vdb(path, [good, good]), "a.vdb", "different names")
    refused(lambda: write_vdb(path, [good], compression="lz4"), "a.vdb", "'lz4'", "blosc")
    refused(lambda: write_vdb(path, [good], metadata={"x": object()}), "a.vdb", "'x'")
    refused(lambda: write_vdb(path, [good], metadata={"x": 2**70}), "a.vdb", "'x'")
    refused(lambda: write_vdb(path, [grid(origins=np.array([[0, 4, 0]], np.int32))]), "density", "multiples")
    refused(lambda: write_vdb(path, [grid(tiles=tile((0, 0, 4), 8))]), "density", "multiples")
    for size in (8, 128, 4096):
        refused(lambda size=size: write_vdb(path, [grid(tiles=tile((0, 0, 0), size))]), "density", "overlap", str(size))
    refused(lambda: write_vdb(path, [grid(transform=np.zeros((4, 4)))]), "density", "invertible")
    large = grid(half=True, values=np.full((1, 8, 8, 8), 7e4, np.float32))
    refused(lambda: write_vdb(path, [large]), "density", "half", "65504")
    refused(lambda: VdbGrid.from_dense("density", np.ones((2, 2))), "density", "(2, 2)")
    refused(
        lambda: VdbGrid.from_dense("density", np.ones((9, 9, 9)), lower=(2**31 - 9, 0, 0)), "density", "fit 32 bits"
    )
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
