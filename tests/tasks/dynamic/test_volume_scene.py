"""From a folder of .vdb files to a data set: grids, frames, cache, times, masks, starting points."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.errors import DataError
from neuprim.core.io.vdb import write_vdb
from neuprim.core.volumes.density_grid import box_lattice
from neuprim.tasks.dynamic import TASK
from neuprim.tasks.dynamic.volume import capture as capturing
from neuprim.tasks.dynamic.volume.capture_density import sample_extinction
from neuprim.tasks.dynamic.volume.volume_scene import choose_frames
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


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Frames 2 (empty), 9, 10 and 11 of an ellipsoid that moves along x."""
    made = write_blobs(tmp_path / "files", {number: 8.0 + 4 * step for step, number in enumerate(NUMBERS[1:])})
    write_vdb(made / "ball_2.vdb", empty_frame())
    return made


def test_frames_in_numerical_order_cameras_and_times(folder: Path, tmp_path: Path) -> None:
    data = dataset(folder, tmp_path)
    assert [f.number for f in recorded(data).capture.frames] == list(NUMBERS)
    assert len(data.train) == 4 * 4 and len(data.test) == 2 * 4
    times = [round(float(data.test.view(i).conditions["time"]), 4) for i in range(4)]
    assert times == [0, 0.7778, 0.8889, 1]  # by number
    assert data.data_source == "real" and data.color_space == "linear"
    assert TASK.clips(data)[1].views == range(4, 8)
    trained, held_out = (
        {tuple(v.view(i).camera.position.tolist()) for i in range(len(v))} for v in (data.train, data.test)
    )
    assert len(trained) == 4 and len(held_out) == 2
    assert not trained & held_out


def test_images_are_radiance_over_the_exposures_peak_with_alpha(folder: Path, tmp_path: Path) -> None:
    data = dataset(folder, tmp_path)
    empty, full = data.test.pixels(0), data.test.pixels(2)
    assert empty.alpha is not None and full.alpha is not None
    assert not bool(empty.rgb.any()) and not bool(empty.alpha.any())
    assert 0.3 < float(full.alpha.max()) <= 1
    brightest = max(float(views.pixels(i).rgb.max()) for views in (data.train, data.test) for i in range(len(views)))
    assert brightest == pytest.approx(1.0, abs=2e-3)
    white = full.over(torch.ones(3))
    assert torch.allclose(white[0, 0], torch.ones(3))


def test_the_ball_moves_in_the_images_and_the_mask_is_its_track(folder: Path, tmp_path: Path) -> None:
    data = dataset(folder, tmp_path)
    mask = TASK.mask(data, 0)
    assert mask is not None
    for i in range(1, 4):
        alpha = data.test.pixels(i).alpha
        assert alpha is not None and bool(((alpha > 1 / 255) <= mask).all())
        assert int((alpha > 1 / 255).sum()) < int(mask.sum())
    assert torch.equal(TASK.mask(data, 3), mask)


def test_starting_points_lie_where_and_when_there_is_matter(folder: Path, tmp_path: Path) -> None:
    data = dataset(folder, tmp_path)
    cloud = data.initial_points(500, torch.Generator().manual_seed(1))
    again = data.initial_points(500, torch.Generator().manual_seed(1))
    assert torch.equal(cloud.means, again.means) and torch.equal(cloud.conditions["time"], again.conditions["time"])
    assert cloud.steps == {"time": pytest.approx(1 / 9)} == cloud.rows(torch.arange(3)).steps
    world = to_world(recorded(data).capture, cloud.means.double().numpy())
    for time, center in ((7 / 9, 8.0), (8 / 9, 12.0), (1.0, 16.0)):
        here = (cloud.conditions["time"] - time).abs() < 1e-6
        assert 100 < int(here.sum()) < 250
        middle = np.array(ORIGIN) + VOXEL * np.array([center, *MIDDLE])
        assert (np.abs(world[here.numpy()] - middle).max(0) < VOXEL * np.array([6, 4.5, 7.5])).all()
    assert bool(((cloud.means >= data.bounds[0] - 0.05) & (cloud.means <= data.bounds[1] + 0.05)).all())


def test_a_second_call_renders_nothing_and_an_interrupted_one_goes_on(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = dataset(folder, tmp_path)
    calls: list[int] = []
    genuine = capturing.render_medium
    monkeypatch.setattr(capturing, "render_medium", lambda *a, **k: calls.append(1) or genuine(*a, **k))
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


def test_every_nth_frame_may_be_left_out_of_training(folder: Path, tmp_path: Path) -> None:
    data = dataset(folder, tmp_path, train_every=2)
    assert len(data.train) == 4 * 2 and len(data.test) == 2 * 4
    assert {round(float(data.train.view(i).conditions["time"]), 3) for i in range(8)} == {0.0, 0.889}
    started = data.initial_points(50, torch.Generator().manual_seed(0)).conditions["time"]
    assert {round(t, 3) for t in started.tolist()} == {0.889}
    whole = dataset(folder, tmp_path)
    assert torch.equal(data.train.pixels(1).rgb, whole.train.pixels(2).rgb)


def test_the_files_extinction_on_a_lattice(folder: Path, tmp_path: Path) -> None:
    data = dataset(folder, tmp_path)
    recording = recorded(data)
    matrix, shape = box_lattice(recording.capture.bounds, 48)
    medium = recording.capture.medium(recording.capture.frames[1])
    found = sample_extinction(medium, matrix, shape)
    peak = np.array(np.unravel_index(found.argmax(), shape))
    world = to_world(recording.capture, matrix[:3, :3].numpy() @ peak + matrix[:3, 3].numpy())
    assert np.linalg.norm(world - (np.array(ORIGIN) + VOXEL * np.array([8, *MIDDLE]))) < VOXEL
    assert found.max() == pytest.approx(float(medium.values[..., 0].max()), rel=0.15)
    assert not sample_extinction(recording.capture.medium(recording.capture.frames[0]), matrix, shape).any()


def test_frames_that_do_not_exist(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"scene\.frames=50:60: .* has frames 2 to 11, and none of these"):
        dataset(folder, tmp_path, frames="50:60")
    assert choose_frames("2:10:4", list(NUMBERS)) == [2, 10]


def test_a_grid_by_another_name(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(
        DataError, match=r"scene\.grids\.density=densty: no frame has such a grid; did you mean 'density'"
    ):
        dataset(folder, tmp_path, grids={"density": "densty"})
    other = write_blobs(tmp_path / "other", {1: 11.0, 2: 12.0}, ("soup",))
    with pytest.raises(DataError, match=r"no grid of density or temperature; found: soup \(readable\)"):
        dataset(other, tmp_path)
    assert dataset(other, tmp_path, grids={"density": "soup"}).exposure > 0


def test_a_look_chosen_by_the_grids(folder: Path, tmp_path: Path) -> None:
    recording = recorded(dataset(folder, tmp_path, look="auto"))
    assert recording.capture.optics.extinction_grids == ("density", "temperature")
    other = write_blobs(tmp_path / "hot", {1: 11.0, 2: 12.0}, ("temperature", "flames"))
    data = dataset(other, tmp_path, look="auto")
    recording = recorded(data)
    assert recording.capture.optics.extinction_grids == ("temperature",)
    assert recording.capture.optics.flame_range == (0.0, pytest.approx(0.2, abs=0.01))  # the hottest flame of the files


def test_damaged_points_say_what_to_do(folder: Path, tmp_path: Path) -> None:
    data = dataset(folder, tmp_path)
    (recorded(data).folder.path / "frame_00010" / "points.npz").write_bytes(b"not a zip")
    with pytest.raises(DataError, match="delete its folder to render the frame again"):
        dataset(folder, tmp_path)


def test_voxel_sizes_and_bounds_may_change(folder: Path, tmp_path: Path) -> None:
    before = dataset(folder, tmp_path).test.pixels(2)
    write_vdb(folder / "ball_10.vdb", blob(12.0, fine=2))
    after = dataset(folder, tmp_path).test.pixels(2)
    assert before.alpha is not None and after.alpha is not None
    assert float((before.alpha - after.alpha).abs().mean()) < 0.01 < float(before.alpha.mean())
