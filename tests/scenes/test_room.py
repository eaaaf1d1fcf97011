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

from neuprim.config import compose
from neuprim.core.data import Dataset
from neuprim.core.data.distortion import Radial, resample, source_grid
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.ply import read_ply
from neuprim.core.task import SceneContext
from neuprim.runs.run import run
from neuprim.scenes.room import generate as generator
from neuprim.scenes.room import lens as lenses
from neuprim.scenes.room.generate import RoomSettings, gains, generate, lens, picture, room
from neuprim.scenes.room.layout import HIGH, LOW
from neuprim.scenes.room.lens import LENS, Lens
from neuprim.scenes.room.path import FARTHEST, HIGHEST, LOWEST, NEAREST, camera_matrices, places
from neuprim.scenes.room.points import NOISE, OUTLIERS, Found, found_points
from neuprim.scenes.room.scene import Room
from neuprim.scenes.shapes import build
from neuprim.tasks.static.generated import load_room as load

SMALL = {"size": 40, "train_views": 6, "test_views": 3, "supersampling": 1, "points": 300}


@pytest.fixture(scope="module")
def scene() -> Room:
    return room(RoomSettings(**SMALL))


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def folder(scene: Room, cache: Path) -> Path:
    return generate(RoomSettings(**SMALL), cache)


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
    corners = np.concatenate([s.mesh.vertices for s in build()])
    seen, poses = Lens(200), camera_matrices(train, test)
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


def test_nothing_stands_between_the_cameras_and_the_subject(scene: Room) -> None:
    poses = [p for split in camera_matrices(80, 20).values() for p in split]
    eyes = np.stack([p[:3, 3] for p in poses])
    short = 1 - 1.4 / np.linalg.norm(eyes, axis=1)  # up to the table's edge
    assert not scene.occluded(eyes, -eyes, short).any()
    assert scene.occluded(eyes, [0, 0, -0.6] - eyes, 1.1).all()  # what there is to meet is met


def test_test_cameras_lie_between_training_ones_and_are_the_same_for_any_number_of_them() -> None:
    for train in (80, 20, 40, 7):
        found = places(train, 20)
        both = np.sort(np.concatenate([found["train"], found["test"]]))
        assert len(both) == train + 20 and np.diff(both).min() > 0.3 / (train + 20)
        assert (np.diff(found["train"]) > 0).all()
        np.testing.assert_array_equal(camera_matrices(train, 20)["test"], camera_matrices(80, 20)["test"])
    many = places(80, 20)
    assert [
        int(((many["train"] > a) & (many["train"] < b)).sum())
        for a, b in zip(many["test"], many["test"][1:], strict=False)
    ] == [4] * 19


def test_they_walk_around_it_twice_low_and_high() -> None:
    eyes = np.stack([p[:3, 3] for p in camera_matrices(80, 20)["train"]])
    turned = np.unwrap(np.arctan2(eyes[:, 1], eyes[:, 0]))
    assert abs(turned[-1] - turned[0] - 4 * np.pi * 79 / 80) < 0.3
    assert eyes[:10, 2].mean() < 0.8 and eyes[35:45, 2].mean() > 1.4 and np.ptp(np.linalg.norm(eyes, axis=1)) > 1.2


# The lens
# ------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("distortion", [LENS, Radial(k1=0.1, k2=-0.02, p1=-0.004, p2=0.003), Radial()])
def test_rays_of_pixels_are_the_inverse_of_the_loaders_projection(distortion: Radial) -> None:
    seen = Lens(200, distortion)
    everywhere = np.random.default_rng(0).random((500, 2)) * [seen.width, seen.height]
    directions = seen.directions(everywhere)
    np.testing.assert_allclose(distortion.project(directions, seen.camera), everywhere, atol=1e-9)
    pinhole = Lens(200, Radial()).directions(everywhere)
    moved = np.abs(directions - pinhole).max() * seen.focal
    assert moved == 0 if distortion == Radial() else moved > 3  # pixels


def test_the_loaders_undistorted_image_is_what_a_pinhole_sees(tmp_path: Path) -> None:
    settings = RoomSettings(size=128, train_views=2, test_views=1, supersampling=2, points=10)
    found = load(asdict(settings), SceneContext(seed=0, cache_dir=tmp_path))
    view = found.test.view(0)
    seen, scene, pose = lens(settings), room(settings), camera_matrices(2, 1)["test"][0]
    pinhole = picture(scene, Lens(128, Radial()), pose, 2)
    pixels_ = found.test.pixels(0)
    assert pixels_.mask is None or pixels_.mask.all()  # a barrel lens shows all that the pinhole would
    undistorted = pixels_.rgb.numpy() * 255
    bent = np.asarray(Image.open(next(tmp_path.glob("room-*")) / "images" / "test_0000.png"))
    agreement = psnr(undistorted, pinhole)
    assert agreement > 28 and psnr(bent, pinhole) < agreement - 8
    # what is left is the resampling's blur: a lens a little stronger or weaker fits worse, and so does one that is
    # askew
    for wrong in (replace(LENS, k1=-0.07), replace(LENS, k1=-0.09), replace(LENS, p1=-0.001), replace(LENS, p2=0.001)):
        other = resample(torch.from_numpy(bent.copy()).float(), source_grid(seen.camera, wrong)[0]).numpy()
        assert psnr(other, pinhole) < agreement - 0.3, wrong
    assert (view.camera.fx, view.camera.cx, view.camera.cy, view.camera.height) == (
        seen.focal,
        0.504 * 128,
        0.495 * 96,
        96,
    )
    np.testing.assert_allclose(torch.linalg.inv(view.camera.viewmat).numpy()[:3, 3], pose[:3, 3], atol=1e-9)


def test_without_distortion_the_file_has_no_lens_and_the_image_is_the_pinholes(tmp_path: Path) -> None:
    settings = RoomSettings(**SMALL, distortion=False)
    folder = generate(settings, tmp_path)
    document = json.loads((folder / "transforms.json").read_text())
    assert not {"k1", "k2", "k3", "k4", "p1", "p2"} & set(document)
    expected = picture(room(settings), Lens(40, Radial()), camera_matrices(6, 3)["test"][1], 1)
    np.testing.assert_array_equal(np.asarray(Image.open(folder / "images" / "test_0001.png")), expected)


def test_pictures_do_not_depend_on_how_rays_are_batched(scene: Room, monkeypatch: pytest.MonkeyPatch) -> None:
    pose = camera_matrices(6, 3)["train"][1]
    whole = picture(scene, Lens(40), pose, 2)
    monkeypatch.setattr(lenses, "RAYS_AT_ONCE", 700)
    np.testing.assert_array_equal(picture(scene, Lens(40), pose, 2), whole)


# The files
# -----------------------------------------------------------------------------------------------------------------------------


def test_same_settings_same_bytes(folder: Path, tmp_path: Path) -> None:
    again = generate(RoomSettings(**SMALL), tmp_path)
    assert again.name == folder.name and contents(again) == contents(folder)
    assert sorted(p.name for p in folder.iterdir()) == ["exposures.json", "images", "points.ply", "transforms.json"]


def test_images_are_opaque_photographs_that_fill_the_frame(folder: Path) -> None:
    document = json.loads((folder / "transforms.json").read_text())
    assert (document["w"], document["h"], document["k1"], document["k2"], document["p1"], document["p2"]) == (
        40,
        30,
        -0.08,
        0.02,
        0.001,
        -0.0005,
    )
    for frame in document["frames"]:
        with Image.open(folder / frame["file_path"]) as image:
            assert image.mode == "RGB" and image.size == (40, 30)
            values = np.asarray(image)
        assert 60 < values.mean() < 170 and values.std() > 35
        assert (values.max(-1) > 8).all(), "nothing of the room is black"


def test_the_loader_finds_splits_points_and_what_the_data_are(dataset: Dataset, folder: Path) -> None:
    assert (dataset.name, dataset.data_source, dataset.color_space) == ("room", "generated", "srgb")
    names = [[views.view(i).name for i in range(len(views))] for views in (dataset.train, dataset.test)]
    assert names == [[f"train_{i:04d}" for i in range(6)], [f"test_{i:04d}" for i in range(3)]]
    for views, split in ((dataset.train, "train"), (dataset.test, "test")):
        for i, pose in enumerate(camera_matrices(6, 3)[split]):
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
    plain = contents(generate(RoomSettings(**SMALL, exposure=0.0), tmp_path))
    for name, data in contents(folder).items():
        if name.startswith("images"):
            assert (plain[name] == data) == ("test_" in name), name
    many = np.log2(gains(2000, 0.3))
    assert (
        many.min() < -0.29
        and many.max() > 0.29
        and abs(many.mean()) < 0.02
        and abs(many.std() - 0.3 / np.sqrt(3)) < 0.01
    )


def test_a_gain_multiplies_linear_light(scene: Room) -> None:
    pose = camera_matrices(6, 3)["train"][2]
    one, brighter = (picture(scene, Lens(40), pose, 1, g) / 255.0 for g in (1.0, 1.2))
    linear = [np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4) for v in (one, brighter)]
    inside = (one > 0.3) & (brighter < 0.99)
    assert inside.sum() > 500
    np.testing.assert_allclose(linear[1][inside] / linear[0][inside], 1.2, atol=0.04)


# Points
# --------------------------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(scene: Room, folder: Path) -> Found:
    """As for the files, but more."""
    poses = camera_matrices(6, 3)["train"]
    return found_points(scene, Lens(40), poses, lambda i: luma(folder, i), 3000)


def luma(folder: Path, index: int) -> np.ndarray:
    return (
        np.asarray(Image.open(folder / "images" / f"train_{index:04d}.png"), dtype=np.float32)
        @ np.array([0.2126, 0.7152, 0.0722])
        / 255
    )


def test_points_lie_on_surfaces_that_two_cameras_see(scene: Room, found: Found) -> None:
    poses = camera_matrices(6, 3)["train"]
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


def test_points_have_the_noise_of_a_measurement_and_a_few_are_wrong(found: Found) -> None:
    eyes = np.stack([p[:3, 3] for p in camera_matrices(6, 3)["train"]])[found.camera]
    depth = np.linalg.norm(found.surface - eyes, axis=1)
    moved = np.linalg.norm(found.position - found.surface, axis=1) / depth
    assert found.outlier.sum() == round(OUTLIERS * 3000) and (moved[found.outlier] > 0.09).all()
    assert (
        np.sqrt((moved[~found.outlier] ** 2).mean()) == pytest.approx(NOISE, rel=0.05)
        and moved[~found.outlier].max() < 0.03
    )
    assert (found.position > np.subtract(LOW, 0.1)).all() and (found.position < np.add(HIGH, 0.1)).all()


def test_more_points_lie_where_there_is_detail(folder: Path, found: Found) -> None:
    there, anywhere = [], []
    for index, pose in enumerate(camera_matrices(6, 3)["train"]):
        detail = np.hypot(*np.gradient(luma(folder, index)))
        x, y = np.floor(pixels(Lens(40), pose, found.surface[found.camera == index])).astype(int).clip(0, [39, 29]).T
        there.append(detail[y, x].mean())
        anywhere.append(detail.mean())
    assert (np.array(there) > 1.3 * np.array(anywhere)).all()


def test_points_have_the_colours_of_their_photographs(scene: Room, found: Found) -> None:
    pose = camera_matrices(6, 3)["train"][0]
    image = picture(scene, Lens(160), pose, 2)  # finer pixels, but textures as blurred as where the points were found
    mine = found.camera == 0
    x, y = np.floor(pixels(Lens(160), pose, found.surface[mine])).astype(int).clip(1, [158, 118]).T
    around = np.stack([image[y + dy, x + dx].astype(int) for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    smooth = np.ptp(around, axis=0).max(-1) < 20  # where it does not matter what part of a pixel was met
    off = np.abs(image[y, x].astype(int) - found.rgb[mine]).max(-1)[smooth]
    assert smooth.sum() > 100 and np.quantile(off, 0.9) < 12


def test_points_that_no_two_views_share_are_refused(scene: Room) -> None:
    away = camera_matrices(6, 3)["train"][0].copy()
    outward = away.copy()
    outward[:3, [0, 2]] *= -1  # turned round by half
    with pytest.raises(
        ConfigError,
        match=r"^scene\.points=50: only \d+ points found that two of 2 training views see; expected more views$",
    ):
        found_points(
            scene, Lens(40), [away, outward], lambda i: np.random.default_rng(i).random((30, 40)).astype(np.float32), 50
        )


# The cache and the settings
# ------------------------------------------------------------------------------------------------------------


def test_cache_is_reused_and_keyed_by_every_setting(folder: Path, cache: Path) -> None:
    calls: list[float] = []
    assert generate(RoomSettings(**SMALL), cache, lambda text, fraction: calls.append(fraction)) == folder
    assert not calls
    other = {"exposure": 0.3, "distortion": False, **{name: value + 1 for name, value in SMALL.items()}}
    assert set(other) == set(asdict(RoomSettings()))
    keys = {RoomSettings(**{**SMALL, name: value}).key() for name, value in other.items()}
    assert len(keys | {RoomSettings(**SMALL).key()}) == len(other) + 1


def test_generator_version_is_part_of_the_key(monkeypatch: pytest.MonkeyPatch) -> None:
    before = RoomSettings().key()
    monkeypatch.setattr(generator, "GENERATOR_VERSION", generator.GENERATOR_VERSION + 1)
    assert RoomSettings().key() != before


def test_progress_runs_from_nothing_to_all_and_an_interruption_leaves_nothing(tmp_path: Path) -> None:
    calls: list[tuple[str, float]] = []

    def stop(text: str, fraction: float) -> None:
        calls.append((text, fraction))
        if fraction == 1.0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(RoomSettings(**SMALL), tmp_path, stop)
    assert list(tmp_path.iterdir()) == []
    fractions = [fraction for _, fraction in calls]
    assert fractions == sorted(fractions) and fractions[0] == 0.0 and len(fractions) == 10
    assert all(text.startswith("room: ") for text, _ in calls)


def test_unwritable_cache_names_the_place(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DataError, match=r"scene room: cannot write the generated images to .*file"):
        generate(RoomSettings(**SMALL), tmp_path / "file")


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("size", 4, "a whole number from 8 to 4096"),
        ("train_views", 1, "a whole number from 2 to 10000"),
        ("test_views", 0, "a whole number from 1 to 10000"),
        ("supersampling", 17, "a whole number from 1 to 16"),
        ("exposure", -0.1, "a number from 0 to 2"),
        ("exposure", 3, "a number from 0 to 2"),
        ("points", 0, "a whole number from 1 to 1000000"),
        ("distortion", 0.1, "true or false"),
    ],
)
def test_impossible_values_are_refused_in_one_line(name: str, value: object, says: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load({name: value}, SceneContext(seed=0, cache_dir=tmp_path))
    assert str(caught.value) == f"scene.{name}={value!s}: expected {says}" and list(tmp_path.iterdir()) == []


def test_unknown_setting_suggests_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^scene\.exposures: no such setting; did you mean 'scene\.exposure'"):
        load({"exposures": 0.1}, SceneContext(seed=0, cache_dir=tmp_path))


def test_the_yaml_has_every_setting_and_its_default(tmp_path: Path) -> None:
    assert dict(compose(["scene=room", f"output_dir='{tmp_path}/out'"]).scene) == asdict(RoomSettings())


def test_it_trains(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: Path, cache: Path) -> None:
    out = tmp_path / "out"
    words = ["task=static", "scene=room", f"output_dir='{out}'", *(f"scene.{k}={v}" for k, v in SMALL.items())]
    run(compose([*words, "model.primitives=200", "train.iterations=200", "train.max_seconds=null"]))
    rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["loss"] < 0.8 * rows[0]["loss"] and rows[-1]["psnr"] > rows[0]["psnr"] + 1
    metrics = json.loads((out / "metrics.json").read_text())
    assert (metrics["data_source"], metrics["dataset"]) == ("generated", "room") and np.isfinite(metrics["psnr"])
