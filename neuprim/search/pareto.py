"""Pareto fronts, and combinations of single changes that may lie on them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import zip_longest
from typing import NamedTuple, TypeVar

T = TypeVar("T")


class Objectives(NamedTuple):
    """Cost (less is better), quality (more is better), and the uncertainty of the cost."""

    cost: float
    quality: float
    doubt: float = 0.0


def pareto_front(points: Sequence[T], objectives: Callable[[T], Objectives]) -> list[T]:
    """Return the Pareto front, best quality first.

    Measured costs of equal points differ by chance. A point must therefore be cheaper than the next better one by more
    than the uncertainty of both. Of equally good points the first stays, unless another is cheaper by as much.
    """
    known = [p for p in points if not (math.isnan(objectives(p).cost) or math.isnan(objectives(p).quality))]
    front: list[T] = []
    for point in sorted(known, key=lambda p: -objectives(p).quality):
        here = objectives(point)
        if front:
            last = objectives(front[-1])
            if here.cost >= last.cost - (here.doubt + last.doubt):
                continue
            if here.quality == last.quality:
                front.pop()
        front.append(point)
    return front


class Step(NamedTuple):
    """A single change: the knob, its override, the gain (log of the cost's reduction) and the loss of quality."""

    knob: str
    override: str
    gain: float
    loss: float


def chain_steps(steps: Sequence[Step], min_gain: float = 0.01) -> list[tuple[str, ...]]:
    """Return combinations of overrides along the expected front, one override per knob, two or more each.

    Gains and losses are assumed to add up; measuring the combinations corrects that. The next step is always the one
    with the least loss per gain, of another knob or further along the same.
    """
    state: dict[str, Step] = {}
    chain: list[tuple[str, ...]] = []
    while True:
        options = []
        for step in steps:
            now = state.get(step.knob)
            gain, loss = (step.gain, step.loss) if now is None else (step.gain - now.gain, step.loss - now.loss)
            if gain > min_gain:
                options.append((max(loss, 0.0) / gain, -gain, step.override, step))
        if not options:
            return chain
        best = min(options, key=lambda option: option[:3])[3]
        state[best.knob] = best
        if len(state) > 1:
            chain.append(tuple(step.override for step in state.values()))


def combine_steps(
    directions: Sequence[Sequence[Step]], known: Sequence[Sequence[str]], most: int
) -> list[tuple[str, ...]]:
    """Return at most ``most`` new combinations, alternating between directions and evenly spread along each."""
    taken = {frozenset(overrides) for overrides in known}
    chains = [[way for way in chain_steps(steps) if frozenset(way) not in taken] for steps in directions]
    chosen: list[tuple[str, ...]] = []
    for rung in zip_longest(*(spread_evenly(chain, most) for chain in chains)):
        for way in rung:
            if way is not None and frozenset(way) not in taken and len(chosen) < most:
                taken.add(frozenset(way))
                chosen.append(way)
    return chosen


def spread_evenly(items: Sequence[T], most: int) -> list[T]:
    """Return at most ``most`` of the items, evenly spread."""
    if len(items) <= most or most < 1:
        return list(items[: max(most, 0)])
    if most == 1:
        return [items[len(items) // 2]]
    return [items[round(i * (len(items) - 1) / (most - 1))] for i in range(most)]
