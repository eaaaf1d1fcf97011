"""Vector grids of ``neuprim export --format vdb``: motion, emission and albedo of the primitives, in the world."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.io.vdb import VdbGrid, read_grid, read_header
from neuprim.core.model.primitives import Primitives
from neuprim.core.volumes.density_grid import density_at
from neuprim.runs.export import export_run
from neuprim.tasks.dynamic.scattering import ScatteringHarmonics
from tests.plugins import marked
from tests.timed_models import model as timed

WORDS = ["task=dynamic", "scene=vdb", "scene.vdb=nowhere"]
SCALE, TURN = 0.25, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
TIME = 0.4


def placed() -> dict[str, object]:
    """A header record of a world that is turned, four times as large as the scene, and elsewhere."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = SCALE * TURN, (1.0, -2.0, 0.5)
    return {"scene_from_world": matrix.tolist(), "up": [0.0, 0.0, 1.0]}


def run_directory(folder: Path, time: str = "window+motion") -> Path:
    model = timed(time, count=16, dtype=torch.float32)
    return marked.write_run(folder, model, WORDS, color_space="linear", data={"frames": [11, 21]}, world=placed())


def exported(run: Path, out: Path, *words: str) -> tuple[VdbGrid, VdbGrid]:
    report = export_run(run, "vdb", out, [f"--time={TIME}", "grid=40", "velocity=true", *words])
    return read_grid(report.files[0], "density"), read_grid(report.files[0], "vel")


def extinctions(model: Primitives, points: torch.Tensor) -> torch.Tensor:
    """(M, N) of every primitive at every point, with one model per primitive."""
    params = {name: value.detach() for name, value in model.params.items()}
    alone = ({name: value[i : i + 1] for name, value in params.items()} for i in range(model.count))
    time = {"time": torch.tensor(TIME)}
    return torch.stack([density_at(Primitives(model.density, model.colour, one), time, points) for one in alone], -1)


def expected(model: Primitives, points: torch.Tensor) -> torch.Tensor:
    """The weighted mean of the closed-form velocities."""
    params = {name: value.detach() for name, value in model.params.items()}
    since = TIME - params["window_center"]
    velocities = params["velocity"] + 2 * params["acceleration"] * since
    sigma = extinctions(model, points)
    return sigma @ velocities.double() / sigma.sum(-1, keepdim=True)


def scene_points(grid: VdbGrid) -> torch.Tensor:
    """Centres of the active voxels."""
    leaf, *inside = np.nonzero(grid.masks)
    world = (grid.origins[leaf] + np.stack(inside, -1)) @ grid.transform[:3, :3].T + grid.transform[:3, 3]
    matrix = np.array(placed()["scene_from_world"])
    return torch.from_numpy(world @ matrix[:3, :3].T + matrix[:3, 3])


def lit(channels: int = 3) -> Primitives:
    """Primitives that emit and scatter."""
    model = timed("window+motion", count=16, dtype=torch.float32)
    colour = ScatteringHarmonics(1, channels, typical=2.0)
    params = {name: value.detach() for name, value in model.params.items()}
    params["scattered"] = 0.1 * torch.rand(16, channels, generator=torch.Generator().manual_seed(2))
    for spec in colour.parameters():
        params[spec.name] = params[spec.name][..., :channels]
    return Primitives(model.density, colour, params)


def test_velocities_are_weighted_means_in_world_units_per_frame(tmp_path: Path) -> None:
    density, vel = exported(run_directory(tmp_path / "run"), tmp_path / "a.vdb")
    assert np.array_equal(vel.masks, density.masks) and np.array_equal(vel.origins, density.origins)
    assert np.array_equal(vel.transform, density.transform) and vel.active_voxels > 1000
    scene = scene_points(vel)
    found = vel.values[vel.masks]
    wanted = expected(timed("window+motion", count=16, dtype=torch.float32), scene).numpy() @ TURN / SCALE / 10
    assert np.abs(wanted).max() > 0.02
    assert np.abs(found - wanted).max() < 1e-4 * np.abs(wanted).max()


def test_emission_and_albedo(tmp_path: Path) -> None:
    """Emission per world unit, times the exposure; impossible albedos are limited to 1."""
    model = lit()
    run = marked.write_run(
        tmp_path / "run", model, WORDS, color_space="linear", data={"frames": [11, 21], "exposure": 3.0}, world=placed()
    )
    words = [f"--time={TIME}", "grid=40", "emission=true", "albedo=true", "velocity=true"]
    (path,) = export_run(run, "vdb", tmp_path / "a.vdb", words).files
    density, emission, albedo = (read_grid(path, name) for name in ("density", "emission", "albedo"))
    assert [grid.name for grid in read_header(path).grids] == ["density", "emission", "albedo", "vel"]
    sigma = extinctions(model, scene_points(emission))
    emitted = model.colour.isotropic(model.of(model.colour), {"time": torch.tensor(TIME)})
    assert emitted is not None
    wanted = (SCALE * 3.0 * sigma @ emitted.double()).numpy()
    found = emission.values[emission.masks]
    assert np.abs(found - wanted).max() < 1e-4 * np.abs(wanted).max() and wanted.max() > 0.01
    share = (model.params["scattered"] / 2.0 * 4 * math.pi * 3.0).clamp_max(1.0)
    assert float(share.max()) == 1.0 and float(share.min()) < 0.2
    mean = (sigma @ share.double() / sigma.sum(-1, keepdim=True)).numpy()
    assert np.abs(albedo.values[albedo.masks] - mean).max() < 1e-4
    assert np.array_equal(emission.masks, density.masks) and np.array_equal(albedo.transform, density.transform)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["albedo=true"],
            "albedo=true: the colours of this model contain the light; expected a run with scene.lights=4",
        ),
        (["emission=yes"], "emission=yes: expected true or false"),
    ],
)
def test_grids_that_a_model_lacks_are_refused(tmp_path: Path, words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        export_run(run_directory(tmp_path / "run"), "vdb", tmp_path / "a.vdb", [f"--time={TIME}", *words])


@pytest.mark.parametrize("exposure", [0, -1.0, "bright", True])
def test_an_impossible_exposure_is_refused(tmp_path: Path, exposure: object) -> None:
    data = {"frames": [11, 21], "exposure": exposure}
    run = marked.write_run(tmp_path / "run", lit(), WORDS, color_space="linear", data=data, world=placed())
    with pytest.raises(NeuprimError, match="exposure"):
        export_run(run, "vdb", tmp_path / "a.vdb", [f"--time={TIME}", "emission=true"])


def test_a_frame_rate_makes_them_velocities_per_second(tmp_path: Path) -> None:
    run = run_directory(tmp_path / "run")
    _, frame = exported(run, tmp_path / "a.vdb")
    _, second = exported(run, tmp_path / "b.vdb", "fps=24")
    assert np.allclose(second.values, 24 * frame.values, rtol=1e-5)
    assert frame.metadata["neuprim_units"] == "world units per frame"
    assert second.metadata["neuprim_units"] == "world units per second"
    assert read_grid(tmp_path / "b.vdb", "density").metadata["neuprim_fps"] == 24.0


def test_the_grid_is_a_vector_grid_of_openvdb(tmp_path: Path) -> None:
    _, vel = exported(run_directory(tmp_path / "run"), tmp_path / "a.vdb", "half=true")
    header = read_header(tmp_path / "a.vdb").grid("vel")
    assert (header.type, header.half, header.kind) == ("Tree_vec3s_5_4_3", True, "unknown")
    assert header.metadata["vector_type"] == "contravariant relative" and vel.channels == 3
    raw = (tmp_path / "a.vdb").read_bytes()
    field = b"\x0b\0\0\0vector_type\x06\0\0\0string\x16\0\0\0contravariant relative"
    assert field in raw and b"\x1a\0\0\0Tree_vec3s_5_4_3_HalfFloat" in raw


def test_an_empty_frame_has_an_empty_grid(tmp_path: Path) -> None:
    model = timed("window+motion", count=4, dtype=torch.float32)
    with torch.no_grad():
        model.params["window_center"].fill_(0.1)
        model.params["log_window"].fill_(-4.0)
    run = marked.write_run(tmp_path / "run", model, WORDS, color_space="linear", data={"frames": [11, 21]})
    files = export_run(run, "vdb", tmp_path / "frames", ["--time=0.1,0.9", "grid=40", "velocity=true"]).files
    assert [read_grid(file, "vel").active_voxels > 0 for file in files] == [True, False]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["velocity=true"], "velocity=true: the primitives of this model do not move; expected a model with motion"),
    ],
)
def test_wrong_options_are_refused(tmp_path: Path, words: list[str], message: str) -> None:
    run = run_directory(tmp_path / "run", "window")
    with pytest.raises(ConfigError, match=message):
        export_run(run, "vdb", tmp_path / "a.vdb", ["--time=0.4", *words])


def test_models_without_time_or_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="velocity=true: the primitives of this model do not move"):
        export_run(marked.static_run(tmp_path / "static"), "vdb", tmp_path / "a.vdb", ["velocity=true"])
    model = timed("motion", count=4, dtype=torch.float32)
    run = marked.write_run(tmp_path / "run", model, WORDS, color_space="linear")
    expected = "velocity=true: the frame interval is unknown: one frame, and the model has no numbered frames"
    with pytest.raises(ConfigError, match=expected):
        export_run(run, "vdb", tmp_path / "a.vdb", ["--time=0.4", "velocity=true"])
