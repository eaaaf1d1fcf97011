"""What the built-in room is made of: patterns and textures, the bodies in it, and the lamp's light."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from neuprim.scenes.meshes import ball, chamfered_box
from neuprim.scenes.room.layout import FREE, HIGH, LAMP, LOW, Furnishing, furnishings
from neuprim.scenes.room.path import FARTHEST
from neuprim.scenes.room.patterns import cells, checks, mix, noise, stripes
from neuprim.scenes.room.scene import Room
from neuprim.scenes.room.shading import LAMPLIGHT, radiance
from neuprim.scenes.room.textures import chequered, speckled
from neuprim.scenes.shapes import build, plain, srgb


@pytest.fixture(scope="module")
def room() -> Room:
    return Room(build(), furnishings(), 1e-3)


def spread(count: int, dimensions: int, seed: int = 0, size: float = 6.0) -> np.ndarray:
    return (np.random.default_rng(seed).uniform(-size, size, (count, dimensions))).astype(np.float32)


def still(count: int, width: float = 0.0) -> np.ndarray:
    return np.full(count, width, dtype=np.float32)


# Patterns
# ------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [0.01, 0.13, 0.7, 3.1])
def test_stripes_and_checks_are_averages_over_the_width(width: float) -> None:
    points = spread(40, 2)
    within = (np.arange(2000) + 0.5) / 2000 * width - width / 2
    x, y = (points[:, axis, None] + within for axis in (0, 1))
    covered = (((x / 0.5) % 1) < 0.3).mean(1)
    np.testing.assert_allclose(stripes(points[:, 0], 0.5, 0.3, still(40, width)), covered, atol=2e-3)
    sides = [np.where((np.floor(t / 0.4) % 2) == 0, 1.0, -1.0).mean(1) for t in (x, y)]
    light = (1 + sides[0] * sides[1]) / 2
    np.testing.assert_allclose(checks(points[:, 0], points[:, 1], 0.4, still(40, width)), light, atol=4e-3)


def test_cells_are_even_and_without_pattern() -> None:
    grid = np.stack(np.meshgrid(np.arange(-60, 60), np.arange(-60, 60)), axis=-1).reshape(-1, 2)
    found = cells(grid, 3)
    np.testing.assert_array_equal(found, cells(grid, 3))
    assert 0 <= found.min() and found.max() < 1 and np.histogram(found, 10, (0, 1))[0].std() < 0.05 * len(grid) / 10
    square = found.reshape(120, 120) - 0.5
    for step in ((0, 1), (1, 0), (1, 1), (1, -1)):
        assert abs((square * np.roll(square, step, (0, 1))).mean()) < 0.02 * square.var() * 2
    assert abs(np.corrcoef(found, cells(grid, 4))[0, 1]) < 0.03


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


def test_mixing_keeps_its_ends() -> None:
    one, other = srgb("#102030"), srgb("#f0e0d0")
    np.testing.assert_allclose(
        mix(one, other, np.array([-1, 0, 0.5, 1, 2], np.float32)), [one, one, (one + other) / 2, other, other]
    )


# Textures and bodies
# -------------------------------------------------------------------------------------------------------------------


def test_every_texture_is_a_reflectance_and_blurs_with_distance() -> None:
    for body in furnishings():
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


def test_walls_and_floor_have_detail_at_several_scales() -> None:
    for name in ("floor", "brick wall", "papered wall", "plastered wall", "tiled wall", "rug"):
        body = next(b for b in furnishings() if b.name == name)
        points = np.random.default_rng(1).uniform(*body.mesh.bounds, (4000, 3)).astype(np.float32)
        bands = [body.texture(points, still(4000, w)) for w in (0.01, 0.04, 0.16, 0.64)]
        lost = [np.abs(a - b).mean() for a, b in pairwise(bands)]
        assert min(lost) > 0.002, (name, lost)


def test_bodies_are_closed_and_leave_the_cameras_room() -> None:
    bodies = furnishings()
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
    feet = min(s.mesh.vertices[:, 2].min() for s in build())
    assert table.bounds[1, 2] == pytest.approx(feet, abs=1e-9)  # the plate stands on it
    assert all(np.linalg.norm(s.mesh.vertices[:, :2], axis=1).max() < table.bounds[1, 0] for s in build())


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


def test_a_ray_takes_the_mean_over_what_it_stands_for() -> None:
    board = Furnishing(
        "board", chamfered_box([40, 40, 0.1], [0, 0, -0.05], 0.01), chequered("#c0c0c0", "#202020", 0, 1, 0.1, 1)
    )
    down = np.tile([[0.0, 0.0, -1.0]], (4000, 1))
    origins = np.column_stack([spread(4000, 2), np.full(4000, 10.0)])
    sharp, coarse = (Room([], [board], spacing).intersect(origins, down).albedo for spacing in (1e-4, 0.1))
    assert sharp.std() > 5 * coarse.std()
    assert np.abs(coarse.mean() - sharp.mean()) < 0.03


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
    rgb = radiance(grey_floor(blocker), origins, np.tile([[0.0, 0, -1]], (3, 1)))
    albedo, above, power = srgb("#808080"), np.array(LAMPLIGHT.above), np.array(LAMPLIGHT.power)
    np.testing.assert_allclose(rgb[0], albedo * (above + power / z**2 / np.pi), rtol=1e-4)
    np.testing.assert_allclose(rgb[1], albedo * (above + power * z / np.hypot(2, z) ** 3 / np.pi), rtol=1e-4)
    np.testing.assert_allclose(rgb[2], albedo * above, rtol=1e-4)


def test_what_glows_sends_its_own_light_and_no_other() -> None:
    lit = Furnishing("pane", chamfered_box([1, 1, 0.1], [0, 0, 1], 0.01), speckled("#4080c0", 1, 0.0), glow=2.0)
    rgb = radiance(grey_floor(lit), np.array([[0.0, 0.0, 2.0]]), np.array([[0.0, 0, -1]]))
    np.testing.assert_allclose(rgb[0], 2.0 * srgb("#4080c0"), rtol=1e-5)


def test_solids_in_the_room_keep_their_colours(room: Room) -> None:
    eye, solids = np.array([2.0, -2.0, 1.0]), Room(build(), [], 1e-3)
    targets = np.random.default_rng(5).uniform(-0.8, 0.8, (3000, 3)) * [1, 1, 0.6]
    rays = (targets - eye) / np.linalg.norm(targets - eye, axis=1, keepdims=True)
    alone, within = solids.intersect(eye, rays), room.intersect(eye, rays)
    both = within.solid < room.subject
    assert 500 < both.sum() and within.hit.all()
    np.testing.assert_array_equal(np.flatnonzero(alone.hit), np.flatnonzero(both))
    np.testing.assert_array_equal(alone.albedo, within.albedo[both])
    assert plain("#ffffff")(targets.astype(np.float32)).shape == targets.shape
