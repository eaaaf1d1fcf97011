"""The interior of the scene ``room``: what stands where, what rays meet, and how it is lit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from neuprim.scenes.raycast import Engine, Hits, Scene
from neuprim.scenes.room.textures import (
    Texture,
    books,
    bricks,
    chequered,
    marble,
    painting,
    planks,
    plaster,
    rug,
    sky,
    speckled,
    wallpaper,
)
from neuprim.scenes.shading import add_surroundings, dot, reflect_light, visible_light
from neuprim.scenes.shapes import FLOOR, Solid, ball, chamfered_box, lathe, merge_meshes, rod, uniform_colour

Corner = tuple[float, float, float]

LOW, HIGH = (-6.0, -6.0, -1.6), (6.0, 6.0, 3.4)
"""Opposite corners of the room's inside, scene units; the solids stand in [-1, 1]^3."""

LAMP = (1.5, -1.9, 2.55)
"""The middle of the lamp's bulb, which is a point for shading."""

LAMP_POWER = (39.0, 35.8, 30.0)
"""Linear RGB irradiance of a surface that faces the lamp at distance 1; it falls with the distance squared."""

ABOVE, BELOW = (0.31, 0.32, 0.34), (0.27, 0.25, 0.23)
"""Linear RGB radiance from straight above and straight below, blended in between."""

_BULB = 0.14
_UP = [0, 0, 1]


class Furnishing(NamedTuple):
    """One closed body of the room; its ``texture`` glows, if ``glow`` is above 0, and then shows no other light."""

    name: str
    mesh: trimesh.Trimesh
    texture: Texture
    gloss: float = 0.0
    glow: float = 0.0


def furnish_room() -> list[Furnishing]:
    """All of the room but the solids, the same at every call. A cylinder of radius 4.7 about z is free of furniture."""
    return [
        *_shell(),
        *_table(),
        *_lamp(),
        *_by_the_bricks(),
        *_by_the_plaster(),
        *_by_the_wallpaper(),
        *_by_the_tiles(),
    ]


def _box(low: Corner, high: Corner, chamfer: float = 0.02) -> trimesh.Trimesh:
    """A box with these opposite corners."""
    return chamfered_box(np.subtract(high, low), np.add(low, high) / 2, chamfer)


def _slab(low: Corner, high: Corner) -> trimesh.Trimesh:
    """A box whose edges are not cut."""
    mesh = trimesh.creation.box(extents=np.subtract(high, low))
    mesh.apply_translation(np.add(low, high) / 2)
    return mesh


def _boxes(*corners: tuple[Corner, Corner], chamfer: float = 0.02) -> trimesh.Trimesh:
    return merge_meshes([_box(low, high, chamfer) for low, high in corners])


def _picture_frame(
    x: float, y: float, low: float, high: float, half: float, along: int, width: float, depth: float
) -> trimesh.Trimesh:
    """Four bars around an opening of half width ``half`` between two heights, on the wall through (x, y) that runs
    along an axis."""
    middle = np.array([x, y, (low + high) / 2])
    side = np.eye(3)[along]
    upright, level = np.full(3, depth), np.full(3, depth)
    upright[along], upright[2] = width, high - low + 2 * width
    level[along], level[2] = 2 * half, width
    bars = []
    for sign in (-1, 1):
        bars.append(chamfered_box(upright, middle + sign * side * (half + width / 2), 0.015))
        bars.append(chamfered_box(level, middle + np.array([0, 0, sign * (high - low + width) / 2]), 0.015))
    return merge_meshes(bars)


def _shell() -> list[Furnishing]:
    (x0, y0, z0), (x1, y1, z1) = LOW, HIGH
    t = 0.3
    below, above = (x0 - t, y0 - t), (x1 + t, y1 + t)
    skirting = _boxes(
        ((x0, y0, z0), (x1, y0 + 0.05, z0 + 0.16)),
        ((x0, y1 - 0.05, z0), (x1, y1, z0 + 0.16)),
        ((x0, y0, z0), (x0 + 0.05, y1, z0 + 0.16)),
        ((x1 - 0.05, y0, z0), (x1, y1, z0 + 0.16)),
    )
    beams = _boxes(*(((x0, y - 0.14, z1 - 0.22), (x1, y + 0.14, z1)) for y in (-4.2, -0.6, 3.0)))
    brick = _slab((x1, y0 - t, z0 - t), (x1 + t, y1 + t, z1 + t))
    papered = _slab((x0 - t, y0 - t, z0 - t), (x0, y1 + t, z1 + t))
    plastered = _slab((x0 - t, y1, z0 - t), (x1 + t, y1 + t, z1 + t))
    tiled = _slab((x0 - t, y0 - t, z0 - t), (x1 + t, y0, z1 + t))
    return [
        Furnishing("floor", _slab((*below, z0 - t), (*above, z0)), planks("#6b4426", "#c08a52", 0, 1, 11), 0.25),
        Furnishing("ceiling", _slab((*below, z1), (*above, z1 + t)), speckled("#ece6da", 23, 0.08, 1.0)),
        Furnishing("brick wall", brick, bricks(1, 2, 31)),
        Furnishing("papered wall", papered, wallpaper(1, 2, 41)),
        Furnishing("plastered wall", plastered, plaster(0, 2, 51, z0 + 1.5)),
        Furnishing("tiled wall", tiled, chequered("#d9cfba", "#3f7f86", 0, 2, 0.5, 61), 0.3),
        Furnishing("skirting", skirting, speckled("#e8e2d6", 71, 0.05)),
        Furnishing("beams", beams, planks("#4a2f1b", "#6e4a2c", 0, 1, 73, width=0.14)),
    ]


def _table() -> list[Furnishing]:
    """A round table under the plate of the solids, on a rug."""
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


def _lamp() -> list[Furnishing]:
    x, y, z = LAMP
    shade = [(0.0, 0.05), (0.05, 0.42), (0.08, 0.42), (0.2, 0.1), (0.22, 0.03)]
    return [
        Furnishing("bulb", ball(LAMP, _BULB, fine=False), speckled("#fff6e0", 91, 0.0), glow=3.0),
        Furnishing("shade", lathe([x, y, z + 0.15], _UP, shade), speckled("#2f6b5a", 93, 0.05), 0.5),
        Furnishing("cord", rod([x, y, z + 0.36], [x, y, HIGH[2] + 0.02], 0.02), speckled("#202020", 95, 0.0)),
    ]


def _by_the_bricks() -> list[Furnishing]:
    """The wall at x = 6: a window with four panes, and crates below."""
    x, low, high = HIGH[0], 0.2, 2.4
    pane = _box((x - 0.02, -1.4, low), (x + 0.05, 1.4, high), 0.005)
    upright, level = (
        _box((x - 0.1, -0.05, low), (x, 0.05, high), 0.01),
        _box((x - 0.1, -1.4, 1.25), (x, 1.4, 1.35), 0.01),
    )
    window = merge_meshes([_picture_frame(x, 0, low, high, 1.4, 1, 0.14, 0.2), upright, level])
    sill = _box((x - 0.3, -1.65, low - 0.24), (x, 1.65, low - 0.14))
    crates = _boxes(
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


def _by_the_plaster() -> list[Furnishing]:
    """The wall at y = 6: a shelf full of books, and a picture in a frame."""
    y0, y1, left, right, z, step = 5.3, 6.0, -4.6, -1.6, -1.6, 0.62
    boards = [((left, y0, z + step * i), (right, y1, z + step * i + 0.06)) for i in range(6)]
    sides = (left - 0.08, (left + right) / 2, right)
    boards += [((x, y0, z), (x + 0.08, y1, z + step * 5 + 0.06)) for x in sides]
    rows = [
        ((left, y0 + 0.12, z + step * i + 0.05), (right - gap, y1, z + step * i + height))
        for i, (gap, height) in enumerate([(0.0, 0.5), (0.5, 0.46), (0.0, 0.52), (1.1, 0.44), (0.2, 0.5)])
    ]
    picture, frame = (
        _box((1.2, 5.93, 0.5), (4.0, 6.0, 2.5), 0.005),
        _picture_frame(2.6, 6.0, 0.5, 2.5, 1.4, 0, 0.14, 0.24),
    )
    shelf = planks("#4d3524", "#7d5a3c", 0, 1, 111, width=0.4)
    return [
        Furnishing("shelf", _boxes(*boards, chamfer=0.005), shelf),
        Furnishing("books", _boxes(*rows, chamfer=0.005), books(0, 2, 113, shelf=step)),
        Furnishing("picture", picture, painting(0, 2, 115)),
        Furnishing("frame", frame, speckled("#b8892f", 117, 0.2, 0.2), 0.6),
    ]


def _by_the_wallpaper() -> list[Furnishing]:
    """The wall at x = -6: a long bench, two pictures above it, and a pillar in the corner."""
    column = [(0.0, 0.62), (0.2, 0.62), (0.3, 0.45), (4.7, 0.42), (4.8, 0.6), (5.0, 0.6)]
    bench = [_box((-5.95, -2.6, -1.35), (-5.15, 1.4, -1.1), 0.05), _box((-5.95, -2.6, -1.1), (-5.75, 1.4, -0.3), 0.05)]
    bench += [_box((-5.9, y, -1.6), (-5.2, y + 0.25, -1.35)) for y in (-2.5, 1.05)]
    small, tall = _box((-6.0, -2.4, 0.3), (-5.94, -0.8, 1.5), 0.005), _box((-6.0, 0.3, 0.1), (-5.94, 1.4, 2.0), 0.005)
    small_frame = _picture_frame(-6.0, -1.6, 0.3, 1.5, 0.8, 1, 0.1, 0.2)
    tall_frame = _picture_frame(-6.0, 0.85, 0.1, 2.0, 0.55, 1, 0.1, 0.2)
    return [
        Furnishing("bench", merge_meshes(bench), chequered("#b5533c", "#d98f4e", 1, 2, 0.2, 121)),
        Furnishing("small picture", small, painting(1, 2, 123)),
        Furnishing("small frame", small_frame, speckled("#26221e", 125, 0.1), 0.4),
        Furnishing("tall picture", tall, painting(1, 2, 127)),
        Furnishing("tall frame", tall_frame, speckled("#8a5a2b", 129, 0.15, 0.2), 0.4),
        Furnishing("pillar", lathe([-5.0, 5.0, -1.6], _UP, column), marble(131), 0.4),
    ]


def _by_the_tiles() -> list[Furnishing]:
    """The wall at y = -6: a cupboard, a door and a big pot."""
    places = [(x, z) for x in (-4.3, -3.55, -2.8) for z in (-1.4, -0.3)]
    panels = _boxes(*(((x, -5.27, z), (x + 0.62, -5.22, z + 0.95)) for x, z in places))
    places = [(x, z) for x in (1.45, 2.2) for z in (-1.4, 0.1)]
    fields = (((x, -5.93, z), (x + 0.55, -5.88, z + 1.1)) for x, z in places)
    door = _boxes(((1.3, -6.0, -1.6), (2.9, -5.92, 1.5)), *fields)
    cupboard = _box((-4.5, -6.0, -1.6), (-2.0, -5.25, 0.8), 0.03)
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


# ---------------------------------------------------------------- rays

_GRAZING = np.float32(0.04)
"""Least cosine between a ray and a surface's normal for the width that the ray stands for."""


class Room(Scene):
    """Solids, coloured as in scenes of their own, and furnishings, whose textures are averaged over what a ray covers.

    Args:
        spacing: of neighbouring rays at distance 1.
    """

    def __init__(
        self, solids: Sequence[Solid], around: Sequence[Furnishing], spacing: float, engine: Engine = "auto"
    ) -> None:
        black = uniform_colour("#000000")
        super().__init__([*solids, *(Solid(f.name, f.mesh, black, f.gloss) for f in around)], engine)
        self.glow = np.array([0.0] * len(solids) + [f.glow for f in around], dtype=np.float32)
        self._textures: list[Texture | None] = [*(None for _ in solids), *(f.texture for f in around)]
        self._spacing = np.float32(spacing)

    def intersect(self, origins: ArrayLike, directions: ArrayLike) -> Hits:
        """As of any scene, for directions of unit length."""
        hits = super().intersect(origins, directions)
        towards = np.asarray(directions, dtype=np.float32)[hits.hit]
        # A pixel covers an ellipse of the surface; its area decides, so grazing views blur across rather than flicker
        # along.
        root: NDArray[np.float32] = np.sqrt(np.maximum(np.abs(dot(hits.face, towards)), _GRAZING))
        width = hits.distance * self._spacing / root
        albedo = hits.albedo.copy()
        for index in np.unique(hits.solid):
            if (texture := self._textures[index]) is not None:
                mine = np.flatnonzero(hits.solid == index)
                albedo[mine] = texture(hits.position[mine], width[mine])
        return replace(hits, albedo=albedo)


def lamplight_radiance(room: Room, origins: ArrayLike, directions: ArrayLike) -> NDArray[np.float32]:
    """What N rays see: (N, 3) linear RGB, zero where nothing is hit, which inside the room does not happen.

    ``origins`` are (N, 3) or (3,), ``directions`` (N, 3) unit vectors.
    """
    d = np.asarray(directions, dtype=np.float32)
    hits = room.intersect(origins, d)
    to_eye = -d[hits.hit]
    to_lamp = np.array(LAMP, dtype=np.float32) - hits.position
    away = np.sqrt(dot(to_lamp, to_lamp))
    to_lamp /= away[:, None]
    beside_bulb = np.maximum(away - np.float32(1.2 * _BULB), 0)  # the bulb itself is no obstacle
    lit = visible_light(room, hits, to_lamp, beside_bulb)
    rgb = reflect_light(hits, to_eye, to_lamp) * (np.array(LAMP_POWER, dtype=np.float32) * (lit / away**2)[:, None])
    add_surroundings(rgb, hits, to_eye, ABOVE, BELOW)
    glow = room.glow[hits.solid][:, None]
    image = np.zeros(d.shape, dtype=np.float32)
    image[hits.hit] = np.where(glow > 0, glow * hits.albedo, rgb)
    return image
