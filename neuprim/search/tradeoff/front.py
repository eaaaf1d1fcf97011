"""Which points are worth having, and which combinations are worth trying."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

__all__ = ["Move", "Spot", "chain", "front"]

T = TypeVar("T")


@dataclass(frozen=True)
class Spot:
    """Where a point lies: what it costs (less is better), how uncertain that is, and how good it is (more is
    better)."""

    cost: float
    quality: float
    doubt: float = 0.0


def front(points: Sequence[T], spot: Callable[[T], Spot]) -> list[T]:
    """The Pareto front, best quality first: no other point is at least as good and costs less.

    A point must be cheaper than the next better one on the front by more than the doubt about both, as measured costs
    of equal ones differ by chance; of equally good ones the first stays unless another is cheaper by as much. Without
    doubt it is the plain front.
    """
    known = [p for p in points if not (math.isnan(spot(p).cost) or math.isnan(spot(p).quality))]
    kept: list[T] = []
    for point in sorted(known, key=lambda p: -spot(p).quality):
        here = spot(point)
        if kept:
            last = spot(kept[-1])
            if here.cost >= last.cost - (here.doubt + last.doubt):
                continue
            if here.quality == last.quality:
                kept.pop()
        kept.append(point)
    return kept


@dataclass(frozen=True)
class Move:
    """A knob turned alone: how much it gains (the logarithm of how many times less the point costs) and loses (of
    quality)."""

    knob: str
    name: str
    gain: float
    loss: float


def chain(moves: Sequence[Move], least: float = 0.01) -> list[tuple[Move, ...]]:
    """Combinations along the front, cheapest loss first: from the reference, always the turn that loses least for what
    it gains, whether of another knob or of one further. Gains and losses are taken to add up, which the combinations'
    own measurement then corrects.

    Args:
        least: gains of a turn that are not counted as such.

    Returns:
        those of two knobs or more, each with one move per knob.
    """
    state: dict[str, Move] = {}
    found: list[tuple[Move, ...]] = []
    while True:
        turns = []
        for move in moves:
            now = state.get(move.knob)
            gain, loss = (move.gain, move.loss) if now is None else (move.gain - now.gain, move.loss - now.loss)
            if gain > least:
                turns.append((max(loss, 0.0) / gain, -gain, move.name, move))
        if not turns:
            return found
        turn = min(turns, key=lambda t: t[:3])[3]
        state[turn.knob] = turn
        if len(state) > 1:
            found.append(tuple(state.values()))
