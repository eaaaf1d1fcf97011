"""A record of trainings, read with a target in mind: forecasts of sizes, limits, and settings that were turned
since."""

from __future__ import annotations

import pytest

from neuprim.config.target import Target
from neuprim.search.target.knobs import pays
from neuprim.search.target.record import Turn
from tests.search.target_records import attempt, judge

PAIR = (attempt(100, 100, 23.0), attempt(100, 200, 24.0), attempt(400, 100, 25.0), attempt(400, 200, 26.0))


def test_trials_promise_what_a_full_run_has() -> None:
    assert [(n, round(m, 2)) for n, m in judge(Target(psnr=25), *PAIR).tried()] == [(100, 0.31), (400, 2.31)]


def test_a_longer_trial_moves_the_promises_of_the_others_the_less_the_further_they_are() -> None:
    before, after = judge(Target(psnr=25), *PAIR), judge(Target(psnr=25), *PAIR, attempt(100, 400, 24.2, "longer"))
    assert dict(after.tried())[100] < dict(before.tried())[100]
    moved = {n: dict(after.tried())[n] - dict(before.tried())[n] for n in (100, 400)}
    assert moved[400] == pytest.approx(0.7**2 * moved[100])


def test_a_full_run_is_what_it_is_and_moves_the_others() -> None:
    found = dict(judge(Target(psnr=25), *PAIR, attempt(200, 800, 25.3, "full")).tried())
    assert found[200] == pytest.approx(0.3) and found[100] == pytest.approx(0.31 - 1.01, abs=0.02)


def test_between_two_full_runs_only_they_count() -> None:
    found = judge(Target(psnr=26.5), *PAIR, attempt(80, 800, 25.0, "full"), attempt(500, 800, 28.0, "full")).tried()
    assert [n for n, _ in found] == [80, 500]


def test_of_two_measures_the_lesser_margin_counts() -> None:
    both = judge(Target(psnr=20, ssim=0.99), *PAIR)
    assert dict(both.tried())[100] == dict(judge(Target(ssim=0.99), *PAIR).tried())[100] < 0
    assert both.predicted(100).keys() == {"psnr", "ssim"}


def test_what_a_turned_setting_costs_is_taken_off_the_trials_before_it() -> None:
    turns = [Turn("model.sh_degree", 3, 1, {"psnr": 0.5, "ssim": 0.2}, 0.6, True)]
    plain, turned = judge(Target(psnr=25), *PAIR), judge(Target(psnr=25), *PAIR, turns=turns)
    assert dict(turned.tried())[100] == pytest.approx(dict(plain.tried())[100] - 0.5)
    own = attempt(100, 200, 24.0, words={"model.sh_degree": 1})
    assert (
        judge(Target(psnr=25), own, turns=turns).forecasts()[100]["psnr"].value > turned.forecasts()[100]["psnr"].value
    )
    assert judge(Target(psnr=25), own).tried() == [], "made with a setting that was not turned"


def test_limits_are_read_off_lines() -> None:
    assert judge(Target(psnr=25), *PAIR).most() is None
    most = judge(Target(megabytes=0.011), *PAIR).most()
    assert most is not None and 1000 + 20 * most == pytest.approx(0.97 * 11_000, rel=0.01)
    fast = judge(Target(fps=50), attempt(100, 200, 24.0, ms=10.0), attempt(400, 200, 24.0, ms=40.0)).most()
    assert fast == pytest.approx(200, abs=1)


def test_a_setting_pays_if_primitives_can_make_up_for_it_in_fewer_bytes() -> None:
    assert pays(0.5, 0.5, 1.0) and not pays(1.0, 0.5, 1.0) and not pays(0.0, 0.99, 1.0)
