"""Channels: grids besides the extinction, which a model learns from voxels and exports again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuprim.cli import main
from neuprim.config import RunConfig, compose
from neuprim.core.checkpoint import load_model_checkpoint
from neuprim.core.data import PointSamples
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.vdb import VdbGrid, VdbTiles, read_grid, vdb_scale_transform, write_vdb
from neuprim.core.model.primitives import GEOMETRY_SPECS, Primitives
from neuprim.core.train.losses import point_loss
from neuprim.core.train.settings import TrainSettings
from neuprim.core.volumes.points import channel_values_at, volume_values_at
from neuprim.runs.export import export_run
from neuprim.runs.open import open_run
from neuprim.runs.run import run
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.dynamic.volume.capture_voxels import FrameVoxels
from tests.tasks.dynamic.sequences import ORIGIN, VOXEL, blob, dataset, recorded

COLD, SLOPE = -250.0, 40.0  # of the grid "heat": negative at one end
WITHOUT = 3  # the frame without the grid "heat"


def heat(scale: float = VOXEL) -> VdbGrid:
    """Values that grow along z, on voxels of edge ``scale``."""
    z = np.arange(round(28 * VOXEL / scale)) * scale / VOXEL
    values = np.broadcast_to(COLD + SLOPE * z, (*(round(n * VOXEL / scale) for n in (24, 18)), len(z)))
    return VdbGrid.from_dense("heat", values.astype(np.float32), transform=vdb_scale_transform(scale, ORIGIN))


def wind() -> VdbGrid:
    """A staggered grid, whose components at the middle of a voxel are (2 + x, -y, 3 z), x, y and z in voxels."""
    x, y, z = np.meshgrid(*(np.arange(n) - 0.5 for n in (24, 18, 28)), indexing="ij")
    values = np.stack([2 + x, -y, 3 * z], -1).astype(np.float32)
    transform = vdb_scale_transform(VOXEL, ORIGIN)
    return replace(VdbGrid.from_dense("wind", values, transform=transform), kind="staggered")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hot")
    for number in range(4):
        grids = blob(8.0 + number, ("smoke",))
        write_vdb(folder / f"hot_{number}.vdb", [*grids, *([] if number == WITHOUT else [heat(), wind()])])
    return folder


def composed(files: Path, out: Path, *more: str) -> RunConfig:
    words = ["task=dynamic", "scene=vdb", f"scene.vdb={files}", "scene.size=24", "scene.cameras=6", "scene.samples=1",
        "model.primitives=300", "scene.channels=[heat,wind]", f"output_dir={out}", *more]  # fmt: skip
    return compose(words)


@pytest.mark.parametrize("scale", [VOXEL, VOXEL / 2])
def test_samples_have_the_values_of_the_files(scale: float, tmp_path: Path) -> None:
    write_vdb(tmp_path / "hot_0.vdb", [*blob(8.0, ("density",)), heat(scale), wind()])
    write_vdb(tmp_path / "hot_1.vdb", blob(9.0, ("density",)))
    data = dataset(tmp_path, tmp_path, channels=["heat", "wind"])
    assert isinstance(data.points, FrameVoxels) and data.points.channels["wind"][:2] == (79.5, 3)
    assert data.points.channels["heat"][0] == pytest.approx(max(-COLD, COLD + SLOPE * (28 - scale / VOXEL)), rel=1e-6)
    capture, generator = recorded(data).capture, torch.Generator().manual_seed(0)
    for _ in range(8):
        samples = data.points.draw(512, generator)
        scale, center = capture.normalisation.scale, torch.tensor(capture.normalisation.center)
        x, y, z = ((samples.points.double() / scale + center - torch.tensor(ORIGIN)) / VOXEL).unbind(1)
        truth = {"heat": (COLD + SLOPE * z)[:, None], "wind": torch.stack([2 + x, -y, 3 * z], 1)}
        for name, values in truth.items():
            value, typical = samples.components[f"channel_{name}"]
            true = samples.sigma.double()[:, None] * values * (samples.name == "frame_0000")
            assert value.shape == true.shape and typical > 0
            assert torch.allclose(value.double(), true, rtol=1e-4, atol=1e-4 * float(true.abs().max()))


def test_the_value_is_the_mean_over_primitives_weighted_by_extinction() -> None:
    generator = torch.Generator().manual_seed(1)
    density, colour = (
        TimeDensity(0, "none", channels=[("heat", 400.0, 1, -400.0), ("wind", 2.0, 3, 0.0)]),
        TimeHarmonics(0),
    )
    specs = [*GEOMETRY_SPECS, *density.parameters(), *colour.parameters()]
    params = {spec.name: torch.rand((40, *spec.shape), generator=generator, dtype=torch.float64) for spec in specs}
    params |= {"log_scales": params["log_scales"] - 1.5, "channel_heat": params["channel_heat"] - 0.5}
    model = Primitives(density, colour, {name: value.float() for name, value in params.items()})
    points = torch.rand((200, 3), generator=generator, dtype=torch.float64)
    found = channel_values_at(model, {"time": torch.tensor(0.5)}, points)
    active = Primitives(density, colour, params).active({"time": torch.tensor(0.5)})
    sigma = torch.zeros(200, 40, dtype=torch.float64)
    for i in range(40):
        offset = (points - active.geometry.means[i]) @ active.geometry.rotations[i] / active.geometry.scales[i]
        inside = offset.square().sum(1) < 1
        prim = torch.full((int(inside.sum()),), i)
        sigma[inside, i] = active.sigma(prim, points[inside]).clamp_min(0)
    assert (sigma.sum(1) > 0).sum() > 50
    for name, (size, *_) in density.ranges.items():
        true = (sigma @ params[f"channel_{name}"]) * size / sigma.sum(1, keepdim=True).clamp_min(1e-300)
        assert torch.allclose(found[name].double(), true, rtol=1e-4, atol=1e-4 * size)


def test_values_stay_above_those_of_the_files() -> None:
    """Otherwise, exported grids would have values that the source never has, such as negative flames."""
    density = TimeDensity(0, "none", channels=[("heat", 400.0, 1, -100.0), ("flames", 2.0, 1, 0.0)])
    lows = {spec.name: spec.low for spec in density.parameters() if spec.name.startswith("channel_")}
    assert lows == {"channel_heat": -0.25, "channel_flames": 0.0}


def test_wrong_extinction_is_no_error_of_a_channel() -> None:
    generator = torch.Generator().manual_seed(2)
    density, colour = TimeDensity(0, "none", channels=[("heat", 400.0, 1, 0.0)]), TimeHarmonics(0)
    specs = [*GEOMETRY_SPECS, *density.parameters(), *colour.parameters()]
    params = {spec.name: torch.rand((40, *spec.shape), generator=generator) for spec in specs}
    params |= {"log_scales": params["log_scales"] - 1.5}
    points, sigma = torch.rand((200, 3), generator=generator), 3 * torch.rand(200, generator=generator)
    sigma[:20] = 0
    plain = PointSamples("frame", {"time": torch.tensor(0.5)}, points, sigma, None, 2.0)
    hot = replace(plain, components={"channel_heat": (200 * sigma[:, None], 300.0)})  # 200 everywhere

    def loss(share: float, samples: PointSamples) -> float:
        model = Primitives(density, colour, {**params, "channel_heat": torch.full((40, 1), share)})
        return float(point_loss(model, samples, TrainSettings()).loss)

    model = Primitives(density, colour, params)
    found = volume_values_at(model, plain.conditions, points, colour=False).sigma.double()
    assert abs(loss(0.5, hot) - loss(0.5, plain)) < 1e-6 < loss(0.5, plain)
    error = 0.1 * 400 * found / (found + 0.02 * 2.0) * (2.0 / 300.0) * (sigma > 0)
    added = 0.1 * float(error.square().mean())
    assert loss(0.6, hot) - loss(0.6, plain) == pytest.approx(added, rel=1e-3) and added > 1e-3


@pytest.mark.filterwarnings("ignore::neuprim.core.errors.NeuprimWarning")
def test_a_run_exports_its_channels_with_errors(files: Path, tmp_path: Path) -> None:
    out = run(composed(files, tmp_path / "run", "train.iterations=400", "train.voxels_every=2"))
    report = export_run(out, "vdb", tmp_path / "frames")
    metrics = json.loads((out / "metrics.json").read_text())
    assert len(metrics["heat_frames"]) == 3  # it is constant in the frame without the grid
    for number, path in enumerate(report.files):
        density, found, blown = (read_grid(path, name) for name in ("smoke", "heat", "wind"))
        assert blown.channels == 3 and np.array_equal(blown.masks, density.masks)
        assert np.array_equal(found.masks, density.masks) and np.array_equal(found.origins, density.origins)
        if number == WITHOUT:
            continue
        assert report.errors[f"frame_{number:04d}.heat.relative_l2"] < 0.3
        assert report.errors[f"frame_{number:04d}.heat.correlation"] > 0.95
        assert report.errors[f"frame_{number:04d}.wind.correlation"] > 0.95
        truth = read_grid(files / f"hot_{number}.vdb", "heat").to_dense(density.bounds)
        wrong = (found.to_dense(density.bounds) - truth)[density.to_dense() > 0.2]
        assert np.sqrt(np.square(wrong).mean()) < 0.15 * np.abs(truth).max()
    assert any(note.startswith("channels heat, wind:") for note in report.notes)
    assert open_run(out).model.density.settings()["channels"] == [["heat", 830.0, 1, -250.0], ["wind", 79.5, 3, -16.5]]
    stored = open_run(out)
    assert main(["compress", str(out), "--seconds", "0"]) == 0
    small = load_model_checkpoint(out / "model.neuprim", stored.task)[0]
    for name in ("channel_heat", "channel_wind"):  # in another order
        before, after = (model.params[name].sort(0).values for model in (stored.model, small))
        assert float((after - before).abs().max()) < 0.01 * float(before.max() - before.min())
    with pytest.raises(ConfigError, match="name=heat: the model has a channel of this name"):
        export_run(out, "vdb", tmp_path / "again", ["name=heat"])


REFUSED: list[tuple[Any, str]] = [
    (["hest"], "scene.channels=hest: no frame has such a grid; did you mean 'heat'"),
    (["both"], "grid 'both' has 3 numbers per voxel; expected 1, as in earlier frames"),
    (["still"], "scene.channels=still: the grid is 0 in all frames"),
    (
        ["huge"],
        ".vdb: grid 'huge' has 2146689 blocks of voxels that are not empty, which take 6259745124 bytes; at most",
    ),
    (["hot"], "hot_0.vdb: grid 'hot' has values up to 1e+38; expected at most 1e+15"),
    (["density"], "scene.channels: 'density' is the extinction, which every model learns; expected others"),
    (["../heat"], "expected a list, each the name of a grid, of letters, digits and underscores"),
]


@pytest.mark.parametrize(("names", "message"), REFUSED)
def test_channels_that_cannot_be_learned_are_refused(names: list[str], message: str, tmp_path: Path) -> None:
    still = VdbGrid.from_dense("still", np.zeros((8, 8, 8), np.float32), transform=vdb_scale_transform(VOXEL))
    for frame, shape in enumerate([(8, 8, 8), (8, 8, 8, 3)]):
        both = VdbGrid.from_dense("both", np.ones(shape, np.float32), transform=vdb_scale_transform(VOXEL))
        corners = 128 * np.stack(np.meshgrid(*(np.arange(8),) * 3), -1).reshape(-1, 3).astype(np.int32)
        tiles = VdbTiles(corners, np.full(512, 128, np.int32), np.ones(512, np.float32), np.ones(512, bool))
        huge = replace(still, name="huge", tiles=tiles)
        hot = VdbGrid.from_dense("hot", np.full((8, 8, 8), 1e38, np.float32), transform=still.transform)
        write_vdb(tmp_path / f"hot_{frame}.vdb", [*blob(8.0, ("density",)), heat(), still, both, huge, hot])
    with pytest.raises((ConfigError, DataError)) as caught:
        data = dataset(tmp_path, tmp_path, channels=names)
        assert data.points is not None
        data.points.draw(8, torch.Generator().manual_seed(0))
    assert message in str(caught.value)


def test_channels_need_voxels(files: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"train\.supervision=images: voxels are needed for scene\.channels"):
        run(composed(files, tmp_path / "run", "train.supervision=images"))


DAMAGED: list[Any] = [7, ["heat"], [["heat", 1.0, 1]], [["a b", 1.0, 1, 0]], [["heat", 0.0, 1, 0]],
    [["heat", "x", 1, 0]], [["heat", 1.0, 2, 0]], [["heat", float("nan"), 1, 0]], [["heat", 1.0, 1, 0]] * 2,
    [["heat", 1.0, 1, 0.1]], [["heat", 1.0, 1, -1.1]], [["heat", 1.0, 1, float("nan")]]]  # fmt: skip


@pytest.mark.parametrize("channels", DAMAGED)
def test_damaged_channels_of_a_model_are_refused(channels: Any) -> None:
    with pytest.raises(ValueError, match="expected a name, a number above 0, 1 or 3, and a number from minus the"):
        TimeDensity(0, channels=channels)
