"""How long steps take, by a clock that the tests move."""

from __future__ import annotations

import pytest

from neuprim.core.train.trainer import StepReport
from neuprim.runs.events import Preparing, Step, ignore_event
from neuprim.runs.training import COMPILING
from neuprim.search.target.pace import Stopwatch, linear


def step(number: int) -> Step:
    return Step(StepReport(number, 0.0, 0.0, {}, 20.0, 10, "view", None), 0.5)


def watched(times: list[float]) -> Stopwatch:
    """Steps that end at these times."""
    now = iter(times)
    watch = Stopwatch(lambda: next(now), ignore_event)
    for number in range(len(times)):
        watch(step(number))
    return watch


def test_one_slow_step_of_few_does_not_spoil_the_pace() -> None:
    assert watched([0.0, 1.0, 2.0, 30.0, 31.0, 32.0]).pace == pytest.approx(1.0)


def test_of_many_steps_the_mean_counts() -> None:
    assert watched([2.0 * i for i in range(50)] + [1000.0 + i for i in range(50)]).pace == pytest.approx(
        (1000 + 49) / 99
    )


def test_one_step_has_no_pace() -> None:
    assert watched([3.0]).pace is None


def test_compiling_is_told_apart() -> None:
    now = iter([10.0, 12.0, 70.0, 71.0])
    watch = Stopwatch(lambda: next(now), ignore_event)
    for event in (Preparing(COMPILING), Preparing(COMPILING), step(1), step(2)):
        watch(event)
    assert watch.compiling == 60.0 and watch.pace == pytest.approx(1.0)


def test_a_time_over_sizes_is_a_line_that_never_falls() -> None:
    assert linear([(100, 1.0)], 200) == pytest.approx(1.5), "half of it is taken to be the same for all"
    assert linear([(100, 1.0), (300, 3.0)], 200) == pytest.approx(2.0)
    assert linear([(100, 2.0), (300, 1.0)], 1000) == pytest.approx(1.5)
    assert linear([(100, 0.0), (300, 3.0)], 1) >= 0
