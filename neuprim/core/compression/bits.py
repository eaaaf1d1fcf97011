"""How many bits each parameter gets: named levels, a user's own numbers over them, and where the data ask for more."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from neuprim.core.compression.columns import MOST_BITS
from neuprim.core.compression.rotations import LEAST_BITS
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.model.schema import ParameterSpec

__all__ = ["LEVELS", "USUAL_LEVEL", "BitTable", "bit_table"]

OTHERS = "others"


@dataclass(frozen=True)
class BitTable:
    """Bits of a number, by parameter.

    Attributes:
        named: parameter -> bits; several numbers are for the bands of spherical harmonics, degrees 1, 2, ... in the
        order of 3D Gaussian
            splatting, the last for all that follow.
        others: of every other parameter.
        exact: parameters that get just that; of the others, columns that need more get more
        (:mod:`neuprim.core.compression.codec`).
    """

    named: Mapping[str, tuple[int, ...]]
    others: int
    exact: frozenset[str] = frozenset()

    def of(self, name: str, shape: tuple[int, ...]) -> list[int]:
        """Bits of each column of a parameter with this shape per primitive."""
        bits = self.named.get(name, (self.others,))
        if len(bits) == 1 or len(shape) < 2:
            return [bits[0]] * math.prod(shape)
        degrees = [math.isqrt(row + 1) for row in range(shape[0])]
        return [bits[min(degree, len(bits)) - 1] for degree in degrees for _ in range(math.prod(shape[1:]))]


def _level(
    means: int, shapes: int, quats: int, gain: int, W1: int, rest: int, sh_dc: int, sh_rest: int, others: int
) -> BitTable:
    """``shapes`` of log_scales, ``rest`` of the density's other numbers."""
    named = {
        "means": means,
        "log_scales": shapes,
        "quats": quats,
        "log_gain": gain,
        "W1": W1,
        "sh_dc": sh_dc,
        "sh_rest": sh_rest,
    }
    return BitTable({name: (bits,) for name, bits in (named | {"b1": rest, "w2": rest, "b2": rest}).items()}, others)


LEVELS: dict[int, BitTable] = {
    1: _level(means=16, shapes=11, quats=11, gain=11, W1=10, rest=9, sh_dc=10, sh_rest=9, others=10),
    2: _level(means=14, shapes=9, quats=9, gain=9, W1=8, rest=7, sh_dc=8, sh_rest=7, others=8),
    3: _level(means=13, shapes=8, quats=8, gain=8, W1=7, rest=6, sh_dc=7, sh_rest=6, others=7),
    4: _level(means=12, shapes=7, quats=7, gain=7, W1=6, rest=5, sh_dc=6, sh_rest=5, others=5),
    5: _level(means=11, shapes=6, quats=6, gain=6, W1=5, rest=4, sh_dc=5, sh_rest=4, others=4),
}
"""From nearly everything to very little. What a primitive has few of and images depend on has more bits: its place,
shape and strength."""

USUAL_LEVEL = 3


def bit_table(level: int, words: Iterable[str], specs: Iterable[ParameterSpec]) -> BitTable:
    """A level's table under a user's words NAME=BITS, where NAME is a parameter of the model or ``others``, and BITS a
    number or several.

    Raises:
        ConfigError: no such level or parameter, or no such number of bits.
    """
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
        bits = _numbers(word, text, name)
        if name == OTHERS:
            table = replace(
                table, others=bits[0], exact=table.exact | {n for n in (*names, OTHERS) if n not in table.named}
            )
        else:
            table = replace(table, named={**table.named, name: bits}, exact=table.exact | {name})
    return table


def _numbers(word: str, text: str, name: str) -> tuple[int, ...]:
    low, high = (LEAST_BITS, 16) if name == "quats" else (1, MOST_BITS if name == "means" else 16)
    several = name not in ("means", "quats", OTHERS)
    parts = text.split(",")
    if any(not p.isascii() or not p.isdigit() or len(p) > 2 or not low <= int(p) <= high for p in parts) or (
        len(parts) > 1 and not several
    ):
        more = "; several, as 7,6,5, for the bands of spherical harmonics" if several else ""
        raise ConfigError(f"--bits {word}: expected {low} to {high}{more}")
    return tuple(map(int, parts))
