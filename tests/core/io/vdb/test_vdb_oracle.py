"""Against OpenVDB itself, where some Python on this machine has its module: it reads what we write, and we read what it
writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from neuprim.core.io.vdb import Grid, Tiles, read_grids, scale_transform, write_vdb
from tests.core.io.vdb.openvdb_oracle import VARIABLE, ask, chosen, compare, other_python, reason
from tests.core.io.vdb.vdb_bytes import random_grid
from tests.systems import posix

# ---------------------------------------------------------------- without OpenVDB


@posix
def test_a_python_without_the_module_is_a_reason_to_skip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    absent = reason(str(tmp_path / "python"))
    assert absent is not None and "does not run (FileNotFoundError)" in absent and VARIABLE in absent
    without = tmp_path / "python-without"
    without.write_text("#!/bin/sh\necho \"ModuleNotFoundError: No module named 'pyopenvdb'\" >&2\nexit 1\n")
    without.chmod(0o755)
    monkeypatch.setenv(VARIABLE, str(without))
    chosen.cache_clear()
    try:
        with pytest.raises(
            pytest.skip.Exception,
            match=r"python-without has not both \(ModuleNotFoundError: No module named 'pyopenvdb'\)",
        ):
            other_python()
    finally:
        chosen.cache_clear()


# ---------------------------------------------------------------- both ways


def ours() -> list[Grid]:
    rng = np.random.default_rng(6)
    dense = rng.normal(size=(21, 9, 30)).astype(np.float32) * (rng.random((21, 9, 30)) < 0.2)
    spoiled = np.ones((8, 8, 8), np.float32)
    spoiled[0, 0, :3] = np.nan, np.inf, -np.inf
    affine = np.array([[0.0, -2.0, 0.0, 5.0], [1.0, 0.0, 0.375, 6.0], [0.0, 0.0, 3.0, 7.0], [0.0, 0.0, 0.0, 1.0]])
    inactive = random_grid(rng, name="inactive")
    inactive.values[0][~inactive.masks[0]] = 7.0  # one value that is not the background
    inactive.values[1] = rng.normal(size=(8, 8, 8))  # many
    metadata = {
        "note": "é",
        "frame": 7,
        "big": 2**40,
        "step": 0.5,
        "flag": True,
        "corner": (1, -2, 3),
        "offset": (0.5, 1.0, -2.0),
    }
    values, mask = np.full((1, 8, 8, 8), 2.0, np.float32), np.ones((1, 8, 8, 8), bool)
    background = Grid("background", np.eye(4), np.float32(0.25), np.zeros((1, 3), np.int32), values, mask, Tiles.none())
    return [
        random_grid(rng, name="float"),
        random_grid(rng, half=True, name="half"),
        random_grid(rng, channels=3, name="vec3s"),
        random_grid(rng, half=True, channels=3, name="halves"),
        inactive,
        background,
        Grid.from_dense("empty", np.zeros((5, 5, 5))),
        Grid.from_dense("affine", dense, lower=(-13, 5, 4090), transform=affine, metadata=metadata),
        Grid.from_dense("uniform", dense, transform=scale_transform(0.25)),
        Grid.from_dense("moved", dense, transform=scale_transform((0.25, -0.5, 2.0), (0, 0, -9))),
        Grid.from_dense("scaled", dense, transform=scale_transform((0.25, 0.5, 2.0))),
        Grid.from_dense("spoiled", spoiled),
    ]


@pytest.mark.slow
@pytest.mark.parametrize("compression", ["none", "zip", "blosc"])
def test_openvdb_reads_what_we_write(tmp_path: Path, compression: str) -> None:
    python = other_python()
    path, grids = tmp_path / "ours.vdb", ours()
    write_vdb(
        path,
        grids,
        compression=compression,
        metadata={"creator": "neuprim", "frame": 7, "corner": (1, 2, 3), "step": 0.5},
    )
    read = compare(python, path, tmp_path)
    assert [g.name for g in read] == [g.name for g in grids]


@pytest.mark.slow
def test_we_read_what_openvdb_writes(tmp_path: Path) -> None:
    python = other_python()
    ask(python, "write", tmp_path / "theirs.vdb")
    grids = {g.name: g for g in compare(python, tmp_path / "theirs.vdb", tmp_path)}
    assert sorted(grids) == ["distances", "empty", "half", "smoke", "tiles", "vectors"]
    assert grids["smoke"].metadata["note"] == "from OpenVDB" and grids["half"].half and grids["vectors"].channels == 3
    assert {4096, 128, 8} <= set(grids["tiles"].tiles.sizes.tolist()) and grids["empty"].bounds is None


@pytest.mark.slow
def test_a_file_goes_round(tmp_path: Path) -> None:
    """Theirs, read and written by us, is theirs."""
    python = other_python()
    ask(python, "write", tmp_path / "theirs.vdb")
    grids = list(read_grids(tmp_path / "theirs.vdb", level_sets=True))
    for compression in ("none", "zip", "blosc"):
        write_vdb(tmp_path / "copy.vdb", grids, compression=compression)
        compare(python, tmp_path / "copy.vdb", tmp_path)
