"""What the built-in room is made of: patterns and textures, the bodies in it, and the lamp's light."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from neuprim.scenes.room.cameras import FARTHEST
from neuprim.scenes.room.interior import (
    FREE,
    HIGH,
    LAMP,
    LAMPLIGHT,
    LOW,
    Furnishing,
    Room,
    furnish_room,
    lamplight_radiance,
)
from neuprim.scenes.room.textures import noise, speckled
from neuprim.scenes.shapes import ball, build_solids, chamfered_box, parse_srgb


@pytest.fixture(scope="module")
def room() -> Room:
    return Room(build_solids(), furnish_room(), 1e-3)


def spread(count: int, dimensions: int, seed: int = 0, size: float = 6.0) -> np.ndarray:
    return (np.random.default_rng(seed).uniform(-size, size, (count, dimensions))).astype(np.float32)


def still(count: int, width: float = 0.0) -> np.ndarray:
    return np.full(count, width, dtype=np.float32)


# Patterns
# ------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dimensions", [2, 3])
def test_noise_is_smooth_centred_and_fades_with_the_width(dimensions: int) -> None:
    points = spread(20000, dimensions)
    found = noise(points, still(20000), 0.5, 7)
    assert abs(found.mean()) < 0.03 and 0.2 < found.std() < 0.6 and np.abs(found).max() < 2.5
    near = noise(points + np.float32(1e-4), still(20000), 0.5, 7)
    assert np.abs(near - found).max() < 0.02
    strength = [noise(points, still(20000, w), 0.5, 7).std() for w in (0.0, 0.1, 0.3, 0.6, 0.8)]
    assert all(a > b for a, b in pairwise(strength)) and strength[-1] == 0
    fine = [
        np.abs(
            noise(points + np.float32(0.02), still(20000, w), 0.5, 7) - noise(points, still(20000, w), 0.5, 7)
        ).mean()
        for w in (0, 0.3)
    ]
    assert fine[1] < 0.5 * fine[0]  # the finest goes first


# Textures and bodies
# -------------------------------------------------------------------------------------------------------------------


def test_every_texture_is_a_reflectance_and_blurs_with_distance() -> None:
    for body in furnish_room():
        low, high = body.mesh.bounds
        points = np.random.default_rng(0).uniform(low, high, (4000, 3)).astype(np.float32)
        sharp = body.texture(points, still(4000))
        np.testing.assert_array_equal(sharp, body.texture(points.copy(), still(4000)))
        assert sharp.shape == (4000, 3) and np.isfinite(sharp).all(), body.name
        assert 0 <= sharp.min() and sharp.max() <= 1, body.name
        far = body.texture(points, still(4000, 2.0))
        assert far.std(0).sum() <= sharp.std(0).sum() + 1e-6, body.name
        near = body.texture(points, still(4000, 0.25))
        assert np.abs(near.mean(0) - sharp.mean(0)).max() < 0.06, body.name  # blurred, not repainted


def test_bodies_are_closed_and_leave_the_cameras_room() -> None:
    bodies = furnish_room()
    assert len({b.name for b in bodies}) == len(bodies)
    middle = {"table top", "table leg", "rug", "bulb", "shade", "cord", "floor", "ceiling", "beams"}
    for body in bodies:
        assert body.mesh.is_watertight and body.mesh.volume > 0, body.name
        assert 0 <= body.gloss <= 1 and body.glow >= 0
        if body.name not in middle:
            # A body whose triangles span the middle has vertices on two sides of it; none of these does.
            assert np.linalg.norm(body.mesh.triangles_center[:, :2], axis=1).min() > FREE > FARTHEST, body.name
            assert np.linalg.norm(body.mesh.vertices[:, :2], axis=1).min() > FREE, body.name
    table = next(b for b in bodies if b.name == "table top").mesh
    feet = min(s.mesh.vertices[:, 2].min() for s in build_solids())
    assert table.bounds[1, 2] == pytest.approx(feet, abs=1e-9)  # the plate stands on it
    assert all(np.linalg.norm(s.mesh.vertices[:, :2], axis=1).max() < table.bounds[1, 0] for s in build_solids())


def test_no_ray_leaves_the_room(room: Room) -> None:
    directions = np.random.default_rng(2).standard_normal((60000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    edges = np.array(
        [[x, y, z] for x in (LOW[0], HIGH[0]) for y in (LOW[1], HIGH[1]) for z in np.linspace(LOW[2], HIGH[2], 2000)]
    )
    corner = (edges - [0.0, 2.0, 1.0]) / np.linalg.norm(edges - [0.0, 2.0, 1.0], axis=1, keepdims=True)
    hits = room.intersect([0.0, 2.0, 1.0], np.concatenate([directions, corner]))
    assert hits.hit.all()
    assert (hits.position > np.subtract(LOW, 1e-3)).all() and (hits.position < np.add(HIGH, 1e-3)).all()
    names = {room.solids[i].name for i in hits.solid}
    assert {
        "floor",
        "ceiling",
        "brick wall",
        "papered wall",
        "plastered wall",
        "tiled wall",
        "rug",
        "table top",
        "pillar",
    } <= names


# Light
# ---------------------------------------------------------------------------------------------------------------------------------


def grey_floor(*more: Furnishing) -> Room:
    grey = speckled("#808080", 1, 0.0)
    return Room([], [Furnishing("floor", chamfered_box([8, 8, 0.1], [0, 0, -0.05], 0.01), grey), *more], 1e-3)


def test_the_lamp_falls_with_distance_and_casts_shadows() -> None:
    grey = speckled("#808080", 1, 0.0)
    x, y, z = LAMP
    blocker = Furnishing("blocker", ball([x + 0.5, y, z / 2], 0.2), grey)
    spots = np.array([[x, y], [x - 2, y], [x + 1.0, y]])  # below, aside, and behind the ball
    origins = np.column_stack([spots, np.full(3, 0.2)])
    rgb = lamplight_radiance(grey_floor(blocker), origins, np.tile([[0.0, 0, -1]], (3, 1)))
    albedo, above, power = parse_srgb("#808080"), np.array(LAMPLIGHT.above), np.array(LAMPLIGHT.power)
    np.testing.assert_allclose(rgb[0], albedo * (above + power / z**2 / np.pi), rtol=1e-4)
    np.testing.assert_allclose(rgb[1], albedo * (above + power * z / np.hypot(2, z) ** 3 / np.pi), rtol=1e-4)
    np.testing.assert_allclose(rgb[2], albedo * above, rtol=1e-4)
