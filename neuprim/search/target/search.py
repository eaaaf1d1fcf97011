"""How many primitives to try next: bisection on the logarithm of the count, along a curve that never falls.

A size is judged by its *margin*: the forecast of its full run less the target, dB; of several targets the least. Zero
is the size wanted.
Between sizes that were tried the curve is straight in log2 of the count; beyond them every doubling gains a share of
what the last one did.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

__all__ = ["Curve", "Proposal", "climb", "propose"]

_FIRST_SLOPE = 1.0
"""dB per doubling of primitives where only one size was tried."""

_FURTHEST = 3.0
"""Doublings from the sizes tried to the next one, at most."""

_APART = 0.5
"""Doublings between two sizes that tell a slope."""

_CLOSE = 0.3
"""Doublings between the size wanted and one tried from which on another trial tells nothing new."""

_SHARE = 0.65
"""Of a doubling's gain in quality to that of the doubling of primitives before it, beyond the sizes tried."""


@dataclass(frozen=True)
class Curve:
    """Margins over log2 of the count, made to never fall.

    Attributes:
        nodes: (log2 of primitives, margin), by their counts.
    """

    nodes: tuple[tuple[float, float], ...]

    @classmethod
    def through(cls, tried: Sequence[tuple[int, float]]) -> Curve:
        """Of (primitives, margin) pairs, one or more; where more primitives did worse, neighbours get their mean."""
        blocks: list[tuple[list[float], list[float]]] = []
        for count, margin in sorted(tried):
            blocks.append(([math.log2(count)], [margin]))
            while len(blocks) > 1 and _mean(blocks[-2][1]) >= _mean(blocks[-1][1]):
                places, values = blocks.pop()
                blocks[-1] = (blocks[-1][0] + places, blocks[-1][1] + values)
        return cls(tuple((place, _mean(values)) for places, values in blocks for place in places))

    @property
    def slope(self) -> float:
        """dB per doubling at the upper end."""
        return self._slope(-1)

    def _slope(self, end: int) -> float:
        places, values = zip(*self.nodes, strict=True)
        apart = [i for i in range(len(places)) if abs(places[i] - places[end]) >= _APART / 2]
        if not apart:
            return _FIRST_SLOPE
        near = apart[end]
        return max((values[end] - values[near]) / (places[end] - places[near]), 0.0)

    def at(self, primitives: float) -> float:
        """The margin of a count."""
        place = math.log2(primitives)
        (first, low), (last, high) = self.nodes[0], self.nodes[-1]
        if place <= first:
            return low - self._slope(0) * (first - place)
        if place >= last:
            return high + self._beyond(place - last)
        for (a, at_a), (b, at_b) in zip(self.nodes, self.nodes[1:], strict=False):
            if place <= b:
                return at_b if b == a else at_a + (at_b - at_a) * (place - a) / (b - a)
        raise AssertionError(place)

    def _beyond(self, doublings: float) -> float:
        return self.slope * _SHARE * (1 - _SHARE**doublings) / (1 - _SHARE)

    def count_for(self, wanted: float, lowest: int, highest: int) -> int | None:
        """The least count from ``lowest`` to ``highest`` whose margin is ``wanted``; None if there is none."""
        low, high = math.log2(lowest), math.log2(max(highest, lowest))
        if self.at(2**low) >= wanted:
            return lowest
        if self.at(2**high) < wanted:
            return None
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (low, middle) if self.at(2**middle) >= wanted else (middle, high)
        return max(math.ceil(2**high), lowest)

    def slope_at(self, primitives: float) -> float:
        """dB per doubling around a count."""
        return self.at(primitives * 2**_APART) / (2 * _APART) - self.at(primitives / 2**_APART) / (2 * _APART)


@dataclass(frozen=True)
class Proposal:
    """What to do: try another count, take this one, or give up on the target with this one as the best."""

    kind: Literal["try", "take", "unreachable"]
    primitives: int


def propose(
    tried: Sequence[tuple[int, float]], lowest: int, highest: int, wanted: float = 0.0, doubt: float = 0.0
) -> Proposal:
    """The next step towards the least count whose margin is ``wanted``.

    Args:
        tried: (primitives, margin) pairs, one or more.
        lowest, highest: bounds of the count.
        doubt: dB by which margins may be wrong: only what is missed by more is out of reach.
    """
    curve = Curve.through(tried)
    counts = sorted({count for count, _ in tried})
    found = curve.count_for(wanted, lowest, highest)
    if found is None and len(counts) > 1 and _tried_up_to(counts, highest, curve, wanted, doubt):
        best = min(max(counts[-1], lowest), highest) if curve.at(highest) + doubt < wanted else highest
        return Proposal("unreachable" if curve.at(highest) + doubt < wanted else "take", best)
    if found is None:
        found = highest
    furthest = (2.0**_FURTHEST * counts[-1], counts[0] / 2.0**_FURTHEST)
    found = round(min(max(found, lowest, furthest[1]), highest, furthest[0]))
    if len(counts) == 1:
        return (
            Proposal("try", _apart(counts[0], found, lowest, highest)) if lowest < highest else Proposal("take", found)
        )
    if any(abs(math.log2(found / count)) <= _CLOSE for count in counts):
        return Proposal("take", found)
    return Proposal("try", found)


def climb(tried: Sequence[tuple[int, float]], lowest: int, highest: int, worth: float = 0.1) -> Proposal:
    """The next step towards the best margin at most ``highest`` primitives can have.

    Args:
        worth: dB per doubling that more primitives must bring.
    """
    counts = sorted({count for count, _ in tried})
    top = counts[-1]
    if highest < counts[0] / 2**_CLOSE:  # all that was tried is above the limit, which is not known well from there
        return Proposal("try", max(highest, round(counts[0] / 2**_FURTHEST), lowest))
    if top >= highest / 2**_CLOSE:
        if len(counts) > 1 or highest <= lowest:
            return Proposal("take", _best(tried, lowest, highest, worth))
        return Proposal(
            "try", max(lowest, round(highest / 2)) if top != round(highest / 2) else max(lowest, highest // 4)
        )
    if len(counts) > 1 and Curve.through(tried).slope < worth:
        return Proposal("take", _best(tried, lowest, highest, worth))
    return Proposal("try", min(highest, round(top * 2**_FURTHEST / 2)))


def _best(tried: Sequence[tuple[int, float]], lowest: int, highest: int, worth: float) -> int:
    """As many as the limit allows while they bring something, else the least count that is as good as any."""
    curve = Curve.through(tried)
    if curve.slope >= worth:
        return highest
    found = curve.count_for(curve.nodes[-1][1] - worth, lowest, highest)
    return highest if found is None else found


def _tried_up_to(counts: Sequence[int], highest: int, curve: Curve, wanted: float, doubt: float) -> bool:
    """Whether more trials cannot change that the target is missed: the largest count was tried, or is hopeless from
    here."""
    return math.log2(highest / counts[-1]) <= _CLOSE or curve.at(highest) + 2 * doubt + _FIRST_SLOPE < wanted


def _apart(tried: int, found: int, lowest: int, highest: int) -> int:
    """``found``, but not so close to the only size tried that both together tell no slope."""
    step = math.log2(found / tried)
    if abs(step) < _APART:
        up = step > 0
        found = round(tried * 2 ** (_APART if up else -_APART))
        if not lowest <= found <= highest:
            found = round(tried * 2 ** (-_APART if up else _APART))
    return min(max(found, lowest), highest)


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
