"""Primitives start with the velocities of a grid, whose unit is measured from how the density moves."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.config import compose
from neuprim.core.data import PointCloud
from neuprim.core.errors import DataError, NeuprimWarning
from neuprim.core.io.vdb import VdbGrid, write_vdb
from neuprim.runs.fit import prepare_training
from neuprim.tasks.dynamic.volume.motion import find_velocity_grid, measure_velocity_grid
from tests.tasks.dynamic.sequences import VOXEL, blob, dataset, recorded

SPEED = 1.5  # voxels per frame along x
UNITS = {"per frame": 1.0, "per second": 24.0, "voxels per frame": 1 / VOXEL, "tiny": 1e-6}


def wind(value: float, name: str = "vel", staggered: bool = False) -> VdbGrid:
    """The same velocity along x everywhere."""
    values = np.zeros((25, 19, 29, 3), np.float32)
    values[..., 0] = value
    grid = VdbGrid.from_dense(name, values, transform=blob(0.0, ("density",))[0].transform)
    return replace(grid, kind="staggered") if staggered else grid


def write(
    folder: Path, factor: float, name: str = "vel", step: int = 1, staggered: bool = False, turn: int = 1
) -> Path:
    """Six frames of a ball that moves evenly; its velocity is in world units per frame, times ``factor``."""
    folder.mkdir()
    for number in range(6):
        moving = wind(turn * factor * SPEED * VOXEL, name, staggered)
        write_vdb(folder / f"ball_{number}.vdb", [*blob(5.0 + SPEED * number, ("density",)), moving])
    return folder


@pytest.mark.filterwarnings("ignore::neuprim.core.errors.NeuprimWarning")
@pytest.mark.parametrize("staggered", [False, True])
@pytest.mark.parametrize("unit", UNITS)
def test_the_unit_is_found(unit: str, staggered: bool, tmp_path: Path) -> None:
    capture = recorded(dataset(write(tmp_path / "f", UNITS[unit], staggered=staggered), tmp_path)).capture
    found = measure_velocity_grid(capture.frames, capture.reader, capture.velocity)
    assert found is not None and found.name == "vel" and found.unit * UNITS[unit] == pytest.approx(1, rel=0.1)
    inside = np.array([[10 + 5 * VOXEL, 8 * VOXEL, -3 + 15 * VOXEL]])
    assert found.sample(capture.frames[0], inside)[0] == pytest.approx([SPEED * VOXEL, 0, 0], rel=0.1)


@pytest.mark.filterwarnings("ignore::neuprim.core.errors.NeuprimWarning")
@pytest.mark.parametrize("step", [1, 2])
def test_primitives_start_moving(step: int, tmp_path: Path) -> None:
    """As fast as the ball, in scene units per unit of time, which is the whole sequence."""
    folder = tmp_path / "f"
    folder.mkdir()
    for number in range(0, 3 * step, step):
        grids = [*blob(5.0 + SPEED * number, ("density",)), wind(24 * SPEED * VOXEL, "velocity")]
        write_vdb(folder / f"ball_{number}.vdb", grids[: 2 - (number == step)])  # the second has no velocities
    words = ["task=dynamic", "scene=vdb", f"scene.vdb={folder}", "scene.size=24", "scene.cameras=6", "scene.samples=1"]
    words += ["model.primitives=90", f"output_dir={tmp_path / 'run'}"]
    fitted = prepare_training(compose(words))
    scale, params = recorded(fitted.dataset).capture.normalisation.scale, fitted.model.params
    late = (params["window_center"][:, 0] - 0.5).abs() < 0.1
    moved = params["velocity"].detach() / scale / (2 * step)  # world units per frame number
    assert late.any() and not moved[late].any()
    assert torch.allclose(moved[~late], torch.tensor([SPEED * VOXEL, 0.0, 0.0]), rtol=0.1, atol=1e-3)
    still = prepare_training(compose([*words, "scene.velocity=none"]))
    assert not still.model.params["velocity"].any()


def test_velocities_that_explain_nothing_are_not_used(tmp_path: Path) -> None:
    capture = recorded(dataset(write(tmp_path / "f", 1.0, turn=-1), tmp_path)).capture
    with pytest.warns(NeuprimWarning, match="grid 'vel' does not explain how the density moves; primitives start at"):
        assert measure_velocity_grid(capture.frames, capture.reader, "vel") is None
    assert measure_velocity_grid(capture.frames[:1], capture.reader, "vel") is None


@pytest.mark.filterwarnings("ignore::neuprim.core.errors.NeuprimWarning")
def test_values_of_strangers(tmp_path: Path) -> None:
    """Voxels that are not finite count as 0, outliers are slowed down, and a grid of numbers is no grid of vectors."""
    folder = write(tmp_path / "f", 1.0)
    for number in range(6):
        density, moving = blob(5.0 + SPEED * number, ("density",))[0], wind(SPEED * VOXEL)
        density.values.flat[:2], moving.values.flat[:6] = (np.nan, np.inf), 1e30
        write_vdb(folder / f"ball_{number}.vdb", [density, moving])
    capture = recorded(dataset(folder, tmp_path)).capture
    found = measure_velocity_grid(capture.frames, capture.reader, "vel")
    assert found is not None and found.unit == pytest.approx(1, rel=0.1)
    corner = (moving.origins[:1] @ moving.transform[:3, :3].T) + moving.transform[:3, 3]
    assert 5 * SPEED * VOXEL < np.linalg.norm(found.sample(capture.frames[0], corner)) < 20 * SPEED * VOXEL
    write_vdb(folder / "ball_3.vdb", blob(5.0, ("density", "vel")))
    with pytest.raises(DataError, match=r"ball_3\.vdb: grid 'vel' has 1 number per voxel; expected 3, as in other"):
        found.sample(capture.frames[3], corner)
    far = wind(1.0)
    write_vdb(folder / "ball_3.vdb", [replace(far, origins=far.origins * np.int32(30_000))])
    with pytest.raises(DataError, match=r"ball_3\.vdb: grid 'vel': the box has .*scene\.velocity=none ignores"):
        found.sample(capture.frames[3], corner)


def test_which_grid_is_used(tmp_path: Path) -> None:
    frames = recorded(dataset(write(tmp_path / "f", 1.0, "gale"), tmp_path)).capture.frames
    assert find_velocity_grid(frames, "auto") is None and find_velocity_grid(frames, "gale") == "gale"
    assert find_velocity_grid(frames, "none") is None
    for name in ("density", "gael"):
        with pytest.raises(DataError, match=rf"scene\.velocity={name}: no frame has such a grid of vectors"):
            find_velocity_grid(frames, name)
    folder = tmp_path / "speed"
    folder.mkdir()
    write_vdb(folder / "a_1.vdb", blob(8.0, ("density", "velocity")))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert recorded(dataset(folder, tmp_path)).capture.velocity is None, "a speed is no vector"


def test_points_keep_their_velocities() -> None:
    cloud = PointCloud(torch.zeros(3, 3), torch.zeros(3, 3), velocities=torch.arange(9.0).reshape(3, 3))
    found = cloud.rows(torch.tensor([2, 0])).velocities
    assert found is not None and found.tolist() == [[6, 7, 8], [0, 1, 2]]
