"""The built-in room: textures, bodies and light, its cameras, lens, exposures and points, and the loaded data set."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.data import Dataset
from neuprim.core.data.image_views import RadialDistortion, resample_image, undistortion_grid
from neuprim.core.io.ply import read_ply
from neuprim.core.task import SceneContext
from neuprim.scenes.room import (
    LENS,
    Room,
    RoomLens,
    RoomSettings,
    build_room,
    photograph_room,
    reconstruct_room_points,
    room_camera_poses,
    room_exposure_gains,
    room_lamplight_radiance,
    room_lens,
    room_walk_positions,
)
from neuprim.scenes.room_interior import (
    ABOVE,
    HIGH,
    LAMP,
    LAMP_POWER,
    LOW,
    Furnishing,
    furnish_room,
    lattice_noise,
    speckled,
)
from neuprim.scenes.shapes import ball, build_solids, chamfered_box, parse_solid_srgb
from neuprim.tasks.static.datasets import load_room_dataset

SMALL = {"size": 40, "train_views": 6, "test_views": 3, "supersampling": 1, "points": 300}


@pytest.fixture(scope="module")
def room() -> Room:
    return build_room(RoomSettings(**SMALL))


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def dataset(cache: Path) -> Dataset:
    return load_room_dataset(SMALL, SceneContext(seed=0, cache_dir=cache))


@pytest.fixture(scope="module")
def folder(dataset: Dataset, cache: Path) -> Path:
    return next(cache.glob("room-*"))


def still(count: int, width: float = 0.0) -> np.ndarray:
    return np.full(count, width, dtype=np.float32)


# ---------------------------------------------------------------- textures, bodies and light


@pytest.mark.parametrize("dimensions", [2, 3])
def test_noise_is_smooth_centred_and_fades_with_the_width(dimensions: int) -> None:
    points = np.random.default_rng(0).uniform(-6, 6, (20000, dimensions)).astype(np.float32)
    sharp = lattice_noise(points, still(20000), 0.5, 7)
    assert abs(sharp.mean()) < 0.03 and 0.2 < sharp.std() < 0.6 and np.abs(sharp).max() < 2.5
    assert np.abs(lattice_noise(points + np.float32(1e-4), still(20000), 0.5, 7) - sharp).max() < 0.02
    strength = [lattice_noise(points, still(20000, w), 0.5, 7).std() for w in (0.0, 0.1, 0.3, 0.6, 0.8)]
    assert all(a > b for a, b in pairwise(strength)) and strength[-1] == 0


def test_every_texture_is_a_reflectance_and_blurs_with_distance() -> None:
    for body in furnish_room():
        low, high = body.mesh.bounds
        points = np.random.default_rng(0).uniform(low, high, (4000, 3)).astype(np.float32)
        sharp, near, far = (body.texture(points, still(4000, width)) for width in (0.0, 0.25, 2.0))
        assert sharp.shape == (4000, 3) and np.isfinite(sharp).all(), body.name
        assert 0 <= sharp.min() and sharp.max() <= 1, body.name
        assert far.std(0).sum() <= sharp.std(0).sum() + 1e-6, body.name
        assert np.abs(near.mean(0) - sharp.mean(0)).max() < 0.06, body.name  # blurred, not repainted


def test_bodies_are_closed_and_leave_the_cameras_room() -> None:
    bodies = {body.name: body for body in furnish_room()}
    assert len(bodies) == len(furnish_room())
    middle = {"table top", "table leg", "rug", "bulb", "shade", "cord", "floor", "ceiling", "beams"}
    for name, body in bodies.items():
        assert body.mesh.is_watertight and body.mesh.volume > 0 and 0 <= body.gloss <= 1 and body.glow >= 0, name
        if name not in middle:
            # A body whose triangles span the middle has vertices on two sides of it; none of these does.
            for points in (body.mesh.triangles_center, body.mesh.vertices):
                assert np.linalg.norm(points[:, :2], axis=1).min() > 4.7, name
    table, solids = bodies["table top"].mesh, build_solids()
    feet = min(s.mesh.vertices[:, 2].min() for s in solids)
    assert table.bounds[1, 2] == pytest.approx(feet, abs=1e-9)  # the plate stands on it
    assert all(np.linalg.norm(s.mesh.vertices[:, :2], axis=1).max() < table.bounds[1, 0] for s in solids)


def test_no_ray_leaves_the_room(room: Room) -> None:
    eye = np.array([0.0, 2.0, 1.0])
    heights = np.linspace(LOW[2], HIGH[2], 2000)
    edges = np.array([[x, y, z] for x in (LOW[0], HIGH[0]) for y in (LOW[1], HIGH[1]) for z in heights])
    directions = np.concatenate([np.random.default_rng(2).standard_normal((60000, 3)), edges - eye])
    hits = room.intersect(eye, directions / np.linalg.norm(directions, axis=1, keepdims=True))
    assert hits.hit.all()
    assert (hits.position > np.subtract(LOW, 1e-3)).all() and (hits.position < np.add(HIGH, 1e-3)).all()
    names = {room.solids[i].name for i in hits.solid}
    walls = {f"{kind} wall" for kind in ("brick", "papered", "plastered", "tiled")}
    assert {"floor", "ceiling", "rug", "table top", "pillar", *walls} <= names


def test_the_lamp_falls_with_distance_and_casts_shadows() -> None:
    grey, (x, y, z) = speckled("#808080", 1, 0.0), LAMP
    floor = Furnishing("floor", chamfered_box([8, 8, 0.1], [0, 0, -0.05], 0.01), grey)
    blocker = Furnishing("blocker", ball([x + 0.5, y, z / 2], 0.2), grey)
    spots = np.array([[x, y], [x - 2, y], [x + 1.0, y]])  # below, aside, and behind the ball
    origins = np.column_stack([spots, np.full(3, 0.2)])
    rgb = room_lamplight_radiance(Room([], [floor, blocker], 1e-3), origins, np.tile([[0.0, 0, -1]], (3, 1)))
    albedo, above, power = parse_solid_srgb("#808080"), np.array(ABOVE), np.array(LAMP_POWER)
    np.testing.assert_allclose(rgb[0], albedo * (above + power / z**2 / np.pi), rtol=1e-4)
    np.testing.assert_allclose(rgb[1], albedo * (above + power * z / np.hypot(2, z) ** 3 / np.pi), rtol=1e-4)
    np.testing.assert_allclose(rgb[2], albedo * above, rtol=1e-4)


# ---------------------------------------------------------------- cameras and the lens


def pixels(lens: RoomLens, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 2) photographed pixels of (N, 3) points, all of them before the camera."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    assert (local[:, 2] < 0).all()
    return lens.pixels(np.stack([local[:, 0], -local[:, 1]], axis=1) / -local[:, 2:])


@pytest.mark.parametrize(("train", "test"), [(80, 20), (2, 1), (5, 7)])
def test_cameras_are_in_the_room_and_see_the_whole_subject(train: int, test: int) -> None:
    corners = np.concatenate([s.mesh.vertices for s in build_solids()])
    lens, poses = RoomLens(200), room_camera_poses(train, test)
    assert {split: len(found) for split, found in poses.items()} == {"train": train, "test": test}
    for pose in (*poses["train"], *poses["test"]):
        eye = pose[:3, 3]
        assert 2.6 <= np.linalg.norm(eye) <= 4.5 and 0.3 <= eye[2] <= 2.0
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert pose[2, 1] > 0.5 and abs(pose[2, 0]) < np.sin(np.radians(3.0))  # upright, but for the hand
        found = pixels(lens, pose, corners)
        assert (found > 0).all() and (found < [lens.width, lens.height]).all()


def test_test_cameras_lie_between_training_ones_and_are_the_same_for_any_number_of_them() -> None:
    for train in (80, 20, 7):
        found = room_walk_positions(train, 20)
        both = np.sort(np.concatenate([found["train"], found["test"]]))
        assert len(both) == train + 20 and np.diff(both).min() > 0.3 / (train + 20)
        np.testing.assert_array_equal(room_camera_poses(train, 20)["test"], room_camera_poses(80, 20)["test"])


def test_the_loaders_undistorted_image_is_what_a_pinhole_sees(tmp_path: Path) -> None:
    def psnr(one: np.ndarray, other: np.ndarray) -> float:
        return float(-10 * np.log10(((one.astype(float) - other.astype(float)) ** 2).mean() / 255**2))

    settings = RoomSettings(size=128, train_views=2, test_views=1, supersampling=2, points=10)
    loaded = load_room_dataset(asdict(settings), SceneContext(seed=0, cache_dir=tmp_path))
    camera, found = loaded.test.view(0).camera, loaded.test.pixels(0)
    lens, pose = room_lens(settings), room_camera_poses(2, 1)["test"][0]
    pinhole = photograph_room(build_room(settings), RoomLens(128, RadialDistortion()), pose, 2)
    assert found.mask is None or found.mask.all()  # a barrel lens shows all that the pinhole would
    bent = np.asarray(Image.open(next(tmp_path.glob("room-*")) / "images" / "test_0000.png"))
    agreement = psnr(found.rgb.numpy() * 255, pinhole)
    assert agreement > 28 and psnr(bent, pinhole) < agreement - 8
    # what is left is the resampling's blur: a lens a little stronger, weaker or askew fits worse
    for wrong in (replace(LENS, k1=-0.07), replace(LENS, k1=-0.09), replace(LENS, p1=-0.001), replace(LENS, p2=0.001)):
        other = resample_image(torch.from_numpy(bent.copy()).float(), undistortion_grid(lens.camera, wrong)[0]).numpy()
        assert psnr(other, pinhole) < agreement - 0.3, wrong
    assert (camera.fx, camera.cx, camera.cy, camera.height) == (lens.focal, 0.504 * 128, 0.495 * 96, 96)
    np.testing.assert_allclose(torch.linalg.inv(camera.viewmat).numpy()[:3, 3], pose[:3, 3], atol=1e-9)


# ---------------------------------------------------------------- the data set


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


def test_exposures_are_within_bounds_and_in_training_images_only(room: Room, folder: Path) -> None:
    written = json.loads((folder / "exposures.json").read_text())
    for split, count in (("train", 6), ("test", 3)):
        poses = room_camera_poses(6, 3)[split]
        for i in range(count):
            name = f"images/{split}_{i:04d}.png"
            image = photograph_room(room, RoomLens(40), poses[i], 1, written[name])
            np.testing.assert_array_equal(np.asarray(Image.open(folder / name)), image)
            assert (written[name] == 1.0) == (split == "test") and abs(np.log2(written[name])) <= 0.15
    many = np.log2(room_exposure_gains(2000, 0.3))
    assert many.min() < -0.29 and many.max() > 0.29
    assert abs(many.mean()) < 0.02 and abs(many.std() - 0.3 / np.sqrt(3)) < 0.01


def test_points_lie_on_surfaces_that_two_cameras_see(room: Room, folder: Path) -> None:
    def luma(index: int) -> np.ndarray:
        image = np.asarray(Image.open(folder / "images" / f"train_{index:04d}.png"), dtype=np.float32)
        return image @ np.array([0.2126, 0.7152, 0.0722]) / 255

    poses = room_camera_poses(6, 3)["train"]
    found = reconstruct_room_points(room, RoomLens(40), poses, luma, 3000)
    assert len(found.surface) == 3000 and set(found.camera) == set(range(6))
    seen_by, own = np.zeros(3000, dtype=int), np.zeros(3000, dtype=bool)
    for index, pose in enumerate(poses):
        ray = found.surface - pose[:3, 3]
        away = np.linalg.norm(ray, axis=1)
        first = room.intersect(pose[:3, 3], ray / away[:, None])
        local = ray @ pose[:3, :3]
        before = local[:, 2] < 0
        flat = np.stack([local[:, 0], -local[:, 1]], axis=1) / -np.where(before, local[:, 2], -1.0)[:, None]
        x, y = RoomLens(40).pixels(flat).T
        inside = before & (x >= 0) & (x <= 40) & (y >= 0) & (y <= 30)
        seen = inside & (np.abs(first.distance - away) < 2e-3 * away)
        seen_by += seen
        own |= seen & (found.camera == index)
    assert own.mean() > 0.995 and (seen_by >= 2).mean() > 0.99  # but for rounding at edges
    wrong = np.linalg.norm(found.position - found.surface, axis=1) > 0.1
    assert 0.012 < wrong.mean() < 0.025  # outliers
