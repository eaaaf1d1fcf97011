"""A sweep from the command line to its table and page: what fails, what goes on, and who may work where."""

from __future__ import annotations

import csv
import errno
import json
from pathlib import Path
from typing import Any

import pytest

from neuprim.cli import main
from neuprim.core import checkpoint
from neuprim.runs.open import lock_run_directory
from neuprim.runs.sweep import read_launch_record
from tests.core import tiny
from tests.short_runs import command_line, words


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("data") / "two")


def typed(scene: Path, out: Path, *more: str) -> list[str]:
    own = [word for word in words(scene, out, 20) if not word.startswith("seed=")]
    return ["run", "-m", *command_line(own), "seed=1,2,3", *more]


def table(out: Path) -> list[dict[str, str]]:
    with open(out / "sweep.csv", encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """For the run of one seed."""
    write = checkpoint.save_model

    def refuse(path: Path, *args: Any, **more: Any) -> None:
        if path.parent.name == "seed-2":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write(path, *args, **more)

    monkeypatch.setattr(checkpoint, "save_model", refuse)


def test_one_fails_the_others_are_compared_and_resume_makes_the_rest(
    scene: Path, tmp_path: Path, full_disk: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sweep"
    assert main(typed(scene, out)) == 2
    said = capsys.readouterr()
    assert [line for line in said.err.splitlines() if "error" in line] == [
        f"neuprim: error: {out / 'seed-2'}: {out / 'seed-2' / 'model.safetensors'}: No space left on device"
    ]
    assert said.out.splitlines() == [
        *(
            line
            for n in (1, 2, 3)
            for line in (f"[{n}/3] {out / f'seed-{n}'}", str(out / f"seed-{n}"))
            if line != str(out / "seed-2")
        ),
        str(out / "sweep.html"),
    ]
    rows = table(out)
    assert [(r["run"], r["seed"], r["state"], r["attempts"]) for r in rows] == [
        ("seed-1", "1", "done", "1"), ("seed-2", "2", "failed", "1"), ("seed-3", "3", "done", "1"),
    ]  # fmt: skip
    metrics = json.loads((out / "seed-1" / "metrics.json").read_text())
    assert float(rows[0]["psnr"]) == metrics["psnr"] and rows[0]["model_bytes"] == str(metrics["model_bytes"])
    assert (
        rows[1]["psnr"] == "" and rows[1]["error"].endswith("No space left on device") and rows[0]["path"] == "seed-1"
    )
    page = (out / "sweep.html").read_text()
    assert "<strong>seed-2 failed:</strong>" in page and "No space left on device" in page

    monkeypatch.undo()
    before = {n: (out / f"seed-{n}" / "metrics.json").stat().st_mtime_ns for n in (1, 3)}
    assert main(["run", "-m", "--out", str(out), "resume=true"]) == 0, "sweep.json has the words"
    assert "[2/3]" in (said := capsys.readouterr()).out and "[1/3]" not in said.out
    assert [r["state"] for r in table(out)] == ["done"] * 3 and "failed" not in (out / "sweep.html").read_text()
    assert before == {n: (out / f"seed-{n}" / "metrics.json").stat().st_mtime_ns for n in (1, 3)}, (
        "what is done is kept"
    )

    assert main(typed(scene, out, "resume=true", "model.primitives=9")) == 2
    assert f"{out / 'sweep.json'}: seed-1 was started with task=static" in capsys.readouterr().err
    more = [w if not w.startswith("seed=") else "seed=3,4" for w in typed(scene, out, "resume=true")]
    assert main(more) == 0, "values may be added"
    assert [r["run"] for r in table(out)] == ["seed-3", "seed-4", "seed-1", "seed-2"]


def test_two_launchers_on_one_directory(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "sweep"
    with lock_run_directory(out, "sweep"):
        assert main(typed(scene, out, "resume=true")) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"neuprim: error: {out}: process ") and "is using this sweep" in line
        assert [p.name for p in out.iterdir()] == [".lock"]


def test_a_duplicated_run_is_refused_and_the_sweep_goes_on(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "sweep"
    with lock_run_directory(out / "seed-2"):
        assert main(typed(scene, out, "train.iterations=1", "resume=true")) == 2
    record = read_launch_record(out / "sweep.json")
    assert record is not None
    refused = [(row.state, "is using this run" in row.line) for row in record.runs]
    assert refused == [("done", False), ("failed", True), ("done", False)]
    assert "neuprim: error:" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["launcher=processes", "launcher.workers=100000"], "launcher.workers=100000: needs more than the"),
        (["launcher=slurm", "launcher.address=moon"], "launcher.address=moon: expected slurm or local"),
        (
            ["launcher=slurm", "launcher.address=local", "launcher.options.color=3"],
            "launcher.options: submitit refuses these options",
        ),
    ],
)
def test_a_launcher_that_is_refused_leaves_nothing(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str
) -> None:
    if "launcher=slurm" in more:
        pytest.importorskip("submitit")
    assert main(typed(scene, tmp_path / "sweep", *more)) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line and not (tmp_path / "sweep").exists()


def test_nothing_to_sweep_and_a_damaged_record_are_said(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "-m", "--out", str(tmp_path), "resume=true"]) == 2
    assert "no values to sweep; expected KEY=A,B,C, or resume=true with --out DIR of a sweep" in capsys.readouterr().err
    for text in ("{", "[]", '{"format": 9}', '{"format": 1, "words": [], "runs": [{"name": "../x"}]}'):
        (tmp_path / "sweep.json").write_text(text)
        assert main(["run", "-m", "--out", str(tmp_path), "resume=true"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"{tmp_path / 'sweep.json'}: " in line and "another --out DIR begins anew" in line
