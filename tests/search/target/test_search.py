"""The search on synthetic curves: it finds the least count, in few trials, or says that there is none."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable

import pytest

from neuprim.search.target.search import Curve, Proposal, climb, propose

Quality = Callable[[int], float]


def searched(quality: Quality, start: int, lowest: int, highest: int, doubt: float = 0.3) -> tuple[Proposal, list[int]]:
    """What is proposed in the end, and what was tried."""
    tried = [(start, quality(start))]
    for _ in range(12):
        proposal = propose(tried, lowest, highest, 0.0, doubt)
        if proposal.kind != "try":
            return proposal, [count for count, _ in tried]
        assert lowest <= proposal.primitives <= highest
        tried.append((proposal.primitives, quality(proposal.primitives)))
    raise AssertionError(tried)


def saturating(limit: float, target: float) -> Quality:
    """dB less the target: every doubling gains less; 20 dB below the limit at one primitive."""
    return lambda n: limit - 20 * 0.8 ** math.log2(n) - target


def least(quality: Quality, highest: int) -> int:
    low, high = 1, highest
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if quality(middle) >= 0 else (middle, high)
    return high


@pytest.mark.parametrize("target", [24.0, 28.0, 30.0, 32.0])
@pytest.mark.parametrize("start", [50, 1000, 20_000])
def test_the_least_count_is_found_in_few_trials(target: float, start: int) -> None:
    quality = saturating(34.0, target)
    proposal, tried = searched(quality, start, 1, 100_000)
    assert proposal.kind == "take" and len(tried) <= 6
    assert abs(quality(proposal.primitives)) < 0.3
    assert 1 / 1.15 < proposal.primitives / least(quality, 100_000) < 1.15


def test_noise_costs_little() -> None:
    ratios = []
    for seed in range(20):
        noise = random.Random(seed)
        quality = saturating(34.0, 29.0)
        known: dict[int, float] = {}
        proposal, tried = searched(lambda n: known.setdefault(n, quality(n) + noise.gauss(0, 0.1)), 1000, 1, 100_000)  # noqa: B023
        assert proposal.kind == "take" and len(tried) <= 8
        ratios.append(proposal.primitives / least(quality, 100_000))
    assert all(0.7 < ratio < 1.4 for ratio in ratios) and 0.9 < sum(ratios) / len(ratios) < 1.15


def test_what_saturates_below_the_target_is_out_of_reach() -> None:
    proposal, tried = searched(saturating(29.0, 31.0), 500, 1, 5000)
    assert proposal.kind == "unreachable" and len(tried) <= 5


def test_what_is_hopeless_is_said_after_two_sizes() -> None:
    proposal, tried = searched(lambda n: 0.1 * math.log2(n) - 20.0, 500, 1, 100_000)
    assert proposal.kind == "unreachable" and len(tried) == 2


def test_what_is_missed_by_less_than_the_doubt_is_worth_a_run() -> None:
    assert propose([(500, -1.0), (5000, -0.2)], 1, 5000, 0.0, 0.5) == Proposal("take", 5000)


def test_the_least_possible_is_taken_where_even_that_is_enough() -> None:
    proposal, _ = searched(lambda n: 5.0 + 0.1 * math.log2(n), 500, 20, 5000)
    assert proposal == Proposal("take", 20)


def test_two_sizes_are_far_enough_apart_to_tell_a_slope() -> None:
    proposal = propose([(1000, 0.01)], 1, 100_000)
    assert proposal.kind == "try" and abs(math.log2(proposal.primitives / 1000)) >= 0.49


def test_nothing_but_one_size_is_possible() -> None:
    assert propose([(7, -3.0)], 7, 7).primitives == 7


# ---------------------------------------------------------------- without a target of quality


def climbed(quality: Quality, start: int, highest: int) -> int:
    tried = [(start, quality(start))]
    for _ in range(12):
        proposal = climb(tried, 1, highest)
        if proposal.kind == "take":
            return proposal.primitives
        assert proposal.primitives not in dict(tried)
        tried.append((proposal.primitives, quality(proposal.primitives)))
    raise AssertionError(tried)


def test_a_limit_is_filled_while_that_brings_something() -> None:
    assert climbed(saturating(34.0, 0.0), 200, 3000) == 3000


def test_a_limit_below_the_start_is_kept() -> None:
    assert climbed(saturating(34.0, 0.0), 200, 200) == 200


def test_a_limit_is_not_filled_for_nothing() -> None:
    assert climbed(lambda n: min(20 + math.log2(n), 30.0), 200, 1_000_000) < 100_000


# ---------------------------------------------------------------- the curve


def test_the_curve_never_falls() -> None:
    curve = Curve.through([(100, 1.0), (200, 3.0), (400, 2.0), (800, 4.0)])
    values = [curve.at(n) for n in range(50, 2000, 25)]
    assert all(a <= b + 1e-12 for a, b in itertools.pairwise(values))
    assert curve.at(200) == curve.at(400) == 2.5 and curve.at(800) == 4.0


def test_beyond_the_sizes_tried_every_doubling_gains_less() -> None:
    curve = Curve.through([(100, 0.0), (200, 1.0)])
    assert curve.at(400) == pytest.approx(1.65) and curve.at(2**30) < 3.0
    assert curve.count_for(1.65, 1, 100_000) == pytest.approx(400, abs=1) and curve.count_for(5.0, 1, 10**9) is None
