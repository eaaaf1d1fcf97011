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


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["view", "nowhere"], "nowhere: no such run directory"),
        (["view", "{run}", "--port", "80000"], "--port 80000: expected a port, 1 to 65535, or 0 for any"),
        (["view", "{run}", "--prot", "1"], "--prot: no such argument of `neuprim view`; did you mean '--port'"),
        (["view", "{run}", "--host", "host.invalid"], "viewer at host.invalid, port 8080"),
        (["run", "-m", "viewer=true", "seed=1,2"], "viewer=true: shows one run; expected no -m beside it"),
        (
            ["run", "viewer=true", "target.psnr=20", "budget=1m"],
            "viewer=true: shows one run; expected no target beside it",
        ),
        (["run", "viewer.prot=1"], "viewer.prot: no such setting"),
    ],
)
def test_what_cannot_be_is_one_line(
    run_dir: Path, argv: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([word.format(run=run_dir) for word in argv]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("neuprim: error: ") and message in error


def test_help_names_the_flags(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", "--help"]) == 0
    assert {"--port N", "--host ADDRESS"} <= set(re.findall(r"--\w+ \w+", capsys.readouterr().out))


def test_without_viser_it_says_how_to_get_it(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    for argv in (
        ["view", str(run_dir)],
        ["run", "task=static", "scene=solids", "viewer=true", f"output_dir={run_dir}-new"],
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
    assert "reached from other machines, without encryption" in error and "ssh -L 8080:127.0.0.1:8080" in error
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
