"""The simulated scenes as files: what is in them, that they are the same every time, and the cache."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.vdb import read_grids, read_header, sequence
from neuprim.scenes.smoke import SCENES, generate, simulate
from neuprim.scenes.smoke.generate import THRESHOLD, box_of, cache_key, grids_of
from neuprim.scenes.smoke.scenes import Scene, Stage
from neuprim.scenes.smoke.solver import State, advance

TINY, FEW = 24, 8


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    cache = tmp_path_factory.mktemp("cache")
    return {name: simulate(name, FEW, TINY, 0, cache) for name in SCENES}


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def states(scene: Scene, seed: int = 0, frames: int = FEW) -> State:
    box = box_of(TINY)
    stage, state = Stage(box, seed), State.empty(box, scene.coloured)
    for _ in range(frames):
        state = advance(state, scene.solver, box, scene.forcing(stage, state.time), scene.frame_time)
    return state


def dense(path: Path) -> dict[str, np.ndarray]:
    x, y, z = box_of(TINY).shape
    return {name: grid.to_dense(((0, 0, 0), (x, y, z))) for name, grid in ((g.name, g) for g in read_grids(path))}


@pytest.mark.parametrize("name", SCENES)
def test_files_hold_what_the_scene_promises(name: str, folders: dict[str, Path]) -> None:
    scene, folder = SCENES[name], folders[name]
    assert sorted(p.name for p in folder.iterdir()) == sorted(f"{name}_{i}.vdb" for i in range(FEW))
    header = read_header(folder / f"{name}_0.vdb")
    assert header.metadata["creator"] == "neuprim simulation" and "simulated" in header.metadata["comment"]
    for frame in range(FEW):
        grids = {grid.name: grid for grid in read_grids(folder / f"{name}_{frame}.vdb")}
        assert tuple(sorted(grids)) == tuple(sorted(scene.grids))
        for grid in grids.values():
            assert grid.kind == "fog volume" and grid.half and grid.non_finite == 0
            assert grid.channels == (3 if grid.name == "color" else 1)
            if grid.range:
                assert 0 <= grid.range[0] and grid.range[1] < 4
            if grid.range and grid.name != "color":
                assert grid.range[0] > 0.99 * THRESHOLD
    assert grids["density"].active_voxels > 20
    assert ("flames" in grids) == (name in ("smoke_fire", "ground_explosion"))
    if "flames" in grids:
        assert grids["flames"].active_voxels > 20 and grids["flames"].range[1] > 0.5
    if "color" in grids:
        assert grids["color"].range[1] <= 1 and grids["color"].active_voxels <= grids["density"].active_voxels
        assert np.ptp(grids["color"].values[grids["color"].masks], axis=1).max() > 0.3  # not grey


@pytest.mark.parametrize("name", SCENES)
def test_files_read_back_as_the_state(name: str, folders: dict[str, Path]) -> None:
    scene = SCENES[name]
    read = dense(folders[name] / f"{name}_{FEW - 1}.vdb")
    state = states(scene)
    expected = {"density": state.density, "temperature": state.temperature, "flames": state.fuel}
    for grid in scene.grids:
        if grid == "color":
            thick = state.density.numpy() > 0.01
            straight = (state.colour / state.density.clamp_min(1e-6)).permute(1, 2, 3, 0).numpy()
            np.testing.assert_allclose(read[grid][thick], straight[thick].clip(0, 1), atol=6e-4)
        else:
            np.testing.assert_allclose(read[grid], expected[grid].numpy(), rtol=1e-3, atol=THRESHOLD)


def test_the_box_stands_on_the_ground_around_the_origin() -> None:
    scene, box = SCENES["smoke_fire"], box_of(64)
    assert box.shape == (64, 64, 96)
    full = dataclasses.replace(State.empty(box), density=torch.ones(box.shape))
    bounds = grids_of(full, scene, box)[0].world_bounds()
    np.testing.assert_allclose(bounds, [[-0.5, -0.5, 0.0], [0.5, 0.5, 1.5]], atol=1e-12)


def test_frames_form_a_sequence(folders: dict[str, Path]) -> None:
    assert [frame.number for frame in sequence(folders["smoke_fire"]).frames] == list(range(FEW))


@pytest.mark.parametrize("name", SCENES)
def test_equal_seeds_give_equal_bits_for_any_number_of_threads(
    name: str, folders: dict[str, Path], tmp_path: Path, threads: None
) -> None:
    first = dense(folders[name] / f"{name}_{FEW - 1}.vdb")
    for count in (1, 3):
        torch.set_num_threads(count)
        again = dense(simulate(name, FEW, TINY, 0, tmp_path / str(count)) / f"{name}_{FEW - 1}.vdb")
        for grid in first:
            np.testing.assert_array_equal(first[grid], again[grid])


def test_another_seed_gives_another_fire(tmp_path: Path, folders: dict[str, Path]) -> None:
    other = simulate("smoke_fire", 4, TINY, 1, tmp_path)
    first, second = dense(folders["smoke_fire"] / "smoke_fire_3.vdb"), dense(other / "smoke_fire_3.vdb")
    assert np.abs(first["flames"] - second["flames"]).max() > 0.05


def test_second_call_does_no_work(folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object) -> None:
        raise AssertionError("simulated again")

    monkeypatch.setattr(generate, "advance", fail)
    folder = folders["dust_tornado"]
    assert simulate("dust_tornado", FEW, TINY, 0, folder.parent, fail) == folder


def test_damaged_cache_is_simulated_again(tmp_path: Path) -> None:
    folder = simulate("dust_tornado", 2, 16, 0, tmp_path)
    before = (folder / "dust_tornado_1.vdb").stat().st_size
    (folder / "dust_tornado_1.vdb").unlink()
    assert simulate("dust_tornado", 2, 16, 0, tmp_path) == folder
    assert (folder / "dust_tornado_1.vdb").stat().st_size == before
    assert list(tmp_path.iterdir()) == [folder]


def test_interruption_leaves_nothing_behind(tmp_path: Path) -> None:
    def stop(text: str, fraction: float) -> None:
        if fraction > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate("colorful_smoke", 4, 16, 0, tmp_path, stop)
    assert list(tmp_path.iterdir()) == []


def test_progress_ends_at_one(tmp_path: Path) -> None:
    said: list[tuple[str, float]] = []
    simulate("ground_explosion", 3, 16, 0, tmp_path, lambda text, fraction: said.append((text, fraction)))
    assert [fraction for _, fraction in said] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    assert all("ground_explosion" in text for text, _ in said)


def test_every_setting_is_in_the_key() -> None:
    scene = SCENES["smoke_fire"]
    keys = [
        cache_key(scene, 100, 64, 0),
        cache_key(scene, 99, 64, 0),
        cache_key(scene, 100, 65, 0),
        cache_key(scene, 100, 64, 1),
    ]
    keys.append(cache_key(dataclasses.replace(scene, frame_time=0.5), 100, 64, 0))
    for field in dataclasses.fields(scene.solver):
        changed = dataclasses.replace(scene.solver, **{field.name: getattr(scene.solver, field.name) + 1})
        keys.append(cache_key(dataclasses.replace(scene, solver=changed), 100, 64, 0))
    keys += [cache_key(other, 100, 64, 0) for other in SCENES.values() if other is not scene]
    assert len(set(keys)) == len(keys)
    assert cache_key(scene, 100, 64, 0) == keys[0]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("smoke_fir", 4, 24, 0), "smoke_fire"),
        (("smoke_fire", 0, 24, 0), r"scene\.timesteps=0: expected a whole number from 1 to 1000"),
        (("smoke_fire", True, 24, 0), r"scene\.timesteps=true"),
        (("smoke_fire", 4, 8, 0), r"scene\.resolution=8: expected a whole number from 16 to 192"),
        (("smoke_fire", 4, 24.5, 0), r"scene\.resolution=24\.5"),
        (("smoke_fire", 4, 24, -1), "seed=-1"),
    ],
)
def test_impossible_settings_are_named(arguments: tuple, text: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=text):
        simulate(*arguments, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_unwritable_cache_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="cannot write the simulated frames"):
        simulate("smoke_fire", 1, 16, 0, tmp_path / "file")


def test_matter_stays_inside_the_box(folders: dict[str, Path]) -> None:
    """Sides and top fade: a late state at a coarse size has next to nothing in its outermost cells."""
    for scene in SCENES.values():
        density = states(scene, frames=40).density
        edge = max(float(part.max()) for part in (density[[0, -1]], density[:, [0, -1]], density[:, :, -1]))
        assert edge < 0.05 * float(density.max()), scene.name
