"""``exports.json``: what a run directory says about the files that were made of it."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

import neuprim
from neuprim.cli import main
from neuprim.plugins.registry import EXPORTERS
from neuprim.runs.export import EXPORTS_FILE, export_run, import_run_directory
from tests.plugins.fakes import install, site
from tests.plugins.marked import static_run

__all__ = ["site"]

MANY = """
from neuprim.core.extensions import Exporter, ExportReport

def write(job):
    paths = tuple(job.out.parent / f"{i}.x" for i in range(job.count("count", 1, 100)))
    for path in paths:
        path.touch()
    return ExportReport(paths, False)

PLUGIN = Exporter(api=1, name="ply", summary="names of files", write=write,
                  options={"count": (1, "n"), "text": ("", "t"), "size": (1.0, "x")})
"""


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    return static_run(tmp_path / "r")


def record(folder: Path) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = json.loads((folder / EXPORTS_FILE).read_text())
    return entries


def test_each_export_adds_its_maker(exported: Path, tmp_path: Path, site: Path) -> None:
    install(
        site,
        "other-ply",
        {"ply": "other_ply:PLUGIN"},
        {"other_ply/__init__.py": MANY},
        version="7",
        group=EXPORTERS.entry_points,
    )
    started = datetime.now(UTC) - timedelta(seconds=1)
    export_run(exported, "neuprim:ply")
    report = export_run(exported, "Other_Ply:ply", words=["count=25", f"text={'t' * 5000}", "size=1e400"])
    export_run(exported, "npz", out=tmp_path / "elsewhere.npz")
    assert not [note for note in report.notes if EXPORTS_FILE in note]
    ours, theirs, outside = record(exported)
    assert datetime.fromisoformat(ours.pop("time")) > started
    assert ours == {
        "files": ["export/model.ply"],
        "format": "ply",
        "package": "neuprim",
        "version": EXPORTERS.find("neuprim:ply").version,
        "neuprim": neuprim.__version__,
        "options": {},
        "lossless": True,
    }
    assert (exported / ours["files"][0]).is_file()
    assert (theirs["format"], theirs["package"], theirs["version"], theirs["lossless"]) == (
        "ply",
        "other-ply",
        "7",
        False,
    )
    assert theirs["files"] == [f"export/{i}.x" for i in range(20)] and theirs["more_files"] == 5
    assert theirs["options"] == {"count": 25, "text": "t" * 500, "size": "inf"}
    assert outside["files"] == [str(tmp_path / "elsewhere.npz")]


def test_the_list_is_bounded(exported: Path) -> None:
    (exported / EXPORTS_FILE).write_text(json.dumps([{"format": str(i)} for i in range(500)]))
    export_run(exported, "npz")
    entries = record(exported)
    assert len(entries) == 200
    assert [e["format"] for e in entries[-2:]] == ["499", "npz"] and entries[0] == {"format": "301"}


def test_an_export_succeeds_where_the_list_cannot_be_written(
    exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (exported / EXPORTS_FILE).mkdir()
    assert main(["export", str(exported), "--format", "npz", "--out", str(tmp_path / "x.npz"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert f"{exported / EXPORTS_FILE}: not written (Is a directory); this export is not recorded" in report["notes"]
    assert (tmp_path / "x.npz").is_file()


@pytest.mark.parametrize("text", ["{", "{}", "[1]", "\xff", "[" * 100_000])
def test_a_file_that_is_no_list_of_exports_is_left_alone(text: str, exported: Path) -> None:
    (exported / EXPORTS_FILE).write_bytes(text.encode("latin-1"))
    notes = export_run(exported, "npz").notes
    assert any(EXPORTS_FILE in note and "expected a list of exports; left as it is" in note for note in notes), notes
    assert (exported / EXPORTS_FILE).read_bytes() == text.encode("latin-1")


def test_an_imported_run_starts_a_list_of_its_own(exported: Path, tmp_path: Path) -> None:
    export_run(exported, "npz", out=tmp_path / "x.npz")
    again = import_run_directory(tmp_path / "x.npz", tmp_path / "again")
    assert not (again / EXPORTS_FILE).exists() and len(record(exported)) == 1
    assert (import_run_directory(tmp_path / "x.npz", tmp_path / "third", "neuprim:npz") / "config.yaml").is_file()
