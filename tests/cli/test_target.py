"""``neuprim run`` with a target: what is refused, and what is printed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from neuprim.cli import main

TINY = (
    "task=static scene=solids scene.size=32 scene.train_views=16 scene.test_views=3 model.primitives=40 model.neurons=2 train.iterations=256 "
    "renderer.threads=1"
).split()


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["target.psnr=30"], "target.psnr=30: expected a budget beside it"),
        (["budget=5m"], "budget=5m: no target"),
        (
            ["target.psnr=30", "budget=5m", "-m", "model.sh_degree=0,1"],
            "target.psnr=30: a target is for one run; expected no -m beside it",
        ),
        (["target.psnr=30", "budget=5m", "model.primitive=3"], "model.primitive: no such setting"),
    ],
)
def test_one_line_and_status_2(words: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *TINY, *words]) == 2
    error = capsys.readouterr().err
    assert text in error and error.count("\n") == 1


def test_cfg_names_the_target_and_stops(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", *TINY, "target.ssim=0.9", "target.megabytes=2", "budget=5m", "--cfg"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("# target.ssim=0.9 target.megabytes=2 budget=300s; the search starts from\ntask:\n")


def test_help_names_the_words(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--help"]) == 0
    assert "target.psnr=DB budget=10m" in capsys.readouterr().out


def test_a_search_prints_what_it_tried_and_what_came_of_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)
    out = tmp_path / "run"
    assert main(["run", *TINY, "target.psnr=50", "budget=5m", f"output_dir={out}"]) == 0
    printed = capsys.readouterr()
    assert printed.out == f"{out}\n"
    for text in (
        "ms a step with 40 primitives",
        "static/solids: 40 primitives, 32 steps",
        "target.psnr=50 is out of reach",
        "full run: ",
        "predicted psnr ",
        "model.neuprim ",
        "s of 300 s used",
        "neuprim: warning: target.psnr=50 is missed: psnr ",
    ):
        assert text in printed.err, text


def test_an_interruption_says_what_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*args: Any, **where: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("neuprim.cli.target.run_target", interrupted)
    out = tmp_path / "run"
    assert main(["run", *TINY, "target.psnr=20", "budget=5m", f"output_dir={out}"]) == 130
    error = capsys.readouterr().err
    assert (
        f"{out} has the trials up to here" in error
        and f"target.psnr=20 budget=5m output_dir={out} resume=true" in error
    )
