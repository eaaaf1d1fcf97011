"""What the end of a run writes is of one model, and nobody else writes over it."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from neuprim.cli import main
from neuprim.config import compose
from neuprim.core import checkpoint, notices
from neuprim.core.errors import CheckpointError
from neuprim.core.io.files import write_text
from neuprim.core.notices import NeuprimWarning
from neuprim.runs.open import read_metrics, result_files
from neuprim.runs.run import run
from neuprim.runs.training import add_run_curve_line, cut_run_curve
from tests.core import tiny
from tests.short_runs import fit, words


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("data") / "two")


class Stop(Exception):
    pass


def test_a_resumed_run_has_no_results_until_its_own(scene: Path, tmp_path: Path) -> None:
    out = fit(words(scene, tmp_path / "run", 6))
    (out / "renders" / "mine.png").touch()
    assert {"metrics.json", "report.html", "orbit.webp", "worst_000.png"} <= {path.name for path in result_files(out)}

    def killed(*_: Any) -> None:
        raise Stop

    with pytest.raises(Stop):
        run(compose([f"output_dir={out}", "resume=true", "train.iterations=9"]), between=killed)
    assert not result_files(out) and (out / "model.safetensors").exists() and (out / "renders" / "mine.png").exists()
    run(compose([f"output_dir={out}", "resume=true"]))
    assert read_metrics(out)["iterations"] == 9


def test_a_picture_of_the_report_is_replaced_only_where_that_is_said(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = fit(words(scene, tmp_path / "run", 3))
    film = out / "renders" / "orbit.webp"
    before = film.read_bytes()
    words_of_film = ["render", str(out), "--camera", "orbit", "--frames", "2"]
    over = ["--out", str(out / "renders" / ".." / "renders" / "orbit.webp")]
    assert main([*words_of_film, *over]) == 2
    assert "orbit.webp: is a picture of the run's report; --force replaces it, --out PATH" in capsys.readouterr().err
    assert main([*words_of_film, "--format", "webp"]) == 0 and (out / "frames" / "orbit.webp").exists()
    assert film.read_bytes() == before
    assert main([*words_of_film, *over, "--force"]) == 0
    assert film.read_bytes() != before
    picture = next(path for path in result_files(out) if path.name.startswith("test_000"))
    assert main(["render", str(out), "--camera", "orbit", "--frames", "1", "--out", str(picture)]) == 2


def test_a_full_disk_costs_a_checkpoint_and_not_the_training(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(notices, "_said", set())
    failing, save_file = {3, 4}, checkpoint.save_file
    calls = 0

    def full(*given: Any, **more: Any) -> None:
        nonlocal calls
        calls += 1
        if calls in failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save_file(*given, **more)

    monkeypatch.setattr(checkpoint, "save_file", full)
    said = ["train.checkpoint_every_seconds=0"]
    with pytest.warns(
        NeuprimWarning,
        match=r"checkpoint\.safetensors: could not write .*No space left.*; training goes on from step 2 to the next",
    ):
        out = fit(words(scene, tmp_path / "run", 6, *said))
    assert read_metrics(out)["iterations"] == 6
    failing = set(range(10**3))
    monkeypatch.setattr(notices, "_said", set())
    calls = 0
    with (
        pytest.warns(NeuprimWarning),
        pytest.raises(CheckpointError, match=r"last/checkpoint\.safetensors: could not write"),
    ):
        fit(words(scene, tmp_path / "last", 3, *said))


def test_a_full_disk_names_the_file_and_keeps_lines_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    cut_run_curve(tmp_path / "metrics.jsonl", 0)
    add_run_curve_line(tmp_path / "metrics.jsonl", '{"step": 1}\n')
    assert (tmp_path / "metrics.jsonl").read_text() == '{"step": 1}\n', "at once"
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as refused:
        write_text(tmp_path / "report.html", "x")
    assert refused.value.filename == str(tmp_path / "report.html") and not list(tmp_path.glob(".*"))
