"""Numbers as codes of a few bits: each column of a parameter in even steps between two ends of its own.

What a code stands for is, with m = 2^bits - 1 and ends stored in float32,

    value = float32((low (m - code) + high code) / m)

in double precision. Both products are exact there, so that whoever adds, divides and rounds by IEEE 754 gets the same
bits, whether or not a compiler fuses product and sum; and the ends come back as they are, so that what was decoded is
coded again as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

__all__ = ["CLIPS", "MOST_BITS", "Columns", "even_columns", "fit_columns", "keep_zero", "spread_error"]

MOST_BITS = 20
"""Of a column's codes: products of a float32 and a code stay exact in double precision with room to spare."""

_MANTISSA = 24
"""Bits of a float32."""

_LARGEST = float(torch.finfo(torch.float32).max)

CLIPS = (0.0, 1e-4, 1e-3, 1e-2)
"""Shares of a column that may lie beyond either end; the one with the least mean square of errors is taken."""


@dataclass(frozen=True)
class Columns:
    """How C columns are coded: ``bits`` (C,) int64, and the first and the last value, ``low`` and ``high`` (C,)
    float32."""

    bits: Tensor
    low: Tensor
    high: Tensor

    @property
    def last(self) -> Tensor:
        """(C,) int64 largest codes."""
        return (1 << self.bits) - 1

    def codes(self, x: Tensor) -> Tensor:
        """(N, C) int64 codes of the nearest values to x (N, C)."""
        low, width = self.low.double(), self.high.double() - self.low.double()
        scale = torch.where(width > 0, self.last / width, 0.0)
        return torch.minimum(((x.detach().double() - low) * scale).round().clamp_min(0), self.last.double()).long()

    def values(self, codes: Tensor) -> Tensor:
        """(N, C) float32 that codes (N, C) stand for."""
        m, c = self.last.double(), codes.double()
        return ((self.low.double() * (m - c) + self.high.double() * c) / m).float()

    def rounded(self, x: Tensor) -> Tensor:
        """x as it comes back, with the gradient of x itself (straight through): for training that knows what will be
        stored."""
        return self.values(self.codes(x)).to(x) + (x - x.detach())

    def to(self, device: torch.device) -> Columns:
        """The same for tensors elsewhere."""
        return Columns(self.bits.to(device), self.low.to(device), self.high.to(device))


def fit_columns(x: Tensor, bits: Sequence[int], clips: Sequence[float] = CLIPS) -> Columns:
    """Ends for every column of x (N, C), finite, on the processor.

    Args:
        bits: one per column, 1 to :data:`MOST_BITS`.
        clips: shares of the column that may lie beyond either end, the first of which wins a tie.
    """
    wanted = torch.tensor(list(bits), dtype=torch.int64)
    best = Columns(wanted, torch.zeros(len(wanted)), torch.zeros(len(wanted)))
    if not x.numel():
        return best
    least = torch.full((len(wanted),), torch.inf, dtype=torch.float64)
    ordered = np.sort(x.detach().double().numpy(), axis=0)
    for clip in clips:
        low, high = (torch.from_numpy(_quantile(ordered, q).astype(np.float32)) for q in (clip, 1 - clip))
        tried = Columns(wanted, low, high)
        error = (tried.values(tried.codes(x)).double() - x.detach().double()).square().mean(0)
        better = error < least
        least = torch.where(better, error, least)
        best = Columns(wanted, torch.where(better, low, best.low), torch.where(better, high, best.high))
    return best


def even_columns(x: Tensor, steps: Tensor, through: Tensor | float) -> Columns:
    """Columns whose neighbouring values lie ``steps`` (C,) apart, or nearer where they would need more than
    :data:`MOST_BITS`, and that reach all of x (N, C), finite, on the processor.

    Codes that no number has are as good as free, so a step can be of any length. A column whose numbers all lie within
    one is a single value.

    Args:
        through: (C,) or a number, what is one of the values, within the column's numbers.
    """
    if not x.numel():
        return fit_columns(x, [1] * x.shape[1])
    y = x.detach().double()
    through = torch.as_tensor(through, dtype=torch.float64).expand(y.shape[1])
    low, high = torch.minimum(y.amin(0), through), torch.maximum(y.amax(0), through)
    steps = torch.maximum(steps.double(), (high - low) / (2**MOST_BITS - 3)).clamp(max=2.0 * _LARGEST)
    wide = torch.where(steps > 0, steps, 1.0)
    below, above = (((side / wide) - 0.5).ceil().clamp(min=0.0) for side in (through - low, high - through))
    bits = torch.log2(below + above + 1).ceil().clamp(min=1.0).long()
    first = through - below * steps
    last = torch.where(below + above > 0, first + ((1 << bits) - 1) * steps, first)
    return Columns(bits, first.clamp(min=-_LARGEST).float(), last.clamp(max=_LARGEST).float())


def keep_zero(columns: Columns) -> Columns:
    """The same with ends a little closer, by two steps at most, so that 0 is one of the values and comes back as 0: for
    columns that many primitives do without.

    Ends are whole multiples of a step that is short enough in binary for both to be float32 numbers. As no end lies
    beyond what the numbers reach, what was decoded is coded again as it was.
    """
    low, high, last = columns.low.double().clamp(max=0.0), columns.high.double().clamp(min=0.0), columns.last.double()
    width = high - low
    place = -low / torch.where(width > 0, width, 1.0) * last  # of zero, between two codes
    tried = torch.stack([place.floor(), place.ceil()])
    below = torch.where(tried > 0, -low / tried.clamp(min=1.0), torch.inf)
    above = torch.where(tried < last, high / (last - tried).clamp(min=1.0), torch.inf)
    steps, better = torch.minimum(below, above).max(0)
    code = tried.gather(0, better[None])[0]
    mantissa, exponent = torch.frexp(steps)
    parts = torch.exp2((_MANTISSA - columns.bits).clamp(min=2).double())
    step = torch.ldexp((mantissa * parts).floor() / parts, exponent)
    return Columns(columns.bits, (-code * step).float(), ((last - code) * step).float())


def _quantile(ordered: np.ndarray, q: float) -> np.ndarray:
    """Of sorted columns (N, C), between neighbours by proportion; ends exactly."""
    place = q * (len(ordered) - 1)
    below = int(place)
    above, share = min(below + 1, len(ordered) - 1), place - below
    return np.asarray(ordered[below] * (1 - share) + ordered[above] * share)


def spread_error(x: Tensor, columns: Columns) -> Tensor:
    """(C,) float64 root mean squares of the errors, over what even steps between -1 and 1 standard deviations would
    leave.

    A bell between its extremes has about 4; a column with a few numbers far from all others, tens and more.
    """
    y = x.detach().double()
    error = (columns.values(columns.codes(x)).double() - y).square().mean(0).sqrt()
    usual = (y - y.mean(0)).square().mean(0).sqrt() * 2 / columns.last / 12**0.5
    return torch.where(usual > 0, error / usual, 0.0)
