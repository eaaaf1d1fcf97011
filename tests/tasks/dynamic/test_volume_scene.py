"""From a folder of .vdb files to a data set: grids, frames, cache, times, masks, starting points; damaged and shared
caches."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuprim.core.data import Dataset
from neuprim.core.data.dataset import hold_out_views
from neuprim.core.errors import ConfigError, DataError, NeuprimWarning
from neuprim.core.io.vdb import VdbGrid, VdbTiles, list_vdb_files, vdb_scale_transform, write_vdb
from neuprim.core.volumes.density_grid import box_lattice
from neuprim.tasks.dynamic import TASK
from neuprim.tasks.dynamic.volume import capture as capturing
from neuprim.tasks.dynamic.volume import capture_density, lit_medium
from neuprim.tasks.dynamic.volume.capture_dataset import VdbFrameViews
from neuprim.tasks.dynamic.volume.capture_density import CaptureDensity, sample_extinction
from neuprim.tasks.dynamic.volume.capture_voxels import FrameVoxels, MediumVoxels
from neuprim.tasks.dynamic.volume.lit_medium import build_medium
from neuprim.tasks.dynamic.volume.optics import optics_preset, override_optics
from neuprim.tasks.dynamic.volume.survey import CaptureNormalisation, find_volume_grids, survey_volume_frames
from neuprim.tasks.dynamic.volume.volume_scene import choose_volume_frames
from tests.tasks.dynamic.sequences import (
    MIDDLE,
    ORIGIN,
    VOXEL,
    blob,
    dataset,
    empty_frame,
    recorded,
    to_world,
    write_blobs,
)

NUMBERS = (2, 9, 10, 11)


def write_sequence(folder: Path) -> Path:
    """Frames 2 (empty), 9, 10 and 11 of an ellipsoid that moves along x."""
    write_blobs(folder, {number: 8.0 + 4 * step for step, number in enumerate(NUMBERS[1:])})
    write_vdb(folder / "ball_2.vdb", empty_frame())
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_sequence(tmp_path / "files")


@pytest.fixture
def hot(tmp_path: Path) -> Path:
    """Two frames with density, temperature and flames."""
    return write_blobs(tmp_path / "hot", {1: 11.0, 2: 12.0}, ("density", "temperature", "flames"))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    made = tmp_path_factory.mktemp("sequence")
    return dataset(write_sequence(made / "files"), made)


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


# ---------------------------------------------------------------- views


def test_frames_in_numerical_order_cameras_and_times(data: Dataset) -> None:
    assert [f.number for f in recorded(data).capture.frames] == list(NUMBERS)
    assert len(data.train) == 4 * 4 and len(data.test) == 2 * 4
    times = [round(float(data.test.view(i).conditions["time"]), 4) for i in range(4)]
    assert times == [0, 0.7778, 0.8889, 1]  # by number
    assert data.data_source == "real" and data.color_space == "linear"
    assert TASK.clips(data)[1].views == range(4, 8)
    trained, held_out = (
        {tuple(v.view(i).camera.position.tolist()) for i in range(len(v))} for v in (data.train, data.test)
    )
    assert len(trained) == 4 and len(held_out) == 2 and not trained & held_out


def test_held_out_training_views_have_neither_masks_nor_clips_of_test_cameras(data: Dataset) -> None:
    held = hold_out_views(data, 2)
    assert TASK.mask is not None and TASK.mask(data, 0) is not None and TASK.mask(held, 0) is None
    assert len(TASK.clips(data)) == 2 and not TASK.clips(held)


def test_images_are_radiance_over_the_exposures_peak_with_alpha(data: Dataset) -> None:
    empty, full = data.test.pixels(0), data.test.pixels(2)
    assert empty.alpha is not None and full.alpha is not None
    assert not bool(empty.rgb.any()) and not bool(empty.alpha.any())
    assert 0.3 < float(full.alpha.max()) <= 1
    brightest = max(float(views.pixels(i).rgb.max()) for views in (data.train, data.test) for i in range(len(views)))
    assert brightest == pytest.approx(1.0, abs=2e-3)
    assert torch.allclose(full.over(torch.ones(3))[0, 0], torch.ones(3))


def test_the_ball_moves_in_the_images_and_the_mask_is_its_track(data: Dataset) -> None:
    mask = TASK.mask(data, 0)
    assert mask is not None and torch.equal(TASK.mask(data, 3), mask)
    for i in range(1, 4):
        alpha = data.test.pixels(i).alpha
        assert alpha is not None and bool(((alpha > 1 / 255) <= mask).all())
        assert int((alpha > 1 / 255).sum()) < int(mask.sum())


def test_every_nth_frame_may_be_left_out_of_training(folder: Path, tmp_path: Path, data: Dataset) -> None:
    some = dataset(folder, tmp_path, train_every=2)
    assert len(some.train) == 4 * 2 and len(some.test) == 2 * 4
    assert {round(float(some.train.view(i).conditions["time"]), 3) for i in range(8)} == {0.0, 0.889}
    started = some.initial_points(50, rng()).conditions["time"]
    assert {round(t, 3) for t in started.tolist()} == {0.889}
    assert torch.equal(some.train.pixels(1).rgb, data.train.pixels(2).rgb)


def test_voxel_sizes_and_bounds_may_change(folder: Path, tmp_path: Path, data: Dataset) -> None:
    write_vdb(folder / "ball_10.vdb", blob(12.0, fine=2))
    before, after = data.test.pixels(2).alpha, dataset(folder, tmp_path).test.pixels(2).alpha
    assert before is not None and after is not None
    assert float((before - after).abs().mean()) < 0.01 < float(before.mean())


def test_light_beyond_half_floats(hot: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"ball_1\.vdb: a radiance of .* does not fit .*scene\.optics\.emission"):
        dataset(hot, tmp_path, optics={"emission": 1e7})
    with pytest.raises(DataError, match=r"ball_1\.vdb: medium: some voxels are NaN or infinite"):
        dataset(hot, tmp_path, optics={"extinction": 1e39})
    with pytest.raises(DataError, match="every frame is black"):
        dataset(hot, tmp_path, optics={"extinction": 1e-12, "flame_extinction": 0.0})


def test_the_files_extinction_on_a_lattice(data: Dataset) -> None:
    capture = recorded(data).capture
    matrix, shape = box_lattice(capture.bounds, 48)
    medium = capture.medium(capture.frames[1])
    sampled = sample_extinction(medium, matrix, shape)
    peak = np.array(np.unravel_index(sampled.argmax(), shape))
    world = to_world(capture, matrix[:3, :3].numpy() @ peak + matrix[:3, 3].numpy())
    assert np.linalg.norm(world - (np.array(ORIGIN) + VOXEL * np.array([8, *MIDDLE]))) < VOXEL
    assert sampled.max() == pytest.approx(float(medium.values[..., 0].max()), rel=0.15)
    assert not sample_extinction(capture.medium(capture.frames[0]), matrix, shape).any()


def test_of_large_boxes_some_points_are_compared(data: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = CaptureDensity(recorded(data).capture)
    whole = truth.points(1)
    assert whole is not None
    monkeypatch.setattr(capture_density, "_MOST_POINTS", math.prod(whole[1]) // 20)
    some = truth.points(1)
    assert some is not None and some[1] == tuple(-(-n // 3) for n in whole[1])
    assert np.allclose(truth.grid(1, *some), truth.grid(1, *whole)[::3, ::3, ::3], atol=1e-4)


# ---------------------------------------------------------------- time and starting points


def test_starting_points_lie_where_and_when_there_is_matter(data: Dataset) -> None:
    cloud, again = (data.initial_points(500, rng(1)) for _ in range(2))
    assert torch.equal(cloud.means, again.means) and torch.equal(cloud.conditions["time"], again.conditions["time"])
    assert cloud.steps == {"time": pytest.approx(1 / 9)} == cloud.rows(torch.arange(3)).steps
    world = to_world(recorded(data).capture, cloud.means.double().numpy())
    for time, center in ((7 / 9, 8.0), (8 / 9, 12.0), (1.0, 16.0)):
        here = (cloud.conditions["time"] - time).abs() < 1e-6
        assert 100 < int(here.sum()) < 250
        middle = np.array(ORIGIN) + VOXEL * np.array([center, *MIDDLE])
        assert (np.abs(world[here.numpy()] - middle).max(0) < VOXEL * np.array([6, 4.5, 7.5])).all()
    assert bool(((cloud.means >= data.bounds[0] - 0.05) & (cloud.means <= data.bounds[1] + 0.05)).all())


def test_more_starting_points_than_are_stored_are_distinct(
    hot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capturing, "POINTS", 64)
    points = dataset(hot, tmp_path).initial_points(1000, rng())
    assert len(points.means) == 1000 == len(np.unique(points.means.numpy(), axis=0))
    assert float(points.means.abs().max()) < 0.7


def test_frames_to_train_on_without_matter_are_refused(hot: Path, tmp_path: Path) -> None:
    write_vdb(hot / "ball_1.vdb", empty_frame())
    with pytest.raises(DataError, match=r"no training frame absorbs light; .*scene\.train_every"):
        dataset(hot, tmp_path, train_every=2).initial_points(5, rng())


def test_a_gap_in_the_numbers_is_a_gap_in_time(hot: Path, tmp_path: Path) -> None:
    write_vdb(hot / "ball_5.vdb", blob(16.0))
    for frames, times in (("all", [0.0, 0.25, 1.0]), ("2:5:3", [0.0, 1.0]), ("2:4", [0.0])):
        assert [float(t) for t in recorded(dataset(hot, tmp_path, frames=frames)).test.times] == times


def test_frames_that_do_not_exist(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"scene\.frames=50:60: no such frame; .* has frames 2 to 11"):
        dataset(folder, tmp_path, frames="50:60")
    assert choose_volume_frames("2:10:4", list(NUMBERS)) == [2, 10]


# ---------------------------------------------------------------- optics and grids


def test_optics_of_every_form() -> None:
    changes = {"extinction": 3, "albedo": [1, 0.5, 0], "gradient": [[1, 0, 0], [0, 0, 1]]}
    look = override_optics(optics_preset("smoke_fire"), {**changes, "light": {"irradiance": [1, 2, 3]}})
    assert look.extinction == 3 and look.albedo == (1.0, 0.5, 0.0)
    assert look.gradient == ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    original = optics_preset("smoke_fire").light
    assert look.light is not None and look.light.irradiance == (1.0, 2.0, 3.0)
    assert original is not None and look.light.direction == original.direction
    assert override_optics(look, {"light": None}).light is None
    with pytest.raises(ConfigError, match=r"light\.irradiance: required and not given; expected three numbers"):
        override_optics(optics_preset("embergen_fire"), {"light": {"direction": [0, 0, 1]}})


def test_the_box_is_that_of_the_grid_that_the_look_absorbs_by(hot: Path, tmp_path: Path) -> None:
    heat = blob(10.0, ("temperature",))[0]
    far = VdbGrid.from_dense(
        "density", np.ones((8, 8, 8), np.float32), transform=vdb_scale_transform(VOXEL, (500.0, 0, 0))
    )
    write_vdb(hot / "ball_1.vdb", [heat, far])
    write_vdb(hot / "ball_2.vdb", [heat])  # has what absorbs, whatever else it lacks
    data = dataset(hot, tmp_path, look="embergen_fire")
    assert recorded(data).capture.normalisation.center[0] < 100
    alphas = [data.test.pixels(i).alpha for i in range(2)]
    assert all(a is not None and bool(a.any()) for a in alphas)
    assert recorded(dataset(hot, tmp_path, look="dust_tornado")).capture.normalisation.center[0] > 400


def test_a_frame_without_the_grid_that_absorbs_takes_no_other(hot: Path, tmp_path: Path) -> None:
    write_vdb(hot / "ball_2.vdb", blob(12.0, ("temperature",)))
    capture = recorded(dataset(hot, tmp_path, look="smoke_fire")).capture
    assert capture.medium(capture.frames[1]).empty and not capture.medium(capture.frames[0]).empty


@pytest.mark.parametrize(
    ("names", "settings", "message"),
    [
        (
            ("density",),
            {"look": "embergen_fire"},
            r"takes extinction from temperature, but the files have density \('density'\)",
        ),
        (("density",), {"grids": {"density": "densty"}}, r"density=densty: no frame has .*; did you mean 'density'"),
        (("soup",), {}, r"no grid of density or temperature; found: soup \(readable\)"),
    ],
)
def test_grids_that_are_missing(names: tuple[str, ...], settings: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=message):
        dataset(write_blobs(tmp_path / "files", {1: 11.0, 2: 12.0}, names), tmp_path, **settings)


def test_a_grid_by_another_name_and_one_of_vectors(hot: Path, tmp_path: Path) -> None:
    other = write_blobs(tmp_path / "other", {1: 11.0, 2: 12.0}, ("soup",))
    assert dataset(other, tmp_path, grids={"density": "soup"}).exposure > 0
    vector = VdbGrid.from_dense("density", np.ones((8, 8, 8, 3), np.float32), transform=vdb_scale_transform(VOXEL))
    write_vdb(hot / "ball_1.vdb", [vector])
    with pytest.raises(DataError, match=r"ball_1\.vdb: grid 'density' has 3 channels; expected 1"):
        dataset(hot, tmp_path)
    only = tmp_path / "only"
    only.mkdir()
    write_vdb(only / "wind_1.vdb", [replace(vector, name="vel")])
    with pytest.raises(DataError, match=r"wind_1\.vdb: grid 'vel' has 3 channels; expected 1"):
        dataset(only, tmp_path, grids={"density": "vel"})
    write_vdb(only / "wind_1.vdb", [*blob(11.0, ("density",)), replace(vector, name="flames")])
    with pytest.raises(DataError, match=r"wind_1\.vdb: grid 'flames' has 3 channels; expected 1"):
        dataset(only, tmp_path, look="smoke_fire")
    dataset(only, tmp_path, look="colorful_smoke")  # does not use flames


def test_frames_with_different_usual_names_are_refused(hot: Path, tmp_path: Path) -> None:
    write_vdb(hot / "ball_2.vdb", blob(12.0, ("smoke", "temperature", "flames")))
    with pytest.raises(
        DataError, match=r"ball_2\.vdb: no grid 'density', .* but 'smoke'; .*: scene\.grids\.density=NAME"
    ):
        dataset(hot, tmp_path)
    assert dataset(hot, tmp_path, grids={"density": "smoke"}).exposure > 0


def test_a_tile_counts_as_all_its_voxels(tmp_path: Path) -> None:
    """A core of 10 in tiles, 14 % of all voxels, in a haze of 0.05: the peak is 10."""
    corners = np.stack(np.meshgrid(*(np.arange(0, 32, 8),) * 3), -1).reshape(-1, 3).astype(np.int32)
    tiles = VdbTiles(corners, np.full(64, 8, np.int32), np.full(64, 10, np.float32), np.ones(64, bool))
    haze = np.array([[32 + 8 * (i % 20), 8 * (i // 20), 0] for i in range(400)], np.int32)
    values = np.full((400, 8, 8, 8), 0.05, np.float32)
    zero = np.zeros((), np.float32)
    write_vdb(tmp_path / "a_1.vdb", [VdbGrid("density", np.eye(4), zero, haze, values, values > 0, tiles)])
    frames = list(list_vdb_files(tmp_path).frames)
    survey = survey_volume_frames(frames, find_volume_grids(frames, {}), optics_preset("smoke_fire"), lambda *_: None)
    assert survey.peaks["density"] == pytest.approx(10, rel=0.01)


def test_fire_by_temperature_is_adapted_to_the_files_by_either_setting(tmp_path: Path) -> None:
    (tmp_path / "files").mkdir()
    for number in (1, 2):
        smoke, heat = blob(10.0 + number, ("density", "temperature"))
        write_vdb(tmp_path / "files" / f"fire_{number}.vdb", [smoke, replace(heat, values=1000 * heat.values)])
    settings: list[dict[str, Any]] = [{"grids": {"flames": "temperature"}}, {"optics": {"flame_grid": "temperature"}}]
    first, second = (
        recorded(dataset(tmp_path / "files", tmp_path / str(i), look="smoke_fire", **more)).capture.optics
        for i, more in enumerate(settings)
    )
    with pytest.warns(NeuprimWarning, match="no flames, so nothing glows; scene.grids.flames=temperature makes"):
        dataset(tmp_path / "files", tmp_path / "smoke", look="smoke_fire")
    assert second.flame_range == first.flame_range and second.flame_range[1] > 0
    assert second.flame_extinction == first.flame_extinction != optics_preset("smoke_fire").flame_extinction


def test_precision_is_that_of_the_first_file_with_the_grid(folder: Path, tmp_path: Path, data: Dataset) -> None:
    for number in NUMBERS[1:]:
        write_vdb(
            folder / f"ball_{number}.vdb", [replace(grid, half=True) for grid in blob(8.0 + number, ("density",))]
        )
    write_vdb(folder / "ball_2.vdb", [replace(grid, name="other") for grid in empty_frame()])
    found = CaptureDensity(recorded(dataset(folder, tmp_path)).capture)
    assert found.half and not CaptureDensity(recorded(data).capture).half


def sphere_level_set(radius: float, width: float = 1.5) -> VdbGrid:
    """Signed distances to a sphere around ORIGIN + 6, in world units; voxels deeper than ``width`` are inactive."""
    index = np.stack(np.meshgrid(*(np.arange(24),) * 3, indexing="ij"), -1)
    distance = np.clip(np.linalg.norm((index - 12) * VOXEL, axis=-1) - radius, -width, width).astype(np.float32)
    transform = vdb_scale_transform(VOXEL, ORIGIN)
    grid = VdbGrid.from_dense("surface", distance, transform=transform, background=width)
    return replace(grid, masks=grid.masks & (grid.values > np.float32(-width)), kind="level set")


def test_a_level_set_is_read_as_fog_if_named(tmp_path: Path) -> None:
    """Inside the surface, density rises from 0 to 1 at the level set's largest distance."""
    for number in (1, 2):
        write_vdb(tmp_path / f"ball_{number}.vdb", [sphere_level_set(4.0)])
    with pytest.raises(DataError, match=r"surface \(is a level set.*scene.grids.density=NAME reads it as fog"):
        dataset(tmp_path, tmp_path)
    data = dataset(tmp_path, tmp_path, grids={"density": "surface"})
    fog = recorded(data).capture.reader.read(tmp_path / "ball_1.vdb")["density"]
    dense = fog.to_dense(((0, 0, 0), (24, 24, 24)))
    depth = 4.0 - np.linalg.norm((np.indices((24, 24, 24)).transpose(1, 2, 3, 0) - 12) * VOXEL, axis=-1)
    np.testing.assert_allclose(dense, np.clip(depth / 1.5, 0, 1), atol=1e-6)
    assert fog.kind == "fog volume" and fog.active_voxels == np.count_nonzero(dense)


def test_a_level_set_that_nobody_named_is_refused(tmp_path: Path) -> None:
    """A grid that is fog in the first frame and a level set in the second."""
    write_vdb(tmp_path / "ball_1.vdb", blob(11.0, ("density",)))
    write_vdb(tmp_path / "ball_2.vdb", [replace(sphere_level_set(4.0), name="density")])
    with pytest.raises(DataError, match=r"ball_2\.vdb: grid 'density' is a level set"):
        dataset(tmp_path, tmp_path)


def test_a_level_set_without_a_width_and_one_with_nan() -> None:
    grid = sphere_level_set(4.0)
    with pytest.raises(DataError, match=r"level set 'surface' has a background of -1.0; expected"):
        replace(grid, background=np.array(-1, np.float32)).fog()
    values = np.where(grid.values < -1, np.nan, grid.values)
    fog = replace(grid, values=values).fog()
    assert fog.non_finite == 0 and not fog.masks[np.isnan(values)].any() and fog.masks.any()


def test_a_level_set_without_a_width_is_refused_by_file(tmp_path: Path) -> None:
    for number in (1, 2):
        write_vdb(
            tmp_path / f"ball_{number}.vdb", [replace(sphere_level_set(4.0), background=np.zeros((), np.float32))]
        )
    with pytest.raises(DataError, match=r"ball_1\.vdb: level set 'surface' has a background of 0.0; expected"):
        dataset(tmp_path, tmp_path, grids={"density": "surface"})


def test_colour_in_three_grids(tmp_path: Path) -> None:
    """Grids NAME_r, NAME_g and NAME_b of unlike bounds are the channels of NAME."""
    smoke = blob(11.0, ("density",))
    parts = [replace(blob(11.0 + c, ("x",))[0], name=f"color_{'rgb'[c]}") for c in range(3)]
    for number in (1, 2):
        write_vdb(tmp_path / f"ball_{number}.vdb", [*smoke, *parts])
    reader = recorded(dataset(tmp_path, tmp_path, look="colorful_smoke")).capture.reader
    assert reader.names["color"] == "color"
    colour = reader.read(tmp_path / "ball_1.vdb")["color"]
    box = ((0, 0, 0), (24, 18, 28))
    np.testing.assert_array_equal(colour.to_dense(box), np.stack([p.to_dense(box) for p in parts], -1))
    moved = replace(parts[2], transform=vdb_scale_transform(VOXEL, (0, 0, 0)))
    write_vdb(tmp_path / "ball_2.vdb", [*smoke, *parts[:2], moved])
    with pytest.raises(DataError, match=r"ball_2\.vdb: grid 'color_b' has another transform or number of channels"):
        reader.read(tmp_path / "ball_2.vdb")


def test_a_look_chosen_by_the_grids(folder: Path, tmp_path: Path) -> None:
    optics = recorded(dataset(folder, tmp_path, look="auto")).capture.optics
    assert optics.extinction_grids == ("density", "temperature")
    other = write_blobs(tmp_path / "other", {1: 11.0, 2: 12.0}, ("temperature", "flames"))
    optics = recorded(dataset(other, tmp_path, look="auto")).capture.optics
    assert optics.extinction_grids == ("temperature",)
    assert optics.flame_range == (0.0, pytest.approx(0.2, abs=0.01))  # the hottest flame of the files


def test_grids_far_from_the_worlds_origin_are_still_told_apart() -> None:
    index = np.stack(np.meshgrid(*(np.arange(24, dtype=np.float32),) * 3, indexing="ij"), -1)
    ball = np.clip(1 - np.linalg.norm(index - 12, axis=-1) / 8, 0, None)
    media = []
    for offset in (0.0, 1e7):
        coarse = VdbGrid.from_dense("flames", ball[::2, ::2, ::2], transform=vdb_scale_transform(2e-3, (offset, 0, 0)))
        fine = VdbGrid.from_dense("density", ball, transform=vdb_scale_transform(1e-3, (offset, 0, 0)))
        box = fine.world_bounds()
        assert box is not None
        grids = {"density": fine, "flames": coarse}
        media.append(build_medium(grids, optics_preset("smoke_fire"), CaptureNormalisation.from_bounds(box).matrix()))
    near, far = (m.values for m in media)
    assert near.shape == far.shape and np.allclose(near, far, atol=0.02 * float(near.max()))


# ---------------------------------------------------------------- the cache


def test_a_second_call_renders_nothing_and_an_interrupted_one_goes_on(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = dataset(folder, tmp_path)
    calls: list[int] = []
    genuine = lit_medium.render_medium
    monkeypatch.setattr(lit_medium, "render_medium", lambda *a, **k: calls.append(1) or genuine(*a, **k))
    before = first.train.pixels(5).rgb
    second = dataset(folder, tmp_path)
    assert not calls and torch.equal(second.train.pixels(5).rgb, before)
    shutil.rmtree(recorded(first).folder.path / "frame_00009")
    third = dataset(folder, tmp_path)
    assert len(calls) == 6 and torch.equal(third.train.pixels(5).rgb, before)


def test_whatever_matters_is_part_of_the_key(folder: Path, tmp_path: Path) -> None:
    names = {recorded(dataset(folder, tmp_path)).folder.path}
    changes = ({"size": 20}, {"samples": 2}, {"cameras": 5}, {"field_of_view": 30.0}, {"look": "dust_tornado"})
    for change in (*changes, {"optics": {"extinction": 3.0}}, {"frames": "9:11"}):
        names.add(recorded(dataset(folder, tmp_path, **change)).folder.path)
    write_vdb(folder / "ball_11.vdb", blob(17.0))
    names.add(recorded(dataset(folder, tmp_path)).folder.path)
    assert len(names) == 9


@pytest.mark.parametrize("address", ["DIR/shared", "file://DIR/shared", "memory://neuprim-truth"])
def test_the_same_data_set_from_anywhere(
    hot: Path, tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = address.replace("DIR", str(tmp_path))
    plain = dataset(hot, tmp_path)
    dataset(hot, tmp_path / "maker", cache=address)  # another machine, with a cache of its own
    monkeypatch.setattr(lit_medium, "render_medium", lambda *a, **k: pytest.fail("rendered again"))
    data = dataset(hot, tmp_path / "reader", cache=address)
    assert recorded(data).folder.path.name == recorded(plain).folder.path.name, "keyed alike"
    for i in range(0, len(plain.train), 3):
        a, b = plain.train.pixels(i), data.train.pixels(i)
        assert torch.equal(a.rgb, b.rgb) and torch.equal(a.alpha, b.alpha)
    clouds = [d.initial_points(50, rng()) for d in (plain, data)]
    assert torch.equal(clouds[0].means, clouds[1].means) and plain.exposure == data.exposure
    first = data.points.draw(20, rng(1))
    monkeypatch.setattr(capturing.Capture, "medium", lambda *a: pytest.fail("read again"))
    again = dataset(hot, tmp_path / "third", cache=address).points.draw(20, rng(1))
    assert torch.equal(again.sigma, first.sigma), "voxels are stored there, too"
    if address.startswith("memory"):
        import fsspec

        fsspec.filesystem("memory").rm("/neuprim-truth", recursive=True)


def test_damaged_files_of_the_cache_are_refused_by_name(folder: Path, tmp_path: Path) -> None:
    data = dataset(folder, tmp_path)
    recording = recorded(data)
    image = recording.capture.fetch_image(recording.folder, recording.capture.frames[1], 0)
    image.write_bytes(image.read_bytes() + bytes(10**6))
    message = r"cam_00\.exr: the file has 1,0\d\d,\d\d\d bytes; expected at most .*; delete the folder .*frame_00009"
    with pytest.raises(DataError, match=message):
        data.train.pixels(1)
    points = {"means": np.zeros((9, 2), np.float32), "colors": np.zeros((9, 3), np.float32)}
    stored = recording.folder.path / "frame_00009" / "points.npz"
    np.savez(stored, **points, weight=1.0, brightest=np.float32(1))
    with pytest.raises(DataError, match=r"damaged \(means is float32 of shape \(9, 2\).*delete its folder"):
        data.initial_points(50, rng())
    stored.write_bytes(b"not a zip")
    with pytest.raises(DataError, match="delete its folder to render the frame again"):
        dataset(folder, tmp_path)


@pytest.mark.parametrize(
    "change",
    [
        {"index": np.array([1, 8])},
        {"index": np.array([5, 1])},
        {"index": np.array([-1, 5])},
        {"index": np.array([1])},
        {"values": np.full((2, 4), np.nan, np.float32)},
        {"scene_from_index": np.full((4, 4), np.inf)},
    ],
)
def test_damaged_voxels_are_refused(change: dict[str, np.ndarray], tmp_path: Path) -> None:
    path = tmp_path / "voxels.npz"
    good = {"index": np.array([1, 5]), "values": np.ones((2, 4), np.float32), "shape": np.array([2, 2, 2])}
    np.savez(path, **good, scene_from_index=np.eye(4))
    assert len(MediumVoxels.read(path).index) == 2
    np.savez(path, **{**good, "scene_from_index": np.eye(4), **change})
    with pytest.raises(
        DataError, match=r"voxels\.npz: damaged .*ascending voxel indices in the grid, and finite values"
    ):
        MediumVoxels.read(path)


def test_memory_is_bounded_by_the_setting_whatever_the_length(hot: Path, tmp_path: Path, data: Dataset) -> None:
    def caches(data: Dataset) -> list[Any]:
        assert isinstance(data.train, VdbFrameViews) and isinstance(data.test, VdbFrameViews)
        assert isinstance(data.points, FrameVoxels)
        return [data.train._images, data.test._images, data.points._voxels]

    tight = dataset(hot, tmp_path, memory=1, size=96, cameras=11)
    train, test, voxels = caches(tight)
    assert train._memory + test._memory + voxels._memory == pytest.approx(2**20)
    for views, cache in ((tight.train, train), (tight.test, test)):
        for i in range(len(views)):
            views.pixels(i)
        assert 0 < sum(image.nbytes for image in cache._items.values()) <= max(cache._memory, 96 * 96 * 8)
    assert len(train._items) < len(tight.train)
    assert [round(cache._memory) / 2**20 for cache in caches(data)] == [768, 128, 512]


def test_pixels_narrower_than_voxels_need_one_ray(folder: Path, tmp_path: Path) -> None:
    for size, rays in ((8, 2), (96, 1)):
        found = recorded(dataset(folder, tmp_path, size=size, samples=None)).capture
        assert found.samples == rays
        assert recorded(dataset(folder, tmp_path, size=size, samples=3)).capture.samples == 3
