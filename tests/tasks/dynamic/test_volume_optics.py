"""Looks, black bodies, shadows, normalisation and the rig of cameras."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.vdb import read_grid, scale_transform, sequence, write_vdb
from neuprim.tasks.dynamic.volume import (
    EMBERGEN_FIRE,
    LOOKS,
    Light,
    Look,
    Medium,
    Normalisation,
    integrate,
    medium_of,
    named_look,
    rig,
)
from neuprim.tasks.dynamic.volume.blackbody import black_body_rgb, black_body_xyz
from neuprim.tasks.dynamic.volume.transmittance import transmittance
from tests.core.io.vdb.vdb_bytes import real_folder
from tests.tasks.dynamic.volumes import box, grey, grid_of, march_slowly, ragged, rotation

SAME = Normalisation((0.0, 0.0, 0.0), 1.0)


# ---------------------------------------------------------------- black body


@pytest.mark.parametrize(
    ("kelvin", "x", "y"),
    [(1000.0, 0.6528, 0.3444), (2000.0, 0.5267, 0.4133), (2856.0, 0.4476, 0.4074), (6504.0, 0.3135, 0.3237)],
)
def test_black_body_chromaticity(kelvin: float, x: float, y: float) -> None:
    """The Planckian locus of CIE 1931; the fit of the observer costs a few thousandths, most in the deep red."""
    xyz = black_body_xyz(np.array(kelvin))
    tolerance = 0.012 if kelvin < 1500 else 0.004
    assert xyz[0] / xyz.sum() == pytest.approx(x, abs=tolerance) and xyz[1] / xyz.sum() == pytest.approx(
        y, abs=tolerance
    )


def test_black_body_colours() -> None:
    orange, white = black_body_rgb(np.array(2000.0), 2000.0), black_body_rgb(np.array(6504.0), 6504.0)
    assert orange[0] == 1.0 and 0.2 < orange[1] < 0.32 and orange[2] < 0.03
    assert white.min() > 0.93 and white.max() == 1.0
    cold = black_body_rgb(np.array([1050.0, 1600.0, 2155.0]), 2155.0)
    assert (
        (np.diff(cold.max(1)) > 0).all()
        and cold[0].max() < 1e-4
        and cold[2].max() == pytest.approx(1.0)
        and (cold >= 0).all()
    )
    # Wien's law at the wavelength that the red channel sees: the slope of log radiance over 1 / T is -hc / λk
    steps = np.log(black_body_rgb(np.array([1500.0, 1510.0]), 2155.0)[:, 0])
    assert 1.4388e7 / ((steps[1] - steps[0]) / (1 / 1500 - 1 / 1510)) == pytest.approx(610.0, abs=25.0)


# ---------------------------------------------------------------- shadows


@pytest.mark.usefixtures("either_kernel")
@pytest.mark.parametrize("seed", range(2))
def test_transmittance_against_brute_force(seed: int) -> None:
    medium = ragged(seed, (6, 8, 7), 20.0)
    medium = Medium(medium.values, rotation(seed) @ medium.scene_from_index)
    direction = np.array([(0.3, -0.5, 0.8), (0.0, 1.0, 0.0)][seed])
    found = transmittance(medium, (2 * direction).tolist())
    filled = np.argwhere(medium.values[..., 0] > 0)[::7]
    # a pixel whose ray starts at the voxel and runs to the light
    for voxel in filled[:12]:
        start = medium.scene_from_index[:3, :3] @ voxel + medium.scene_from_index[:3, 3]
        alpha = _alpha(medium, start, direction / np.linalg.norm(direction))
        assert found[tuple(voxel)] == pytest.approx(1 - alpha, abs=2e-3)
    assert (found[medium.values[..., 0] == 0] == 1).all()


def _alpha(medium: Medium, start: np.ndarray, direction: np.ndarray) -> float:
    eye = torch.from_numpy(start)
    viewmat = look_at(eye, eye + torch.from_numpy(direction), torch.tensor([0.3, 0.2, 0.9]))
    return float(
        march_slowly(medium, Camera(viewmat, 1.0, 1.0, 0.5, 0.5, 1, 1), near=0.0, far=2.0, steps=8000)[0, 0, 3]
    )


@pytest.mark.usefixtures("either_kernel")
def test_transmittance_of_a_slab() -> None:
    """exp(-σ d) below the surface of a slab, straight and at 60 degrees, for any number of threads."""
    n, sigma = 32, 6.0
    medium = Medium.padded(grey(np.full((n, n, n), sigma)), box((n, n, n)))
    depth = (n - np.arange(n) - 0.5) / n
    straight = transmittance(medium, (0, 0, 1))[17, 17, 1:-1]
    assert np.allclose(straight, np.exp(-sigma * depth), rtol=1e-4)
    tilted = transmittance(medium, (math.sqrt(0.75), 0, 0.5))[4, 17, -8:-1]
    assert np.allclose(tilted, np.exp(-sigma * 2 * depth[-7:]), rtol=1e-3)
    for threads in (1, 3):
        assert np.array_equal(transmittance(medium, (0, 0, 1), threads), transmittance(medium, (0, 0, 1), 2))
    with pytest.raises(ConfigError, match="direction"):
        transmittance(medium, (0, 0, 0))


# ---------------------------------------------------------------- grids to a medium


def test_the_equation_of_a_look() -> None:
    """Each term by itself on one voxel."""
    grids = {n: grid_of(n, np.full((1, 1, 1), v)) for n, v in (("density", 0.5), ("flames", 0.25))}
    grids["color"] = grid_of("color", np.array([0.5, 1.0, 2.0]).reshape(1, 1, 1, 3))

    def value(**settings: object) -> list[float]:
        found = medium_of(grids, Look(extinction=4.0, **settings), SAME)  # type: ignore[arg-type]
        assert found.values.shape == (3, 3, 3, 4)
        return found.values[1, 1, 1].tolist()

    assert value() == [2.0, 0.0, 0.0, 0.0]
    assert value(albedo=(0.5, 0.25, 1.0), ambient=(1.0, 2.0, 3.0)) == [2.0, 1.0, 1.0, 6.0]
    assert value(ambient=(1.0, 1.0, 1.0), color_grid="color") == [2.0, 1.0, 2.0, 2.0]  # clamped to 1
    through = math.exp(-1.0)  # half a ramp of σ = 2
    light = Light((0.0, 0.0, 5.0), (4 * math.pi, 0.0, 0.0))
    assert value(light=light) == pytest.approx([2.0, 2.0 * through, 0.0, 0.0], rel=1e-5)
    glow = value(emission=3.0, kelvin=(1000.0, 2000.0), flame_range=(0.0, 0.25))
    assert glow == pytest.approx([2.0, *(2.0 * 3.0 * black_body_rgb(np.array(2000.0), 2000.0))], rel=1e-5)
    middle = value(emission=3.0, kelvin=(1000.0, 2000.0), flame_range=(0.0, 0.5))
    assert middle[1:] == pytest.approx((6.0 * black_body_rgb(np.array(1500.0), 2000.0)).tolist(), rel=1e-3)
    assert value(flame_extinction=8.0)[0] == 4.0


def test_which_grid_gives_extinction() -> None:
    temperature, density = grid_of("temperature", np.full((1, 1, 1), 0.5)), grid_of("density", np.full((1, 1, 1), 0.25))
    assert medium_of({"temperature": temperature}, Look(), SAME).values.max() == 5.0
    assert medium_of({"temperature": temperature, "density": density}, Look(), SAME).values.max() == 2.5
    with pytest.raises(DataError, match=r"no grid 'density' or 'temperature'.*flames"):
        medium_of({"flames": density}, Look(), SAME)
    with pytest.raises(DataError, match="'density' has 3 channels; expected 1"):
        medium_of({"density": grid_of("density", np.ones((2, 2, 2, 3)))}, Look(), SAME)


def test_bad_voxels_count_as_zero_and_are_counted() -> None:
    clean = np.random.default_rng(0).random((6, 5, 4)).astype(np.float32)
    dirty = clean.copy()
    dirty[1, 2, 3], dirty[2, 2, 2], dirty[3, 1, 1], dirty[4, 4, 1] = np.nan, np.inf, -np.inf, -3.0
    clean[dirty != clean] = 0.0
    flames = np.zeros((6, 5, 4), np.float32)
    flames[0, 0, 0] = np.nan
    look = Look(ambient=(0.1, 0.1, 0.1), emission=1.0)
    a = medium_of({"density": grid_of("density", dirty), "flames": grid_of("flames", flames)}, look, SAME)
    b = medium_of(
        {"density": grid_of("density", clean), "flames": grid_of("flames", np.zeros_like(flames))}, look, SAME
    )
    assert a.non_finite == 4 and b.non_finite == 0 and np.array_equal(a.values, b.values)


def test_empty_frames() -> None:
    nothing = grid_of("density", np.zeros((4, 4, 4)))
    for look in LOOKS.values():
        medium = medium_of({"density": nothing, "temperature": nothing, "flames": nothing}, look, SAME)
        assert medium.empty and integrate(medium, rig(8)[1][0]).abs().max() == 0


def test_grids_of_other_resolutions_meet_in_the_world() -> None:
    """Flames on voxels of half the edge, with centres of their own: the same field, sampled where the density is."""
    where = [(np.arange(n) + 0.5) / n for n in (24, 48)]
    fields = []
    for at in where:
        x, y, z = np.meshgrid(at, at, at, indexing="ij")
        fields.append(0.2 + 0.8 * np.exp(-8 * ((x - 0.4) ** 2 + (y - 0.5) ** 2 + (z - 0.6) ** 2)))
    coarse, fine = (scale_transform(1 / n, [0.5 / n] * 3) for n in (24, 48))
    density = grid_of("density", np.ones((24, 24, 24)), coarse)
    look = Look(emission=1.0, flame_extinction=3.0)
    a = medium_of({"density": density, "flames": grid_of("flames", fields[0], coarse)}, look, SAME)
    b = medium_of({"density": density, "flames": grid_of("flames", fields[1], fine)}, look, SAME)
    assert a.values.shape == b.values.shape and np.abs(a.values - b.values).max() < 0.02 * a.values.max()
    assert np.abs(a.values - b.values)[..., 0].max() < 0.003 * a.values[..., 0].max()
    tall = Look(gradient=((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), ambient=(1.0, 1.0, 1.0), color_grid="color")
    high = medium_of({"density": density}, tall, Normalisation((0.5, 0.5, 0.5), 1.0)).values[12, 12, 1:-1]
    assert np.allclose(high[:, 3] / high[:, 0], where[0], atol=1e-5) and np.allclose(
        high[:, 1] / high[:, 0], 1 - where[0], atol=1e-5
    )


def test_named_looks_differ() -> None:
    """Smoke above a fire, under every look: pictures unlike each other, and lit from where the light is."""
    n = 24
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    density = np.clip(1.5 - 2 * np.sqrt(x**2 + y**2 + z**2), 0, 1)
    flames = np.clip(1 - 3 * np.sqrt(x**2 + y**2 + (z + 0.6) ** 2), 0, 1)
    grids = {
        k: grid_of(k, v, scale_transform(1 / n))
        for k, v in (("density", density), ("flames", flames), ("temperature", flames))
    }
    norm = Normalisation.from_bounds(np.array([[0, 0, 0], [1, 1, 1]]) - 0.5 / n)
    view, means = rig(24)[1][0], {}
    for name, look in LOOKS.items():
        image = integrate(medium_of(grids, look, norm), view)
        means[name] = image[image[..., 3] > 0.3][:, :3].mean(0)
    sun = LOOKS["dust_tornado"]
    assert sun.light is not None
    shares = []
    for height in (1.0, -1.0):  # lit from above, and from below
        lit = dataclasses.replace(sun, light=dataclasses.replace(sun.light, direction=(0.2, 0.2, height)))
        image = integrate(medium_of(grids, lit, norm), view)[..., :3]
        shares.append(image[:12].sum() / image.sum())
    assert shares[0] > 0.53 > 0.47 > shares[1]
    names = list(means)
    close = [(a, b) for a in names for b in names if a < b and (means[a] - means[b]).abs().max() < 0.03]
    assert close == []
    turned = named_look("dust_tornado", "y")
    assert (
        turned.light is not None and turned.light.direction[1] == sun.light.direction[2] and turned.turned("z") == sun
    )
    with pytest.raises(ConfigError, match="did you mean 'smoke_fire'"):
        named_look("smokefire")
    with pytest.raises(ConfigError, match=r"scene\.optics\.up=x: expected y or z"):
        Look(up="x")
    with pytest.raises(ConfigError, match=r"scene\.optics\.extinction=-1\.0: expected a number of at least 0"):
        Look(extinction=-1.0)


# ---------------------------------------------------------------- the frame of the scene


def test_normalisation(tmp_path: Path) -> None:
    for number, low in ((1, (0, 0, 0)), (2, (10, 4, 2)), (3, (0, 0, 0))):
        array = np.zeros((2, 2, 2)) if number == 3 else np.ones((2, 2, 2))
        grid = dataclasses.replace(
            grid_of("density", array), transform=scale_transform((0.5, 1.0, 2.0), (7.0, 8.0, 9.0))
        )
        grid = dataclasses.replace(grid, origins=grid.origins + np.array(low, np.int32) * 8)
        write_vdb(tmp_path / f"f_{number}.vdb", [grid])
    boxes = [b for f in sequence(tmp_path).frames if (b := read_grid(f.path, "density").world_bounds()) is not None]
    bounds = np.stack([np.min(boxes, 0)[0], np.max(boxes, 0)[1]])
    norm = Normalisation.from_bounds(bounds)
    scene = norm.to_scene(bounds)
    assert np.allclose(scene[0], -scene[1]) and (scene[1] - scene[0]).max() == pytest.approx(1.0)
    points = np.random.default_rng(0).normal(size=(4, 3))
    assert np.allclose(norm.to_world(norm.to_scene(points)), points)
    assert np.allclose(norm.matrix()[:3, :3] @ points[0] + norm.matrix()[:3, 3], norm.to_scene(points[0]))
    assert Normalisation.from_json(json.loads(json.dumps(norm.to_json()))) == norm
    with pytest.raises(DataError, match=r"a\.json.*scale"):
        Normalisation.from_json({"center": [0, 0, 0]}, "a.json")
    with pytest.raises(DataError, match="volume"):
        Normalisation.from_bounds(np.zeros((2, 3)))


def test_extinction_is_per_scene_unit() -> None:
    """The same voxels in a world a hundred times as large look the same."""
    cloud = np.random.default_rng(0).random((8, 8, 8))
    images = []
    for size in (1.0, 100.0):
        grid = grid_of("density", cloud, scale_transform(size / 8, (size, 0.0, -size)))
        bounds = grid.world_bounds()
        assert bounds is not None
        images.append(
            integrate(
                medium_of({"density": grid}, LOOKS["dust_tornado"], Normalisation.from_bounds(bounds)), rig(16)[1][0]
            )
        )
    assert (images[0] - images[1]).abs().max() < 1e-6


@pytest.mark.parametrize("up", ["y", "z"])
def test_rig(up: str) -> None:
    train, test = rig(64, up=up)
    assert len(train) == 38 and len(test) == 2
    axis = "xyz".index(up)
    eyes = torch.stack([c.position for c in (*test, *train)])
    assert torch.allclose(eyes.norm(dim=-1), torch.full((40,), 2.7, dtype=torch.float64))
    elevation = torch.rad2deg(torch.asin(eyes[:, axis] / 2.7))
    assert elevation.min() == pytest.approx(3.0) and elevation.max() == pytest.approx(80.0)
    assert ((elevation[:2] > 12) & (elevation[:2] < 55)).all() and torch.rad2deg(
        torch.acos(eyes[0] @ eyes[1] / 2.7**2)
    ) > 40
    around = torch.rad2deg(torch.acos((eyes @ eyes.T / 2.7**2).clamp(-1, 1))).fill_diagonal_(180.0).min(1).values
    assert around.min() > 12 and around.max() < 28  # even
    for test_eye in eyes[:2]:  # within the others: they surround it
        offsets = eyes[2:] - test_eye
        flat = offsets - (offsets @ test_eye / 2.7**2)[:, None] * test_eye
        near = flat[offsets.norm(dim=-1).argsort()[:8]]
        right = torch.linalg.cross(test_eye, near[0])
        bearing = torch.atan2(near @ right / right.norm(), near @ near[0] / near[0].norm()).sort().values
        gaps = torch.diff(torch.cat([bearing, bearing[:1] + 2 * math.pi]))
        assert gaps.max() < math.radians(120)
    for view in train:
        center = view.viewmat[:3, 3] / view.viewmat[2, 3]
        assert (
            center[:2].abs().max() < 1e-12 and (view.viewmat[:3, :3] @ torch.eye(3, dtype=torch.float64)[axis])[1] < 0
        )  # up is up
        assert math.degrees(2 * math.atan(0.5 * view.width / view.fx)) == pytest.approx(27.0)
    with pytest.raises(ConfigError, match="up 'x'"):
        rig(64, up="x")
    with pytest.raises(ConfigError, match="at least 4"):
        rig(64, 3)


# ---------------------------------------------------------------- a real fire


def test_a_real_fire_converges() -> None:
    fire = sequence(real_folder("embergen_fire_a"))
    position = [f.number for f in fire.frames].index(40)
    grids = {n: read_grid(fire.frames[position].path, n) for n in ("temperature", "flames")}
    boxes = [g.world_bounds() for g in grids.values() if g is not None]
    norm = Normalisation.from_bounds(np.stack([np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)]))  # type: ignore[index]
    medium = medium_of({n: g for n, g in grids.items() if g is not None}, EMBERGEN_FIRE, norm)
    assert medium.non_finite == 0
    view = rig(96)[1][0]
    images = [integrate(medium, view, subdivisions=n) for n in (1, 2, 4)]
    peak = images[-1][..., :3].max()
    assert (images[0] - images[1]).abs().max() < 5e-4 * peak and (images[1] - images[2]).abs().max() < 2e-4 * peak
    lit = images[0][images[0][..., 3] > 0.5]
    assert len(lit) > 500 and (lit[:, 0] >= lit[:, 2] - 1e-6).all() and 0.2 < peak < 2.1
