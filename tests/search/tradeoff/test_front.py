"""The front is a front, and combinations are those that lose least for what they gain."""

from __future__ import annotations

import itertools
import math

from hypothesis import given
from hypothesis import strategies as st

from neuprim.search.tradeoff.front import Move, Spot, chain, front

NUMBERS = st.integers(0, 8).map(float)
SPOTS = st.lists(st.builds(Spot, NUMBERS, NUMBERS), max_size=25)
DOUBTFUL = st.lists(st.builds(Spot, st.floats(0.1, 10), NUMBERS, st.floats(0, 2)), max_size=25)


def same(spot: Spot) -> Spot:
    return spot


def dominated(a: Spot, b: Spot) -> bool:
    """Whether b is as good for less, or better for as much."""
    return b.cost <= a.cost and b.quality >= a.quality and (b.cost < a.cost or b.quality > a.quality)


@given(SPOTS)
def test_without_doubt_it_is_all_that_nothing_dominates(spots: list[Spot]) -> None:
    found = front(spots, same)
    assert {(s.cost, s.quality) for s in found} == {
        (s.cost, s.quality) for s in spots if not any(dominated(s, other) for other in spots)
    }
    assert len({(s.cost, s.quality) for s in found}) == len(found), "equal points count once"


@given(DOUBTFUL)
def test_with_doubt_every_step_is_beyond_it(spots: list[Spot]) -> None:
    found = front(spots, same)
    assert bool(found) == bool(spots)
    for better, cheaper in itertools.pairwise(found):
        assert better.quality > cheaper.quality and cheaper.cost < better.cost - better.doubt - cheaper.doubt
    for spot in found:
        sure = [o for o in spots if o.quality > spot.quality and o.cost + o.doubt < spot.cost - spot.doubt]
        assert not sure, "nothing on the front is surely dominated"
    if spots:
        assert found[0].quality == max(s.quality for s in spots)


def test_equally_good_points_leave_the_first_unless_another_is_surely_cheaper() -> None:
    reference, luck, truly = Spot(1.0, 30.0, 0.05), Spot(0.95, 30.0, 0.05), Spot(0.5, 30.0, 0.05)
    assert front([reference, luck], same) == [reference]
    assert front([reference, luck, truly], same) == [truly]


def test_what_was_not_measured_is_on_no_front() -> None:
    assert front([Spot(math.nan, 40.0), Spot(1.0, math.nan), Spot(1.0, 3.0)], same) == [Spot(1.0, 3.0)]


def test_the_chain_joins_what_loses_least_for_its_gain() -> None:
    cheap, dear = Move("a", "a=1", 0.2, 0.01), Move("b", "b=1", 0.5, 1.0)
    further, free = Move("a", "a=2", 0.4, 0.5), Move("c", "c=1", 0.1, -0.2)
    assert chain([dear, further, cheap, free]) == [(free, cheap), (free, cheap, dear), (free, further, dear)]
    assert chain([cheap, further]) == [], "one knob is no combination"
    assert chain([Move("a", "a=1", 0.001, 0.0), Move("b", "b=1", -0.5, 0.0)]) == []


MOVES = st.lists(
    st.builds(
        lambda knob, value, gain, loss: Move(knob, f"{knob}={value}", gain, loss),
        st.sampled_from("abcd"), st.integers(0, 5), st.floats(-1, 3), st.floats(-1, 5),
    ),
    max_size=20,
)  # fmt: skip


@given(MOVES)
def test_every_combination_gains_more_than_the_one_before(moves: list[Move]) -> None:
    last = 0.0
    for combination in chain(moves):
        assert len({move.knob for move in combination}) == len(combination) >= 2
        assert set(combination) <= set(moves)
        gain = sum(move.gain for move in combination)
        assert gain > last
        last = gain
