"""Predict quality over training length and model size, and choose the size to try next.

Every doubling of the steps gains a share of what the doubling before gained; so does every doubling of primitives
beyond the sizes tried. Predictions are rough, about 0.6 dB over two doublings, so full runs check them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

STEP_RATIO, _MIN_RATIO, _MAX_RATIO = 0.75, 0.5, 1.0
"""Gain of a doubling of steps over that of the doubling before: usual, least and largest measured."""

_SIZE_RATIO = 0.65
"""Gain of a doubling of primitives over that of the doubling before, beyond the sizes tried."""

FIRST_GAIN, _FIRST_SLOPE = 1.3, 1.0
"""dB that a doubling of steps, and of primitives, gains where nothing is known."""

SEED_NOISE = 0.1
"""dB between two seeds of one configuration."""

_FURTHEST, _APART, _CLOSE = 3.0, 0.5, 0.3
"""Doublings from the sizes tried to the next, at most; between two sizes that give a slope, at least; and between two
sizes of which the second gives no new information."""

_FIXED_SHARE = 0.5
"""Share of a time that does not depend on the number of primitives, where only one number was tried."""


class Forecast(NamedTuple):
    """Predicted quality in dB (:func:`to_decibels`), and half the width of its likely range."""

    value: float
    doubt: float


def to_decibels(name: str, value: float) -> float:
    """Return PSNR as it is, and SSIM as -10 log10(1 - ssim), on which equal steps need about equal work."""
    return value if name == "psnr" else -10 * math.log10(max(1.0 - value, 1e-6))


def from_decibels(name: str, value: float) -> float:
    """Invert :func:`to_decibels`."""
    return value if name == "psnr" else 1.0 - 10 ** (-value / 10)


def forecast_quality(lengths: Mapping[int, float], steps: float, gain: float = FIRST_GAIN) -> Forecast:
    """Predict the quality after ``steps`` from trials of one configuration.

    Args:
        lengths: steps of a trial -> its quality, dB.
        gain: dB of the doubling that ends with the trial, where only one length was tried.
    """
    tried = sorted(lengths)
    gains = [(lengths[b] - lengths[a]) / math.log2(b / a) for a, b in itertools.pairwise(tried)]
    last, longest = max(gains[-1] if gains else gain, 0.0), tried[-1]
    doublings = math.log2(max(steps / longest, 1e-6))
    if doublings <= 0:
        return Forecast(lengths[longest] + last * max(doublings, -1.0), SEED_NOISE)
    ratio = STEP_RATIO
    if len(gains) > 1 and gains[-2] > SEED_NOISE:
        ratio = min(max((STEP_RATIO + gains[-1] / gains[-2]) / 2, _MIN_RATIO), _MAX_RATIO)
    low, middle, high = (_sum_gains(last, r, doublings) for r in (_MIN_RATIO, ratio, _MAX_RATIO))
    return Forecast(lengths[longest] + middle, SEED_NOISE + (high - low) / 2)


def _sum_gains(gain: float, ratio: float, doublings: float) -> float:
    """Return gain (ratio + ratio^2 + ...), for a number of doublings that need not be whole."""
    return gain * doublings if ratio == 1 else gain * ratio * (1 - ratio**doublings) / (1 - ratio)


def fit_line(known: Sequence[tuple[int, float]], primitives: float) -> float:
    """Return a time at a number of primitives, by a least-squares line that neither falls nor starts below zero."""
    counts, times = [float(n) for n, _ in known], [t for _, t in known]
    mean_n, mean_t = sum(counts) / len(counts), sum(times) / len(times)
    spread = sum((n - mean_n) ** 2 for n in counts)
    slope = (1 - _FIXED_SHARE) * mean_t / mean_n
    if spread > 0:
        slope = sum((n - mean_n) * (t - mean_t) for n, t in zip(counts, times, strict=True)) / spread
    slope = min(max(slope, 0.0), mean_t / mean_n)
    return mean_t + slope * (primitives - mean_n)


@dataclass(frozen=True)
class Curve:
    """Margin (predicted quality less the target, dB) over log2 of the number of primitives; it never falls."""

    nodes: tuple[tuple[float, float], ...]

    @classmethod
    def fit(cls, tried: Sequence[tuple[int, float]]) -> Curve:
        """Fit (primitives, margin) pairs; neighbours that would make the curve fall get their mean."""
        blocks: list[tuple[list[float], float]] = []
        for count, margin in sorted(tried):
            blocks.append(([math.log2(count)], margin))
            while len(blocks) > 1 and blocks[-2][1] >= blocks[-1][1]:
                (before, low), (after, high) = blocks[-2:]
                mean = (len(before) * low + len(after) * high) / (len(before) + len(after))
                blocks[-2:] = [(before + after, mean)]
        return cls(tuple((place, value) for places, value in blocks for place in places))

    def _end_slope(self, end: int) -> float:
        """Return dB per doubling at the first (0) or last (-1) node."""
        place, value = self.nodes[end]
        apart = [node for node in self.nodes if abs(node[0] - place) >= _APART / 2]
        if not apart:
            return _FIRST_SLOPE
        return max((value - apart[end][1]) / (place - apart[end][0]), 0.0)

    @property
    def slope(self) -> float:
        """dB per doubling at the upper end."""
        return self._end_slope(-1)

    def at(self, primitives: float) -> float:
        """Return the margin of a number of primitives."""
        place = math.log2(primitives)
        (first, low), (last, high) = self.nodes[0], self.nodes[-1]
        if place <= first:
            return low - self._end_slope(0) * (first - place)
        if place >= last:
            return high + _sum_gains(self.slope, _SIZE_RATIO, place - last)
        (a, at_a), (b, at_b) = next(pair for pair in itertools.pairwise(self.nodes) if place <= pair[1][0])
        return at_b if b == a else at_a + (at_b - at_a) * (place - a) / (b - a)

    def slope_at(self, primitives: float) -> float:
        """Return dB per doubling around a number of primitives."""
        return self.at(primitives * 2**_APART) - self.at(primitives / 2**_APART)

    def find_count(self, wanted: float, highest: int) -> int | None:
        """Return the least number of primitives with a margin, at most ``highest``; None if there is none."""
        if self.at(1) >= wanted:
            return 1
        if self.at(max(highest, 1)) < wanted:
            return None
        low, high = 0.0, math.log2(highest)
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (low, middle) if self.at(2**middle) >= wanted else (middle, high)
        return math.ceil(2**high)


class Proposal(NamedTuple):
    """Try another size, take this one, or report the target as unreachable with this one as the best."""

    kind: Literal["try", "take", "unreachable"]
    primitives: int


def propose_size(tried: Sequence[tuple[int, float]], highest: int, wanted: float, doubt: float) -> Proposal:
    """Return the next step towards the least size with a margin.

    Args:
        tried: (primitives, margin) pairs, one or more.
        doubt: dB by which margins may be wrong; only a target missed by more is unreachable.
    """
    curve, counts = Curve.fit(tried), sorted({count for count, _ in tried})
    found = curve.find_count(wanted, highest)
    if found is None and len(counts) > 1:
        best = curve.at(highest)
        final = math.log2(highest / counts[-1]) <= _CLOSE or best + 2 * doubt + _FIRST_SLOPE < wanted
        if final and best + doubt < wanted:
            return Proposal("unreachable", min(counts[-1], highest))
        if final:
            return Proposal("take", highest)
    found = highest if found is None else found
    found = round(min(max(found, counts[0] / 2.0**_FURTHEST, 1), highest, 2.0**_FURTHEST * counts[-1]))
    if len(counts) == 1:
        return Proposal("try" if highest > 1 else "take", _move_apart(counts[0], found, highest))
    near = any(abs(math.log2(found / count)) <= _CLOSE for count in counts)
    return Proposal("take" if near else "try", found)


def _move_apart(tried: int, found: int, highest: int) -> int:
    """Return ``found``, moved so far from the only size tried that both give a slope."""
    step = math.log2(found / tried)
    if abs(step) < _APART:
        up, down = round(tried * 2**_APART), round(tried / 2**_APART)
        found = up if (step > 0 and up <= highest) or down < 1 else down
    return min(max(found, 1), highest)


def climb(tried: Sequence[tuple[int, float]], highest: int, worth: float = 0.1) -> Proposal:
    """Return the next step towards the best quality within ``highest`` primitives.

    Args:
        worth: dB per doubling that more primitives must gain.
    """
    curve, counts = Curve.fit(tried), sorted({count for count, _ in tried})
    top = counts[-1]
    if highest < counts[0] / 2**_CLOSE:  # all sizes tried are above the limit
        return Proposal("try", max(highest, round(counts[0] / 2**_FURTHEST), 1))
    at_limit = top >= highest / 2**_CLOSE
    if len(counts) == 1 and highest > 1:
        if at_limit:
            return Proposal("try", max(1, round(highest / 2)))
        return Proposal("try", min(highest, round(top * 2**_FURTHEST / 2)))
    if at_limit or curve.slope < worth:
        enough = None if curve.slope >= worth else curve.find_count(curve.nodes[-1][1] - worth, highest)
        return Proposal("take", highest if enough is None else enough)
    return Proposal("try", min(highest, round(top * 2**_FURTHEST / 2)))
