"""What users and disks do to volume scenes: wrong optics, unusual grids, damaged and shared caches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.vdb import Grid, scale_transform, write_vdb
from neuprim.tasks.dynamic.volume.capture_dataset import FrameViews
from neuprim.tasks.dynamic.volume.medium import build_medium
from neuprim.tasks.dynamic.volume.optics import optics_preset, override_optics
from neuprim.tasks.dynamic.volume.survey import Normalisation
from tests.tasks.dynamic.sequences import VOXEL, blob, dataset, empty_frame, recorded, write_blobs


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two frames with density, temperature and flames."""
    return write_blobs(tmp_path / "files", {1: 11.0, 2: 12.0}, ("density", "temperature", "flames"))


# ---------------------------------------------------------------- optics


def test_optics_of_every_form() -> None:
    changes = {"extinction": 3, "albedo": [1, 0.5, 0], "gradient": [[1, 0, 0], [0, 0, 1]]}
    look = override_optics(optics_preset("smoke_fire"), {**changes, "light": {"irradiance": [1, 2, 3]}})
    assert look.extinction == 3 and look.albedo == (1.0, 0.5, 0.0)
    assert look.gradient == ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert look.light is not None and look.light.irradiance == (1.0, 2.0, 3.0)
    original = optics_preset("smoke_fire").light
    assert original is not None and look.light.direction == original.direction
    assert override_optics(look, {"light": None}).light is None
    with pytest.raises(
        ConfigError, match=r"scene\.optics\.light\.irradiance: required and not given; expected three numbers"
    ):
        override_optics(optics_preset("embergen_fire"), {"light": {"direction": [0, 0, 1]}})


# ---------------------------------------------------------------- grids


def test_the_box_is_that_of_the_grid_that_the_look_absorbs_by(folder: Path, tmp_path: Path) -> None:
    hot = blob(10.0, ("temperature",))[0]
    far = Grid.from_dense(
        "density", np.ones((8, 8, 8), np.float32), transform=scale_transform(VOXEL, (500.0, 0.0, 0.0))
    )
    write_vdb(folder / "ball_1.vdb", [hot, far])
    write_vdb(folder / "ball_2.vdb", [hot])  # has what absorbs, whatever else it lacks
    data = dataset(folder, tmp_path, look="embergen_fire")
    assert recorded(data).capture.normalisation.center[0] < 100
    alphas = [data.test.pixels(i).alpha for i in range(2)]
    assert all(a is not None and bool(a.any()) for a in alphas)
    assert recorded(dataset(folder, tmp_path, look="dust_tornado")).capture.normalisation.center[0] > 400


def test_a_frame_without_the_grid_that_absorbs_takes_no_other(folder: Path, tmp_path: Path) -> None:
    write_vdb(folder / "ball_2.vdb", blob(12.0, ("temperature",)))
    data = dataset(folder, tmp_path, look="smoke_fire")
    capture = recorded(data).capture
    assert capture.medium(capture.frames[1]).empty and not capture.medium(capture.frames[0]).empty


def test_a_look_whose_grids_are_missing(folder: Path, tmp_path: Path) -> None:
    write_blobs(folder, {1: 11.0, 2: 12.0}, ("density",))
    message = r"files: this look absorbs by temperature, and the files have density \('density'\)"
    with pytest.raises(DataError, match=message):
        dataset(folder, tmp_path, look="embergen_fire")


def test_a_vector_grid_as_density_names_the_file(folder: Path, tmp_path: Path) -> None:
    vector = Grid.from_dense("density", np.ones((8, 8, 8, 3), np.float32), transform=scale_transform(VOXEL))
    write_vdb(folder / "ball_1.vdb", [vector])
    with pytest.raises(DataError, match=r"ball_1\.vdb: grid 'density' has 3 channels; expected 1"):
        dataset(folder, tmp_path)


def test_grids_far_from_the_worlds_origin_are_still_told_apart() -> None:
    look = optics_preset("smoke_fire")
    index = np.stack(np.meshgrid(*(np.arange(24, dtype=np.float32),) * 3, indexing="ij"), -1)
    ball = np.clip(1 - np.linalg.norm(index - 12, axis=-1) / 8, 0, None)
    media = []
    for offset in (0.0, 1e7):
        coarse = Grid.from_dense("flames", ball[::2, ::2, ::2], transform=scale_transform(2e-3, (offset, 0, 0)))
        fine = Grid.from_dense("density", ball, transform=scale_transform(1e-3, (offset, 0, 0)))
        box = fine.world_bounds()
        assert box is not None
        media.append(build_medium({"density": fine, "flames": coarse}, look, Normalisation.from_bounds(box).matrix()))
    near, far = (m.values for m in media)
    assert near.shape == far.shape and np.allclose(near, far, atol=0.02 * float(near.max()))


# ---------------------------------------------------------------- time and starting points


def times(data: Dataset) -> list[torch.Tensor]:
    """Of the training views' frames."""
    assert isinstance(data.train, FrameViews)
    return data.train.times


def test_a_gap_in_the_numbers_is_a_gap_in_time(folder: Path, tmp_path: Path) -> None:
    write_vdb(folder / "ball_5.vdb", blob(16.0))
    data = dataset(folder, tmp_path)
    assert [float(t) for t in recorded(data).test.times] == [0.0, 0.25, 1.0]
    assert [float(t) for t in times(dataset(folder, tmp_path, frames="2:5:3"))] == [0.0, 1.0]
    assert [float(t) for t in times(dataset(folder, tmp_path, frames="2:4"))] == [0.0]


def test_more_starting_points_than_were_kept_are_distinct(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("neuprim.tasks.dynamic.volume.capture.POINTS", 64)
    points = dataset(folder, tmp_path).initial_points(1000, torch.Generator().manual_seed(0))
    assert len(points.means) == 1000 == len(np.unique(points.means.numpy(), axis=0))
    assert float(points.means.abs().max()) < 0.7


def test_matter_in_frames_that_are_not_learned_from(folder: Path, tmp_path: Path) -> None:
    write_vdb(folder / "ball_1.vdb", empty_frame())
    with pytest.raises(DataError, match=r"no frame to learn from absorbs light; .*scene\.train_every"):
        dataset(folder, tmp_path, train_every=2).initial_points(5, torch.Generator().manual_seed(0))


# ---------------------------------------------------------------- light that half floats cannot hold


def test_light_beyond_half_floats(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"ball_1\.vdb: a radiance of .* does not fit .*scene\.optics\.emission"):
        dataset(folder, tmp_path, optics={"emission": 1e7})
    with pytest.raises(DataError, match="every frame is black"):
        dataset(folder, tmp_path, optics={"extinction": 1e-12, "flame_extinction": 0.0})
