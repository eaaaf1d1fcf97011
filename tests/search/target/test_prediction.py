"""What longer runs will have, from short ones."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import pytest

import neuprim
from neuprim.search.target.prediction import decibels, forecast, ratio_of, undecibels

MEASURED = Path(neuprim.__file__).parents[1] / "benchmarks" / "results" / "budget.json"


def test_no_further_than_tried_is_what_was_tried() -> None:
    found = forecast({100: 20.0, 200: 21.0}, 200)
    assert found.value == 21.0 and found.doubt < 0.2


def test_every_doubling_gains_less_and_is_less_sure() -> None:
    found = [forecast({100: 20.0, 200: 21.0}, steps) for steps in (200, 400, 800, 1600)]
    gains = [b.value - a.value for a, b in itertools.pairwise(found)]
    assert gains[0] == pytest.approx(0.75) and gains[0] > gains[1] > gains[2] > 0
    assert all(a.doubt < b.doubt for a, b in itertools.pairwise(found))


def test_half_a_doubling_is_between() -> None:
    low, middle, high = (forecast({100: 20.0, 200: 21.0}, steps).value for steps in (200, 283, 400))
    assert low < middle < high and middle - low > high - middle


def test_a_model_that_got_worse_is_not_expected_to_fall_further() -> None:
    assert forecast({100: 21.0, 200: 20.8}, 1600).value == pytest.approx(20.8)


def test_three_lengths_tell_how_gains_shrink() -> None:
    steady, tired = forecast({100: 20.0, 200: 21.0, 400: 22.0}, 1600), forecast({100: 20.0, 200: 22.0, 400: 23.0}, 1600)
    assert steady.value - 22.0 > tired.value - 23.0
    assert 0.5 <= ratio_of([2.0, 0.1]) < ratio_of([2.0, 2.0]) <= 1.0


def test_one_length_goes_by_the_gain_of_others() -> None:
    assert forecast({200: 21.0}, 400, gain=2.0).value == pytest.approx(22.5)


def test_ssim_is_forecast_by_what_is_missing_to_one() -> None:
    assert decibels("psnr", 30.0) == 30.0
    assert decibels("ssim", 0.99) == pytest.approx(20.0) and undecibels("ssim", 20.0) == pytest.approx(0.99)
    assert decibels("ssim", 1.0) < 100


def test_what_was_measured_lies_within_the_doubt_mostly() -> None:
    """Two doublings ahead, over the surfaces of docs/budgets.md."""
    runs: dict[tuple[str, int], dict[int, float]] = {}
    for trial in json.loads(MEASURED.read_text(encoding="utf-8"))["trials"]:
        if trial["scene"] != "smoke_fire":
            runs.setdefault((trial["scene"], trial["seed"]), {})[trial["iterations"]] = trial["psnr"]
    inside, misses = 0, []
    for values in runs.values():
        steps = sorted(values)
        for a, b, end in zip(steps, steps[1:], steps[3:], strict=False):
            found = forecast({a: values[a], b: values[b]}, end)
            misses.append(abs(found.value - values[end]))
            inside += misses[-1] <= found.doubt
    assert len(misses) >= 9 and inside >= 0.7 * len(misses) and sum(misses) / len(misses) < 0.7
