"""How good a run will be after more steps than were tried: every doubling of the steps gains a share of what the one
before it gained.

The share is that of the doublings behind ``docs/budgets.md``, drawn towards what the trials themselves show where they
have three lengths. It is rough: over two doublings of surfaces it is off by about 0.6 dB, and scenes of smoke gain more
with every doubling for long. So a forecast has a doubt, and what is forecast is checked by a full run.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

__all__ = ["FIRST_GAIN", "RATIO", "Forecast", "decibels", "forecast", "ratio_of", "undecibels"]

RATIO = 0.75
"""Of a doubling's gain to that of the one before it."""

LEAST, MOST = 0.5, 1.0
"""Between them that share is in nearly every doubling measured; what they make of the forecast is its doubt."""

FIRST_GAIN = 1.3
"""dB that a doubling gains where nothing is known; the middle of those measured."""

NOISE = 0.1
"""dB between two seeds of one configuration."""

_EQUAL = 1e-6


@dataclass(frozen=True)
class Forecast:
    """A quality on the scale of :func:`decibels`, and half of the range in which it is believed to be."""

    value: float
    doubt: float


def decibels(name: str, value: float) -> float:
    """PSNR as it is; SSIM as dB of what is missing to 1, -10 log10(1 - ssim), on which equal steps are about equal
    work, too."""
    if name == "psnr":
        return value
    return -10 * math.log10(max(1.0 - value, _EQUAL))


def undecibels(name: str, value: float) -> float:
    """The inverse of :func:`decibels`."""
    return value if name == "psnr" else 1.0 - 10 ** (-value / 10)


def ratio_of(gains: Sequence[float]) -> float:
    """The share that the next doubling keeps, of the gains of doublings that follow each other."""
    if len(gains) < 2 or gains[-2] <= NOISE:
        return RATIO
    return min(max((RATIO + gains[-1] / gains[-2]) / 2, LEAST), MOST)


def forecast(lengths: Mapping[int, float], steps: float, gain: float = FIRST_GAIN) -> Forecast:
    """What ``steps`` will give.

    Args:
        lengths: steps of a trial -> its quality, dB, of trials that differ in nothing else; one or more.
        steps: of the run to come.
        gain: dB of the doubling that ends with the trial, used where only one length was tried.
    """
    tried = sorted(lengths)
    pairs = list(itertools.pairwise(tried))
    gains = [(lengths[b] - lengths[a]) / math.log2(b / a) for a, b in pairs]
    last = max(gains[-1] if gains else gain, 0.0)
    doublings = math.log2(max(steps / tried[-1], _EQUAL))
    if doublings <= 0:
        return Forecast(lengths[tried[-1]] + last * max(doublings, -1.0), NOISE)
    low, middle, high = (_sum(last, ratio, doublings) for ratio in (LEAST, ratio_of(gains), MOST))
    return Forecast(lengths[tried[-1]] + middle, NOISE + (high - low) / 2)


def _sum(gain: float, ratio: float, doublings: float) -> float:
    """gain * (ratio + ratio^2 + ...), for a number of doublings that need not be whole."""
    if ratio == 1:
        return gain * doublings
    return gain * ratio * (1 - ratio**doublings) / (1 - ratio)
