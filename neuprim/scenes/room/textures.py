"""Patterns evaluated where a ray hits, averaged over the width that the ray stands for, so that they do not flicker.

Everything is a function of position; randomness is a hash of a cell's integer coordinates.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from neuprim.scenes.shapes import parse_srgb

Array = NDArray[np.float32]

Texture = Callable[[Array, Array], Array]
"""(M, 3) positions in scene units and (M,) widths in the same -> (M, 3) linear RGB reflectance 0..1."""

_PRIMES = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)


def stripes(x: Array, period: float, part: float, width: Array) -> Array:
    """(M,) share of intervals of ``width`` about ``x`` that the first ``part`` (0..1) of every ``period`` covers."""
    half = np.maximum(width / np.float32(period), np.float32(1e-4)) / 2
    t = x / np.float32(period)
    return ((_filled(t + half, part) - _filled(t - half, part)) / (2 * half)).astype(np.float32, copy=False)


def _filled(t: Array, part: float) -> NDArray[np.float64]:
    """How much of 0..t is covered; double precision, as nearly equal values are subtracted."""
    wide = t.astype(np.float64)
    whole = np.floor(wide)
    return whole * part + np.minimum(wide - whole, part)


def noise(points: Array, width: Array, cell: float, seed: int, octaves: int = 4, fall: float = 0.55) -> Array:
    """(M,) smooth noise about -1..1 of mean 0 at ``points`` (M, D), on lattices of edge ``cell``, ``cell``/2, ...

    Each is ``fall`` times weaker. An octave is left out where its cells are smaller than about ``width`` (M,).
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
    """(M,) values of -1..1 at integer coordinates, blended in between by a quintic with two smooth derivatives."""
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


# ---------------------------------------------------------------- textures


def speckled(code: str, seed: int, strength: float = 0.12, cell: float = 0.5) -> Texture:
    """One colour, unevenly painted."""
    colour = parse_srgb(code)
    return lambda p, w: np.clip(colour * (1 + np.float32(strength) * noise(p, w, cell, seed))[:, None], 0, 1)


def planks(
    dark: str, light: str, along: int, across: int, seed: int, width: float = 0.3, length: float = 2.2
) -> Texture:
    """Boards along one axis beside each other along another, each of its own tone, with a grain and narrow gaps."""
    one, other = parse_srgb(dark), parse_srgb(light)

    def texture(p: Array, w: Array) -> Array:
        row = np.floor(p[:, across] / width)
        x: Array = p[:, along] + np.float32(length) * cells(row[:, None].astype(np.int64), seed)
        board = np.stack([row, np.floor(x / length)], axis=1).astype(np.int64)
        grain = noise(np.stack([x / 9, p[:, across]], axis=1), w, 0.12, seed + 1, octaves=3, fall=0.7)
        knots = noise(np.stack([x / 3, p[:, across]], axis=1), w, 0.5, seed + 7, octaves=2)
        tone = 0.15 + 0.6 * cells(board, seed + 2) + 0.22 * grain + 0.15 * knots
        side = stripes(p[:, across] + 0.007, width, 0.014 / width, w)
        gap = np.maximum(side, stripes(x + 0.007, length, 0.014 / length, w))
        return mix(one, other, tone) * (1 - np.float32(0.75) * gap)[:, None]

    return texture


def bricks(u: int, v: int, seed: int, width: float = 0.62, height: float = 0.22, mortar: float = 0.03) -> Texture:
    """A wall of bricks, each of its own red, rough, every other row moved by half a brick."""
    dark, light, grout = parse_srgb("#7d3527"), parse_srgb("#cf7d5a"), parse_srgb("#c9c0b2")

    def texture(p: Array, w: Array) -> Array:
        row = np.floor(p[:, v] / height)
        x = p[:, u] + np.float32(width / 2) * (row % 2)
        brick = np.stack([np.floor(x / width), row], axis=1).astype(np.int64)
        flat = p[:, [u, v]]
        fine, coarse = noise(flat, w, 0.12, seed + 1, octaves=3), noise(flat, w, 2.5, seed + 2, 2)
        tone = 0.1 + 0.8 * cells(brick, seed) + 0.2 * fine + 0.15 * coarse
        joint = 1 - stripes(x, width, 1 - mortar / width, w) * stripes(p[:, v], height, 1 - mortar / height, w)
        return mix(mix(dark, light, tone), grout, joint)

    return texture


def chequered(one: str, other: str, u: int, v: int, cell: float, seed: int) -> Texture:
    """Squares of two colours with fine joints, worn unevenly."""
    first, second = parse_srgb(one), parse_srgb(other)

    def texture(p: Array, w: Array) -> Array:
        flat = p[:, [u, v]]
        across, up = stripes(p[:, u], 2 * cell, 0.5, w) - 0.5, stripes(p[:, v], 2 * cell, 0.5, w) - 0.5
        colour = mix(first, second, (0.5 + 2 * across * up).astype(np.float32))
        joint = np.maximum(stripes(p[:, u] + 0.01, cell, 0.02 / cell, w), stripes(p[:, v] + 0.01, cell, 0.02 / cell, w))
        worn = 1 + 0.14 * noise(flat, w, 1.4, seed, octaves=6, fall=0.7)
        return np.clip(colour * (worn * (1 - 0.5 * joint))[:, None], 0, 1)

    return texture


def wallpaper(u: int, v: int, seed: int) -> Texture:
    """Broad and narrow stripes with a row of dots in every broad one."""
    ground, broad, narrow, dot = map(parse_srgb, ("#e9dcc0", "#9db8a2", "#4f7a6b", "#b5533c"))

    def texture(p: Array, w: Array) -> Array:
        x, y = p[:, u], p[:, v]
        colour = mix(ground, broad, stripes(x, 0.8, 0.5, w))
        colour = mix(colour, narrow, stripes(x + 0.06, 0.4, 0.06, w))
        # dots in the middle of the broad stripes, moved by half a step from one to the next
        column = np.floor(x / 0.8)
        across = x - 0.8 * column - 0.2
        up = (y / 0.4 + 0.5 * (column % 2)) % 1 * 0.4 - 0.2
        edge = np.maximum(w, 0.005)
        inside = np.clip((0.075 - np.hypot(across, up)) / edge + 0.5, 0, 1) * np.minimum(1, 0.15 / edge) ** 2
        faded = 1 + 0.1 * noise(p[:, [u, v]], w, 2.0, seed, octaves=6, fall=0.7)
        return np.clip(mix(colour, dot, inside) * faded[:, None], 0, 1)

    return texture


def plaster(u: int, v: int, seed: int, panel: float) -> Texture:
    """Rough plaster in clouds of ochre; below the height ``panel`` a wainscot of upright boards."""
    light, dark, board, seam, edge = map(parse_srgb, ("#e6c98c", "#b0764a", "#5d6f86", "#2f3a4a", "#efe9dc"))
    narrow = np.array([1, 0.2], np.float32)

    def texture(p: Array, w: Array) -> Array:
        flat = p[:, [u, v]]
        rough = mix(light, dark, 0.45 + 0.5 * noise(flat, w, 1.6, seed, octaves=7, fall=0.72))
        boards = mix(board, seam, stripes(p[:, u], 0.32, 0.12, w))
        boards = boards * (1 + 0.1 * noise(flat * narrow, w, 0.12, seed + 9, octaves=2))[:, None]
        rail: Array = np.clip((0.06 - np.abs(p[:, v] - panel)) / np.maximum(w, 0.005) + 0.5, 0, 1)
        below: Array = np.clip((panel - p[:, v]) / np.maximum(w, 0.005) + 0.5, 0, 1)
        return np.clip(mix(mix(rough, boards, below), edge, rail), 0, 1)

    return texture


def painting(u: int, v: int, seed: int) -> Texture:
    """A picture: three colours flow into each other, with contours where one gives way to the next."""
    ground, *colours = map(parse_srgb, ("#12355b", "#e4572e", "#f3a712", "#76b041"))

    def texture(p: Array, w: Array) -> Array:
        flat = p[:, [u, v]]
        fields = [noise(flat, w, 0.7, seed + 17 * i, octaves=4, fall=0.5) for i in range(3)]
        colour = np.broadcast_to(ground, p.shape)
        for field, other in zip(fields, colours, strict=True):
            colour = mix(colour, other, 0.5 + 1.6 * field)
        lines = stripes(fields[0], 0.35, 0.14, 3 * w)
        return np.clip(colour * (1 - 0.55 * lines)[:, None], 0, 1)

    return texture


def books(u: int, v: int, seed: int, thickness: float = 0.11, shelf: float = 0.5) -> Texture:
    """Spines side by side: each of its own colour, with a band, and a dark line to the next."""
    codes = ("#8c2f39", "#1d3557", "#e0b04c", "#3a5a40", "#d8d0c0", "#5e3a78", "#c8553d", "#247ba0")
    colours = np.stack([parse_srgb(code) for code in codes])

    def texture(p: Array, w: Array) -> Array:
        index = np.stack([np.floor(p[:, u] / thickness), np.floor(p[:, v] / shelf)], axis=1).astype(np.int64)
        own = colours[np.minimum((cells(index, seed) * len(colours)).astype(np.int64), len(colours) - 1)]
        far = np.clip(w / np.float32(thickness) - 0.5, 0, 1)  # where one ray stands for several spines
        colour = mix(own, colours.mean(0), far)
        height = (p[:, v] / shelf) % 1
        band = (np.abs(height - 0.35 - 0.3 * cells(index, seed + 1)) < 0.06) * (1 - far)
        gap = stripes(p[:, u] + 0.008, thickness, 0.016 / thickness, w)
        return mix(colour, parse_srgb("#f1e4b8"), 0.8 * band) * (1 - 0.8 * gap)[:, None]

    return texture


def marble(seed: int) -> Texture:
    """Dark veins through something light, in all three dimensions."""
    light, vein = parse_srgb("#e4e0d8"), parse_srgb("#5a6470")

    def texture(p: Array, w: Array) -> Array:
        flow = noise(p, w, 0.9, seed, octaves=5, fall=0.6)
        fine = noise(p, w, 0.25, seed + 11, octaves=3)
        return mix(light, vein, 0.75 * (1 - np.abs(np.sin(3.0 * p[:, 2] + 4.0 * flow))) ** 2 + 0.15 * fine)

    return texture


def rug(radius: float, seed: int) -> Texture:
    """Rings about the z axis, some of them cut into wedges, woven from coarse yarn."""
    red, navy, cream = parse_srgb("#a63a3a"), parse_srgb("#1f2f4f"), parse_srgb("#e8dcc2")

    def texture(p: Array, w: Array) -> Array:
        r: Array = np.hypot(p[:, 0], p[:, 1])
        turn = (np.arctan2(p[:, 1], p[:, 0]) / np.float32(2 * np.pi)).astype(np.float32)
        around: Array = w / np.maximum(np.float32(2 * np.pi) * r, np.float32(0.1))  # what the width is in turns
        ring = stripes(r, radius / 4, 0.5, w)
        wedge = stripes(turn, 1 / 36, 0.5, around)
        colour = mix(mix(red, cream, wedge), navy, ring)
        colour = mix(colour, cream, stripes(r + 0.03, radius / 4, 0.2, w) * (1 - stripes(r, radius / 2, 0.5, w)))
        yarn = 1 + 0.2 * noise(p[:, :2], w, 0.16, seed, octaves=3, fall=0.8)
        return np.clip(colour * yarn[:, None], 0, 1)

    return texture


def sky(seed: int, low: float, high: float) -> Texture:
    """Clouds before a blue that pales from the height ``high`` down to ``low``; what is behind a window."""
    zenith, horizon, cloud = parse_srgb("#4f8fd6"), parse_srgb("#cfe3f2"), parse_srgb("#ffffff")

    def texture(p: Array, w: Array) -> Array:
        blue = mix(horizon, zenith, (p[:, 2] - low) / (high - low))
        spread = p * np.array([1, 1, 2], np.float32)
        return mix(blue, cloud, 0.25 + 1.1 * noise(spread, w, 0.8, seed, octaves=5))

    return texture
