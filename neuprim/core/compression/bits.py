"""Bits per parameter: five named levels, and a user's own numbers over them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from neuprim.core.compression.quantizers import MAX_BITS, MIN_BITS
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.model.schema import ParameterSpec

OTHERS = "others"


@dataclass(frozen=True)
class BitTable:
    """Bits per number, by parameter."""

    # parameter -> bits. Several values are for the degrees 1, 2, ... of spherical harmonics (in the order of 3D
    # Gaussian splatting); the last holds for all higher degrees
    named: Mapping[str, tuple[int, ...]]
    others: int  # bits of every other parameter
    # parameters that get exactly these bits. Other parameters get more where their data need it
    exact: frozenset[str] = frozenset()

    def of(self, name: str, shape: tuple[int, ...]) -> list[int]:
        """Return the bits of each column of a parameter of this shape."""
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
"""From nearly lossless (1) to very small (5). Position, shape and strength have more bits, as images depend on them."""

DEFAULT_LEVEL = 3


def bit_table(level: int, words: Iterable[str], specs: Iterable[ParameterSpec]) -> BitTable:
    """Return a level's table with ``NAME=BITS`` overrides (a parameter or ``others``), or raise ConfigError."""
    if level not in LEVELS:
        raise ConfigError(f"--level {level}: expected one of {', '.join(map(str, LEVELS))}")
    table, names = LEVELS[level], [spec.name for spec in specs]
    for word in words:
        name, equals, text = word.partition("=")
        if not equals:
            raise ConfigError(f"--bits {word}: expected NAME=BITS, for example means=16")
        if name not in names and name != OTHERS:
            raise ConfigError(f"--bits {word}: the model has no parameter {name!r}{nearest(name, [*names, OTHERS])}")
        if name in table.exact:
            raise ConfigError(f"--bits {word}: {name} is given twice")
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
        more = "; several, as 7,6,5, for the bands of spherical harmonics" if several else ""
        raise ConfigError(f"--bits {word}: expected {low} to {high}{more}")
    return tuple(map(int, parts))
