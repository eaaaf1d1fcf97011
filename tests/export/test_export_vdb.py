"""`neuprim export --format vdb`: voxels where the primitives are, in the units and on the voxels of the source."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.errors import ConfigError
from neuprim.core.io.vdb import VdbGrid, read_grid, write_vdb
from neuprim.core.volumes.density_grid import density_grid
from neuprim.core.volumes.density_truth import DENSITY_ERRORS
from neuprim.export import vdb as exporter
from neuprim.runs.export import export_run
from neuprim.runs.open import open_run
from tests.plugins import marked


def centre_of(grid: VdbGrid, near: tuple[float, float, float], radius: float) -> np.ndarray:
    """World position of the middle of what lies within ``radius`` of a place."""
    assert grid.bounds is not None
    dense, low = grid.to_dense(), np.array(grid.bounds[0])
    where = np.argwhere(dense > 0)
    world = (where + low) @ grid.transform[:3, :3].T + grid.transform[:3, 3]
    close = np.linalg.norm(world - near, axis=1) < radius
    assert close.any()
    result: np.ndarray = world[close].mean(0)
    return result


@pytest.fixture(scope="module")
def static(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return marked.static_run(tmp_path_factory.mktemp("runs") / "static")


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    return marked.dynamic_run(folder / "moving", marked.write_sequence(folder / "files"))


def test_each_ball_is_where_it_belongs(static: Path, tmp_path: Path) -> None:
    report = export_run(static, "vdb", tmp_path / "d.vdb", ["grid=160"])
    grid = read_grid(report.files[0], "density")
    assert not report.lossless and report.errors == {}
    for place, radius in zip(marked.PLACES.tolist(), marked.RADII.tolist(), strict=True):
        assert np.linalg.norm(centre_of(grid, tuple(place), radius + 0.03) - place) < 0.01
    assert float(grid.background) == 0 and grid.metadata["neuprim_units"] == "world"
    assert grid.active_voxels < 0.1 * np.prod([h - l for l, h in zip(*grid.bounds, strict=True)])


def test_values_are_sigma_at_the_centres(static: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exporter, "_SLAB_BYTES", 4 * 8 * 64 * 16)  # many slabs
    grid = read_grid(
        export_run(static, "vdb", tmp_path / "d.vdb", ["voxel_size=0.04", "threshold=1"]).files[0], "density"
    )
    low, high = grid.bounds or ((0,) * 3, (0,) * 3)
    matrix = np.array(grid.transform)
    assert np.array_equal(matrix, np.diag([0.04, 0.04, 0.04, 1]))
    matrix[:3, 3] += matrix[:3, :3] @ np.array(low)
    shape = tuple(h - l for l, h in zip(low, high, strict=True))
    expected = density_grid(open_run(static).model, {}, torch.from_numpy(matrix), shape).numpy()  # type: ignore[arg-type]
    expected[expected < 1] = 0
    assert expected.max() > 10 and np.allclose(grid.to_dense(), expected, rtol=1e-5, atol=1e-5)


def test_a_sequence_lies_on_the_voxels_of_its_files_and_in_their_units(moving: Path, tmp_path: Path) -> None:
    report = export_run(moving, "vdb", tmp_path / "frames")
    assert [p.name for p in report.files] == ["density_0003.vdb", "density_0004.vdb", "density_0005.vdb"]
    run = open_run(moving)
    source = run.volume()
    assert source is not None
    world_from_scene = np.linalg.inv(source.placement.scene_from_world)
    for i, path in enumerate(report.files):
        grid = read_grid(path, "density")
        assert np.allclose(grid.transform[:3, 3], marked.WORLD_SHIFT) and grid.voxel_size == (marked.WORLD_VOXEL,) * 3
        assert grid.metadata["neuprim_units"] == "source" and grid.metadata["neuprim_time"] == pytest.approx(i / 2)
        geometry, _ = run.model.lower_density({"time": torch.tensor(i / 2)})
        first = world_from_scene[:3, :3] @ geometry.means[0].numpy() + world_from_scene[:3, 3]
        index = np.rint((first - marked.WORLD_SHIFT) / marked.WORLD_VOXEL).astype(int)
        place = torch.from_numpy(source.placement.scene_from_world @ grid.transform)
        place[:3, 3] += place[:3, :3] @ torch.from_numpy(index).double()
        sigma = float(density_grid(run.model, {"time": torch.tensor(i / 2)}, place, (1, 1, 1)))
        value = float(grid.to_dense((tuple(index), tuple(index + 1)))[0, 0, 0])  # type: ignore[arg-type]
        assert value > 0 and value * source.placement.sigma_per_unit == pytest.approx(sigma, rel=1e-4)


def test_errors_are_those_of_the_runs_own_comparison(moving: Path, tmp_path: Path) -> None:
    from neuprim.tasks.dynamic.volume.capture_density import compare_capture_extinction

    report = export_run(moving, "vdb", tmp_path / "frames")
    run = open_run(moving)
    expected = compare_capture_extinction(run.model, run.volume().capture, [0.0, 0.5, 1.0])["sigma_frames"]  # type: ignore[union-attr]
    assert len(expected) == 3
    for entry in expected:
        name = f"frame_{entry['frame']:04d}"
        assert {key: report.errors[f"{name}.{key}"] for key in DENSITY_ERRORS} == {
            key: entry[key] for key in DENSITY_ERRORS
        }


def test_units_times_and_voxels_can_be_chosen(moving: Path, tmp_path: Path) -> None:
    values = {}
    for units in ("source", "world", "scene"):
        report = export_run(
            moving, "vdb", tmp_path / units, ["--time=0:1:5", f"units={units}", "grid=24", "name=smoke"]
        )
        assert [p.name for p in report.files] == [f"density_{i:04d}.vdb" for i in range(5)]
        assert {k.split(".")[0] for k in report.errors} == {
            "frame_0003",
            "frame_0004",
            "frame_0005",
        }  # times 0, 1/2 and 1
        grid = read_grid(report.files[2], "smoke")
        assert grid.range is not None and grid.bounds is not None
        values[units] = grid.range[1]
    per_unit = open_run(moving).volume().placement.sigma_per_unit  # type: ignore[union-attr]
    scale = open_run(moving).volume().placement.scene_from_world[0, 0]  # type: ignore[union-attr]
    assert values["scene"] == pytest.approx(values["source"] * per_unit, rel=1e-5)
    assert values["world"] == pytest.approx(values["scene"] * scale, rel=1e-5)
    one = export_run(moving, "vdb", tmp_path / "one.vdb", ["--time=0.5"])
    assert one.files == (tmp_path / "one.vdb",)


@pytest.mark.parametrize(("faint", "expected"), [(0.004, 0.004), (1e-7, None), (None, 0.02)])
def test_the_threshold_is_that_of_the_source(tmp_path: Path, faint: float | None, expected: float | None) -> None:
    """But not below what is invisible, and not above a hundredth of the largest value, here 2."""
    files = marked.write_sequence(tmp_path / "files")
    if faint is not None:
        path = files / "block_4.vdb"
        grid = read_grid(path, "density")
        grid.values[grid.masks] = np.where(np.arange(grid.masks.sum()) == 0, faint, grid.values[grid.masks])
        write_vdb(path, [grid])
    run = marked.dynamic_run(tmp_path / "run", files)
    invisible = 0.001 / 2 / float(open_run(run).volume().placement.sigma_per_unit)  # type: ignore[union-attr]
    for path in export_run(run, "vdb", tmp_path / "frames").files:
        found = read_grid(path, "density")
        threshold = float(found.metadata["neuprim_threshold"])
        assert found.range is not None and found.range[0] >= threshold
        assert threshold == pytest.approx(expected, rel=1e-3) if expected else threshold < 3 * invisible


def test_without_the_files_the_header_still_places_it(tmp_path: Path) -> None:
    files = marked.write_sequence(tmp_path / "files")
    known = open_run(marked.dynamic_run(tmp_path / "a", files)).volume()
    assert known is not None
    run = marked.dynamic_run(tmp_path / "b", files, world=known.placement.to_json())
    with_files = export_run(run, "vdb", tmp_path / "with", ["voxel_size=0.25"])
    files.rename(tmp_path / "elsewhere")
    without = export_run(run, "vdb", tmp_path / "without", ["voxel_size=0.25"])
    assert without.errors == {} and any("cannot be read" in note for note in without.notes)
    for a, b in zip(with_files.files, without.files, strict=True):
        one, two = read_grid(a, "density"), read_grid(b, "density")
        assert np.array_equal(one.transform, two.transform) and np.array_equal(one.to_dense(), two.to_dense())
    bare = marked.dynamic_run(tmp_path / "c", files)
    with pytest.raises(ConfigError, match="--time: required"):
        export_run(bare, "vdb", tmp_path / "bare")
    assert export_run(bare, "vdb", tmp_path / "bare", ["--time=0.5"]).errors == {}


def test_a_time_when_nothing_lives_is_an_empty_frame(tmp_path: Path) -> None:
    run = marked.dynamic_run(tmp_path / "run", marked.write_sequence(tmp_path / "files"))
    from safetensors.torch import load_file

    from neuprim.core import checkpoint

    tensors = load_file(run / "model.safetensors")
    header = checkpoint.read_header(run / "model.safetensors", "model")
    tensors["log_window"] -= 3.0
    checkpoint.write_tensors(
        run / "model.safetensors", "model", tensors, {k: v for k, v in header.items() if k not in ("format", "kind")}
    )
    report = export_run(run, "vdb", tmp_path / "frames")
    assert (
        read_grid(report.files[0], "density").active_voxels == 0
        and read_grid(report.files[1], "density").active_voxels > 0
    )


def test_a_usd_stage_plays_the_files(moving: Path, tmp_path: Path) -> None:
    """Read by usd-core: one volume, whose files follow the frame numbers, with a grid of each name."""
    usd = pytest.importorskip("pxr.Usd", reason="needs usd-core: pip install 'neuprim[usd]'")
    from pxr import UsdGeom, UsdVol

    options = ["usd=true", "fps=25", "emission=true", "name=3 grids"]
    report = export_run(moving, "vdb", tmp_path / "frames", options)
    assert [p.name for p in report.files][-1] == "density.usda"
    stage = usd.Stage.Open(str(report.files[-1]))
    span = stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetFramesPerSecond(), stage.GetTimeCodesPerSecond()
    assert span == (3, 5, 25, 25) and UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.StageHasAuthoredMetersPerUnit(stage)
    volume = UsdVol.Volume(stage.GetDefaultPrim())
    paths = volume.GetFieldPaths()
    assert set(paths) == {"_3_grids", "emission"}
    for name, prim in paths.items():
        asset = UsdVol.OpenVDBAsset(stage.GetPrimAtPath(prim))
        grid = asset.GetFieldNameAttr().Get()
        assert grid == {"_3_grids": "3 grids", "emission": "emission"}[name]
        for number, path in zip((3, 4, 5), report.files, strict=False):
            found = Path(asset.GetFilePathAttr().Get(number).resolvedPath)
            assert found == path and read_grid(found, grid).name == grid
    low, high = volume.GetExtentAttr().Get()
    for path in report.files[:3]:
        box = read_grid(path, "3 grids").world_bounds()
        assert box is not None and (box[0] >= np.array(low) - 1e-5).all() and (box[1] <= np.array(high) + 1e-5).all()


def test_a_usd_stage_of_one_file(static: Path, tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd", reason="needs usd-core: pip install 'neuprim[usd]'")
    stage = usd.Stage.Open(str(export_run(static, "vdb", tmp_path / "d", ["grid=32", "usd=true"]).files[-1]))
    asset = stage.GetPrimAtPath("/volume/density").GetAttribute("filePath")
    assert Path(asset.Get().resolvedPath) == tmp_path / "d" / "density.vdb" and not asset.GetNumTimeSamples()
    with pytest.raises(ConfigError, match=r"usd=true writes several files; expected a folder"):
        export_run(static, "vdb", tmp_path / "d.vdb", ["usd=true"])
