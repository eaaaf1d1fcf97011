"""From single knobs to combinations: down from the centre along the fronts of time and of bytes, and up along that of
quality."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import zip_longest

from neuprim.search.design.record import Model
from neuprim.search.design.variants import CENTRE, COMBINED, Variant
from neuprim.search.tradeoff.front import Move, Spot, chain, front

__all__ = ["combinations", "fronts"]

_DIGITS = 2
"""Decimals of PSNR, dB, that count."""

_BETTER = 0.02
"""Decibels that a knob must gain to be turned up."""


def combinations(found: Sequence[Model], most: int) -> list[Variant]:
    """At most so many variants that turn several knobs, from each way some, evenly spread along it.

    Args:
        found: the centre first.
    """
    centre = found[0]
    single = [m for m in found if m.knob not in (CENTRE, COMBINED) and m.length == 1.0 and len(m.turned) == 1]
    lost = {id(m): centre.quality["psnr"] - m.quality["psnr"] for m in single}
    faster = [
        Move(m.knob, m.turned[0], -math.log(m.ratio), lost[id(m)])
        for m in single
        if m.ratios and 0 < m.ratio < 1.0 - m.doubt
    ]
    smaller = [
        Move(m.knob, m.turned[0], math.log(centre.bytes / m.bytes), lost[id(m)])
        for m in single
        if m.bytes < centre.bytes
    ]
    better = [
        Move(m.knob, m.turned[0], -lost[id(m)], math.log(m.bytes / centre.bytes))
        for m in single
        if lost[id(m)] < -_BETTER
    ]
    known = {frozenset(m.turned) for m in found}
    ways = []
    for moves in (smaller, faster, better):
        made = [tuple(move.name for move in way) for way in chain(moves)]
        ways.append(_spread([turned for turned in made if frozenset(turned) not in known], most))
    chosen: list[Variant] = []
    for rung in zip_longest(*ways):
        for turned in rung:
            if turned is not None and frozenset(turned) not in known and len(chosen) < most:
                known.add(frozenset(turned))
                chosen.append(Variant(COMBINED, turned))
    return chosen


def _spread(ways: list[tuple[str, ...]], most: int) -> list[tuple[str, ...]]:
    if len(ways) <= most or most < 1:
        return ways[: max(most, 0)]
    if most == 1:
        return [ways[len(ways) // 2]]
    return [ways[round(i * (len(ways) - 1) / (most - 1))] for i in range(most)]


def fronts(found: Sequence[Model]) -> tuple[list[int], list[int]]:
    """Numbers of the models on the front of time, and on that of bytes, both against PSNR, best quality first."""

    def quality(i: int) -> float:
        return round(found[i].quality["psnr"], _DIGITS)

    timed = [i for i in range(len(found)) if found[i].ratios]
    speed = front(timed, lambda i: Spot(found[i].ratio, quality(i), found[i].doubt))
    return speed, front(range(len(found)), lambda i: Spot(float(found[i].bytes), quality(i)))
