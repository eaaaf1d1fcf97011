"""Exported sequences as other programs see them: Debian's OpenVDB, and fileseq, with which pipelines find sequences."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from neuprim.core.io.vdb import read_grid
from neuprim.runs.export import export_run
from neuprim.runs.render_images import RenderRequest, render_run
from tests.plugins import marked

pytestmark = pytest.mark.slow

PYTHON = Path("/usr/bin/python3")  # of the system, for which Debian's python3-openvdb is
_READ = """
import json, sys, pyopenvdb
found = {}
for grid in pyopenvdb.readAllGridMetadata(sys.argv[1]):
    grid = pyopenvdb.read(sys.argv[1], grid.name)
    read = grid.getConstAccessor()
    points = json.loads(sys.argv[2])
    found[grid.name] = {
        "class": grid.gridClass, "active": grid.activeVoxelCount(), "values": [read.getValue(tuple(p)) for p in points],
        "world": [grid.transform.indexToWorld(tuple(p)) for p in points], "half": grid.saveFloatAsHalf,
        "frame": grid["neuprim_time"] if "neuprim_time" in grid else None}
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sequence")
    return marked.dynamic_run(folder / "run", marked.write_sequence(folder / "files"), data={"frames": [3, 5]})


def test_openvdb_reads_the_same_grids(sequence: Path, tmp_path: Path) -> None:
    if not PYTHON.exists() or subprocess.run([PYTHON, "-c", "import pyopenvdb"], capture_output=True).returncode:
        pytest.skip("needs OpenVDB for Python: apt install python3-openvdb")
    files = export_run(sequence, "vdb", tmp_path / "out", ["emission=true", "half=false", "fps=24"]).files
    for path in files:
        own = {name: read_grid(path, name) for name in ("density", "emission")}
        (low, high), dense = own["density"].bounds or ((0,) * 3, (0,) * 3), own["density"].to_dense()
        random = np.random.default_rng(0)
        points = (np.array(low) + random.integers(0, np.subtract(high, low), (50, 3))).tolist()
        command = [PYTHON, "-c", _READ, str(path), json.dumps(points)]
        found = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
        assert found.keys() == own.keys() and found["density"]["class"] == "fog volume"
        for name, grid in own.items():
            assert found[name]["active"] == grid.active_voxels
            places = np.array(points) @ grid.transform[:3, :3].T + grid.transform[:3, 3]
            np.testing.assert_allclose(found[name]["world"], places)
        values = [dense[tuple(np.subtract(point, low))] for point in points]
        np.testing.assert_array_equal(np.float32(found["density"]["values"]), values)


def test_fileseq_sees_one_sequence(sequence: Path, tmp_path: Path) -> None:
    fileseq = pytest.importorskip("fileseq", reason="needs fileseq: pip install fileseq")
    export_run(sequence, "vdb", tmp_path / "vdb")
    export_run(sequence, "gaussian-ply", tmp_path / "ply", ["--time=0,0.5,1", "size=moments"])
    for folder, frames in (("exr", "3-5"), ("odd", "3-5x2")):
        request = RenderRequest("orbit", (16, 12), "exr", tmp_path / folder, frame=frames, layers="beauty,alpha")
        render_run(sequence, request)
    for folder, expected in (("vdb", "3-5"), ("ply", "3-5"), ("exr", "3-5"), ("odd", "3,5")):
        (found,) = fileseq.findSequencesOnDisk(str(tmp_path / folder))
        assert sorted(found.frameSet()) == sorted(fileseq.FrameSet(expected)) and found.zfill() == 4
