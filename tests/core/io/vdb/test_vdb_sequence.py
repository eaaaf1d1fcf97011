"""Folders of frames, and the command that shows them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from neuprim.cli import main
from neuprim.core.io.vdb import VdbGrid, list_vdb_files, vdb_scale_transform, write_vdb
from tests.core.io.vdb.vdb_bytes import one_grid, one_leaf, refused


def frame(path: Path, size: int, voxel: float = 1.0, name: str = "density", value: float = 1.0) -> Path:
    write_vdb(path, [VdbGrid.from_dense(name, np.full((size,) * 3, value), transform=vdb_scale_transform(voxel))])
    return path


def test_sorted_by_number_with_gaps(tmp_path: Path) -> None:
    for number in (10, 9, 0, 1, 14):
        frame(tmp_path / f"fire_a2_{number}.vdb", 1)
    (tmp_path / "notes_3.txt").write_text("no frame")
    found = list_vdb_files(tmp_path)
    assert [f.number for f in found.frames] == [0, 1, 9, 10, 14] and len(found) == 5
    assert found.gaps == ((2, 8), (11, 13))


def test_folders_that_are_no_sequence(tmp_path: Path) -> None:
    refused(lambda: list_vdb_files(tmp_path / "gone"), "gone", "no such folder")
    refused(lambda: list_vdb_files(tmp_path / ("x" * 300)), "cannot be read", "expected a folder")
    refused(lambda: list_vdb_files(tmp_path), "no .vdb files found")
    frame(tmp_path / "a_1.vdb", 1)
    frame(tmp_path / "b_1.vdb", 1)
    refused(lambda: list_vdb_files(tmp_path), "'a_', 'b_'", "choose one by the path of one of its files")
    for name in ("b_1.vdb", "b_7.vdb", "b_%04d.vdb", "b_####.vdb", "b_@.vdb", "b_*.vdb"):
        assert [frame.path.name for frame in list_vdb_files(tmp_path / name).frames] == ["b_1.vdb"]
    refused(lambda: list_vdb_files(tmp_path / "c_#.vdb"), "c_#.vdb: no .vdb files found")
    (tmp_path / "notes.txt").touch()
    refused(lambda: list_vdb_files(tmp_path / "notes.txt"), "notes.txt", "is a file")
    frame(tmp_path / "b_01.vdb", 1)
    refused(lambda: list_vdb_files(tmp_path / "b_#.vdb"), "frame 1", "b_01.vdb")
    frame(tmp_path / "smoke.vdb", 1)
    refused(lambda: list_vdb_files(tmp_path), "smoke.vdb", "no frame number")


# ---------------------------------------------------------------- neuprim vdb info


def test_info_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frame(tmp_path / "a_2.vdb", 4, 0.5)
    frame(tmp_path / "a_10.vdb", 0)
    frame(tmp_path / "a_3.vdb", 2, value=float("inf"))
    assert main(["vdb", "info", str(tmp_path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [Path(f["path"]).name for f in report["files"]] == ["a_2.vdb", "a_3.vdb", "a_10.vdb"]
    assert report["notes"] == ["3 frames, 2 to 10; missing: 4–9"]
    first, second, last = (f["grids"][0] for f in report["files"])
    assert first["voxel_size"] == [0.5] * 3 and first["bounds"] == [[0, 0, 0], [4, 4, 4]]
    assert first["active_voxels"] == 64 and first["range"] == [1.0, 1.0] and first["dense_bytes"] == 256
    assert first["compression"] == "blosc + active values"
    assert second["non_finite"] == 8 and second["range"] is None
    assert last["bounds"] is None and last["active_voxels"] == 0


def test_info_of_a_sequence_is_one_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    frame(tmp_path / "a_2.vdb", 4, 0.5)
    frame(tmp_path / "a_3.vdb", 0)
    frame(tmp_path / "a_4.vdb", 2, value=float("inf"))
    assert main(["vdb", "info", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert len(out.splitlines()) < 10 and "3 frames, 2 to 4; missing: none" in out
    assert "0 to 64" in out and "0:4 0:4 0:4" in out and "0.5 0.5 0.5 or 1 1 1" in out
    assert "8 active values are NaN or infinite" in out
    assert main(["vdb", "info", str(tmp_path), "--frames"]) == 0
    out = capsys.readouterr().out
    assert all(f"a_{number}.vdb" in out for number in (2, 3, 4))


def test_info_shows_what_is_not_read_and_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one_grid(tmp_path / "b.vdb", b"noise", b"", name="points\x1b[31m", kind="Tree_ptdataidx32_5_4_3_Mask")
    leaf = one_leaf(np.ones(512, bool), b"\0" + bytes(2048), bytes(4))
    one_grid(tmp_path / "a.vdb", *leaf, name="sdf", kept={"class": ("string", b"level set")})
    assert main(["vdb", "info", str(tmp_path)]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "\x1b" not in out and "not read; holds points" in out
    assert "is a level set" in out and "no frame number" in out


def test_info_refuses_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.vdb").write_bytes(b"no volume at all")
    for words in (
        ["vdb", "info", str(tmp_path / "a.vdb")],
        ["vdb", "info", str(tmp_path / "b.vdb")],
        ["vdb", "show", "x"],
        ["vdb"],
    ):
        assert main(words) == 2
        streams = capsys.readouterr()
        assert streams.out == "" and streams.err.count("\n") == 1 and streams.err.startswith("neuprim: error:")
