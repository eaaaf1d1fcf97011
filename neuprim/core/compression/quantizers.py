"""Quantizers, which convert numbers to integer codes of a few bits and back, and tables of bits per parameter.

A column holds one number of every primitive. Its codes stand for even steps between two float32 values, ``low`` and
``high``. With m = 2^bits - 1, in double precision,

    value = float32((low (m - code) + high code) / m)

Both products are exact, so every IEEE 754 implementation decodes the same bits, with or without fused multiply-add.
Encoding a decoded value returns its code.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.model.schema import ParameterSpec

MIN_BITS = 3  # smallest bits of a component of an orientation

MAX_BITS = 20  # largest bits of a column: products of a float32 and a code stay exact in double precision

_MANTISSA = 24  # bits of a float32

_LARGEST = float(torch.finfo(torch.float32).max)

CLIPS = (0.0, 1e-4, 1e-3, 1e-2)
"""Candidate fractions of a column's values to clip at either end. The fraction with the least mean squared error is
used."""


@dataclass(frozen=True)
class ColumnQuantizer:
    """Uniform quantizer of C columns, each of which holds one number per primitive.

    ``bits`` (C,) int64 is the number of bits per number of each column. Codes 0 to 2^bits - 1 stand for even steps from
    ``low`` to ``high``, (C,) float32.
    """

    bits: Tensor
    low: Tensor
    high: Tensor

    @property
    def last(self) -> Tensor:
        """Largest code of each column, (C,) int64."""
        return (1 << self.bits) - 1

    def codes(self, x: Tensor) -> Tensor:
        """Quantize x (N, C): return the (N, C) int64 codes of the nearest values."""
        low, width = self.low.double(), self.high.double() - self.low.double()
        scale = torch.where(width > 0, self.last / width, 0.0)
        return torch.minimum(((x.detach().double() - low) * scale).round().clamp_min(0), self.last.double()).long()

    def values(self, codes: Tensor) -> Tensor:
        """Dequantize codes (N, C): return the (N, C) float32 values."""
        m, c = self.last.double(), codes.double()
        return ((self.low.double() * (m - c) + self.high.double() * c) / m).float()

    def fake_quantize(self, x: Tensor) -> Tensor:
        """Quantize and dequantize x, with straight-through gradients."""
        return self.values(self.codes(x)).to(x) + (x - x.detach())

    def to(self, device: torch.device) -> ColumnQuantizer:
        return ColumnQuantizer(self.bits.to(device), self.low.to(device), self.high.to(device))


def fit_columns(x: Tensor, bits: Sequence[int], clips: Sequence[float] = CLIPS) -> ColumnQuantizer:
    """Return a quantizer whose ``low`` and ``high`` fit each column of x (N, C), finite and on the CPU.

    ``clips`` are candidate fractions of the values to clip at each end. Each column uses the fraction with the least
    mean squared error.
    """
    wanted = torch.tensor(list(bits), dtype=torch.int64)
    best = ColumnQuantizer(wanted, torch.zeros(len(wanted)), torch.zeros(len(wanted)))
    if not x.numel():
        return best
    least = torch.full((len(wanted),), torch.inf, dtype=torch.float64)
    ordered = np.sort(x.detach().double().numpy(), axis=0)
    for clip in clips:
        low, high = (torch.from_numpy(_column_quantile(ordered, q).astype(np.float32)) for q in (clip, 1 - clip))
        tried = ColumnQuantizer(wanted, low, high)
        error = (tried.values(tried.codes(x)).double() - x.detach().double()).square().mean(0)
        better = error < least
        least = torch.where(better, error, least)
        best = ColumnQuantizer(wanted, torch.where(better, low, best.low), torch.where(better, high, best.high))
    return best


def columns_of_step(x: Tensor, steps: Tensor, through: Tensor | float) -> ColumnQuantizer:
    """Return a quantizer with step lengths ``steps`` (C,) that covers all of x (N, C), finite, on the CPU.

    Steps that would need more than :data:`MAX_BITS` bits are enlarged. ``through``, (C,) or a number, is a value that
    one of the codes represents.
    """
    if not x.numel():
        return fit_columns(x, [1] * x.shape[1])
    y = x.detach().double()
    through = torch.as_tensor(through, dtype=torch.float64).expand(y.shape[1])
    low, high = torch.minimum(y.amin(0), through), torch.maximum(y.amax(0), through)
    steps = torch.maximum(steps.double(), (high - low) / (2**MAX_BITS - 3)).clamp(max=2.0 * _LARGEST)
    wide = torch.where(steps > 0, steps, 1.0)
    below, above = (((side / wide) - 0.5).ceil().clamp(min=0.0) for side in (through - low, high - through))
    bits = torch.log2(below + above + 1).ceil().clamp(min=1.0).long()
    first = through - below * steps
    last = torch.where(below + above > 0, first + ((1 << bits) - 1) * steps, first)
    return ColumnQuantizer(bits, first.clamp(min=-_LARGEST).float(), last.clamp(max=_LARGEST).float())


def snap_to_zero(columns: ColumnQuantizer) -> ColumnQuantizer:
    """Return a quantizer like ``columns`` in which one code decodes to exactly 0.

    ``low`` and ``high`` move inwards by at most two steps; a range without 0 is first extended to 0.
    """
    low, high, last = columns.low.double().clamp(max=0.0), columns.high.double().clamp(min=0.0), columns.last.double()
    width = high - low
    place = -low / torch.where(width > 0, width, 1.0) * last  # position of zero, between two codes
    tried = torch.stack([place.floor(), place.ceil()])
    below = torch.where(tried > 0, -low / tried.clamp(min=1.0), torch.inf)
    above = torch.where(tried < last, high / (last - tried).clamp(min=1.0), torch.inf)
    steps, better = torch.minimum(below, above).max(0)
    code = tried.gather(0, better[None])[0]
    mantissa, exponent = torch.frexp(steps)
    parts = torch.exp2((_MANTISSA - columns.bits).clamp(min=2).double())
    step = torch.ldexp((mantissa * parts).floor() / parts, exponent)
    return ColumnQuantizer(columns.bits, (-code * step).float(), ((last - code) * step).float())


def _column_quantile(ordered: np.ndarray, q: float) -> np.ndarray:
    """Return the ``q`` quantile of each of C sorted columns (N, C), by linear interpolation."""
    place = q * (len(ordered) - 1)
    below = int(place)
    above, share = min(below + 1, len(ordered) - 1), place - below
    return np.asarray(ordered[below] * (1 - share) + ordered[above] * share)


def relative_quantizer_error(x: Tensor, columns: ColumnQuantizer) -> Tensor:
    """Return (C,) RMS quantization errors of the columns of x (N, C), each divided by a usual error.

    The usual error is the error of a quantizer with as many steps, from -1 to 1 standard deviation around the mean.
    """
    y = x.detach().double()
    error = (columns.values(columns.codes(x)).double() - y).square().mean(0).sqrt()
    usual = (y - y.mean(0)).square().mean(0).sqrt() * 2 / columns.last / 12**0.5
    return torch.where(usual > 0, error / usual, 0.0)


@dataclass(frozen=True)
class RotationQuantizer:
    """Quantizer of unit quaternions by their three smallest components, ``bits`` each (:data:`MIN_BITS` to 16).

    With h = 2^(bits-1) - 1, the three components are u / (h sqrt 2) with integers u from -h to h, in the order of the
    quaternion. The largest component is sqrt(2 h^2 - u1^2 - u2^2 - u3^2) / (h sqrt 2), positive. All sums are sums of
    integers, and root and quotient are each rounded once, so all machines decode the same bits. The identity decodes
    exactly.
    """

    bits: int

    @property
    def half(self) -> int:
        """The integer h in the formulas of this class: codes are u + h, from 0 to 2 h."""
        return (1 << (self.bits - 1)) - 1

    def codes(self, quats: Tensor) -> Tensor:
        """Return (N, 4) int64 codes of quaternions wxyz (N, 4).

        A row has the index of the largest component, and the codes of the other three components. If rounding makes one
        of these three as large as the largest component, the rounded component is reduced. So decoding and encoding
        again returns the same codes.
        """
        q = quats.detach().double()
        q = q / q.abs().amax(1, keepdim=True)  # the square of a tiny norm would underflow
        q = q / q.norm(dim=1, keepdim=True)
        largest = q.abs().argmax(1)
        q = torch.where(q.gather(1, largest[:, None]) < 0, -q, q)
        u = (q.gather(1, self._others(largest)) * (self.half * 2**0.5)).round().long().clamp(-self.half, self.half)
        while True:
            most, which = u.abs().max(1)
            over = (self._left(u) < (most + 1).square()) & (most > 0)
            if not bool(over.any()):
                return torch.cat([largest[:, None], u + self.half], 1)
            u = u.scatter_add(
                1, which[:, None], torch.where(over, -u.gather(1, which[:, None])[:, 0].sign(), 0)[:, None]
            )

    def values(self, codes: Tensor) -> Tensor:
        """Dequantize codes (N, 4): return (N, 4) float32 unit quaternions wxyz."""
        u = codes[:, 1:] - self.half
        norm = torch.tensor(2 * self.half * self.half, dtype=torch.float64, device=codes.device).sqrt()
        made = torch.empty(len(codes), 4, dtype=torch.float64, device=codes.device)
        made.scatter_(1, codes[:, :1], self._left(u).clamp_min(0).double().sqrt()[:, None] / norm)
        made.scatter_(1, self._others(codes[:, 0]), u.double() / norm)
        return made.float()

    def fake_quantize(self, quats: Tensor) -> Tensor:
        """Quantize and dequantize quaternions, keeping norm and sign, with straight-through gradients."""
        q = quats.detach()
        back = self.values(self.codes(q)).to(q)
        back = back * q.norm(dim=1, keepdim=True) * torch.where((back * q).sum(1, keepdim=True) < 0, -1.0, 1.0).to(q)
        return back + (quats - q)

    def to(self, device: torch.device) -> RotationQuantizer:
        """Return this quantizer itself, because it has no tensors to move."""
        return self

    def _left(self, u: Tensor) -> Tensor:
        """Return (N,) 2 h^2 times the square of the largest component.

        ``u`` (N, 3) are the integers of the other three components.
        """
        return 2 * self.half * self.half - u.square().sum(1)

    @staticmethod
    def _others(largest: Tensor) -> Tensor:
        """Return the (N, 3) indices, ascending, of the quaternion components other than ``largest`` (N,)."""
        first = torch.arange(3, device=largest.device).expand(len(largest), 3)
        return first + (first >= largest[:, None])


OTHERS = "others"


@dataclass(frozen=True)
class BitTable:
    """Number of bits of each quantized number, by parameter name."""

    # parameter -> bits. Several values are for the degrees 1, 2, ... of spherical harmonics (in the order of 3D
    # Gaussian splatting); the last value holds for all higher degrees
    named: Mapping[str, tuple[int, ...]]
    others: int  # bits of every parameter that is not in ``named``
    # parameters that get exactly the bits in this table. Other parameters get more bits if their values need them
    exact: frozenset[str] = frozenset()

    def of(self, name: str, shape: tuple[int, ...]) -> list[int]:
        """Return the bits of each column of a parameter; ``shape`` is its shape for one primitive."""
        bits = self.named.get(name, (self.others,))
        if len(bits) == 1 or len(shape) < 2:
            return [bits[0]] * math.prod(shape)
        degrees = [math.isqrt(row + 1) for row in range(shape[0])]
        return [bits[min(degree, len(bits)) - 1] for degree in degrees for _ in range(math.prod(shape[1:]))]


_NAMED = ("means", "log_scales", "quats", "log_gain", "W1", "b1", "w2", "b2", "sh_dc", "sh_rest")


def _level_bits(*bits: int, others: int) -> BitTable:
    return BitTable({name: (own,) for name, own in zip(_NAMED, bits, strict=True)}, others)


LEVELS: dict[int, BitTable] = {
    1: _level_bits(16, 11, 11, 11, 10, 9, 9, 9, 10, 9, others=10),
    2: _level_bits(14, 9, 9, 9, 8, 7, 7, 7, 8, 7, others=8),
    3: _level_bits(13, 8, 8, 8, 7, 6, 6, 6, 7, 6, others=7),
    4: _level_bits(12, 7, 7, 7, 6, 5, 5, 5, 6, 5, others=5),
    5: _level_bits(11, 6, 6, 6, 5, 4, 4, 4, 5, 4, others=4),
}
"""Compression level -> bits of each parameter, from nearly lossless (1) to very small (5). Positions, shapes and gains
get more bits, because images depend most on these parameters."""

DEFAULT_LEVEL = 3


def bit_table(level: int, words: Iterable[str], specs: Iterable[ParameterSpec]) -> BitTable:
    """Return the bits of each parameter at a level of compression, changed by overrides ``NAME=BITS``.

    NAME is a parameter or ``others``. Raises ConfigError if the level or an override is invalid.
    """
    if level not in LEVELS:
        raise ConfigError(f"--level {level}: expected one of {', '.join(map(str, LEVELS))}")
    table, names = LEVELS[level], [spec.name for spec in specs]
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            raise ConfigError(f"bits.{word}: expected bits.NAME=BITS, for example bits.means=16")
        if name not in names and name != OTHERS:
            raise ConfigError(f"bits.{word}: the model has no parameter {name!r}{nearest(name, [*names, OTHERS])}")
        if name in table.exact:
            raise ConfigError(f"bits.{word}: {name} is given twice")
        bits = _parse_quantizer_bits(word, text, name)
        if name == OTHERS:
            table = replace(
                table, others=bits[0], exact=table.exact | {n for n in (*names, OTHERS) if n not in table.named}
            )
        else:
            table = replace(table, named={**table.named, name: bits}, exact=table.exact | {name})
    return table


def _parse_quantizer_bits(word: str, text: str, name: str) -> tuple[int, ...]:
    low, high = (MIN_BITS, 16) if name == "quats" else (1, MAX_BITS if name == "means" else 16)
    several = name not in ("means", "quats", OTHERS)
    parts = text.split(",")
    if any(not p.isascii() or not p.isdigit() or len(p) > 2 or not low <= int(p) <= high for p in parts) or (
        len(parts) > 1 and not several
    ):
        more = ", or one number for each band of spherical harmonics, as in 7,6,5" if several else ""
        raise ConfigError(f"bits.{word}: expected {low} to {high} bits{more}")
    return tuple(map(int, parts))
