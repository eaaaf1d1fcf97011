"""Solids of the scene ``solids``: closed triangle meshes with outward faces, in scene units, and their normals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

Albedo = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""(M, 3) positions in scene units -> (M, 3) linear RGB reflectance 0..1."""

FLOOR = -0.52  # height of the plate's upper side, on which everything stands

_CREASE = np.cos(np.radians(24.0))
"""Cosine of the crease angle. Normals are smoothed across faces that meet at a smaller angle, so chamfers (45 degrees)
keep sharp edges."""

_CORNERS_AT_ONCE = 1 << 18  # bounds the memory for pairs of corners


def chamfered_box(size: ArrayLike, centre: ArrayLike, chamfer: float) -> trimesh.Trimesh:
    """Build a box of edge lengths ``size`` around ``centre``, with edges cut at 45 degrees by ``chamfer``."""
    half = np.asarray(size, dtype=np.float64) / 2
    # Each corner becomes a triangle: one axis at full extent, the other two drawn in. Their hull is the chamfered box.
    pulls = sorted(set(permutations((0.0, chamfer, chamfer))))
    points = [np.array(sign) * (half - np.array(pull)) for sign in product((-1.0, 1.0), repeat=3) for pull in pulls]
    hull = trimesh.convex.convex_hull(np.array(points))
    hull.apply_translation(centre)
    return hull


def pyramid(base: float, height: float, centre: ArrayLike, turn: float) -> trimesh.Trimesh:
    """Build a pyramid on a square of edge ``base``, centred at ``centre`` and turned by ``turn`` radians about z."""
    angles = turn + np.pi / 4 + np.pi / 2 * np.arange(4)
    square = np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1) * base / np.sqrt(2)
    vertices = np.concatenate([square, [[0.0, 0.0, height]]]) + np.asarray(centre, dtype=np.float64)
    return trimesh.Trimesh(vertices, [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [2, 1, 0], [3, 2, 0]])


def ball(centre: ArrayLike, radius: float, fine: bool = True) -> trimesh.Trimesh:
    """Build a sphere of 5,120 triangles, or of 1,280 if not ``fine``."""
    mesh = trimesh.creation.icosphere(subdivisions=4 if fine else 3, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def ring(centre: ArrayLike, axis: ArrayLike, major: float, minor: float) -> trimesh.Trimesh:
    """Build a torus: circle of radius ``major`` in the plane normal to ``axis``, tube of radius ``minor``."""
    mesh = trimesh.creation.torus(major, minor, major_sections=128, minor_sections=48)
    mesh.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], axis))
    mesh.apply_translation(centre)
    return mesh


def rod(start: ArrayLike, end: ArrayLike, radius: float) -> trimesh.Trimesh:
    """Build a straight cylinder from ``start`` to ``end`` with flat ends."""
    length = float(np.linalg.norm(np.subtract(end, start)))
    return lathe(start, np.subtract(end, start), [(0.0, radius), (length, radius)], sections=24)


def lathe(
    start: ArrayLike, axis: ArrayLike, profile: Sequence[tuple[float, float]], sections: int = 96
) -> trimesh.Trimesh:
    """Build a solid of revolution about the axis through ``start`` with direction ``axis``.

    ``profile`` lists (distance from ``start`` along the axis, radius).
    """
    direction = np.asarray(axis, dtype=np.float64)
    direction = direction / np.linalg.norm(direction)
    side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    side /= np.linalg.norm(side)
    heights, radii = np.array(profile, dtype=np.float64).T
    path = np.asarray(start, dtype=np.float64) + heights[:, None] * direction
    sides, half = np.broadcast_to(side, path.shape), np.stack([radii, radii], axis=1)
    return _tube_mesh(path, sides, np.cross(direction, side), half, sections)


def arc_tube(
    centre: ArrayLike,
    first: ArrayLike,
    second: ArrayLike,
    radius: float,
    angles: NDArray[np.float64],
    radii: ArrayLike,
    sections: int = 64,
) -> trimesh.Trimesh:
    """Sweep a tube along a circular arc about ``centre``, from direction ``first`` (angle 0) towards ``second``.

    ``angles`` (n,) are the ascending angles of the cross-sections, radians. ``radii`` (n, 2) are half axes of elliptic
    cross-sections, in the plane of the arc and perpendicular to the plane. For round cross-sections, ``radii`` is (n,)
    or one number.
    """
    one, two = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    outward = np.cos(angles)[:, None] * one + np.sin(angles)[:, None] * two
    half = np.asarray(radii, dtype=np.float64)
    if half.ndim < 2:
        half = np.broadcast_to(half.reshape(-1, 1), (len(angles), 2))
    # outward x across must point along the path, as side x other does along a lathe's axis.
    return _tube_mesh(
        np.asarray(centre, dtype=np.float64) + radius * outward, outward, np.cross(two, one), half, sections
    )


def _tube_mesh(path: NDArray, side: NDArray, across: NDArray, half: NDArray, sections: int) -> trimesh.Trimesh:
    """Build a tube with end caps along ``path`` (n, 3), with elliptic cross-sections of ``sections`` points.

    ``half`` (n, 2) are the half axes along the unit vectors ``side`` (n, 3) and ``across`` (3,).
    """
    turn = 2 * np.pi * np.arange(sections) / sections
    in_plane = (half[:, :1] * np.cos(turn))[..., None] * side[:, None]
    rings = path[:, None] + in_plane + (half[:, 1:] * np.sin(turn))[..., None] * across  # (n, sections, 3)
    n = len(path)
    rim, following = np.arange(sections), (np.arange(sections) + 1) % sections
    here = (np.arange(n - 1)[:, None] * sections + rim).ravel()
    right = (np.arange(n - 1)[:, None] * sections + following).ravel()
    bottom = np.stack([np.full(sections, n * sections), following, rim], 1)
    top = np.stack([np.full(sections, n * sections + 1), rim + (n - 1) * sections, following + (n - 1) * sections], 1)
    lower = np.stack([here, right, right + sections], 1)
    upper = np.stack([here, right + sections, here + sections], 1)
    vertices = np.concatenate([rings.reshape(-1, 3), path[:1], path[-1:]])
    # Rings of radius zero (points of cones) collapse to one vertex; `validate` drops the faces that vanish with them.
    return trimesh.Trimesh(vertices, np.concatenate([lower, upper, bottom, top]), process=True, validate=True)


def merge_solid_meshes(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Merge meshes into one. Touching meshes do not share vertices, so that each mesh remains closed."""
    start = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces.view(np.ndarray) + first for mesh, first in zip(meshes, start[:-1], strict=True)]
    return trimesh.Trimesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces), process=False)


def solid_corner_normals(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Return (F, 3, 3) unit normals at the corners of the F triangles, for smooth shading.

    The normal of a corner is the mean of the normals of adjacent faces, weighted by the faces' corner angles. Faces
    beyond the crease angle (24 degrees) are left out.
    """
    faces, flat = mesh.faces.view(np.ndarray), mesh.face_normals.view(np.ndarray)
    corners, angles = faces.size, mesh.face_angles.view(np.ndarray).ravel()
    places = (np.arange(corners), faces.ravel())
    around = sparse.csr_matrix((np.ones(corners), places), shape=(corners, len(mesh.vertices)))
    touching = around.T.tocsr()
    normals = np.empty((corners, 3))
    for begin in range(0, corners, _CORNERS_AT_ONCE):
        pairs = (around[begin : begin + _CORNERS_AT_ONCE] @ touching).tocoo()  # corners that share a vertex
        own, other = (begin + pairs.row) // 3, pairs.col // 3
        smooth = (flat[own] * flat[other]).sum(1) > _CREASE
        blend = sparse.csr_matrix((angles[pairs.col] * smooth, (pairs.row, other)), shape=(pairs.shape[0], len(faces)))
        normals[begin : begin + _CORNERS_AT_ONCE] = blend @ flat
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    own_face = np.repeat(flat, 3, axis=0)  # for degenerate triangles, which have no angle
    normals = np.where(length > 0, normals / np.where(length > 0, length, 1.0), own_face)
    return normals.reshape(-1, 3, 3)


@dataclass(frozen=True)
class Solid:
    """A closed body with its material."""

    name: str
    mesh: trimesh.Trimesh  # watertight, scene units
    albedo: Albedo  # diffuse reflectance as a function of position
    gloss: float  # 0 (matt) to 1 (polished); see :mod:`neuprim.scenes.shading`
    specular: float = 0.12  # strength of the highlight of a polished solid
    # (F, 3, 3) unit normals at the faces' corners; None: :func:`solid_corner_normals`
    normals: NDArray[np.float64] | None = None


def parse_solid_srgb(code: str) -> NDArray[np.float32]:
    """Convert an sRGB colour "#rrggbb" to (3,) linear RGB (IEC 61966-2-1)."""
    value = np.array([int(code[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)


def uniform_colour(code: str) -> Albedo:
    """Return an albedo function with one colour everywhere."""
    colour = parse_solid_srgb(code)
    return lambda position: np.broadcast_to(colour, position.shape)


def _two_tone(code: str, other: str, is_other: Callable[[NDArray[np.float32]], NDArray[np.bool_]]) -> Albedo:
    """Return an albedo function: colour ``other`` where ``is_other`` (positions -> bool) is true, else ``code``."""
    first, second = parse_solid_srgb(code), parse_solid_srgb(other)
    return lambda position: np.where(is_other(position)[:, None], second, first)


# ---------------------------------------------------------------- the solids


def build_solids() -> list[Solid]:
    """Build all solids of the scene ``solids``; every call returns equal solids."""
    # Enlarged about the plate and turned, so that the bit ends over the wire cube.
    pose = trimesh.transformations.rotation_matrix(np.radians(24.0), [0.0, 0.0, 1.0])
    pose[:3, :3] *= 1.16
    pose[:3, 3] = pose[:3, :3] @ [-0.2, 0.0, -FLOOR] + [0.0, 0.0, FLOOR]
    return [
        _plate_solid(),
        *(_place_solid(solid, pose) for solid in _drill_solids()),
        *_wire_cube_solids(),
        *_pin_solids(),
        *_small_solids(),
    ]


def _place_solid(solid: Solid, pose: NDArray[np.float64]) -> Solid:
    """Return the solid transformed by ``pose``, a (4, 4) similarity transform; the colour pattern moves along."""
    mesh = solid.mesh.copy()
    mesh.apply_transform(pose)
    back = np.linalg.inv(pose).astype(np.float32)
    return replace(solid, mesh=mesh, albedo=lambda position: solid.albedo(position @ back[:3, :3].T + back[:3, 3]))


def _plate_solid() -> Solid:
    half, thickness, rim, cell = 0.84, 0.08, 0.78, 0.195
    ivory, slate, edge = parse_solid_srgb("#f2ead8"), parse_solid_srgb("#33415c"), parse_solid_srgb("#1f9e89")

    def albedo(position: NDArray[np.float32]) -> NDArray[np.float32]:
        odd = np.floor(position[:, :2] / cell).sum(1) % 2 == 1
        board = np.where(odd[:, None], slate, ivory)
        inside = (np.abs(position[:, :2]).max(1) < rim) & (position[:, 2] > FLOOR - thickness / 2)
        return np.where(inside[:, None], board, edge)

    mesh = chamfered_box([2 * half, 2 * half, thickness], [0, 0, FLOOR - thickness / 2], 0.012)
    return Solid("plate", mesh, albedo, 0.25)


def _drill_solids() -> list[Solid]:
    """Build the drill in local coordinates: bit along +x, symmetric in y, standing on its battery."""
    x, z, axis_z = [1, 0, 0], [0, 0, 1], 0.44
    grip_arc, grip_centre = np.linspace(np.radians(149.0), np.radians(211.0), 64), np.array([0.33, 0.0, -0.05])
    guard_arc = np.linspace(np.radians(-96.0), np.radians(14.0), 64)

    def turn(p: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.arctan2(p[:, 1], p[:, 2] - axis_z) / (2 * np.pi)

    def is_rib(p: NDArray[np.float32]) -> NDArray[np.bool_]:
        angle = np.degrees(np.arctan2(p[:, 2] - grip_centre[2], p[:, 0] - grip_centre[0])) % 360
        return (np.abs(angle - 184) < 14) & ((angle / 4) % 1 < 0.45)

    body_paint = _two_tone("#f2600c", "#fff4e0", lambda p: np.abs(p[:, 2] - 0.37) < 0.022)
    knurl = _two_tone("#b8c0cc", "#5c6675", lambda p: (p[:, 0] < 0.44) & ((turn(p) * 18) % 1 < 0.35))
    helix = _two_tone("#ffc93c", "#6b4a12", lambda p: (turn(p) + p[:, 0] / 0.11) % 1 < 0.4)
    battery_paint = _two_tone("#2454d6", "#ffd23f", lambda p: np.abs(p[:, 2] - FLOOR - 0.075) < 0.014)
    gearbox = lathe([0.12, 0, axis_z], x, [(0, 0.125), (0.05, 0.15), (0.13, 0.15), (0.19, 0.1)])
    chuck = lathe([0.29, 0, axis_z], x, [(0, 0.07), (0.02, 0.09), (0.15, 0.09), (0.22, 0.05), (0.24, 0.032)])
    bit = lathe([0.5, 0, axis_z], x, [(0, 0.022), (0.44, 0.022), (0.5, 0.0)], sections=32)
    grip = arc_tube(grip_centre, x, z, 0.695, grip_arc, np.broadcast_to([0.085, 0.07], (64, 2)))
    guard = arc_tube([-0.27, 0, 0.22], x, z, 0.3, guard_arc, 0.014, sections=32)
    trigger = chamfered_box([0.06, 0.07, 0.14], [-0.19, 0, 0.19], 0.012)
    # Slats stand proud of both flanks: thin dark boxes right through the body.
    slats = [chamfered_box([0.022, 0.312, 0.13], [-0.50 + 0.05 * i, 0, 0.47], 0.003) for i in range(5)]
    return [
        Solid("body", chamfered_box([0.72, 0.30, 0.34], [-0.22, 0, 0.42], 0.05), body_paint, 0.5),
        Solid("gearbox", gearbox, uniform_colour("#2b2d42"), 0.6),
        Solid("chuck", chuck, knurl, 0.9),
        Solid("bit", bit, helix, 0.8),
        Solid("grip", grip, _two_tone("#2a3bb8", "#19c3e6", is_rib), 0.3),
        Solid("guard", guard, uniform_colour("#d7263d"), 0.6),
        Solid("trigger", trigger, uniform_colour("#d7263d"), 0.6),
        Solid("battery", chamfered_box([0.46, 0.28, 0.15], [-0.23, 0, FLOOR + 0.075], 0.03), battery_paint, 0.5),
        Solid("slats", merge_solid_meshes(slats), uniform_colour("#22223b"), 0.2),
    ]


def _wire_cube_solids() -> list[Solid]:
    """Build a wire cube: twelve rods and eight knots around a polished ball."""
    side, thick = 0.40, 0.013
    centre = np.array([0.46, 0.46, FLOOR + side / 2 + 2 * thick])
    turn = trimesh.transformations.rotation_matrix(np.radians(20.0), [0, 0, 1])[:3, :3]
    corner = {sign: centre + turn @ (np.array(sign) * side / 2) for sign in product((-1, 1), repeat=3)}
    edges = [(a, b) for a in corner for b in corner if a < b and sum(x != y for x, y in zip(a, b, strict=True)) == 1]
    rods = merge_solid_meshes([rod(corner[a], corner[b], thick) for a, b in edges])
    knots = merge_solid_meshes([ball(point, 2 * thick, fine=False) for point in corner.values()])
    return [
        Solid("wire cube", rods, uniform_colour("#0fa34a"), 0.5),
        Solid("knots", knots, uniform_colour("#0b5d2c"), 0.5),
        Solid("ball", ball([centre[0], centre[1], FLOOR + 0.13], 0.13), uniform_colour("#e0218a"), 1.0),
    ]


def _pin_solids() -> list[Solid]:
    """Build a row of five pins with coloured heads; each pin is thinner and taller than the one before."""
    solids = []
    for i, colour in enumerate(("#e63946", "#ff9f1c", "#ffe14d", "#2ec4b6", "#7b2cbf")):
        foot = np.array([-0.66 + 0.155 * i, 0.64 - 0.02 * i, FLOOR])
        tip = foot + np.array([0, 0, 0.3 + 0.11 * i])
        thick = 0.022 - 0.0035 * i
        solids.append(Solid(f"pin {i}", rod(foot - np.array([0, 0, 0.01]), tip, thick), uniform_colour("#d9dde3"), 0.7))
        solids.append(Solid(f"head {i}", ball(tip, 0.042 - 0.004 * i), uniform_colour(colour), 0.8))
    return solids


def _small_solids() -> list[Solid]:
    major, minor = 0.21, 0.068
    span = np.radians(np.linspace(20.0, 140.0, 96))
    thickness = 0.012 + 0.062 * np.abs(np.sin(np.pi * np.linspace(0.0, 1.0, 96))) ** 0.6
    bend = np.array([-0.38, -0.8, FLOOR + 0.074])

    def is_tip(p: NDArray[np.float32]) -> NDArray[np.bool_]:
        angle = np.degrees(np.arctan2(p[:, 1] - bend[1], p[:, 0] - bend[0]))
        return (angle < 25) | (angle > 133)

    torus = ring([0.46, -0.42, FLOOR + major + minor], [0.8, -0.6, 0.0], major, minor)
    banana = arc_tube(bend, [1, 0, 0], [0, 1, 0], 0.34, span, thickness)
    return [
        Solid("ring", torus, uniform_colour("#8f35e8"), 0.8),
        Solid("banana", banana, _two_tone("#ffd60a", "#5b3a12", is_tip), 0.3),
        Solid("pyramid", pyramid(0.24, 0.32, [0.66, 0.03, FLOOR], np.radians(15.0)), uniform_colour("#12b5e5"), 0.4),
    ]
