"""Looks, black bodies, shadows, normalisation and the hemisphere_capture_cameras of cameras."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage

from neuprim.core.cameras import Camera, look_at
from neuprim.core.errors import DataError
from neuprim.core.io.vdb import list_vdb_files, read_grid, vdb_scale_transform, write_vdb
from neuprim.tasks.dynamic.volume.capture import hemisphere_capture_cameras
from neuprim.tasks.dynamic.volume.lit_medium import LitMedium, build_medium, light_medium
from neuprim.tasks.dynamic.volume.medium import Medium
from neuprim.tasks.dynamic.volume.optics import OPTICS_PRESETS, Axis, Light, Optics, black_body_rgb, black_body_xyz
from neuprim.tasks.dynamic.volume.raymarch import light_transmittance, point_transmittance, render_medium
from neuprim.tasks.dynamic.volume.survey import CaptureNormalisation
from tests.tasks.dynamic.volumes import grid_of, march_slowly, ragged, rotation

SAME = np.eye(4)


# ---------------------------------------------------------------- black body


@pytest.mark.parametrize(
    ("kelvin", "x", "y"),
    [(1000.0, 0.6528, 0.3444), (2000.0, 0.5267, 0.4133), (2856.0, 0.4476, 0.4074), (6504.0, 0.3135, 0.3237)],
)
def test_black_body_chromaticity(kelvin: float, x: float, y: float) -> None:
    """The Planckian locus of CIE 1931; the fit of the observer costs a few thousandths, most in the deep red."""
    xyz = black_body_xyz(np.array(kelvin))
    tolerance = 0.012 if kelvin < 1500 else 0.004
    assert (xyz / xyz.sum())[:2].tolist() == pytest.approx([x, y], abs=tolerance)


# ---------------------------------------------------------------- shadows


@pytest.mark.parametrize("seed", range(2))
def test_transmittance_against_brute_force(seed: int) -> None:
    medium = ragged(seed, (6, 8, 7), 20.0)
    medium = dataclasses.replace(medium, scene_from_index=rotation(seed) @ medium.scene_from_index)
    direction = np.array([(0.3, -0.5, 0.8), (0.0, 1.0, 0.0)][seed])
    found, sigma = light_transmittance(medium, (2 * direction).tolist())[0], medium.values[0, ..., 0]
    filled = np.argwhere(sigma > 0)[::7]
    # a pixel whose ray starts at the voxel and runs to the light
    for voxel in filled[:12]:
        start = medium.scene_from_index[:3, :3] @ voxel + medium.scene_from_index[:3, 3]
        alpha = _alpha(medium, start, direction / np.linalg.norm(direction))
        assert found[tuple(voxel)] == pytest.approx(1 - alpha, abs=2e-3)
    assert (found[sigma == 0] == 1).all()


def _alpha(medium: Medium, start: np.ndarray, direction: np.ndarray) -> float:
    eye = torch.from_numpy(start)
    viewmat = look_at(eye, eye + torch.from_numpy(direction), torch.tensor([0.3, 0.2, 0.9]))
    view = Camera(viewmat, 1.0, 1.0, 0.5, 0.5, 1, 1)
    return float(march_slowly(medium, view, near=0.0, far=2.0, steps=8000)[0, 0, 3])


# ---------------------------------------------------------------- grids to a medium


def test_the_equation_of_a_look() -> None:
    """Each term by itself on one voxel."""
    grids = {n: grid_of(n, np.full((1, 1, 1), v)) for n, v in (("density", 0.5), ("flames", 0.25))}
    grids["color"] = grid_of("color", np.array([0.5, 1.0, 2.0]).reshape(1, 1, 1, 3))

    def value(**settings: object) -> list[float]:
        optics = Optics(extinction=4.0, **settings)  # type: ignore[arg-type]
        found = light_medium(build_medium(grids, optics, SAME), optics.light, optics)
        assert found.values.shape == (1, 3, 3, 3, 4)
        return found.values[0, 1, 1, 1].tolist()

    assert value() == [2.0, 0.0, 0.0, 0.0]
    assert value(albedo=(0.5, 0.25, 1.0), ambient=(1.0, 2.0, 3.0)) == [2.0, 1.0, 1.0, 6.0]
    assert value(ambient=(1.0, 1.0, 1.0), color_grid="color") == [2.0, 1.0, 2.0, 2.0]  # clamped to 1
    through = math.exp(-1.0)  # half a ramp of σ = 2
    light = Light((0.0, 0.0, 5.0), (4 * math.pi, 0.0, 0.0))
    assert value(light=light) == pytest.approx([2.0, 2.0 * through, 0.0, 0.0], rel=1e-5)
    twice = value(light=light, albedo=(0.9, 0.9, 0.9), octaves=2)[1]
    assert twice == pytest.approx(1.8 * (through + 0.45 * math.sqrt(through)), rel=1e-5)
    glow = value(emission=3.0, kelvin=(1000.0, 2000.0), flame_range=(0.0, 0.25))
    assert glow == pytest.approx([2.0, *(2.0 * 3.0 * black_body_rgb(np.array(2000.0), 2000.0))], rel=1e-5)
    middle = value(emission=3.0, kelvin=(1000.0, 2000.0), flame_range=(0.0, 0.5))
    assert middle[1:] == pytest.approx((6.0 * black_body_rgb(np.array(1500.0), 2000.0)).tolist(), rel=1e-3)
    assert value(flame_extinction=8.0)[0] == 4.0


@pytest.mark.parametrize("octaves", [1, 2])
def test_the_angle_to_the_light(octaves: int) -> None:
    """Each octave of a pixel is multiplied by the phase function of its ray; light that does not scatter is not."""
    medium = ragged(3, (6, 8, 7), 20.0)
    medium = dataclasses.replace(medium, scattered=0.7 * medium.values[..., :1] * np.ones(3, np.float32))
    look = Optics(albedo=(0.6, 0.6, 0.6), light=Light((-0.5, 2.0, 0.3), (3.0, 2.0, 1.0)), octaves=octaves)
    eye = torch.tensor([1.2, -1.0, 0.7], dtype=torch.float64)
    view = Camera(look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])), 30.0, 40.0, 14.0, 17.0, 32, 32)
    own = render_medium(medium, view, 1)
    single = LitMedium.of(medium, look.light, dataclasses.replace(look, octaves=1))
    octave_images = [single.render(view, 1) - own]
    octave_images.append(LitMedium.of(medium, look.light, look).render(view, 1) - own - octave_images[0])
    found = LitMedium.of(medium, look.light, dataclasses.replace(look, anisotropy=0.6))
    rays = torch.stack(
        torch.meshgrid((torch.arange(32) - 13.5) / 30, (torch.arange(32) - 16.5) / 40, indexing="xy"), -1
    )
    rays = torch.cat([rays, torch.ones(32, 32, 1)], -1).double() @ view.viewmat[:3, :3]
    towards = torch.tensor([-0.5, 2.0, 0.3], dtype=torch.float64)
    cosine = (rays @ towards) / rays.norm(dim=-1) / towards.norm()
    expected = own.clone()
    for octave in range(octaves):
        g = 0.6 / 2**octave
        phase = (1 - g**2) / (4 * math.pi * (1 + g**2 - 2 * g * cosine) ** 1.5)
        expected[..., :3] += (4 * math.pi * phase)[..., None].float() * octave_images[octave][..., :3]
    assert float(expected[..., :3].max()) > 0.1
    assert torch.allclose(found.render(view, 1), expected, rtol=1e-4, atol=1e-5)
    assert np.allclose(found.mean.values, light_medium(medium, look.light, look).values, rtol=1e-5, atol=1e-6)


def test_flames_light_the_smoke() -> None:
    """One flame and one voxel of smoke in a vacuum."""
    flames, smoke = np.zeros((9, 3, 3), np.float32), np.zeros((9, 3, 3), np.float32)
    flames[1, 1, 1], smoke[7, 1, 1] = 1.0, 1e-3
    grids = {"flames": grid_of("flames", flames), "density": grid_of("density", smoke)}
    look = Optics(extinction=1.0, albedo=(0.5, 0.5, 0.5), emission=2.0, flame_extinction=1e-3, kelvin=(1000.0, 2000.0))
    plain, lit = (
        build_medium(grids, dataclasses.replace(look, fire_lights=n), SAME).values[0, ..., 1:] for n in (0, 4)
    )
    light, change = 1e-3 * 2.0 * black_body_rgb(np.array(2000.0), 2000.0), lit - plain
    assert change[7, 1, 1] == pytest.approx(0.5 * 1e-3 * light / (4 * math.pi * (36 + 0.25)), rel=3e-3)
    change[7, 1, 1] = 0
    assert not change.any()


def test_few_fire_lights_come_close_to_one_for_each_flame() -> None:
    g = np.random.default_rng(1)
    x, y, z = np.meshgrid(*(np.linspace(-1, 1, 20),) * 3, indexing="ij")
    flames = np.maximum(1 - 9 * (x**2 + (y + 0.4) ** 2 + z**2), 0).astype(np.float32) * g.random((20, 20, 20))
    smoke = np.maximum(1 - x**2 - y**2 - z**2, 0).astype(np.float32)
    grids = {"flames": grid_of("flames", flames), "density": grid_of("density", smoke)}
    optics = Optics(extinction=0.3, emission=1.0, kelvin=(1000.0, 2000.0))

    def lit(lights: int) -> np.ndarray:
        return build_medium(grids, dataclasses.replace(optics, fire_lights=lights), SAME).values[..., 1:] - dark

    dark = build_medium(grids, optics, SAME).values[..., 1:]
    exact = lit(4096)  # more lights than flames
    errors = [float(np.abs(lit(n) - exact).sum() / exact.sum()) for n in (1, 4, 16)]
    assert errors[2] < 0.15 and errors[0] > errors[1] > errors[2], errors


def test_transmittance_to_a_point() -> None:
    """From every voxel of a uniform block, to points inside, outside, and so far away that the rays are parallel."""
    sigma = np.zeros((8, 9, 10), np.float32)
    sigma[1:-1, 1:-1, 1:-1] = 0.2 + np.random.default_rng(0).random((6, 7, 8))
    turned = 0.25 * rotation(3)[:3, :3]
    scene_from_index = np.eye(4)
    scene_from_index[:3, :3], scene_from_index[:3, 3] = turned, (1.0, -2.0, 0.5)
    values = np.concatenate([sigma[..., None], np.zeros((*sigma.shape, 3), np.float32)], -1)
    medium = Medium.dense(values, scene_from_index)
    some = np.argwhere(sigma > 0)[::29]
    for index in ((4.3, 3.7, 5.1), (4.0, 4.0, 4.0), (-30.0, 12.0, 5.0)):
        place = (scene_from_index @ [*index, 1.0])[:3]
        found = point_transmittance(medium, place)[0][tuple(some.T)]
        steps = (np.arange(4000) + 0.5) / 4000
        for voxel, transmittance in zip(some, found, strict=True):
            way = np.array(index) - voxel
            samples = ndimage.map_coordinates(sigma.astype(np.float64), voxel[:, None] + way[:, None] * steps, order=1)
            exact = math.exp(-samples.mean() * float(np.linalg.norm(turned @ way)))
            assert transmittance == pytest.approx(exact, abs=2e-4), (index, voxel)
    direction = np.array([0.3, -0.5, 0.8])
    far, parallel = point_transmittance(medium, 1e7 * direction), light_transmittance(medium, direction)
    assert np.abs(far - parallel).max() < 1e-4


def test_which_grid_gives_extinction() -> None:
    temperature, density = grid_of("temperature", np.full((1, 1, 1), 0.5)), grid_of("density", np.full((1, 1, 1), 0.25))
    assert build_medium({"temperature": temperature}, Optics(), SAME).values.max() == 5.0
    assert build_medium({"temperature": temperature, "density": density}, Optics(), SAME).values.max() == 2.5
    with pytest.raises(DataError, match=r"no grid 'density' or 'temperature'.*flames"):
        build_medium({"flames": density}, Optics(), SAME)
    with pytest.raises(DataError, match="'density' has 3 channels; expected 1"):
        build_medium({"density": grid_of("density", np.ones((2, 2, 2, 3)))}, Optics(), SAME)


def test_bad_voxels_count_as_zero() -> None:
    clean = np.random.default_rng(0).random((6, 5, 4)).astype(np.float32)
    dirty = clean.copy()
    dirty[1, 2, 3], dirty[2, 2, 2], dirty[3, 1, 1], dirty[4, 4, 1] = np.nan, np.inf, -np.inf, -3.0
    clean[dirty != clean] = 0.0
    flames = np.zeros((6, 5, 4), np.float32)
    flames[0, 0, 0] = np.nan
    look = Optics(ambient=(0.1, 0.1, 0.1), emission=1.0)
    a = build_medium({"density": grid_of("density", dirty), "flames": grid_of("flames", flames)}, look, SAME)
    dark = grid_of("flames", np.zeros_like(flames))
    b = build_medium({"density": grid_of("density", clean), "flames": dark}, look, SAME)
    assert np.array_equal(a.values, b.values)


def test_grids_of_other_resolutions_meet_in_the_world() -> None:
    """Flames on voxels of half the edge, with centres of their own: the same field, sampled where the density is."""
    where = [(np.arange(n) + 0.5) / n for n in (24, 48)]
    fields = []
    for at in where:
        x, y, z = np.meshgrid(at, at, at, indexing="ij")
        fields.append(0.2 + 0.8 * np.exp(-8 * ((x - 0.4) ** 2 + (y - 0.5) ** 2 + (z - 0.6) ** 2)))
    coarse, fine = (vdb_scale_transform(1 / n, [0.5 / n] * 3) for n in (24, 48))
    density = grid_of("density", np.ones((24, 24, 24)), coarse)
    look = Optics(emission=1.0, flame_extinction=3.0)
    a = build_medium({"density": density, "flames": grid_of("flames", fields[0], coarse)}, look, SAME)
    b = build_medium({"density": density, "flames": grid_of("flames", fields[1], fine)}, look, SAME)
    assert a.values.shape == b.values.shape and np.abs(a.values - b.values).max() < 0.02 * a.values.max()
    assert np.abs(a.values - b.values)[..., 0].max() < 0.003 * a.values[..., 0].max()
    tall = Optics(gradient=((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), ambient=(1.0, 1.0, 1.0), color_grid="color")
    high = build_medium({"density": density}, tall, CaptureNormalisation((0.5, 0.5, 0.5), 1.0).matrix()).values[
        0, 12, 12, 1:-1
    ]
    assert np.allclose(high[:, 3] / high[:, 0], where[0], atol=1e-5)
    assert np.allclose(high[:, 1] / high[:, 0], 1 - where[0], atol=1e-5)


# ---------------------------------------------------------------- the frame of the scene


def test_normalisation(tmp_path: Path) -> None:
    for number, low in ((1, (0, 0, 0)), (2, (10, 4, 2)), (3, (0, 0, 0))):
        array = np.zeros((2, 2, 2)) if number == 3 else np.ones((2, 2, 2))
        grid = dataclasses.replace(
            grid_of("density", array), transform=vdb_scale_transform((0.5, 1.0, 2.0), (7.0, 8.0, 9.0))
        )
        grid = dataclasses.replace(grid, origins=grid.origins + np.array(low, np.int32) * 8)
        write_vdb(tmp_path / f"f_{number}.vdb", [grid])
    boxes = [
        b for f in list_vdb_files(tmp_path).frames if (b := read_grid(f.path, "density").world_bounds()) is not None
    ]
    bounds = np.stack([np.min(boxes, 0)[0], np.max(boxes, 0)[1]])
    norm = CaptureNormalisation.from_bounds(bounds)
    scene = norm.to_scene(bounds)
    assert np.allclose(scene[0], -scene[1]) and (scene[1] - scene[0]).max() == pytest.approx(1.0)
    points = np.random.default_rng(0).normal(size=(4, 3))
    assert np.allclose(norm.matrix()[:3, :3] @ points[0] + norm.matrix()[:3, 3], norm.to_scene(points[0]))
    with pytest.raises(DataError, match="volume"):
        CaptureNormalisation.from_bounds(np.zeros((2, 3)))


def test_extinction_is_per_scene_unit() -> None:
    """The same voxels in a world a hundred times as large look the same."""
    cloud = np.random.default_rng(0).random((8, 8, 8))
    images = []
    for size in (1.0, 100.0):
        grid = grid_of("density", cloud, vdb_scale_transform(size / 8, (size, 0.0, -size)))
        bounds = grid.world_bounds()
        assert bounds is not None
        place = CaptureNormalisation.from_bounds(bounds).matrix()
        medium = build_medium({"density": grid}, OPTICS_PRESETS["dust_tornado"], place)
        images.append(render_medium(medium, hemisphere_capture_cameras(16)[1][0]))
    assert (images[0] - images[1]).abs().max() < 1e-6


# ---------------------------------------------------------------- a real fire


@pytest.mark.parametrize("up", ["y", "z"])
def test_cameras_cover_the_upper_hemisphere(up: Axis) -> None:
    train, test = hemisphere_capture_cameras(64, 40, up=up, field_of_view=30.0)
    assert (len(train), len(test)) == (38, 2)
    eyes = torch.stack([view.position for view in (*train, *test)]).double()
    heights = eyes[:, "xyz".index(up)] / 2.7
    assert torch.allclose(eyes.norm(dim=1), torch.tensor(2.7, dtype=torch.float64))
    assert heights.min().item() == pytest.approx(math.sin(math.radians(3.0)))
    assert heights.max().item() == pytest.approx(math.sin(math.radians(80.0)))
    for view in train:
        assert torch.allclose(view.viewmat[:3, 3], torch.tensor([0.0, 0.0, 2.7], dtype=torch.float64), atol=1e-9)
        assert view.fx == pytest.approx(32 / math.tan(math.radians(15.0)))
