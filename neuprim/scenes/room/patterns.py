"""Patterns evaluated where a ray hits, averaged over the width that the ray stands for, so that distant detail blurs
and does not flicker.

Everything is a function of position; nothing is stored, nothing is random but by the hash of a cell's whole
coordinates.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["cells", "checks", "mix", "noise", "stripes"]

Array = NDArray[np.float32]

_PRIMES = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)


def stripes(x: Array, period: float, part: float, width: Array) -> Array:
    """(M,) share of the intervals of ``width`` (M,) about ``x`` (M,) that the first ``part`` (0..1) of every ``period``
    covers."""
    half = np.maximum(width / np.float32(period), np.float32(1e-4)) / 2
    t = x / np.float32(period)
    return ((_filled(t + half, part) - _filled(t - half, part)) / (2 * half)).astype(np.float32, copy=False)


def _filled(t: Array, part: float) -> NDArray[np.float64]:
    """How much of 0..t is covered; double precision, as nearly equal values are subtracted."""
    wide = t.astype(np.float64)
    whole = np.floor(wide)
    return whole * part + np.minimum(wide - whole, part)


def checks(x: Array, y: Array, cell: float, width: Array) -> Array:
    """(M,) share of the light squares of a chequerboard of edge ``cell``."""
    return (0.5 + 2 * (stripes(x, 2 * cell, 0.5, width) - 0.5) * (stripes(y, 2 * cell, 0.5, width) - 0.5)).astype(
        np.float32
    )


def noise(points: Array, width: Array, cell: float, seed: int, octaves: int = 4, fall: float = 0.55) -> Array:
    """(M,) smooth noise about -1..1 of mean 0 at ``points`` (M, D): lattices of edge ``cell``, ``cell``/2, ..., each
    ``fall`` times weaker.

    An octave is left out where its cells are smaller than about ``width`` (M,), having averaged out.
    """
    total = np.zeros(len(points), dtype=np.float32)
    strength = 1.0
    for octave in range(octaves):
        edge = cell / 2**octave
        weight = np.clip(1.5 - width / np.float32(edge), 0, 1) * np.float32(strength)
        seen = np.flatnonzero(weight > 0)
        if len(seen) == len(points):
            total += weight * _lattice(points / np.float32(edge), seed + octave)
        else:
            total[seen] += weight[seen] * _lattice(points[seen] / np.float32(edge), seed + octave)
        strength *= fall
    return total


def cells(index: NDArray[np.integer], seed: int) -> Array:
    """(M,) numbers 0..1, evenly spread and without pattern, one for each of the whole coordinates ``index`` (M, D)."""
    h = np.full(len(index), (seed * 0x27D4EB2F + 0x165667B1) & 0xFFFFFFFF, dtype=np.uint32)
    for axis in range(index.shape[1]):
        h = (h ^ index[:, axis].astype(np.int64).astype(np.uint32)) * np.uint32(_PRIMES[axis % 3])
        h ^= h >> np.uint32(15)
    h *= np.uint32(0x2C1B3C6D)
    h ^= h >> np.uint32(12)
    h *= np.uint32(0x297A2D39)
    h ^= h >> np.uint32(15)
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def mix(one: Array, other: Array, share: Array) -> Array:
    """(M, 3) from ``one`` where ``share`` (M,) is 0 to ``other`` where it is 1; both (3,) or (M, 3)."""
    t = np.clip(share, 0, 1)[:, None].astype(np.float32, copy=False)
    return one + t * (other - one)


def _lattice(points: Array, seed: int) -> Array:
    """(M,) values of -1..1 at whole coordinates, blended in between by the quintic whose first and second derivatives
    vanish there."""
    base = np.floor(points)
    t = points - base
    t = t * t * t * (t * (t * 6 - 15) + 10)
    corner = base.astype(np.int64)
    total = np.zeros(len(points), dtype=np.float32)
    for bits in range(2 ** points.shape[1]):
        step = [(bits >> axis) & 1 for axis in range(points.shape[1])]
        weight = np.ones(len(points), dtype=np.float32)
        for axis, up in enumerate(step):
            weight *= t[:, axis] if up else 1 - t[:, axis]
        total += weight * cells(corner + step, seed)
    return 2 * total - 1
