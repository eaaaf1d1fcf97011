"""Size searches: replays of the recorded grids, predictions, decisions, and limits."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from neuprim.config.command_settings import SearchTarget
from neuprim.search.size_forecast import (
    SizeCurve,
    SizePredictor,
    exceeded_limit,
    forecast_quality,
    format_target_forecast,
    from_forecast_decibels,
    propose_best_size,
    propose_size,
    to_forecast_decibels,
)
from neuprim.search.size_search import propose_setting_trial, setting_change_pays
from neuprim.search.target_record import Attempt, SettingChange, TargetRecord, forecast_time
from tests.search.simulated_search import attempt, from_grid, simulate_search

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
RESULTS = json.loads((BENCHMARKS / "results/target.json").read_text(encoding="utf-8"))
STARTS = {"solids": 400, "chair": 2800, "fire": 13500, "lit_solids": 2655}


@pytest.fixture(scope="module")
def smallest() -> Iterator[Callable[[Sequence[Mapping[str, Any]], float], float]]:
    """The benchmark's function: bytes of the smallest model of a grid that has a PSNR."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(BENCHMARKS))
        patch.setattr(sys, "dont_write_bytecode", True)
        yield importlib.import_module("target").smallest


def test_replays_of_the_recorded_grids_find_the_smallest_model(smallest: Any) -> None:
    """As the benchmark counts: bytes of the chosen full run over those of the grid's smallest with the target."""
    ratios = []
    for name, start in STARTS.items():
        grid, curves = RESULTS[name]["grid"], from_grid(RESULTS[name]["grid"])
        for run in RESULTS[name]["runs"]:
            chosen, _ = simulate_search(curves, SearchTarget(psnr=run["target"]), start, run["seed"])
            assert chosen.measured("psnr") >= run["target"], name
            ratios.append((chosen.packed / smallest(grid, run["target"]), name, run["target"], run["seed"]))
    assert len(ratios) == 15 and sum(ratio <= 1.15 for ratio, *_ in ratios) >= 13, ratios


@pytest.mark.parametrize("start", [20, 160, 3000])
def test_the_start_does_not_decide(smallest: Any, start: int) -> None:
    grid = RESULTS["solids"]["grid"]
    chosen, runner = simulate_search(from_grid(grid), SearchTarget(psnr=26.0), start)
    assert chosen.packed / smallest(grid, 26.0) <= 1.25 and runner.seconds_spent <= 60.0


def test_an_unreachable_target_is_reported_before_full_runs() -> None:
    _, runner = simulate_search(from_grid(RESULTS["solids"]["grid"]), SearchTarget(psnr=60.0), 160)
    reported = next(i for i, note in enumerate(runner.notes) if "target.psnr=60 is out of reach" in note)
    assert reported < next(i for i, note in enumerate(runner.notes) if note.startswith("full run"))


def test_limits_alone_are_used_up() -> None:
    chosen, _ = simulate_search(from_grid(RESULTS["chair"]["grid"]), SearchTarget(megabytes=0.03), 400)
    assert 0.6 * 30000 <= chosen.packed <= 30000


# ---------------------------------------------------------------- curves

PAIRS = st.lists(st.tuples(st.integers(1, 10**6), st.floats(-20, 20)), min_size=1, max_size=8, unique_by=lambda p: p[0])


@given(PAIRS, st.floats(-25, 25), st.integers(1, 10**7))
def test_curves_never_fall_and_find_what_they_predict(
    pairs: list[tuple[int, float]], wanted: float, highest: int
) -> None:
    curve = SizeCurve.fit(pairs)
    values = [curve.at(2.0**k) for k in range(25)]
    assert all(b >= a - 1e-9 for a, b in pairwise(values))
    found = curve.find_count(wanted, highest)
    if found is None:
        assert curve.at(highest) < wanted
    else:
        assert 1 <= found <= max(highest, 1) + 1 and (found == 1 or curve.at(found) >= wanted - 1e-6)


@given(PAIRS, st.integers(1, 10**6), st.floats(0, 3))
def test_proposals_stay_within_bounds(pairs: list[tuple[int, float]], highest: int, doubt: float) -> None:
    for proposal in (propose_size(pairs, highest, 0.1, doubt), propose_best_size(pairs, highest)):
        assert 1 <= proposal.primitives <= max(highest, *(count for count, _ in pairs))


def test_forecasts_follow_the_gains() -> None:
    assert forecast_quality({100: 20.0, 200: 21.0}, 200) == (21.0, 0.1)
    one, two = (forecast_quality({100: 20.0, 200: 21.0}, steps) for steps in (400, 800))
    assert one.value == pytest.approx(21.75) and two.value == pytest.approx(21.75 + 0.75**2) and two.doubt > one.doubt
    assert forecast_quality({100: 20.0, 200: 22.0, 400: 24.0}, 800).value > 25.5
    assert to_forecast_decibels("ssim", 0.9) == pytest.approx(10) and from_forecast_decibels(
        "ssim", 10
    ) == pytest.approx(0.9)
    assert format_target_forecast("psnr", 30, 0.5) == "psnr 30.00 ± 0.5 dB" and "ssim 0.9000" in format_target_forecast(
        "ssim", 0.9, 0.5
    )


def test_times_are_lines_that_neither_fall_nor_start_below_zero() -> None:
    assert forecast_time([(100, 2.0)], 200) == pytest.approx(3.0)
    assert forecast_time([(100, 2.0), (200, 3.0)], 400) == pytest.approx(5.0)
    assert forecast_time([(100, 3.0), (200, 2.0)], 400) == pytest.approx(2.5)
    assert forecast_time([(100, 1.0), (200, 5.0)], 1) >= 0


# ---------------------------------------------------------------- the record, read with a target


def predictor(target: SearchTarget, *attempts: Attempt, turns: Sequence[SettingChange] = ()) -> SizePredictor:
    record = TargetRecord({}, {}, length=200, attempts=list(attempts), turns=list(turns))
    return SizePredictor(target, record, lambda n: 800.0)


def test_full_runs_correct_the_forecasts_of_other_sizes() -> None:
    trials = [attempt(n, steps, q) for n, q in ((100, 24.0), (200, 26.0)) for steps, q in ((100, q - 1), (200, q))]
    before = dict(predictor(SearchTarget(psnr=26.0), *trials).margins())
    full = attempt(100, 800, before[100] + 26.0 - 2.0, "full")
    after = dict(predictor(SearchTarget(psnr=26.0), *trials, full).margins())
    assert after[100] == pytest.approx(before[100] - 2.0) and after[200] == pytest.approx(before[200] - 2.0)


def test_between_full_runs_that_bracket_the_target_only_these_count() -> None:
    trials = [attempt(n, 200, 20.0 + n / 100) for n in (100, 200, 300, 400)]
    full = [attempt(100, 800, 25.0, "full"), attempt(400, 800, 27.0, "full")]
    assert [n for n, _ in predictor(SearchTarget(psnr=26.0), *trials, *full).margins()] == [100, 400]


def test_the_least_measure_counts() -> None:
    both = predictor(SearchTarget(psnr=30.0, ssim=0.9), attempt(100, 800, 31.0, "full"))
    assert both.margin({"psnr": 31.0, "ssim": 0.8}) == pytest.approx(to_forecast_decibels("ssim", 0.8) - 10)
    assert both.measures == ("psnr", "ssim") and predictor(SearchTarget(megabytes=1)).margin({"psnr": 31.0}) == 31.0


def test_trainings_before_a_changed_setting_pay_its_loss() -> None:
    turn = SettingChange("model.neurons", 4, 2, {"psnr": 0.5}, 0.8, True)
    plain, changed = attempt(100, 800, 30.0, "full"), attempt(200, 800, 31.0, "full", words={"model.neurons": 2})
    other = attempt(300, 800, 33.0, "full", words={"model.neurons": 1})
    margins = dict(predictor(SearchTarget(psnr=29.0), plain, changed, other, turns=[turn]).margins())
    assert margins == {100: pytest.approx(0.5), 200: pytest.approx(2.0)}


def test_limits_of_bytes_and_speed() -> None:
    trials = [attempt(n, 200, 20.0, ms_per_frame=n / 100) for n in (100, 1000)]
    assert predictor(SearchTarget(megabytes=0.011), *trials).limit() == pytest.approx(483, abs=3)
    assert predictor(SearchTarget(fps=100), *trials).limit() == pytest.approx(1000, abs=2)
    assert predictor(SearchTarget(psnr=1), *trials).limit() is None
    assert "MB are more" in str(exceeded_limit(SearchTarget(megabytes=0.01), trials[1]))
    assert (
        "frames per second" in str(exceeded_limit(SearchTarget(fps=1000), trials[1]))
        and exceeded_limit(SearchTarget(fps=90), trials[1]) is None
    )


def test_settings_are_halved_while_that_pays() -> None:
    ladder = {"a": (0, 1, 2, 3, 4), "b": (0, 1)}

    def change(key: str, before: int, after: int, adopted: bool) -> SettingChange:
        return SettingChange(key, before, after, {}, 1.0, adopted)

    turns: list[SettingChange] = []
    assert propose_setting_trial(ladder, turns) == ("a", 4, 2)
    turns.append(change("a", 4, 2, True))
    assert propose_setting_trial(ladder, turns) == ("a", 2, 1)
    turns.append(change("a", 2, 1, False))
    assert propose_setting_trial(ladder, turns) == ("b", 1, 0)
    turns.append(change("b", 1, 0, True))
    assert propose_setting_trial(ladder, turns) is None
    assert propose_setting_trial(ladder, [change("a", 4, 2, False)]) == ("a", 4, 3)
    assert (
        setting_change_pays(0.4, 0.7, 1.0)
        and not setting_change_pays(0.6, 0.7, 1.0)
        and not setting_change_pays(0.0, 0.98, 1.0)
    )
