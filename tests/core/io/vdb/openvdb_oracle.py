"""OpenVDB itself, in another Python of this machine that has its module.

Looked for in ``$NEUPRIM_OPENVDB_PYTHON``, else in ``/usr/bin/python3`` (Debian's package is python3-openvdb). The other
Python runs :mod:`tests.core.io.vdb.openvdb_side`; numbers travel in .npz files.
"""

from __future__ import annotations

import json
import os
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from neuprim.core.io.vdb import Grid, read_grids, read_header

SCRIPT = Path(__file__).with_name("openvdb_side.py")
VARIABLE = "NEUPRIM_OPENVDB_PYTHON"
POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-7, 12, 0.5]])


def reason(python: str) -> str | None:
    """Why a Python cannot serve, or None."""
    hint = f"set {VARIABLE} to a Python with the module openvdb or pyopenvdb"
    try:
        done = subprocess.run(
            [python, str(SCRIPT), "check"], capture_output=True, text=True, timeout=120, env=environment()
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"needs OpenVDB's Python module and numpy: {python} does not run ({type(error).__name__}); {hint}"
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return f"needs OpenVDB's Python module and numpy: {python} has not both ({last}); {hint}"
    return None


def environment() -> dict[str, str]:
    """The other Python finds its own packages, not this one's."""
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}


@cache
def chosen() -> tuple[str, str | None]:
    python = os.environ.get(VARIABLE) or "/usr/bin/python3"
    return python, reason(python)


def other_python() -> str:
    """The Python that has OpenVDB; skips the test where there is none."""
    python, why = chosen()
    if why:
        pytest.skip(why)
    return python


def ask(python: str, *words: object) -> None:
    done = subprocess.run(
        [python, str(SCRIPT), *map(str, words)], capture_output=True, text=True, timeout=600, env=environment()
    )
    assert done.returncode == 0, done.stderr


# ---------------------------------------------------------------- comparison


def query(grids: list[Grid], path: Path) -> None:
    """Where to look: all leaves, corners of all tiles and a voxel beside each, and points to transform."""
    where = {}
    for grid in grids:
        corners = grid.tiles.origins.astype(np.int64)
        where[f"{grid.name}/leaves"] = grid.origins
        where[f"{grid.name}/probes"] = np.concatenate([corners, corners + grid.tiles.sizes[:, None] - 1])
        where[f"{grid.name}/points"] = POINTS
    np.savez(path, **where)


def actives(grid: Grid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest and highest index and value of all active voxels and tiles."""
    leaf, *inside = np.nonzero(grid.masks)
    voxels = grid.origins[leaf].astype(np.int64) + np.stack(inside, 1)
    on = grid.tiles.active
    low = np.concatenate([voxels, grid.tiles.origins[on]])
    high = np.concatenate([voxels, grid.tiles.origins[on].astype(np.int64) + grid.tiles.sizes[on, None] - 1])
    return low, high, np.concatenate([grid.values[grid.masks], grid.tiles.values[on]])


def agrees(grid: Grid, kind: str, mapping: str, found: dict[str, np.ndarray], about: dict[str, Any]) -> None:
    """Values, active masks, tiles, transform and metadata are the same, to the bit."""
    low, high, values = actives(grid)
    mine, theirs = np.lexsort(np.hstack([high, low]).T), np.lexsort(np.hstack([found["high"], found["low"]]).T)
    np.testing.assert_array_equal(low[mine], found["low"][theirs])
    np.testing.assert_array_equal(high[mine], found["high"][theirs])
    np.testing.assert_array_equal(values[mine].astype(np.float64), found["value"][theirs])
    np.testing.assert_array_equal(grid.values, found["blocks"])  # inactive voxels too
    np.testing.assert_array_equal(np.concatenate([grid.tiles.values] * 2).astype(np.float64), found["probed"])
    np.testing.assert_array_equal(np.concatenate([grid.tiles.active] * 2), found["on"])
    np.testing.assert_array_equal(grid.background.astype(np.float64), found["background"])
    np.testing.assert_allclose(
        POINTS @ grid.transform[:3, :3].T + grid.transform[:3, 3], found["world"], rtol=1e-14, atol=1e-14
    )
    np.testing.assert_allclose(grid.voxel_size, found["voxel_size"], rtol=1e-14)
    assert (about["name"], about["class"], about["half"]) == (grid.name, grid.kind, grid.half)
    assert about["map"] == mapping and kind.startswith(f"Tree_{about['type']}_")
    assert about["active"] == grid.active_voxels == found["count"].sum() and about["leaves"] == len(grid.values)
    if grid.bounds is not None:
        assert about["box"] == [list(grid.bounds[0]), [v - 1 for v in grid.bounds[1]]]
    for key, value in grid.metadata.items():
        if isinstance(value, (str, bool, int, float, tuple)):
            assert about["metadata"].get(key) == (list(value) if isinstance(value, tuple) else value), key


def compare(python: str, path: Path, tmp_path: Path) -> list[Grid]:
    """Our reading of a file against OpenVDB's."""
    header = read_header(path)
    grids = list(read_grids(path, level_sets=True))
    query(grids, tmp_path / "query.npz")
    ask(python, "read", path, tmp_path / "query.npz", tmp_path / "found.npz")
    with np.load(tmp_path / "found.npz") as file:
        found = {name: file[name] for name in file.files}
    about = json.loads(str(found["about"]))
    assert sorted(g["name"] for g in about["grids"]) == sorted(g.name for g in grids)
    for key, value in header.metadata.items():
        if isinstance(value, (str, bool, int, float, tuple)):
            assert about["metadata"].get(key) == (list(value) if isinstance(value, tuple) else value), key
    for number, text in enumerate(about["grids"]):
        arrays = {name.split("/", 1)[1]: value for name, value in found.items() if name.startswith(f"{number}/")}
        entry = header.grid(text["name"])
        agrees(next(g for g in grids if g.name == text["name"]), entry.type, entry.map, arrays, text)
    return grids
