"""From the points of single knobs to combinations, and the fronts of all."""

from __future__ import annotations

import math
from collections.abc import Sequence

from neuprim.runs.render_config import RenderConfig
from neuprim.search.tradeoff.front import Move, Spot, chain, front
from neuprim.search.tradeoff.knobs import COMBINED, joined
from neuprim.search.tradeoff.record import Measured, Record
from neuprim.search.tradeoff.subject import Subject

__all__ = ["fronts", "size_points", "speed_points"]

_MOST = 12
"""Combinations of each kind that are measured; of more, evenly spread ones."""

_DIGITS = 2
"""Decimals of PSNR, dB, that count: smaller differences decide nothing."""

Found = Sequence[tuple[RenderConfig, Measured]]


def speed_points(reference: RenderConfig, found: Found) -> list[RenderConfig]:
    """Combinations along the front of time: knobs that save more of it than chance does. What storage changes is left
    out."""

    def gain(measured: Measured) -> float:
        return -math.log(measured.ratio) if measured.ratio < 1.0 - measured.doubt else 0.0

    own = [
        (p, m, gain(m))
        for p, m in found
        if m.knob != COMBINED and m.ratios and p.storage == reference.storage and p != reference
    ]
    return _together(reference, found, [(p, m, g) for p, m, g in own if g > 0])


def size_points(reference: RenderConfig, found: Found, subject: Subject) -> list[RenderConfig]:
    """Combinations along the front of bytes; those of the model's file are counted, so nothing is uncertain."""
    whole = found[0][1].bytes
    own = [
        (p, m, math.log(whole / m.bytes))
        for p, m in found
        if m.knob != COMBINED
        and p.settings == reference.settings
        and p.resolution == reference.resolution
        and m.bytes < whole
    ]
    return _together(reference, found, own)


def _together(
    reference: RenderConfig, found: Found, gaining: Sequence[tuple[RenderConfig, Measured, float]]
) -> list[RenderConfig]:
    """The combinations of :func:`~neuprim.search.tradeoff.front.chain`, without points that were measured alone."""
    best = found[0][1].quality["psnr"]
    usual = found[0][0]
    moves, points = [], {}
    for point, measured, gain in gaining:
        turned = [word for word in measured.words if word not in found[0][1].words]
        if len(turned) != 1:
            continue  # several groups at once, which their own moves make too
        name = turned[0]
        moves.append(Move(name.partition("=")[0], name, gain, best - measured.quality["psnr"]))
        points[name] = point
    ways = chain(moves)
    if len(ways) > _MOST:
        ways = [ways[round(i * (len(ways) - 1) / (_MOST - 1))] for i in range(_MOST)]
    known = [p for p, m in found if m.knob != COMBINED]
    made = [joined(usual, [points[move.name] for move in way]) for way in ways]
    return [point for point in made if point not in known]


def fronts(reference: RenderConfig, points: Sequence[RenderConfig], record: Record) -> tuple[list[int], list[int]]:
    """Numbers of the record's points on the front of time, and on that of bytes, both against PSNR."""
    measured = record.points

    def quality(i: int) -> float:
        return round(measured[i].quality["psnr"], _DIGITS)

    def in_time(i: int) -> Spot:
        return Spot(measured[i].ratio, quality(i), measured[i].doubt)

    def in_bytes(i: int) -> Spot:
        return Spot(float(measured[i].bytes), quality(i))

    every = range(len(measured))
    speed = front([i for i in every if measured[i].ratios and points[i].storage == reference.storage], in_time)
    same = [
        i for i in every if points[i].settings == reference.settings and points[i].resolution == reference.resolution
    ]
    return speed, front(same, in_bytes)
