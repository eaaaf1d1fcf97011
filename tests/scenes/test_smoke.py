"""The simulated scenes as files: what is in them, that they are the same every time, and the cache's key."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.io.vdb import read_grids, read_header
from neuprim.scenes.smoke.smoke_scenes import (
    SMOKE_SCENES,
    THRESHOLD,
    SmokeStage,
    simulate_smoke,
    simulation_key,
    smoke_box,
)
from neuprim.scenes.smoke.solver import GasState, advance_gas

TINY, FEW = 24, 8


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    cache = tmp_path_factory.mktemp("cache")
    return {name: simulate_smoke(name, FEW, TINY, 0, cache) for name in SMOKE_SCENES}


def dense(path: Path) -> dict[str, np.ndarray]:
    x, y, z = smoke_box(TINY).shape
    return {name: grid.to_dense(((0, 0, 0), (x, y, z))) for name, grid in ((g.name, g) for g in read_grids(path))}


@pytest.mark.parametrize("name", SMOKE_SCENES)
def test_files_hold_what_the_scene_promises(name: str, folders: dict[str, Path]) -> None:
    scene, folder = SMOKE_SCENES[name], folders[name]
    assert sorted(p.name for p in folder.iterdir()) == sorted(f"{name}_{i}.vdb" for i in range(FEW))
    header = read_header(folder / f"{name}_0.vdb")
    assert header.metadata["creator"] == "neuprim simulation" and "simulated" in header.metadata["comment"]
    for frame in range(FEW):
        grids = {grid.name: grid for grid in read_grids(folder / f"{name}_{frame}.vdb")}
        assert sorted(grids) == sorted(scene.grids)
        for grid in grids.values():
            assert grid.kind == "fog volume" and grid.half and grid.non_finite == 0
            assert grid.channels == (3 if grid.name == "color" else 1)
            low, high = grid.range or (THRESHOLD, 0.0)
            assert high < 4 and low >= (0 if grid.name == "color" else 0.99 * THRESHOLD)
    assert grids["density"].active_voxels > 20
    assert ("flames" in grids) == (name in ("smoke_fire", "ground_explosion"))
    if "flames" in grids:
        assert grids["flames"].active_voxels > 20 and grids["flames"].range[1] > 0.5
    if "color" in grids:
        assert grids["color"].range[1] <= 1 and grids["color"].active_voxels <= grids["density"].active_voxels
        assert np.ptp(grids["color"].values[grids["color"].masks], axis=1).max() > 0.3  # not grey


@pytest.mark.parametrize("name", SMOKE_SCENES)
def test_files_read_back_as_the_state(name: str, folders: dict[str, Path]) -> None:
    scene, box = SMOKE_SCENES[name], smoke_box(TINY)
    stage, state = SmokeStage(box, 0), GasState.clear_air(box, scene.coloured)
    for _ in range(FEW):
        state = advance_gas(state, scene.solver, box, scene.forcing(stage, state.time), scene.frame_time)
    read = dense(folders[name] / f"{name}_{FEW - 1}.vdb")
    expected = {"density": state.density, "temperature": state.temperature, "flames": state.fuel}
    for grid in scene.grids:
        if grid == "color":
            thick = state.density.numpy() > 0.01
            straight = (state.colour / state.density.clamp_min(1e-6)).permute(1, 2, 3, 0).numpy()
            np.testing.assert_allclose(read[grid][thick], straight[thick].clip(0, 1), atol=6e-4)
        else:
            np.testing.assert_allclose(read[grid], expected[grid].numpy(), rtol=1e-3, atol=THRESHOLD)


@pytest.mark.parametrize("name", ["smoke_fire", "colorful_smoke"])
def test_equal_seeds_give_equal_bits_for_any_number_of_threads(
    name: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        again = dense(simulate_smoke(name, FEW, TINY, 0, tmp_path) / f"{name}_{FEW - 1}.vdb")
    finally:
        torch.set_num_threads(before)
    for grid, values in dense(folders[name] / f"{name}_{FEW - 1}.vdb").items():
        np.testing.assert_array_equal(again[grid], values)


def test_every_setting_is_in_the_key() -> None:
    scene = SMOKE_SCENES["smoke_fire"]
    changed = [
        dataclasses.replace(scene, frame_time=0.5),
        *(other for other in SMOKE_SCENES.values() if other is not scene),
    ]
    for field in dataclasses.fields(scene.solver):
        solver = dataclasses.replace(scene.solver, **{field.name: getattr(scene.solver, field.name) + 1})
        changed.append(dataclasses.replace(scene, solver=solver))
    keys = [simulation_key(scene, *sizes) for sizes in ((100, 64, 0), (99, 64, 0), (100, 65, 0), (100, 64, 1))]
    keys += [simulation_key(other, 100, 64, 0) for other in changed]
    assert len(set(keys)) == len(keys)
    # who has simulated a scene already does not simulate it again
    assert keys[0] == "b2b2e02207668569"
