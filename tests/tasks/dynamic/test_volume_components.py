"""What the data decide about a volume's optics, and the density of a fire apart from what its flames absorb."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuprim.config import RunConfig, compose
from neuprim.core.errors import ConfigError
from neuprim.core.io.vdb import VdbGrid, read_grid, vdb_scale_transform, write_vdb
from neuprim.core.model.primitives import Primitives
from neuprim.core.volumes.density_grid import density_grid
from neuprim.runs.export import export_run
from neuprim.runs.fit import prepare_training
from neuprim.runs.open import open_run
from neuprim.runs.run import run
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.dynamic.volume.capture import Capture
from tests.tasks.dynamic.sequences import dataset, recorded

PEAK = 0.0155
SHIFT = (4.0, -2.0, 0.0)


def ball(centre: tuple[float, float, float], radius: float, peak: float, size: int = 16) -> np.ndarray:
    """(n, n, n) values that fall from the middle to the edge of a ball, indices."""
    index = np.stack(np.meshgrid(*(np.arange(size),) * 3, indexing="ij"), -1)
    return np.clip(peak * (1 - np.linalg.norm(index - centre, axis=-1) / radius), 0, None).astype(np.float32)


def fire(frame: int) -> list[VdbGrid]:
    """Faint smoke, and flames of 1 that reach beyond it."""
    transform = vdb_scale_transform(0.5, SHIFT)
    smoke, flame = ball((6 + frame, 8, 9), 5, PEAK), ball((6 + frame, 8, 5), 5, 1.0)
    named = (("density", smoke), ("flame", flame))
    return [VdbGrid.from_dense(name, values, transform=transform, half=True) for name, values in named]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fire")
    for frame in range(3):
        write_vdb(folder / f"fire_{frame}.vdb", fire(frame))
    return folder


def captured(folder: Path, tmp_path: Path, **changes: Any) -> Capture:
    return recorded(dataset(folder, tmp_path, **{"look": "auto", **changes})).capture


# ---------------------------------------------------------------- optics follow the data


@pytest.mark.filterwarnings("ignore::neuprim.core.errors.NeuprimWarning")
@pytest.mark.parametrize(("peak", "times"), [(PEAK, 64), (1.17, 1), (0.8, 1), (90.0, 1 / 64)])
def test_extinction_is_for_the_peak_of_the_sequence(peak: float, times: float, tmp_path: Path) -> None:
    values = np.repeat(ball((8, 8, 8), 6, peak), 8, 1)
    values[8, 8, 8] = peak * 100  # one wrong voxel of thousands decides nothing
    values[2, 8, 8] = -peak
    (tmp_path / "files").mkdir()
    write_vdb(
        tmp_path / "files" / "a_1.vdb", [VdbGrid.from_dense("density", values, transform=vdb_scale_transform(0.5))]
    )
    assert captured(tmp_path / "files", tmp_path).optics.extinction == 14 * times
    chosen = captured(tmp_path / "files", tmp_path, optics={"extinction": 3.0}).optics
    assert chosen.extinction == 3 and chosen.flame_extinction == 14


def test_what_was_chosen_is_said_once_in_one_line(files: Path, tmp_path: Path) -> None:
    with pytest.warns(
        UserWarning, match=r"extinction=896 \(look: 14\), because values of grid 'density' go up to about 0\.016"
    ):
        dataset(files, tmp_path, look="auto", frames="0:1")


# ---------------------------------------------------------------- what absorbs


def test_the_parts_of_the_extinction_are_those_of_the_grids(files: Path, tmp_path: Path) -> None:
    capture = captured(files, tmp_path)
    medium = capture.medium(capture.frames[0])
    smoke, flame = (read_grid(files / "fire_0.vdb", name) for name in ("density", "flame"))
    assert medium.scattering is not None and capture.components == ("density",)
    assert medium.scattering.sum() == pytest.approx(capture.optics.extinction * smoke.to_dense().sum(), rel=1e-5)
    assert medium.values[..., 0].sum() == pytest.approx(medium.scattering.sum() + 14 * flame.to_dense().sum(), rel=1e-5)


@pytest.mark.parametrize("other", [0.5, 0.25])
def test_flames_beyond_the_density_and_on_other_voxels_absorb(other: float, tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    smoke = VdbGrid.from_dense("density", ball((8, 8, 8), 3, 1.0), transform=vdb_scale_transform(0.5))
    flame = VdbGrid.from_dense("flames", ball((20, 8, 8), 4, 1.0, 32), transform=vdb_scale_transform(other))
    write_vdb(folder / "a_1.vdb", [smoke, flame])
    write_vdb(folder / "a_2.vdb", [flame])  # writers leave out a grid that is empty
    capture = captured(folder, tmp_path)
    expected = 14 * float(flame.to_dense().sum()) * (other * capture.normalisation.scale) ** 3
    for frame in capture.frames:
        medium = capture.medium(frame)
        assert medium.scattering is not None
        cell = abs(np.linalg.det(medium.scene_from_index[:3, :3]))
        flames = (medium.values[..., 0] - medium.scattering).sum() * cell
        assert flames == pytest.approx(expected, rel=0.02), frame.path.name
        filled = np.argwhere(medium.values[0, ..., 0] > 1).T
        corners = medium.scene_from_index[:3, :3] @ filled + medium.scene_from_index[:3, 3:]
        assert (corners.min(1) >= capture.bounds[0]).all() and (corners.max(1) <= capture.bounds[1]).all()


def test_a_flame_grid_without_a_flame_needs_no_component(tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    write_vdb(folder / "a_1.vdb", [fire(0)[0], VdbGrid.from_dense("flame", np.zeros((8, 8, 8), np.float32))])
    assert captured(folder, tmp_path).components == ()


# ---------------------------------------------------------------- what a model keeps of it


def test_a_component_is_every_primitives_share() -> None:
    field = TimeDensity(0, "window", gain=True, components=("density",))
    generator = torch.Generator().manual_seed(0)
    params = {s.name: torch.randn((6, *s.shape), generator=generator) * 0.3 for s in field.parameters()}
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(6, 1)
    params |= {"means": torch.zeros(6, 3), "log_scales": torch.full((6, 3), -1.0), "quats": quats}
    params["b2"] = params["b2"].abs() + 1
    params["window_center"], params["log_window"] = torch.full((6, 1), 0.5), torch.zeros(6, 1)
    params["sh_dc"] = torch.zeros(6, 3)
    model, when = Primitives(field, TimeHarmonics(0, powers=0, waves=0), params), {"time": torch.tensor(0.5)}
    at = torch.eye(4, dtype=torch.float64)
    total, part = (density_grid(m, when, at, (1, 1, 1)) for m in (model, model.component("density")))
    largest = field.largest(model.of(field), model.geometry)
    assert torch.allclose(part, (largest * params["share_density"].sigmoid()[:, 0]).sum(), rtol=1e-5)
    assert torch.allclose(total, largest.sum(), rtol=1e-5)  # all are in the middle of their lives and of themselves


SMALL = ["scene.size=24", "scene.cameras=6", "scene.samples=1", "model.primitives=120", "train.max_seconds=null"]


def composed(files: Path, out: Path, *more: str) -> RunConfig:
    scene = ["task=dynamic", "scene=vdb", f"scene.vdb='{files}'", f"output_dir='{out}'", "renderer.threads=1"]
    return compose([*scene, *SMALL, *more], check_output=False)


def test_no_primitive_goes_beyond_the_largest_extinction(files: Path, tmp_path: Path) -> None:
    trainer = prepare_training(composed(files, tmp_path / "run", "train.iterations=3")).trainer
    model, largest = trainer.model, trainer.dataset.largest
    assert largest is not None
    with torch.no_grad():
        model.params["log_gain"][:40] += 5
    trainer.train_step()
    with torch.no_grad():
        found = model.density.largest(model.of(model.density), model.geometry)
    assert found is not None and float(found.max()) <= largest * (1 + 1e-5) and float(found[:40].min()) > 0.9 * largest


@pytest.mark.filterwarnings("ignore::neuprim.core.errors.NeuprimWarning")
def test_exported_density_is_the_files_own(files: Path, tmp_path: Path) -> None:
    out = run(composed(files, tmp_path / "run", "train.iterations=240", "train.voxels_every=2"))
    report = export_run(out, "vdb", tmp_path / "frames")
    again = export_run(out, "vdb", tmp_path / "again", ["grid=32"])
    for number in range(3):
        source = read_grid(files / f"fire_{number}.vdb", "density")
        world = source.world_bounds()
        assert source.range is not None and world is not None
        for path in (report.files[number], again.files[number]):
            grid = read_grid(path, "density")
            box = grid.world_bounds()
            half = np.array(grid.voxel_size) / 2
            assert grid.half is source.half is True
            assert grid.range is not None and grid.range[1] <= source.range[1] * 1.001
            assert box is not None and (box[0] >= world[0] - half - 1e-6).all()
            assert (box[1] <= world[1] + half + 1e-6).all()
        truth, written = source.to_dense(), read_grid(report.files[number], "density").to_dense(source.bounds)
        assert np.linalg.norm(written - truth) < 0.4 * np.linalg.norm(truth)
    assert any("flames absorb, too" in note for note in report.notes)
    header = open_run(out).header["world"]
    assert header["exact"] is False and len(header["extents"]) == 3


@pytest.mark.filterwarnings("ignore::neuprim.core.errors.NeuprimWarning")
def test_a_density_that_nothing_taught_is_refused(files: Path, tmp_path: Path) -> None:
    out = run(composed(files, tmp_path / "run", "train.iterations=3", "train.supervision=images"))
    assert open_run(out).model.density.components(open_run(out).model.params) == {}
    with pytest.raises(ConfigError, match=r"extinction is a sum of flames and grid 'density'.*train\.supervision=both"):
        export_run(out, "vdb", tmp_path / "frames")
