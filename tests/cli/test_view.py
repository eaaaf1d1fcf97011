"""``neuprim view`` and ``viewer=true`` as commands."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from neuprim.cli import main
from tests.core import tiny
from tests.short_runs import fit, words


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cli")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 4)
        return fit(words(tiny.write_blender(folder / "two"), folder / "run", 20))


def test_without_viser_it_says_how_to_get_it(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    for module in ("view", "server"):
        monkeypatch.delitem(sys.modules, f"neuprim.viewer.{module}", raising=False)
    for argv in (
        ["view", str(run_dir)],
        ["run", "task=static", "scene=solids", "viewer=true", "--out", f"{run_dir}-new"],
    ):
        assert main(argv) == 2
        assert "pip install 'neuprim[viewer]'" in capsys.readouterr().err
    assert not Path(f"{run_dir}-new").exists()


def test_an_address_that_others_reach_is_warned_of(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("viser", reason="the package viser is not installed")
    monkeypatch.setattr("neuprim.viewer.view.view_run", lambda *args: None)
    assert main(["view", str(run_dir), "--host", "0.0.0.0"]) == 0
    error = capsys.readouterr().err
    assert "other machines can reach the viewer at" in error and "ssh -L 8080:127.0.0.1:8080" in error
    assert main(["view", str(run_dir)]) == 0 and "warning" not in capsys.readouterr().err


def test_ctrl_c_ends_it(run_dir: Path) -> None:
    pytest.importorskip("viser", reason="the package viser is not installed")
    command = [sys.executable, "-m", "neuprim", "view", str(run_dir), "--port", "0"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=[\w-]{43}\n", process.stdout.readline())
    assert process.stdout.readline() == "open it in a browser; Ctrl-C ends the viewer\n"
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=30)
    assert (
        process.returncode == 0
        and error.splitlines()[-1] == "neuprim: the viewer is closed"
        and "Traceback" not in error + out
    )
    assert out == "", "nothing of viser's own"
