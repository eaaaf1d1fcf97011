"""The built-in room as a data set: its cameras, lens, exposures and points, and what the project's own loader makes of
the files."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.data import Dataset
from neuprim.core.data.distortion import Radial, resample_image, undistortion_grid
from neuprim.core.io.ply import read_ply
from neuprim.core.task import SceneContext
from neuprim.scenes.room.cameras import (
    FARTHEST,
    HIGHEST,
    LENS,
    LOWEST,
    NEAREST,
    Lens,
    camera_positions,
    room_camera_poses,
)
from neuprim.scenes.room.generate import (
    ReconstructedPoints,
    RoomSettings,
    build_room,
    exposure_gains,
    generate_room,
    photograph_room,
    reconstruct_points,
    room_lens,
)
from neuprim.scenes.room.interior import HIGH, LOW, Room
from neuprim.scenes.shapes import build_solids
from neuprim.tasks.static.generated import load_room as load

SMALL = {"size": 40, "train_views": 6, "test_views": 3, "supersampling": 1, "points": 300}


@pytest.fixture(scope="module")
def scene() -> Room:
    return build_room(RoomSettings(**SMALL))


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def folder(scene: Room, cache: Path) -> Path:
    return generate_room(RoomSettings(**SMALL), cache)


@pytest.fixture(scope="module")
def dataset(folder: Path, cache: Path) -> Dataset:
    return load(SMALL, SceneContext(seed=0, cache_dir=cache))


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def pixels(seen: Lens, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) photographed pixels of (N, 3) points, all of them before the camera."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    assert (local[:, 2] < 0).all()
    return seen.pixels(np.stack([local[:, 0], -local[:, 1]], axis=1) / -local[:, 2:])


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    return float(-10 * np.log10(((one.astype(float) - other.astype(float)) ** 2).mean() / 255**2))


# Cameras
# -------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("train", "test"), [(80, 20), (20, 20), (2, 1), (5, 7)])
def test_cameras_are_in_the_room_and_see_the_whole_subject(train: int, test: int) -> None:
    corners = np.concatenate([s.mesh.vertices for s in build_solids()])
    seen, poses = Lens(200), room_camera_poses(train, test)
    assert {split: len(found) for split, found in poses.items()} == {"train": train, "test": test}
    heights = []
    for pose in (*poses["train"], *poses["test"]):
        eye = pose[:3, 3]
        assert NEAREST <= np.linalg.norm(eye) <= FARTHEST and LOWEST <= eye[2] <= HIGHEST
        assert (eye > np.add(LOW, 0.5)).all() and (eye < np.subtract(HIGH, 0.5)).all()
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert pose[2, 1] > 0.5 and abs(pose[2, 0]) < np.sin(np.radians(3.0))  # upright, but for the hand
        found = pixels(seen, pose, corners)
        assert (found > 0).all() and (found < [seen.width, seen.height]).all()
        upright = pixels(seen, pose, np.array([[0, 0, corners[:, 2].min()], [0, 0, corners[:, 2].max()]]))
        heights.append(np.ptp(upright[:, 1]) / seen.height)
    assert 0.2 < min(heights) and max(heights) < 0.5 and 0.27 < np.mean(heights) < 0.4  # about a third of the picture


def test_test_cameras_lie_between_training_ones_and_are_the_same_for_any_number_of_them() -> None:
    for train in (80, 20, 40, 7):
        found = camera_positions(train, 20)
        both = np.sort(np.concatenate([found["train"], found["test"]]))
        assert len(both) == train + 20 and np.diff(both).min() > 0.3 / (train + 20)
        assert (np.diff(found["train"]) > 0).all()
        np.testing.assert_array_equal(room_camera_poses(train, 20)["test"], room_camera_poses(80, 20)["test"])
    many = camera_positions(80, 20)
    assert [
        int(((many["train"] > a) & (many["train"] < b)).sum())
        for a, b in zip(many["test"], many["test"][1:], strict=False)
    ] == [4] * 19


# The lens
# ------------------------------------------------------------------------------------------------------------------------------


def test_the_loaders_undistorted_image_is_what_a_pinhole_sees(tmp_path: Path) -> None:
    settings = RoomSettings(size=128, train_views=2, test_views=1, supersampling=2, points=10)
    found = load(asdict(settings), SceneContext(seed=0, cache_dir=tmp_path))
    view = found.test.view(0)
    seen, scene, pose = room_lens(settings), build_room(settings), room_camera_poses(2, 1)["test"][0]
    pinhole = photograph_room(scene, Lens(128, Radial()), pose, 2)
    pixels_ = found.test.pixels(0)
    assert pixels_.mask is None or pixels_.mask.all()  # a barrel lens shows all that the pinhole would
    undistorted = pixels_.rgb.numpy() * 255
    bent = np.asarray(Image.open(next(tmp_path.glob("room-*")) / "images" / "test_0000.png"))
    agreement = psnr(undistorted, pinhole)
    assert agreement > 28 and psnr(bent, pinhole) < agreement - 8
    # what is left is the resampling's blur: a lens a little stronger or weaker fits worse, and so does one that is
    # askew
    for wrong in (replace(LENS, k1=-0.07), replace(LENS, k1=-0.09), replace(LENS, p1=-0.001), replace(LENS, p2=0.001)):
        other = resample_image(torch.from_numpy(bent.copy()).float(), undistortion_grid(seen.camera, wrong)[0]).numpy()
        assert psnr(other, pinhole) < agreement - 0.3, wrong
    assert (view.camera.fx, view.camera.cx, view.camera.cy, view.camera.height) == (
        seen.focal,
        0.504 * 128,
        0.495 * 96,
        96,
    )
    np.testing.assert_allclose(torch.linalg.inv(view.camera.viewmat).numpy()[:3, 3], pose[:3, 3], atol=1e-9)


# The files
# -----------------------------------------------------------------------------------------------------------------------------


def test_the_loader_finds_splits_points_and_what_the_data_are(dataset: Dataset, folder: Path) -> None:
    assert (dataset.name, dataset.data_source, dataset.color_space) == ("room", "generated", "srgb")
    names = [[views.view(i).name for i in range(len(views))] for views in (dataset.train, dataset.test)]
    assert names == [[f"train_{i:04d}" for i in range(6)], [f"test_{i:04d}" for i in range(3)]]
    for views, split in ((dataset.train, "train"), (dataset.test, "test")):
        for i, pose in enumerate(room_camera_poses(6, 3)[split]):
            np.testing.assert_allclose(views.view(i).camera.position.numpy(), pose[:3, 3], atol=1e-6)
    assert dataset.up.tolist() == [0.0, 0.0, 1.0] and dataset.center.norm() < 0.2
    start = dataset.start(dataset.train, 10_000, torch.Generator().manual_seed(0))
    stored = read_ply(folder / "points.ply")
    assert len(start.means) == 300
    np.testing.assert_allclose(start.means.numpy(), stored.columns("xyz"), atol=1e-6)
    np.testing.assert_allclose(start.colors.numpy() * 255, stored.columns(("red", "green", "blue")), atol=1e-3)


# Exposures
# -----------------------------------------------------------------------------------------------------------------------------


def test_exposures_are_within_bounds_and_in_training_images_only(folder: Path, tmp_path: Path) -> None:
    written = json.loads((folder / "exposures.json").read_text())
    assert list(written) == [f"images/train_{i:04d}.png" for i in range(6)] + [
        f"images/test_{i:04d}.png" for i in range(3)
    ]
    stops = np.log2([written[f"images/train_{i:04d}.png"] for i in range(6)])
    assert (np.abs(stops) <= 0.15).all() and len(set(stops)) == 6
    assert [written[f"images/test_{i:04d}.png"] for i in range(3)] == [1.0, 1.0, 1.0]
    plain = contents(generate_room(RoomSettings(**SMALL, exposure=0.0), tmp_path))
    for name, data in contents(folder).items():
        if name.startswith("images"):
            assert (plain[name] == data) == ("test_" in name), name
    many = np.log2(exposure_gains(2000, 0.3))
    assert (
        many.min() < -0.29
        and many.max() > 0.29
        and abs(many.mean()) < 0.02
        and abs(many.std() - 0.3 / np.sqrt(3)) < 0.01
    )


# Points
# --------------------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(scene: Room, folder: Path) -> ReconstructedPoints:
    """As for the files, but more."""
    poses = room_camera_poses(6, 3)["train"]
    return reconstruct_points(scene, Lens(40), poses, lambda i: luma(folder, i), 3000)


def luma(folder: Path, index: int) -> np.ndarray:
    return (
        np.asarray(Image.open(folder / "images" / f"train_{index:04d}.png"), dtype=np.float32)
        @ np.array([0.2126, 0.7152, 0.0722])
        / 255
    )


def test_points_lie_on_surfaces_that_two_cameras_see(scene: Room, found: ReconstructedPoints) -> None:
    poses = room_camera_poses(6, 3)["train"]
    assert len(found.surface) == 3000 and set(found.camera) == set(range(6))
    seen_by = np.zeros(3000, dtype=int)
    own = np.zeros(3000, dtype=bool)
    for index, pose in enumerate(poses):
        ray = found.surface - pose[:3, 3]
        away = np.linalg.norm(ray, axis=1)
        first = scene.intersect(pose[:3, 3], ray / away[:, None])
        local = ray @ pose[:3, :3]
        before = local[:, 2] < 0
        x, y = (
            Lens(40)
            .pixels(np.stack([local[:, 0], -local[:, 1]], axis=1) / -np.where(before, local[:, 2], -1.0)[:, None])
            .T
        )
        inside = before & (x >= 0) & (x <= 40) & (y >= 0) & (y <= 30)
        seen = inside & (np.abs(first.distance - away) < 2e-3 * away)
        seen_by += seen
        own |= seen & (found.camera == index)
    assert own.mean() > 0.995 and (seen_by >= 2).mean() > 0.99  # but for rounding at edges
    assert (found.surface >= np.subtract(LOW, 1e-3)).all() and (found.surface <= np.add(HIGH, 1e-3)).all()


# The cache and the settings
# ------------------------------------------------------------------------------------------------------------
