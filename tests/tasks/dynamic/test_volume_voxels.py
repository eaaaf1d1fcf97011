"""Fitting a volume sequence to its voxels: what is drawn, what is learned, and that a run goes on where it stopped."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuprim.config import compose
from neuprim.core.data.dataset import PointSamples
from neuprim.core.errors import DataError
from neuprim.core.io.vdb import write_vdb
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import fit, prepare_training
from neuprim.tasks.dynamic.volume.capture_voxels import FrameVoxels, MediumVoxels, take_voxel_rows
from neuprim.tasks.dynamic.volume.lit_medium import light_medium
from tests.tasks.dynamic.sequences import VOXEL, dataset, empty_frame, recorded, write_blobs

SMALL = (
    "scene.size=24 scene.cameras=6 scene.samples=1 model.primitives=80 model.neurons=0 train.max_seconds=null".split()
)
SOFT = ["model.density.edge=2", "model.density.gain=true"]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames 1 to 4 of an ellipsoid that moves along x, and an empty frame 5."""
    folder = write_blobs(tmp_path_factory.mktemp("ball"), {n: 6.0 + 3 * n for n in range(1, 5)})
    write_vdb(folder / "ball_5.vdb", empty_frame())
    return folder


def supervision(folder: Path, tmp_path: Path, **changes: Any) -> FrameVoxels:
    found = dataset(folder, tmp_path, **changes).points
    assert isinstance(found, FrameVoxels)
    return found


def size_of(voxels: MediumVoxels) -> int:
    return voxels.index.nbytes + voxels.values.nbytes


def frames_of(points: FrameVoxels, draws: int, count: int = 400) -> dict[str, list[PointSamples]]:
    generator, found = torch.Generator().manual_seed(0), dict[str, list[PointSamples]]()
    for _ in range(draws):
        samples = points.draw(count, generator)
        found.setdefault(samples.name, []).append(samples)
    return found


def words(folder: Path, *more: str) -> list[str]:
    return ["task=dynamic", "scene=vdb", f"scene.vdb='{folder}'", "scene.look=smoke_fire", *SMALL, *SOFT, *more]


def trainer(folder: Path, *more: str) -> Trainer:
    return prepare_training(compose(words(folder, *more), check_output=False)).trainer


# ---------------------------------------------------------------- what is drawn


def test_points_are_voxel_centres_with_the_files_own_values(files: Path, tmp_path: Path) -> None:
    data = dataset(files, tmp_path)
    assert isinstance(data.points, FrameVoxels)
    drawn = frames_of(data.points, 300)
    capture = recorded(data).capture
    assert sorted(drawn) == [f"frame_{n:04d}" for n in range(1, 6)]
    for frame in capture.frames[:4]:
        medium = light_medium(capture.medium(frame), capture.optics.light, capture.optics)
        for samples in drawn[f"frame_{frame.number:04d}"]:
            assert float(samples.conditions["time"]) == pytest.approx((frame.number - 1) / 4)
            index = samples.points.double().numpy() @ medium.index_from_scene[:3, :3].T + medium.index_from_scene[:3, 3]
            assert np.abs(index - np.rint(index)).max() < 1e-3
            cells = np.rint(index).astype(int)
            inside = ((cells >= 0) & (cells < medium.bricks.shape)).all(1)
            expected = np.zeros((len(cells), 4), np.float32)
            expected[inside] = medium.values[0][tuple(cells[inside].T)]
            assert np.array_equal(samples.sigma.numpy(), expected[:, 0])
            assert samples.source is not None
            assert np.allclose(samples.source.numpy(), expected[:, 1:] / data.exposure)
            full = medium.values[..., 0][medium.values[..., 0] > 0].astype(float)
            assert samples.sigma_scale == pytest.approx(np.sqrt((full**2).mean()), rel=1e-5)
            share = float((samples.sigma > 0).float().mean())
            assert 0.7 <= share < 0.98 and not inside.all()  # some lie beside the matter, some beyond the box


def test_under_several_lights_points_have_emission_and_albedo(files: Path, tmp_path: Path) -> None:
    """Errors of both are relative to all light, as a light of the look would scatter it without shadows."""
    data = dataset(files, tmp_path, lights=3)
    assert isinstance(data.points, FrameVoxels)
    capture = recorded(data).capture
    (one,) = frames_of(data.points, 1).values()
    (samples,) = one
    frame = next(f for f in capture.frames if samples.name == f"frame_{f.number:04d}")
    medium, light = capture.medium(frame), capture.optics.light
    assert medium.scattered is not None and light is not None
    index = samples.points.double().numpy() @ medium.index_from_scene[:3, :3].T + medium.index_from_scene[:3, 3]
    cells = np.rint(index).astype(int)
    inside = ((cells >= 0) & (cells < medium.bricks.shape)).all(1)
    where = tuple(cells[inside].T)
    assert samples.source is not None and samples.scattered is not None
    assert np.allclose(samples.source[inside].numpy(), medium.values[0][where][:, 1:] / data.exposure)
    scattered = medium.scattered[0][where] / (4 * math.pi * data.exposure)
    assert np.allclose(samples.scattered[inside].numpy(), scattered, rtol=1e-5) and scattered.max() > 0
    assert not samples.scattered[~inside].any()
    irradiance = sum(light.irradiance) / 3
    assert samples.source_scale == pytest.approx(irradiance * samples.scattered_scale)
    rms = [float(np.sqrt(np.square(x[medium.values[..., 0] > 0], dtype=np.float64).mean())) for x in
           (medium.values[..., 1:], irradiance / (4 * math.pi) * medium.scattered)]  # fmt: skip
    assert samples.source_scale == pytest.approx(sum(rms) / data.exposure, rel=1e-4)
    assert frames_of(supervision(files, tmp_path), 1).popitem()[1][0].scattered is None


def test_voxels_teach_lit_smoke_its_albedo(files: Path) -> None:
    """From voxels alone, without any image."""
    lit = trainer(files, "scene.lights=3", "train.supervision=voxels", "train.iterations=150", "train.voxel_colour=1")
    steps = [float(lit.train_step().parts["voxel_scattered"]) for _ in range(150)]
    assert sum(steps[-20:]) < 0.3 * sum(steps[:20])


def test_points_anywhere_fill_the_box_along_every_axis(files: Path, tmp_path: Path) -> None:
    points = supervision(files, tmp_path)
    drawn = frames_of(points, 200)
    low, high = points.capture.bounds
    assert len({round(float(side), 2) for side in high - low}) == 3, "no two axes are alike"
    margin, voxel = 0.1 * (high - low).max(), VOXEL * points.capture.normalisation.scale
    # the first tenth of a draw lies anywhere; an empty frame has no voxels of its own
    anywhere = [one.points[:40].numpy() for name in drawn if name != "frame_0005" for one in drawn[name]]
    places = np.concatenate(anywhere)
    assert np.allclose([places.min(0), places.max(0)], [low - margin, high + margin], atol=voxel)


def test_an_empty_frame_is_learned_as_empty(files: Path, tmp_path: Path) -> None:
    for samples in frames_of(supervision(files, tmp_path), 300)["frame_0005"]:
        assert len(samples.points) == 400 and not bool(samples.sigma.any()) and samples.sigma_scale > 1
        assert samples.source is not None and not bool(samples.source.any()) and samples.source_scale > 0


def test_a_chunk_of_a_sequence_and_frames_left_out(files: Path, tmp_path: Path) -> None:
    assert set(frames_of(supervision(files, tmp_path, frames="2:3"), 20)) == {"frame_0002", "frame_0003"}
    every_other = frames_of(supervision(files, tmp_path, train_every=2), 300)
    assert set(every_other) == {"frame_0001", "frame_0003", "frame_0005"}


def test_voxels_are_read_once_kept_beside_the_images_and_bounded(
    files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = supervision(files, tmp_path)
    read = [first._voxels[t] for t in range(5)]
    reads: list[int] = []
    monkeypatch.setattr(type(first.capture), "medium", lambda self, frame: reads.append(frame.number))
    again = supervision(files, tmp_path)
    again._voxels._memory = sum(size_of(voxels) for voxels in read[:2])
    for t, expected in enumerate(read):
        found = again._voxels[t]
        assert np.array_equal(found.index, expected.index) and np.array_equal(found.values, expected.values)
        assert sum(map(size_of, again._voxels._items.values())) <= again._voxels._memory
    assert not reads
    path = again.capture.fetch_points(again.folder, again.frames[0]).with_name("voxels.npz")
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(DataError, match=r"voxels\.npz: damaged .*delete it"):
        supervision(files, tmp_path)._voxels[0]


def test_values_at_indices_are_those_of_the_grid() -> None:
    rng = np.random.default_rng(0)
    values = np.where(rng.random((5, 4, 6, 1)) > 0.6, rng.random((5, 4, 6, 4)), 0).astype(np.float32)
    index = np.flatnonzero(values.reshape(-1, 4).any(1))
    voxels = MediumVoxels(index, values.reshape(-1, 4)[index], (5, 4, 6), np.eye(4))
    cells = np.stack(np.meshgrid(*(np.arange(-2, n + 2) for n in (5, 4, 6)), indexing="ij"), -1).reshape(-1, 3)
    padded = np.pad(values, ((2, 2), (2, 2), (2, 2), (0, 0)))
    assert np.array_equal(take_voxel_rows(voxels.values, voxels.find_cells(cells)), padded.reshape(-1, 4))


# ---------------------------------------------------------------- what is learned


@pytest.mark.parametrize("supervision", ["voxels", "both"])
def test_it_learns_the_voxels_better_than_images_alone(files: Path, supervision: str) -> None:
    budget = ["train.iterations=300", "train.voxels_per_step=1000", "scene.frames='1:4'"]
    results = {}
    for kind in ("images", supervision):
        results[kind] = fit(compose(words(files, *budget, f"train.supervision={kind}"), check_output=False)).metrics()
    images, voxels = results["images"], results[supervision]
    bound = 0.6 if supervision == "voxels" else 0.9
    assert voxels["sigma_relative_l2_middle"] < bound * images["sigma_relative_l2_middle"]
    assert voxels["psnr_mask"] > voxels["psnr_black_image_mask"] + (2 if supervision == "voxels" else 4)


def test_auto_is_images_where_there_are_no_voxels() -> None:
    words = "task=static scene=solids scene.size=16 scene.train_views=4 scene.test_views=1 model.primitives=10".split()
    found = prepare_training(compose([*words, "train.supervision=auto"], check_output=False)).trainer
    assert found.settings.supervision == "images" and "voxel_sigma" not in found.train_step().parts
