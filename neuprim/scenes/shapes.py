"""The solids of the built-in scenes: a power drill over a chequered plate, and small things that are hard to fit.

Sharp edges (chamfered boxes, a pyramid, a plate), thin parts (drill bit, pins, a wire cube, a trigger guard) and smooth
curves (grip, ring, banana) in saturated colours, all inside the box [-1, 1]^3 with z up. Nothing here knows about
lights or cameras, and nothing is random.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import trimesh
from numpy.typing import NDArray

from neuprim.scenes.meshes import arc_tube, ball, chamfered_box, lathe, merged, pyramid, ring, rod

__all__ = ["FLOOR", "Albedo", "Solid", "build", "plain", "srgb", "two_tone"]

Albedo = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""(M, 3) positions in scene units -> (M, 3) linear RGB reflectance 0..1."""

FLOOR = -0.52
"""Height of the plate's upper side, on which everything stands."""


@dataclass(frozen=True)
class Solid:
    """One closed body.

    Attributes:
        name: for messages and tests.
        mesh: watertight, scene units.
        albedo: diffuse reflectance as a function of position.
        gloss: 0 (matt) to 1 (polished); see :mod:`neuprim.scenes.reflectance`.
        specular: strength of the highlight of a polished solid.
        normals: (F, 3, 3) unit normals at the faces' corners; None: what the angles between faces suggest.
    """

    name: str
    mesh: trimesh.Trimesh
    albedo: Albedo
    gloss: float
    specular: float = 0.12
    normals: NDArray[np.float64] | None = None


def srgb(code: str) -> NDArray[np.float32]:
    """(3,) linear RGB of a display colour "#rrggbb" (IEC 61966-2-1)."""
    value = np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def plain(code: str) -> Albedo:
    """One colour everywhere."""
    colour = srgb(code)
    return lambda position: np.broadcast_to(colour, position.shape)


def two_tone(code: str, other: str, is_other: Callable[[NDArray[np.float32]], NDArray[np.bool_]]) -> Albedo:
    """``other`` where ``is_other`` (positions (M, 3) -> (M,) bool) holds, else ``code``."""
    first, second = srgb(code), srgb(other)
    return lambda position: np.where(is_other(position)[:, None], second, first)


def build() -> list[Solid]:
    """All solids of the scene, the same at every call."""
    # Enlarged about the plate and turned, so that the bit ends over the wire cube.
    pose = trimesh.transformations.rotation_matrix(np.radians(24.0), [0.0, 0.0, 1.0])
    pose[:3, :3] *= 1.16
    pose[:3, 3] = pose[:3, :3] @ [-0.2, 0.0, -FLOOR] + [0.0, 0.0, FLOOR]
    return [_plate(), *(_placed(solid, pose) for solid in _drill()), *_wire_cube(), *_pins(), *_small_things()]


def _placed(solid: Solid, pose: NDArray[np.float64]) -> Solid:
    """The solid moved by a (4, 4) similarity ``pose``, its pattern moving along."""
    mesh = solid.mesh.copy()
    mesh.apply_transform(pose)
    back = np.linalg.inv(pose).astype(np.float32)
    return replace(solid, mesh=mesh, albedo=lambda position: solid.albedo(position @ back[:3, :3].T + back[:3, 3]))


def _plate() -> Solid:
    half, thickness, rim, cell = 0.84, 0.08, 0.78, 0.195
    ivory, slate, edge = srgb("#f2ead8"), srgb("#33415c"), srgb("#1f9e89")

    def albedo(position: NDArray[np.float32]) -> NDArray[np.float32]:
        odd = np.floor(position[:, :2] / cell).sum(1) % 2 == 1
        board = np.where(odd[:, None], slate, ivory)
        inside = (np.abs(position[:, :2]).max(1) < rim) & (position[:, 2] > FLOOR - thickness / 2)
        return np.where(inside[:, None], board, edge)

    mesh = chamfered_box([2 * half, 2 * half, thickness], [0, 0, FLOOR - thickness / 2], 0.012)
    return Solid("plate", mesh, albedo, 0.25)


def _drill() -> list[Solid]:
    """The drill in its own frame: bit along +x, symmetric in y, standing on its battery."""
    axis_z = 0.44
    slope = np.linspace(np.radians(149.0), np.radians(211.0), 64)
    grip_centre, grip_radius = np.array([0.33, 0.0, -0.05]), 0.695

    def grip_ribs(p: NDArray[np.float32]) -> NDArray[np.bool_]:
        angle = np.degrees(np.arctan2(p[:, 2] - grip_centre[2], p[:, 0] - grip_centre[0])) % 360
        return (np.abs(angle - 184) < 14) & ((angle / 4) % 1 < 0.45)

    def helix(p: NDArray[np.float32]) -> NDArray[np.bool_]:
        return (np.arctan2(p[:, 1], p[:, 2] - axis_z) / (2 * np.pi) + p[:, 0] / 0.11) % 1 < 0.4

    def knurl(p: NDArray[np.float32]) -> NDArray[np.bool_]:
        turn = np.arctan2(p[:, 1], p[:, 2] - axis_z) / (2 * np.pi)
        return (p[:, 0] < 0.44) & ((turn * 18) % 1 < 0.35)

    guard = np.linspace(np.radians(-96.0), np.radians(14.0), 64)
    parts = [
        Solid(
            "body",
            chamfered_box([0.72, 0.30, 0.34], [-0.22, 0, 0.42], 0.05),
            two_tone("#f2600c", "#fff4e0", lambda p: np.abs(p[:, 2] - 0.37) < 0.022),
            0.5,
        ),
        Solid(
            "gearbox",
            lathe([0.12, 0, axis_z], [1, 0, 0], [(0, 0.125), (0.05, 0.15), (0.13, 0.15), (0.19, 0.1)]),
            plain("#2b2d42"),
            0.6,
        ),
        Solid(
            "chuck",
            lathe([0.29, 0, axis_z], [1, 0, 0], [(0, 0.07), (0.02, 0.09), (0.15, 0.09), (0.22, 0.05), (0.24, 0.032)]),
            two_tone("#b8c0cc", "#5c6675", knurl),
            0.9,
        ),
        Solid(
            "bit",
            lathe([0.5, 0, axis_z], [1, 0, 0], [(0, 0.022), (0.44, 0.022), (0.5, 0.0)], sections=32),
            two_tone("#ffc93c", "#6b4a12", helix),
            0.8,
        ),
        Solid(
            "grip",
            arc_tube(grip_centre, [1, 0, 0], [0, 0, 1], grip_radius, slope, np.broadcast_to([0.085, 0.07], (64, 2))),
            two_tone("#2a3bb8", "#19c3e6", grip_ribs),
            0.3,
        ),
        Solid(
            "guard",
            arc_tube([-0.27, 0, 0.22], [1, 0, 0], [0, 0, 1], 0.3, guard, 0.014, sections=32),
            plain("#d7263d"),
            0.6,
        ),
        Solid("trigger", chamfered_box([0.06, 0.07, 0.14], [-0.19, 0, 0.19], 0.012), plain("#d7263d"), 0.6),
        Solid(
            "battery",
            chamfered_box([0.46, 0.28, 0.15], [-0.23, 0, FLOOR + 0.075], 0.03),
            two_tone("#2454d6", "#ffd23f", lambda p: np.abs(p[:, 2] - FLOOR - 0.075) < 0.014),
            0.5,
        ),
    ]
    # Slats stand proud of both flanks: thin dark boxes right through the body.
    slats = [chamfered_box([0.022, 0.312, 0.13], [-0.50 + 0.05 * i, 0, 0.47], 0.003) for i in range(5)]
    return [*parts, Solid("slats", merged(slats), plain("#22223b"), 0.2)]


def _wire_cube() -> list[Solid]:
    """Twelve rods and eight knots around a polished ball."""
    side, thick = 0.40, 0.013
    centre = np.array([0.46, 0.46, FLOOR + side / 2 + 2 * thick])
    turn = trimesh.transformations.rotation_matrix(np.radians(20.0), [0, 0, 1])[:3, :3]
    corner = {sign: centre + turn @ (np.array(sign) * side / 2) for sign in product((-1, 1), repeat=3)}
    rods = [
        rod(corner[a], corner[b], thick)
        for a in corner
        for b in corner
        if a < b and sum(x != y for x, y in zip(a, b, strict=True)) == 1
    ]
    knots = [ball(point, 2 * thick, fine=False) for point in corner.values()]
    return [
        Solid("wire cube", merged(rods), plain("#0fa34a"), 0.5),
        Solid("knots", merged(knots), plain("#0b5d2c"), 0.5),
        Solid("ball", ball([centre[0], centre[1], FLOOR + 0.13], 0.13), plain("#e0218a"), 1.0),
    ]


def _pins() -> list[Solid]:
    """A row of ever thinner and taller pins with coloured heads."""
    solids = []
    for i, colour in enumerate(("#e63946", "#ff9f1c", "#ffe14d", "#2ec4b6", "#7b2cbf")):
        foot = np.array([-0.66 + 0.155 * i, 0.64 - 0.02 * i, FLOOR])
        tip = foot + np.array([0, 0, 0.3 + 0.11 * i])
        thick = 0.022 - 0.0035 * i
        solids.append(Solid(f"pin {i}", rod(foot - np.array([0, 0, 0.01]), tip, thick), plain("#d9dde3"), 0.7))
        solids.append(Solid(f"head {i}", ball(tip, 0.042 - 0.004 * i), plain(colour), 0.8))
    return solids


def _small_things() -> list[Solid]:
    major, minor = 0.21, 0.068
    span = np.radians(np.linspace(20.0, 140.0, 96))
    place = np.linspace(0.0, 1.0, 96)
    thickness = 0.012 + 0.062 * np.abs(np.sin(np.pi * place)) ** 0.6
    bend = np.array([-0.38, -0.8, FLOOR + 0.074])

    def tips(p: NDArray[np.float32]) -> NDArray[np.bool_]:
        angle = np.degrees(np.arctan2(p[:, 1] - bend[1], p[:, 0] - bend[0]))
        return (angle < 25) | (angle > 133)

    return [
        Solid(
            "ring", ring([0.46, -0.42, FLOOR + major + minor], [0.8, -0.6, 0.0], major, minor), plain("#8f35e8"), 0.8
        ),
        Solid(
            "banana",
            arc_tube(bend, [1, 0, 0], [0, 1, 0], 0.34, span, thickness),
            two_tone("#ffd60a", "#5b3a12", tips),
            0.3,
        ),
        Solid("pyramid", pyramid(0.24, 0.32, [0.66, 0.03, FLOOR], np.radians(15.0)), plain("#12b5e5"), 0.4),
    ]
