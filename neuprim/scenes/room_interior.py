"""Furnishings of the scene ``room``, with procedural textures that are averaged over the width of a ray."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from neuprim.scenes.shapes import (
    FLOOR,
    ball,
    chamfered_box,
    lathe,
    merge_solid_meshes,
    parse_solid_srgb,
    rod,
)

Array = NDArray[np.float32]

Texture = Callable[[Array, Array], Array]
"""Function: (M, 3) positions and (M,) ray widths, both in scene units -> (M, 3) linear RGB reflectance 0..1."""

_PRIMES = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)


def stripes(x: Array, period: float, part: float, width: Array) -> Array:
    """Return (M,) box-filtered stripes: the fraction of an interval of length ``width`` around ``x`` that is striped.

    Each ``period`` begins with a stripe, whose length is the fraction ``part``, 0..1, of the period.
    """

    def covered(t: Array) -> NDArray[np.float64]:  # of 0..t, in double precision, as nearly equal values are subtracted
        wide = t.astype(np.float64)
        whole = np.floor(wide)
        return whole * part + np.minimum(wide - whole, part)

    half = np.maximum(width / np.float32(period), np.float32(1e-4)) / 2
    t = x / np.float32(period)
    return ((covered(t + half) - covered(t - half)) / (2 * half)).astype(np.float32, copy=False)


def lattice_noise(points: Array, width: Array, cell: float, seed: int, octaves: int = 4, fall: float = 0.55) -> Array:
    """Return (M,) smooth noise at ``points`` (M, D), about -1..1, with mean 0.

    The noise is a sum of octaves with lattice edges ``cell``, ``cell``/2, ... Each octave has ``fall`` times the
    amplitude of the octave before. Octaves whose lattice edge is smaller than about ``width`` (M,) are left out.
    """
    total, strength = np.zeros(len(points), dtype=np.float32), 1.0
    for octave in range(octaves):
        edge = cell / 2**octave
        weight = np.clip(1.5 - width / np.float32(edge), 0, 1) * np.float32(strength)
        seen = np.flatnonzero(weight > 0)
        total[seen] += weight[seen] * _lattice_noise(points[seen] / np.float32(edge), seed + octave)
        strength *= fall
    return total


def cell_random(index: NDArray[np.integer], seed: int) -> Array:
    """Return (M,) pseudo-random uniform numbers 0..1, hashed from the integer coordinates ``index`` (M, D)."""
    h = np.full(len(index), (seed * 0x27D4EB2F + 0x165667B1) & 0xFFFFFFFF, dtype=np.uint32)
    for axis in range(index.shape[1]):
        h = (h ^ index[:, axis].astype(np.int64).astype(np.uint32)) * np.uint32(_PRIMES[axis % 3])
        h ^= h >> np.uint32(15)
    h *= np.uint32(0x2C1B3C6D)
    h ^= h >> np.uint32(12)
    h *= np.uint32(0x297A2D39)
    h ^= h >> np.uint32(15)
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def mix_colours(one: Array, other: Array, share: Array) -> Array:
    """Blend two colours linearly; return (M, 3). ``one`` and ``other`` are (3,) or (M, 3).

    ``share`` (M,) is clipped to 0..1: 0 gives ``one``, 1 gives ``other``.
    """
    t = np.clip(share, 0, 1)[:, None].astype(np.float32, copy=False)
    return one + t * (other - one)


def _lattice_noise(points: Array, seed: int) -> Array:
    """Return (M,) noise -1..1: random values on the integer lattice, interpolated by quintic polynomials.

    The first two derivatives are continuous.
    """
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
        total += weight * cell_random(corner + step, seed)
    return 2 * total - 1


# ---------------------------------------------------------------- textures


def speckled(code: str, seed: int, strength: float = 0.12, cell: float = 0.5) -> Texture:
    """Return a texture of uneven paint: one colour, "#rrggbb", whose brightness varies by noise of size ``cell``."""
    colour = parse_solid_srgb(code)
    return lambda p, w: np.clip(colour * (1 + np.float32(strength) * lattice_noise(p, w, cell, seed))[:, None], 0, 1)


def planks(
    dark: str, light: str, along: int, across: int, seed: int, width: float = 0.3, length: float = 2.2
) -> Texture:
    """Return a texture of wooden boards with grain and gaps.

    ``along`` and ``across`` are the indices of the axes along the boards and across the boards.
    """
    one, other = parse_solid_srgb(dark), parse_solid_srgb(light)

    def texture(p: Array, w: Array) -> Array:
        row = np.floor(p[:, across] / width)
        x: Array = p[:, along] + np.float32(length) * cell_random(row[:, None].astype(np.int64), seed)
        board = np.stack([row, np.floor(x / length)], axis=1).astype(np.int64)
        grain = lattice_noise(np.stack([x / 9, p[:, across]], axis=1), w, 0.12, seed + 1, octaves=3, fall=0.7)
        knots = lattice_noise(np.stack([x / 3, p[:, across]], axis=1), w, 0.5, seed + 7, octaves=2)
        tone = 0.15 + 0.6 * cell_random(board, seed + 2) + 0.22 * grain + 0.15 * knots
        side = stripes(p[:, across] + 0.007, width, 0.014 / width, w)
        gap = np.maximum(side, stripes(x + 0.007, length, 0.014 / length, w))
        return mix_colours(one, other, tone) * (1 - np.float32(0.75) * gap)[:, None]

    return texture


def bricks(u: int, v: int, seed: int, width: float = 0.62, height: float = 0.22, mortar: float = 0.03) -> Texture:
    """Return a texture of red bricks and mortar; ``u``, ``v`` are the indices of the horizontal and vertical axis."""
    dark, light, grout = parse_solid_srgb("#7d3527"), parse_solid_srgb("#cf7d5a"), parse_solid_srgb("#c9c0b2")

    def texture(p: Array, w: Array) -> Array:
        row = np.floor(p[:, v] / height)
        x = p[:, u] + np.float32(width / 2) * (row % 2)
        brick = np.stack([np.floor(x / width), row], axis=1).astype(np.int64)
        flat = p[:, [u, v]]
        fine, coarse = lattice_noise(flat, w, 0.12, seed + 1, octaves=3), lattice_noise(flat, w, 2.5, seed + 2, 2)
        tone = 0.1 + 0.8 * cell_random(brick, seed) + 0.2 * fine + 0.15 * coarse
        joint = 1 - stripes(x, width, 1 - mortar / width, w) * stripes(p[:, v], height, 1 - mortar / height, w)
        return mix_colours(mix_colours(dark, light, tone), grout, joint)

    return texture


def chequered(one: str, other: str, u: int, v: int, cell: float, seed: int) -> Texture:
    """Return a texture of worn squares in two colours, with fine joints. ``u``, ``v`` are the indices of the axes."""
    first, second = parse_solid_srgb(one), parse_solid_srgb(other)

    def texture(p: Array, w: Array) -> Array:
        flat = p[:, [u, v]]
        across, up = stripes(p[:, u], 2 * cell, 0.5, w) - 0.5, stripes(p[:, v], 2 * cell, 0.5, w) - 0.5
        colour = mix_colours(first, second, (0.5 + 2 * across * up).astype(np.float32))
        joint = np.maximum(stripes(p[:, u] + 0.01, cell, 0.02 / cell, w), stripes(p[:, v] + 0.01, cell, 0.02 / cell, w))
        worn = 1 + 0.14 * lattice_noise(flat, w, 1.4, seed, octaves=6, fall=0.7)
        return np.clip(colour * (worn * (1 - 0.5 * joint))[:, None], 0, 1)

    return texture


def wallpaper(u: int, v: int, seed: int) -> Texture:
    """Return a wallpaper texture: broad and narrow stripes, with a row of dots in every broad stripe."""
    ground, broad, narrow, dot = map(parse_solid_srgb, ("#e9dcc0", "#9db8a2", "#4f7a6b", "#b5533c"))

    def texture(p: Array, w: Array) -> Array:
        x, y = p[:, u], p[:, v]
        colour = mix_colours(ground, broad, stripes(x, 0.8, 0.5, w))
        colour = mix_colours(colour, narrow, stripes(x + 0.06, 0.4, 0.06, w))
        # dots in the middle of the broad stripes, moved by half a step from one to the next
        column = np.floor(x / 0.8)
        across = x - 0.8 * column - 0.2
        up = (y / 0.4 + 0.5 * (column % 2)) % 1 * 0.4 - 0.2
        edge = np.maximum(w, 0.005)
        inside = np.clip((0.075 - np.hypot(across, up)) / edge + 0.5, 0, 1) * np.minimum(1, 0.15 / edge) ** 2
        faded = 1 + 0.1 * lattice_noise(p[:, [u, v]], w, 2.0, seed, octaves=6, fall=0.7)
        return np.clip(mix_colours(colour, dot, inside) * faded[:, None], 0, 1)

    return texture


def plaster(u: int, v: int, seed: int, panel: float) -> Texture:
    """Return a wall texture: rough ochre plaster, and upright boards below the height ``panel``, scene units."""
    light, dark, board, seam, edge = map(parse_solid_srgb, ("#e6c98c", "#b0764a", "#5d6f86", "#2f3a4a", "#efe9dc"))
    narrow = np.array([1, 0.2], np.float32)

    def texture(p: Array, w: Array) -> Array:
        flat = p[:, [u, v]]
        rough = mix_colours(light, dark, 0.45 + 0.5 * lattice_noise(flat, w, 1.6, seed, octaves=7, fall=0.72))
        boards = mix_colours(board, seam, stripes(p[:, u], 0.32, 0.12, w))
        boards = boards * (1 + 0.1 * lattice_noise(flat * narrow, w, 0.12, seed + 9, octaves=2))[:, None]
        rail: Array = np.clip((0.06 - np.abs(p[:, v] - panel)) / np.maximum(w, 0.005) + 0.5, 0, 1)
        below: Array = np.clip((panel - p[:, v]) / np.maximum(w, 0.005) + 0.5, 0, 1)
        return np.clip(mix_colours(mix_colours(rough, boards, below), edge, rail), 0, 1)

    return texture


def painting(u: int, v: int, seed: int) -> Texture:
    """Return the texture of an abstract painting: three colours that blend, with contour lines between them."""
    ground, *colours = map(parse_solid_srgb, ("#12355b", "#e4572e", "#f3a712", "#76b041"))

    def texture(p: Array, w: Array) -> Array:
        flat = p[:, [u, v]]
        fields = [lattice_noise(flat, w, 0.7, seed + 17 * i, octaves=4, fall=0.5) for i in range(3)]
        colour = np.broadcast_to(ground, p.shape)
        for field, other in zip(fields, colours, strict=True):
            colour = mix_colours(colour, other, 0.5 + 1.6 * field)
        lines = stripes(fields[0], 0.35, 0.14, 3 * w)
        return np.clip(colour * (1 - 0.55 * lines)[:, None], 0, 1)

    return texture


def books(u: int, v: int, seed: int, thickness: float = 0.11, shelf: float = 0.5) -> Texture:
    """Return a texture of book spines in random colours, each with a band, separated by dark lines."""
    codes = ("#8c2f39", "#1d3557", "#e0b04c", "#3a5a40", "#d8d0c0", "#5e3a78", "#c8553d", "#247ba0")
    colours = np.stack([parse_solid_srgb(code) for code in codes])

    def texture(p: Array, w: Array) -> Array:
        index = np.stack([np.floor(p[:, u] / thickness), np.floor(p[:, v] / shelf)], axis=1).astype(np.int64)
        own = colours[np.minimum((cell_random(index, seed) * len(colours)).astype(np.int64), len(colours) - 1)]
        far = np.clip(w / np.float32(thickness) - 0.5, 0, 1)  # where one ray stands for several spines
        colour = mix_colours(own, colours.mean(0), far)
        height = (p[:, v] / shelf) % 1
        band = (np.abs(height - 0.35 - 0.3 * cell_random(index, seed + 1)) < 0.06) * (1 - far)
        gap = stripes(p[:, u] + 0.008, thickness, 0.016 / thickness, w)
        return mix_colours(colour, parse_solid_srgb("#f1e4b8"), 0.8 * band) * (1 - 0.8 * gap)[:, None]

    return texture


def marble(seed: int) -> Texture:
    """Return a 3D marble texture: dark veins in light stone."""
    light, vein = parse_solid_srgb("#e4e0d8"), parse_solid_srgb("#5a6470")

    def texture(p: Array, w: Array) -> Array:
        flow = lattice_noise(p, w, 0.9, seed, octaves=5, fall=0.6)
        fine = lattice_noise(p, w, 0.25, seed + 11, octaves=3)
        return mix_colours(light, vein, 0.75 * (1 - np.abs(np.sin(3.0 * p[:, 2] + 4.0 * flow))) ** 2 + 0.15 * fine)

    return texture


def rug(radius: float, seed: int) -> Texture:
    """Return the texture of a woven rug: rings about the z axis; some rings are divided into wedges."""
    red, navy, cream = parse_solid_srgb("#a63a3a"), parse_solid_srgb("#1f2f4f"), parse_solid_srgb("#e8dcc2")

    def texture(p: Array, w: Array) -> Array:
        r: Array = np.hypot(p[:, 0], p[:, 1])
        turn = (np.arctan2(p[:, 1], p[:, 0]) / np.float32(2 * np.pi)).astype(np.float32)
        around: Array = w / np.maximum(np.float32(2 * np.pi) * r, np.float32(0.1))  # the width in turns
        ring = stripes(r, radius / 4, 0.5, w)
        wedge = stripes(turn, 1 / 36, 0.5, around)
        colour = mix_colours(mix_colours(red, cream, wedge), navy, ring)
        rings = stripes(r + 0.03, radius / 4, 0.2, w) * (1 - stripes(r, radius / 2, 0.5, w))
        colour = mix_colours(colour, cream, rings)
        yarn = 1 + 0.2 * lattice_noise(p[:, :2], w, 0.16, seed, octaves=3, fall=0.8)
        return np.clip(colour * yarn[:, None], 0, 1)

    return texture


def sky(seed: int, low: float, high: float) -> Texture:
    """Return a texture of sky and clouds; the blue becomes paler from height ``high`` down to ``low``."""
    zenith, horizon, cloud = parse_solid_srgb("#4f8fd6"), parse_solid_srgb("#cfe3f2"), parse_solid_srgb("#ffffff")

    def texture(p: Array, w: Array) -> Array:
        blue = mix_colours(horizon, zenith, (p[:, 2] - low) / (high - low))
        spread = p * np.array([1, 1, 2], np.float32)
        return mix_colours(blue, cloud, 0.25 + 1.1 * lattice_noise(spread, w, 0.8, seed, octaves=5))

    return texture


Corner = tuple[float, float, float]

LOW, HIGH = (-6.0, -6.0, -1.6), (6.0, 6.0, 3.4)  # opposite corners of the room's inside; solids are in [-1, 1]^3
LAMP = (1.5, -1.9, 2.55)  # the middle of the lamp's bulb, a point light in shading
LAMP_POWER = (39.0, 35.8, 30.0)  # linear RGB irradiance at distance 1; it falls with the distance squared
ABOVE, BELOW = (0.31, 0.32, 0.34), (0.27, 0.25, 0.23)  # linear RGB radiance from straight above and straight below
BULB = 0.14
_UP = [0, 0, 1]


class Furnishing(NamedTuple):
    """A closed body in the room. If ``glow`` is above 0, the body emits the texture's colour and reflects no light."""

    name: str
    mesh: trimesh.Trimesh
    texture: Texture
    gloss: float = 0.0
    glow: float = 0.0


def furnish_room() -> list[Furnishing]:
    """Build all bodies of the scene ``room`` except the solids; every call returns equal bodies.

    The cameras need space: a cylinder of radius 4.7 about the z axis is free of furniture.
    """
    inside = [*_wall_furnishings(), *_table_furnishings(), *_lamp_furnishings()]
    inside += [*_brick_side_furnishings(), *_plaster_side_furnishings()]
    return [*inside, *_wallpaper_side_furnishings(), *_tile_side_furnishings()]


def _room_corner_box(low: Corner, high: Corner, chamfer: float = 0.02) -> trimesh.Trimesh:
    """Build a chamfered box from two opposite corners."""
    return chamfered_box(np.subtract(high, low), np.add(low, high) / 2, chamfer)


def _wall_slab(low: Corner, high: Corner) -> trimesh.Trimesh:
    """Build a box without chamfers from two opposite corners."""
    mesh = trimesh.creation.box(extents=np.subtract(high, low))
    mesh.apply_translation(np.add(low, high) / 2)
    return mesh


def _room_corner_boxes(*corners: tuple[Corner, Corner], chamfer: float = 0.02) -> trimesh.Trimesh:
    return merge_solid_meshes([_room_corner_box(low, high, chamfer) for low, high in corners])


def _picture_frame(
    x: float, y: float, low: float, high: float, half: float, along: int, width: float, depth: float
) -> trimesh.Trimesh:
    """Build a frame of four bars around an opening in a wall, centred at ``x``, ``y``.

    The opening is 2 ``half`` wide along the axis with index ``along``, and reaches from height ``low`` to ``high``.
    """
    middle = np.array([x, y, (low + high) / 2])
    side = np.eye(3)[along]
    upright, level = np.full(3, depth), np.full(3, depth)
    upright[along], upright[2] = width, high - low + 2 * width
    level[along], level[2] = 2 * half, width
    bars = []
    for sign in (-1, 1):
        bars.append(chamfered_box(upright, middle + sign * side * (half + width / 2), 0.015))
        bars.append(chamfered_box(level, middle + np.array([0, 0, sign * (high - low + width) / 2]), 0.015))
    return merge_solid_meshes(bars)


def _wall_furnishings() -> list[Furnishing]:
    (x0, y0, z0), (x1, y1, z1) = LOW, HIGH
    t = 0.3
    below, above = (x0 - t, y0 - t), (x1 + t, y1 + t)
    skirting = _room_corner_boxes(
        ((x0, y0, z0), (x1, y0 + 0.05, z0 + 0.16)),
        ((x0, y1 - 0.05, z0), (x1, y1, z0 + 0.16)),
        ((x0, y0, z0), (x0 + 0.05, y1, z0 + 0.16)),
        ((x1 - 0.05, y0, z0), (x1, y1, z0 + 0.16)),
    )
    beams = _room_corner_boxes(*(((x0, y - 0.14, z1 - 0.22), (x1, y + 0.14, z1)) for y in (-4.2, -0.6, 3.0)))
    brick = _wall_slab((x1, y0 - t, z0 - t), (x1 + t, y1 + t, z1 + t))
    papered = _wall_slab((x0 - t, y0 - t, z0 - t), (x0, y1 + t, z1 + t))
    plastered = _wall_slab((x0 - t, y1, z0 - t), (x1 + t, y1 + t, z1 + t))
    tiled = _wall_slab((x0 - t, y0 - t, z0 - t), (x1 + t, y0, z1 + t))
    return [
        Furnishing("floor", _wall_slab((*below, z0 - t), (*above, z0)), planks("#6b4426", "#c08a52", 0, 1, 11), 0.25),
        Furnishing("ceiling", _wall_slab((*below, z1), (*above, z1 + t)), speckled("#ece6da", 23, 0.08, 1.0)),
        Furnishing("brick wall", brick, bricks(1, 2, 31)),
        Furnishing("papered wall", papered, wallpaper(1, 2, 41)),
        Furnishing("plastered wall", plastered, plaster(0, 2, 51, z0 + 1.5)),
        Furnishing("tiled wall", tiled, chequered("#d9cfba", "#3f7f86", 0, 2, 0.5, 61), 0.3),
        Furnishing("skirting", skirting, speckled("#e8e2d6", 71, 0.05)),
        Furnishing("beams", beams, planks("#4a2f1b", "#6e4a2c", 0, 1, 73, width=0.14)),
    ]


def _table_furnishings() -> list[Furnishing]:
    """Build a round table under the plate of the solids, on a rug."""
    top, foot, radius = FLOOR - 0.08, LOW[2], 1.3
    disc = [(0, radius - 0.04), (0.03, radius), (0.06, radius), (0.09, radius - 0.03)]
    leg = [(0.02, 0.62), (0.09, 0.6), (0.16, 0.2), (0.5, 0.13), (top - foot - 0.16, 0.16), (top - foot - 0.08, 0.5)]
    carpet = [(0, 2.5), (0.015, 2.5), (0.02, 2.49)]
    boards = planks("#5b3a24", "#a9764a", 1, 0, 81, width=0.21)
    return [
        Furnishing("table top", lathe([0, 0, top - 0.09], _UP, disc), boards, 0.35),
        Furnishing("table leg", lathe([0, 0, foot], _UP, leg), speckled("#54351f", 83, 0.3, 0.12), 0.3),
        Furnishing("rug", lathe([0, 0, foot], _UP, carpet), rug(2.5, 85)),
    ]


def _lamp_furnishings() -> list[Furnishing]:
    x, y, z = LAMP
    shade = [(0.0, 0.05), (0.05, 0.42), (0.08, 0.42), (0.2, 0.1), (0.22, 0.03)]
    return [
        Furnishing("bulb", ball(LAMP, BULB, fine=False), speckled("#fff6e0", 91, 0.0), glow=3.0),
        Furnishing("shade", lathe([x, y, z + 0.15], _UP, shade), speckled("#2f6b5a", 93, 0.05), 0.5),
        Furnishing("cord", rod([x, y, z + 0.36], [x, y, HIGH[2] + 0.02], 0.02), speckled("#202020", 95, 0.0)),
    ]


def _brick_side_furnishings() -> list[Furnishing]:
    """Build the furnishings at the brick wall, x = 6: a window with four panes, and crates."""
    x, low, high = HIGH[0], 0.2, 2.4
    pane = _room_corner_box((x - 0.02, -1.4, low), (x + 0.05, 1.4, high), 0.005)
    upright = _room_corner_box((x - 0.1, -0.05, low), (x, 0.05, high), 0.01)
    level = _room_corner_box((x - 0.1, -1.4, 1.25), (x, 1.4, 1.35), 0.01)
    window = merge_solid_meshes([_picture_frame(x, 0, low, high, 1.4, 1, 0.14, 0.2), upright, level])
    sill = _room_corner_box((x - 0.3, -1.65, low - 0.24), (x, 1.65, low - 0.14))
    crates = _room_corner_boxes(
        ((5.0, 3.6, -1.6), (5.9, 4.9, -0.7)),
        ((5.1, 3.8, -0.7), (5.8, 4.7, 0.0)),
        ((5.2, -4.4, -1.6), (5.9, -3.2, -0.9)),
        chamfer=0.03,
    )
    return [
        Furnishing("pane", pane, sky(101, low, high), glow=0.95),
        Furnishing("window", window, speckled("#f2efe8", 103, 0.05), 0.3),
        Furnishing("sill", sill, speckled("#f2efe8", 105, 0.05), 0.3),
        Furnishing("crates", crates, planks("#7c5a34", "#cfa46a", 1, 2, 107, width=0.22, length=1.3)),
    ]


def _plaster_side_furnishings() -> list[Furnishing]:
    """Build the furnishings at the plastered wall, y = 6: a shelf full of books, and a picture in a frame."""
    y0, y1, left, right, z, step = 5.3, 6.0, -4.6, -1.6, -1.6, 0.62
    boards = [((left, y0, z + step * i), (right, y1, z + step * i + 0.06)) for i in range(6)]
    sides = (left - 0.08, (left + right) / 2, right)
    boards += [((x, y0, z), (x + 0.08, y1, z + step * 5 + 0.06)) for x in sides]
    rows = [
        ((left, y0 + 0.12, z + step * i + 0.05), (right - gap, y1, z + step * i + height))
        for i, (gap, height) in enumerate([(0.0, 0.5), (0.5, 0.46), (0.0, 0.52), (1.1, 0.44), (0.2, 0.5)])
    ]
    picture = _room_corner_box((1.2, 5.93, 0.5), (4.0, 6.0, 2.5), 0.005)
    frame = _picture_frame(2.6, 6.0, 0.5, 2.5, 1.4, 0, 0.14, 0.24)
    shelf = planks("#4d3524", "#7d5a3c", 0, 1, 111, width=0.4)
    return [
        Furnishing("shelf", _room_corner_boxes(*boards, chamfer=0.005), shelf),
        Furnishing("books", _room_corner_boxes(*rows, chamfer=0.005), books(0, 2, 113, shelf=step)),
        Furnishing("picture", picture, painting(0, 2, 115)),
        Furnishing("frame", frame, speckled("#b8892f", 117, 0.2, 0.2), 0.6),
    ]


def _wallpaper_side_furnishings() -> list[Furnishing]:
    """Build the furnishings at the papered wall, x = -6: a bench, two pictures above it, and a pillar in the corner."""
    column = [(0.0, 0.62), (0.2, 0.62), (0.3, 0.45), (4.7, 0.42), (4.8, 0.6), (5.0, 0.6)]
    bench = [
        _room_corner_box((-5.95, -2.6, -1.35), (-5.15, 1.4, -1.1), 0.05),
        _room_corner_box((-5.95, -2.6, -1.1), (-5.75, 1.4, -0.3), 0.05),
    ]
    bench += [_room_corner_box((-5.9, y, -1.6), (-5.2, y + 0.25, -1.35)) for y in (-2.5, 1.05)]
    small, tall = (
        _room_corner_box((-6.0, -2.4, 0.3), (-5.94, -0.8, 1.5), 0.005),
        _room_corner_box((-6.0, 0.3, 0.1), (-5.94, 1.4, 2.0), 0.005),
    )
    small_frame = _picture_frame(-6.0, -1.6, 0.3, 1.5, 0.8, 1, 0.1, 0.2)
    tall_frame = _picture_frame(-6.0, 0.85, 0.1, 2.0, 0.55, 1, 0.1, 0.2)
    return [
        Furnishing("bench", merge_solid_meshes(bench), chequered("#b5533c", "#d98f4e", 1, 2, 0.2, 121)),
        Furnishing("small picture", small, painting(1, 2, 123)),
        Furnishing("small frame", small_frame, speckled("#26221e", 125, 0.1), 0.4),
        Furnishing("tall picture", tall, painting(1, 2, 127)),
        Furnishing("tall frame", tall_frame, speckled("#8a5a2b", 129, 0.15, 0.2), 0.4),
        Furnishing("pillar", lathe([-5.0, 5.0, -1.6], _UP, column), marble(131), 0.4),
    ]


def _tile_side_furnishings() -> list[Furnishing]:
    """Build the furnishings at the tiled wall, y = -6: a cupboard, a door, and a big pot with a bush."""
    places = [(x, z) for x in (-4.3, -3.55, -2.8) for z in (-1.4, -0.3)]
    panels = _room_corner_boxes(*(((x, -5.27, z), (x + 0.62, -5.22, z + 0.95)) for x, z in places))
    places = [(x, z) for x in (1.45, 2.2) for z in (-1.4, 0.1)]
    fields = (((x, -5.93, z), (x + 0.55, -5.88, z + 1.1)) for x, z in places)
    door = _room_corner_boxes(((1.3, -6.0, -1.6), (2.9, -5.92, 1.5)), *fields)
    cupboard = _room_corner_box((-4.5, -6.0, -1.6), (-2.0, -5.25, 0.8), 0.03)
    pot = [(0.0, 0.3), (0.2, 0.42), (0.5, 0.48), (0.75, 0.4), (0.85, 0.45), (0.9, 0.45)]
    glaze = bricks(0, 2, 145, width=0.2, height=0.15, mortar=0.02)
    door_frame = _picture_frame(2.1, -6.0, -1.8, 1.5, 0.8, 0, 0.12, 0.24)
    return [
        Furnishing("cupboard", cupboard, speckled("#496a81", 141, 0.15, 0.3), 0.2),
        Furnishing("panels", panels, speckled("#6f93a8", 143, 0.15, 0.3), 0.2),
        Furnishing("pot", lathe([-0.2, -5.4, -1.6], _UP, pot), glaze, 0.3),
        Furnishing("bush", ball([-0.2, -5.4, -0.2], 0.62), speckled("#3f7d3a", 147, 0.7, 0.25)),
        Furnishing("door", door, planks("#6e2f24", "#8f4a35", 2, 0, 149, width=0.4), 0.3),
        Furnishing("door frame", door_frame, speckled("#efe9dc", 151, 0.05), 0.2),
    ]
