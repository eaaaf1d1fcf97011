"""Files that OpenVDB wrote: its own counts and boxes are the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from neuprim.core.io.vdb import VdbGrid, list_vdb_files, read_grid, read_header, write_vdb
from tests.core.io.vdb.vdb_bytes import real_folder, same

FOLDERS = {"embergen_fire_a": 2, "mantaflow_smoke": 21, "vdb_samples": 1}
"""Folder -> how many grids of its first file are decodable."""


def agrees(grid: VdbGrid) -> None:
    """With what OpenVDB counted when it wrote the file."""
    assert grid.active_voxels == grid.metadata["file_voxel_count"]
    if grid.bounds is not None:
        low, high = grid.bounds
        assert low == grid.metadata["file_bbox_min"] and tuple(v - 1 for v in high) == grid.metadata["file_bbox_max"]


@pytest.mark.parametrize("folder", FOLDERS)
def test_counts_and_boxes(folder: str) -> None:
    paths = sorted(real_folder(folder).glob("*.vdb"))
    checked = 0
    for path in (paths[0], paths[len(paths) // 2], paths[-1]):
        for entry in read_header(path).grids:
            if entry.undecodable() is None:
                agrees(read_grid(path, entry.name, level_sets=True))
                checked += 1
    assert checked >= FOLDERS[folder]


def test_the_writer_makes_the_same_bytes_as_openvdb(tmp_path: Path) -> None:
    """The tree up to the leaf buffers, byte by byte; the buffers hold chunks that another Blosc version packs
    differently."""
    source = real_folder("vdb_samples") / "dragon.vdb"
    grid = read_grid(source, "density")
    copy = tmp_path / "copy.vdb"
    write_vdb(copy, [grid])
    trees = []
    for path in (source, copy):
        (entry,) = read_header(path).grids
        trees.append(path.read_bytes()[entry.tree_at : entry.block])
    assert trees[0] == trees[1] and len(trees[0]) > 10_000
    same(grid, read_grid(copy, "density"))


@pytest.mark.parametrize("compression", ["zip", "blosc"])
def test_copies_are_equal(tmp_path: Path, compression: str) -> None:
    """Level sets, tiles, half floats and vectors included."""
    sources = [real_folder("mantaflow_smoke") / "fluid_data_0001.vdb", real_folder("vdb_samples") / "sphere.vdb"]
    for source in sources:
        entries = [e for e in read_header(source).grids if e.undecodable() is None][:8]
        grids = [read_grid(source, e.name, level_sets=True) for e in entries]
        write_vdb(tmp_path / "copy.vdb", grids, compression=compression)
        for grid in grids:
            same(grid, read_grid(tmp_path / "copy.vdb", grid.name, level_sets=True))


def test_the_fire(tmp_path: Path) -> None:
    """Frame 0 is empty with an inverted box, numbers are not padded, and there is no grid called density."""
    fire = list_vdb_files(real_folder("embergen_fire_a"))
    assert [f.number for f in fire.frames] == list(range(41)) and fire.gaps == ()
    first, second = (read_grid(frame.path, "flames") for frame in fire.frames[:2])
    assert first.bounds is None and first.metadata["file_bbox_min"] > first.metadata["file_bbox_max"]
    assert second.half and second.active_voxels == 7405
    assert second.to_dense().shape == (45, 45, 30) and np.count_nonzero(second.to_dense()) == 7405
