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
    known = [(o, p) for p in points if not math.isnan((o := objectives(p)).cost) and not math.isnan(o.quality)]
    front: list[tuple[Objectives, T]] = []
    for here, point in sorted(known, key=lambda pair: -pair[0].quality):
        if front:
            last = front[-1][0]
            if here.cost >= last.cost - (here.doubt + last.doubt):
                continue
            if here.quality == last.quality:
                front.pop()
        front.append((here, point))
    return [point for _, point in front]


class ParetoStep(NamedTuple):
    """A single change: the knob, its override, the gain (log of the cost's reduction) and the loss of quality."""

    knob: str
    override: str
    gain: float
    loss: float


def chain_pareto_steps(steps: Sequence[ParetoStep], min_gain: float = 0.01) -> list[tuple[str, ...]]:
    """Return combinations of overrides along the expected front, one override per knob, two or more each.

    Gains and losses are assumed to add up; measuring the combinations corrects that. The next step is always the one
    with the least loss per gain, of another knob or further along the same.
    """
    state: dict[str, ParetoStep] = {}
    chain: list[tuple[str, ...]] = []
    while True:
        options = []
        for step in steps:
            now = state.get(step.knob, ParetoStep(step.knob, "", 0.0, 0.0))
            if (gain := step.gain - now.gain) > min_gain:
                options.append((max(step.loss - now.loss, 0.0) / gain, -gain, step.override, step))
        if not options:
            return chain
        best = min(options)[3]
        state[best.knob] = best
        if len(state) > 1:
            chain.append(tuple(step.override for step in state.values()))


def combine_pareto_steps(
    directions: Sequence[Sequence[ParetoStep]], known: Sequence[Sequence[str]], most: int
) -> list[tuple[str, ...]]:
    """Return at most ``most`` new combinations, alternating between directions and evenly spread along each."""
    taken = {frozenset(overrides) for overrides in known}
    chains = [[way for way in chain_pareto_steps(steps) if frozenset(way) not in taken] for steps in directions]
    chosen: dict[frozenset[str], tuple[str, ...]] = {}
    for rung in zip_longest(*(thin_pareto_chain(chain, most) for chain in chains)):
        for way in filter(None, rung):
            chosen.setdefault(frozenset(way), way)
    return list(chosen.values())[: max(most, 0)]


def thin_pareto_chain(items: Sequence[T], most: int) -> list[T]:
    """Return at most ``most`` of the items, evenly spread."""
    if len(items) <= most or most < 1:
        return list(items[: max(most, 0)])
    if most == 1:
        return [items[len(items) // 2]]
    return [items[round(i * (len(items) - 1) / (most - 1))] for i in range(most)]
