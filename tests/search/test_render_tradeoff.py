"""``neuprim tradeoff RUN_DIR`` on a tiny run: what it measures, keeps, writes and refuses."""

from __future__ import annotations

import json
import time
from pathlib import Path

import pytest
import torch

from neuprim.cli import main
from neuprim.core.errors import ConfigError
from neuprim.runs.measure import evaluate_run
from neuprim.search import render_tradeoff as engine
from neuprim.search.render_tradeoff import measure_tradeoff
from neuprim.search.tradeoff_measuring import TimedPoint, TradeoffRequest, load_tradeoff_setup, time_tradeoff_points
from neuprim.search.tradeoff_record import TradeoffPoint, TradeoffRecord, read_tradeoff_record
from tests.search.tradeoff_runs import copied, tiny_run

QUICK = ("alpha_min", "resolution", "colour.degree", "density.neurons")
"""Knobs that compile nothing more."""


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_run(tmp_path_factory.mktemp("tradeoff"))


@pytest.fixture(scope="module")
def measured(bare: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TradeoffRecord]:
    run_dir = copied(bare, tmp_path_factory.mktemp("measured") / "run it")
    return run_dir, measure_tradeoff(run_dir, TradeoffRequest((), 120.0, 2, 3, QUICK))


def test_every_value_of_every_knob_is_measured(measured: tuple[Path, TradeoffRecord]) -> None:
    _, record = measured
    knobs = [point.knob for point in record.points]
    counts = {name: knobs.count(name) for name in ("reference", *QUICK)}
    assert counts == {"reference": 1, "alpha_min": 7, "resolution": 3, "colour.degree": 3, "density.neurons": 4}
    assert "combined" in knobs and len({point.words for point in record.points}) == len(record.points)
    for point in record.points:
        assert len(point.ms) == len(point.ratios) >= 3 and min(point.ms) > 0
        assert {"psnr", "ssim", "ssim_3dgs"} == point.quality.keys()
        assert (point.knob == "combined") == (len(point.words) > 1)
    assert record.speed and record.size and set(record.points[0].ratios) == {1.0}


def test_the_reference_has_the_numbers_of_eval(measured: tuple[Path, TradeoffRecord]) -> None:
    run_dir, record = measured
    metrics, reference = evaluate_run(run_dir), record.points[0]
    assert all(reference.quality[name] == metrics[name] for name in ("psnr", "ssim", "ssim_3dgs"))
    assert reference.bytes == (run_dir / "model.safetensors").stat().st_size


def test_outputs_and_what_is_kept(measured: tuple[Path, TradeoffRecord], monkeypatch: pytest.MonkeyPatch) -> None:
    run_dir, record = measured
    folder = run_dir / "tradeoff"
    assert read_tradeoff_record(folder / "tradeoff.json") == record
    page = (folder / "tradeoff.html").read_text(encoding="utf-8")
    assert "neuprim render" in page and (folder / "front.png").stat().st_size > 1000
    monkeypatch.setattr(engine, "measure_point", lambda *args: pytest.fail("measured again"))
    told: list[str] = []
    again = measure_tradeoff(run_dir, TradeoffRequest((), 120.0, 2, 3, QUICK), told.append)
    assert len(told) == 1 and "are kept" in told[0] and again.points == record.points


def test_another_reference_is_measured_anew_and_nothing_fits_no_budget(bare: Path, tmp_path: Path) -> None:
    run_dir = copied(bare, tmp_path / "run")
    measure_tradeoff(run_dir, TradeoffRequest((), 0.001, 1, 1, ("sort",)))
    told: list[str] = []
    words = ["resolution=0.5"]
    record = measure_tradeoff(run_dir, TradeoffRequest(words, 0.001, 1, 1, ("resolution",)), told.append)
    assert "made with another reference" in told[0] and [p.words for p in record.points] == [("resolution=0.5",)]
    assert {one.reason for one in record.left_out} == {"no time left of the budget of 0.001 s"}


def test_the_command_prints_the_fronts(bare: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run_dir = copied(bare, tmp_path / "run")
    words = [
        "tradeoff",
        str(run_dir),
        "--views",
        "1",
        "--repeats",
        "1",
        "--vary",
        "resolution,sort",
        "renderer.alpha_min=0.01",
        "--out",
        str(tmp_path / "set"),
    ]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert (
        "front of speed" in out
        and "front of size" in out
        and str(tmp_path / "set" / "tradeoff.html") in out.replace("\n", "")
    )
    assert json.loads((tmp_path / "set" / "tradeoff.json").read_text())["same"]["reference"] == [
        "renderer.alpha_min=0.01"
    ]
    for more, text in (
        (["--vary", "alpha"], "--vary alpha: no such setting of this run"),
        (["budget=x"], "budget=x: expected"),
        (["--out", str(run_dir)], f"--out {run_dir}: has other files"),
    ):
        assert main(["tradeoff", str(run_dir), *more]) == 2
        assert text in capsys.readouterr().err


def test_a_word_that_cannot_be_drawn_is_refused(bare: Path) -> None:
    with pytest.raises(ConfigError, match=r"colour\.degree"):
        measure_tradeoff(bare, TradeoffRequest(["colour.degree=9"]))


def test_rounds_time_the_reference_beside_each_point(bare: Path) -> None:
    setup = load_tradeoff_setup(bare, (), 2)

    def renderer(seconds: float):  # type: ignore[no-untyped-def]
        def draw(view: object) -> torch.Tensor:
            time.sleep(seconds)
            return torch.zeros(1)

        return lambda: draw

    points = [TradeoffPoint(name, (), {}, 0) for name in ("reference", "slow", "timed before")]
    points[2].ms, points[2].ratios = [1.0, 1.0], [1.0, 1.0]
    timed = [TimedPoint(p, renderer(s)) for p, s in zip(points, (0.002, 0.008, 0.002), strict=True)]
    rounds: list[tuple[int, int]] = []
    time_tradeoff_points(timed, 3, setup.views, time.monotonic() + 60, lambda *one: rounds.append(one))
    assert [len(p.ms) for p in points] == [3, 3, 3] and rounds == [(1, 3), (2, 3), (3, 3)]
    assert set(points[0].ratios) == {1.0} and all(2 < ratio < 6 for ratio in points[1].ratios)
    time_tradeoff_points(timed, 9, setup.views, 0.0, lambda *one: None)
    assert len(points[0].ms) == 4, "one round after the deadline"
