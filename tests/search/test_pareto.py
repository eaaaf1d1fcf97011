"""Pareto fronts against brute force, and combinations of single changes."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from neuprim.search.pareto import (
    Objectives,
    ParetoStep,
    chain_pareto_steps,
    combine_pareto_steps,
    pareto_front,
    thin_pareto_chain,
)

VALUES = st.integers(0, 6).map(float)
POINTS = st.lists(st.tuples(VALUES, VALUES).map(lambda pair: Objectives(*pair)), max_size=12)


@given(POINTS)
def test_the_front_is_that_of_brute_force(points: list[Objectives]) -> None:
    front = pareto_front(points, lambda p: p)
    for p in points:
        better = any(o.cost <= p.cost and o.quality >= p.quality and o[:2] != p[:2] for o in points)
        assert (p[:2] in [f[:2] for f in front]) != better
    assert [f.quality for f in front] == sorted({f.quality for f in front}, reverse=True)


def test_differences_within_the_doubt_do_not_count() -> None:
    points = [Objectives(1.0, 30.0, 0.05), Objectives(0.95, 29.0, 0.05), Objectives(0.8, 28.0, 0.05)]
    assert pareto_front(points, lambda p: p) == [points[0], points[2]]
    assert pareto_front([*points, Objectives(math.nan, 50.0)], lambda p: p) == [points[0], points[2]]


def test_chains_take_the_least_loss_per_gain_first() -> None:
    steps = [
        ParetoStep("a", "a=1", 0.5, 0.1),
        ParetoStep("a", "a=2", 1.0, 1.0),
        ParetoStep("b", "b=1", 0.4, 0.2),
        ParetoStep("c", "c=1", 0.0, 0.0),
    ]
    assert chain_pareto_steps(steps) == [("a=1", "b=1"), ("a=2", "b=1")]
    assert chain_pareto_steps(steps[:2]) == []


def test_combinations_are_new_and_alternate_between_directions() -> None:
    faster = [ParetoStep(name, f"{name}=1", gain, 0.1) for name, gain in (("a", 0.4), ("b", 0.3), ("c", 0.2))]
    smaller = [ParetoStep(name, f"{name}=1", gain, 0.1) for name, gain in (("x", 0.4), ("y", 0.3))]
    assert combine_pareto_steps((faster, smaller), [("b=1", "a=1")], 5) == [("a=1", "b=1", "c=1"), ("x=1", "y=1")]
    assert combine_pareto_steps((faster, smaller), [], 2) == [("a=1", "b=1"), ("x=1", "y=1")]
    assert thin_pareto_chain(list(range(10)), 4) == [0, 3, 6, 9] and thin_pareto_chain([1, 2], 0) == []
