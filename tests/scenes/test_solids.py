"""The built-in scene: its geometry, what rays meet, and the data set it becomes."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.cameras import Camera
from neuprim.core.errors import BackendUnavailable, ConfigError, DataError
from neuprim.core.task import SceneContext
from neuprim.scenes import rays
from neuprim.scenes.meshes import ball, chamfered_box, corner_normals, rod
from neuprim.scenes.raycast import Scene
from neuprim.scenes.shapes import Solid, build, plain, srgb
from neuprim.scenes.solids import generate as generator
from neuprim.scenes.solids.generate import SolidsSettings, camera_matrices, generate, picture
from neuprim.scenes.solids.shading import DAYLIGHT, encode_srgb, radiance
from neuprim.tasks.static.generated import load_solids as load

SMALL = {"size": 32, "train_views": 3, "test_views": 2, "supersampling": 2}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(build())


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(autouse=True)
def one_scene(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Building the scene takes a second: once is enough."""
    monkeypatch.setattr(generator, "Scene", lambda solids: scene)
    monkeypatch.setattr(generator, "build", list)
    yield


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(N, 2) pixel coordinates of (N, 3) points."""
    p = torch.tensor(points, dtype=torch.float64) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    image = p @ camera.K.T
    assert (p[:, 2] > 0).all()
    return (image[:, :2] / image[:, 2:]).numpy()


# Geometry
# ------------------------------------------------------------------------------------------------------------------------------


def test_solids_are_closed_outward_and_in_the_box() -> None:
    solids = build()
    assert len({s.name for s in solids}) == len(solids)
    for solid in solids:
        assert solid.mesh.is_watertight and solid.mesh.volume > 0, solid.name
        assert np.abs(solid.mesh.vertices).max() <= 1.0, solid.name
        assert 0.0 <= solid.gloss <= 1.0
        albedo = solid.albedo(solid.mesh.vertices.view(np.ndarray).astype(np.float32))
        assert albedo.shape == solid.mesh.vertices.shape and 0.0 <= albedo.min() and albedo.max() <= 1.0, solid.name


def test_everything_is_in_view_from_every_side() -> None:
    farthest = max(np.linalg.norm(s.mesh.vertices, axis=1).max() for s in build())
    assert farthest < generator.DISTANCE * np.sin(generator.FIELD_OF_VIEW / 2)


def test_normals_are_flat_on_boxes_and_smooth_on_balls() -> None:
    box = chamfered_box([1, 2, 3], [0, 0, 0], 0.1)
    np.testing.assert_allclose(corner_normals(box), np.repeat(box.face_normals[:, None], 3, axis=1), atol=1e-9)
    sphere = ball([0, 0, 0], 2.0)
    np.testing.assert_allclose(corner_normals(sphere), sphere.vertices[sphere.faces] / 2.0, atol=4e-3)


def test_rod_has_round_sides_and_hard_caps() -> None:
    mesh = rod([0, 0, 0], [0, 0, 2], 0.1)
    along = np.abs(corner_normals(mesh)[..., 2])
    assert ((along < 1e-9) | (along > 1 - 1e-9)).all()
    assert mesh.volume == pytest.approx(np.pi * 0.01 * 2, rel=0.02)


# Rays
# ----------------------------------------------------------------------------------------------------------------------------------


def test_rays_meet_a_ball_where_the_equation_says() -> None:
    scene = Scene([Solid("ball", ball([0.1, 0, 0], 0.5), plain("#ff8000"), 0.7)])
    origins = np.array([[3.0, 0.1, 0.2], [3.0, 0.0, 0.9]])
    hits = scene.intersect(origins, np.array([[-2.0, 0, 0], [-1.0, 0, 0]]))
    assert hits.hit.tolist() == [True, False]
    x = 0.1 + np.sqrt(0.25 - 0.05)
    np.testing.assert_allclose(hits.position, [[x, 0.1, 0.2]], atol=2e-3)
    np.testing.assert_allclose(hits.distance, [(3 - x) / 2], atol=2e-3)
    np.testing.assert_allclose(hits.normal, (hits.position - [[0.1, 0, 0]]) / 0.5, atol=5e-3)
    np.testing.assert_allclose(hits.albedo, [srgb("#ff8000")])
    assert hits.gloss.tolist() == [np.float32(0.7)] and hits.solid.tolist() == [0]


def test_occlusion_counts_only_what_is_nearer(scene: Scene) -> None:
    down = np.tile([[0.0, 0.0, -2.0]], (3, 1))
    above = np.tile([[-0.75, -0.75, 1.0]], (3, 1))  # a free corner of the plate, 1.52 below
    assert scene.occluded(above, down, [0.7, 0.759, 0.761]).tolist() == [False, False, True]
    assert scene.occluded(above, down).all()


def test_lifted_points_do_not_shadow_themselves() -> None:
    sphere = Scene([Solid("ball", ball([0, 0, 0], 1.0), plain("#ffffff"), 0.0)])
    d = torch.nn.functional.normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)), dim=1).numpy()
    hits = sphere.intersect(-3 * d, d)
    assert hits.hit.all() and not sphere.occluded(hits.lifted(), hits.face).any()


def test_both_engines_agree(scene: Scene) -> None:
    if scene.engine != "embree":
        pytest.skip("embreex is not installed: there is nothing to compare with")
    solids = [s for s in scene.solids if s.name in ("plate", "body", "grip", "chuck", "wire cube", "banana")]
    scene, other = Scene(solids, "embree"), Scene(solids, "numba")
    targets = scene.surface_points(4000, torch.Generator().manual_seed(1))
    origins = np.tile(np.array([[2.5, -2.0, 1.5]], np.float32), (4000, 1))
    # Half of them from within the scene, where rays pass many boxes, but not from the surface itself.
    origins[::2] = targets[1::2] + np.array([0.012, 0.017, 0.023], np.float32)
    a, b = scene.intersect(origins, targets - origins), other.intersect(origins, targets - origins)
    same = a.hit == b.hit
    assert same.mean() > 0.998  # rays to points on silhouettes may go either way
    both_a, both_b = b.hit[a.hit], a.hit[b.hit]
    close = np.abs(a.distance[both_a] - b.distance[both_b]) < 1e-3
    assert close.mean() > 0.998
    np.testing.assert_allclose(a.normal[both_a][close], b.normal[both_b][close], atol=0.02)
    shadows = scene.occluded(origins, targets - origins, 0.9), other.occluded(origins, targets - origins, 0.9)
    assert (shadows[0] == shadows[1]).mean() > 0.998


def test_asking_for_embree_without_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex.mesh_construction", None)
    solids = [Solid("ball", ball([0, 0, 0], 0.5, fine=False), plain("#ffffff"), 0.0)]
    with pytest.raises(BackendUnavailable, match="pip install embreex"):
        Scene(solids, "embree")
    assert Scene(solids).engine == "numba"


def test_surface_points_lie_on_surfaces_and_repeat(scene: Scene) -> None:
    points = scene.surface_points(3000, torch.Generator().manual_seed(3))
    np.testing.assert_array_equal(points, scene.surface_points(3000, torch.Generator().manual_seed(3)))
    assert len(np.unique(points, axis=0)) == 3000
    alone = Scene([Solid("ball", ball([0, 0, 0], 1.0), plain("#ffffff"), 0.0)])
    sphere = alone.surface_points(5000, torch.Generator().manual_seed(4))
    np.testing.assert_allclose(np.linalg.norm(sphere, axis=1), 1.0, atol=5e-3)
    assert np.abs(sphere.mean(0)).max() < 0.04


# Light
# ---------------------------------------------------------------------------------------------------------------------------------


def test_shadow_takes_the_sun_away() -> None:
    floor = Solid("floor", chamfered_box([2, 2, 0.1], [0, 0, -0.05], 0.01), plain("#808080"), 0.0)
    lamp = np.array(DAYLIGHT.direction) / np.linalg.norm(DAYLIGHT.direction)
    blocker = Solid("blocker", ball(lamp * 0.8, 0.2), plain("#ffffff"), 0.0)
    origins, down = np.array([[0.0, 0, 0.3], [-0.8, 0.8, 0.3]]), np.tile([[0.0, 0, -1]], (2, 1))
    rgb, hit = radiance(Scene([floor, blocker]), origins, down)
    assert hit.all()
    grey = srgb("#808080")
    np.testing.assert_allclose(rgb[0], grey * DAYLIGHT.sky, rtol=1e-5)
    np.testing.assert_allclose(
        rgb[1], grey * (np.array(DAYLIGHT.sky) + np.array(DAYLIGHT.sun) * lamp[2] / np.pi), rtol=1e-5
    )


def test_gloss_makes_colour_depend_on_the_eye() -> None:
    point = np.array([0.2, -0.3, 0.5]) / np.linalg.norm([0.2, -0.3, 0.5]) * 0.4
    eyes = np.array([[0.5, -0.8, 3.0], [0.3, 2.0, 3.0]])
    rays = (point - eyes) / np.linalg.norm(point - eyes, axis=1, keepdims=True)
    matt, polished = (
        radiance(Scene([Solid("ball", ball([0, 0, 0], 0.4), plain("#2040c0"), g)]), eyes, rays)[0] for g in (0.0, 1.0)
    )
    np.testing.assert_allclose(matt[0], matt[1], atol=0.02)
    assert np.abs(polished[0] - polished[1]).max() > 0.05


def test_srgb_decoding_and_encoding_are_inverse() -> None:
    codes = [f"#{v:02x}{255 - v:02x}{v // 2:02x}" for v in range(0, 256, 15)]
    stored = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in codes])
    np.testing.assert_array_equal(np.round(encode_srgb(np.stack([srgb(c) for c in codes])) * 255), stored)


# The data set
# --------------------------------------------------------------------------------------------------------------------------


def test_same_settings_same_bytes(tmp_path: Path, cache: Path) -> None:
    first, second = generate(SolidsSettings(**SMALL), cache), generate(SolidsSettings(**SMALL), tmp_path)
    assert contents(first) == contents(second)
    assert sorted(p.name for p in (first / "train").iterdir()) == ["r_0.png", "r_1.png", "r_2.png"]


def test_layout_and_alpha(cache: Path) -> None:
    folder = generate(SolidsSettings(**SMALL), cache)
    for split, count in (("train", 3), ("test", 2)):
        layout = json.loads((folder / f"transforms_{split}.json").read_text())
        assert layout["camera_angle_x"] == pytest.approx(np.radians(40)) and len(layout["frames"]) == count
        for frame in layout["frames"]:
            image = np.asarray(Image.open(folder / f"{frame['file_path']}.png"))
            assert image.shape == (32, 32, 4)
            alpha = image[..., 3] / 255
            assert 0.1 < alpha.mean() < 0.6
            assert (alpha == 1).mean() > 0.05 and ((alpha > 0) & (alpha < 1)).any()
            assert not alpha[[0, -1]].any() and not alpha[:, [0, -1]].any()
            assert not image[alpha == 0].any()
            assert 40 < image[alpha == 1][:, :3].mean() < 200 and image[alpha == 1][:, :3].std() > 30


def test_pictures_do_not_depend_on_how_rays_are_batched(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    pose = camera_matrices("train", 3)[1]
    whole = picture(scene, pose, 24, 3)
    monkeypatch.setattr(rays, "RAYS_AT_ONCE", 700)
    np.testing.assert_array_equal(picture(scene, pose, 24, 3), whole)


def test_training_and_test_cameras_differ_and_look_at_the_middle() -> None:
    train, test = np.array(camera_matrices("train", 80)), np.array(camera_matrices("test", 20))
    for poses in (train, test):
        np.testing.assert_allclose(np.linalg.norm(poses[:, :3, 3], axis=1), 4.0)
        np.testing.assert_allclose(poses[:, :3, 2], poses[:, :3, 3] / 4, atol=1e-12)  # OpenGL looks along -z
        assert (poses[:, 2, 1] > 0).all()  # the image's up is the world's
    nearest = (test[:, :3, 2] @ train[:, :3, 2].T).max(1)
    assert nearest.max() < np.cos(np.radians(1.0)) and nearest.min() > np.cos(np.radians(15.0))
    assert (train[:, 2, 3] < 0).sum() > 3


def test_silhouette_lies_where_the_loaders_cameras_project_it(scene: Scene, cache: Path) -> None:
    dataset = load({**SMALL, "size": 96}, SceneContext(seed=0, cache_dir=cache))
    vertices = np.concatenate([s.mesh.vertices for s in scene.solids])
    points = scene.surface_points(4000, torch.Generator().manual_seed(0))
    for views in (dataset.train, dataset.test):
        for index in range(len(views)):
            camera, alpha = views.view(index).camera, views.pixels(index).alpha
            assert alpha is not None
            rows, columns = np.nonzero(alpha.numpy())
            corners = project(camera, vertices)
            found = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            np.testing.assert_allclose(found, [*corners.min(0), *corners.max(0)], atol=1.5)
            x, y = np.floor(project(camera, points)).astype(int).T
            assert (alpha.numpy()[y, x] > 0).mean() > 0.99


def test_a_marked_point_has_its_colour_at_its_pixel() -> None:
    spots = {"#ff0000": [0.7, 0, 0], "#00ff00": [0, 0.7, 0], "#0000ff": [0, 0, 0.7]}
    axes = Scene([Solid(code, ball(at, 0.08), plain(code), 0.0) for code, at in spots.items()])
    pose = camera_matrices("test", 5)[2]
    image = picture(axes, pose, 100, 1)
    world_to_camera = np.linalg.inv(pose)
    focal = 50 / np.tan(np.radians(20))
    for channel, at in enumerate(spots.values()):
        x, y, z = world_to_camera[:3, :3] @ at + world_to_camera[:3, 3]
        pixel = image[int(50 - focal * y / -z), int(50 + focal * x / -z)]
        assert pixel[3] == 255 and pixel[:3].argmax() == channel and pixel[channel] > 90, (channel, pixel)


def test_dataset_is_marked_generated(cache: Path) -> None:
    dataset = load(SMALL, SceneContext(seed=5, cache_dir=cache))
    assert (dataset.name, dataset.data_source, dataset.color_space) == ("solids", "generated", "srgb")
    assert (len(dataset.train), len(dataset.test)) == (3, 2)
    assert dataset.center.abs().max() < 0.05 and dataset.up.tolist() == [0.0, 0.0, 1.0]


# The cache
# -----------------------------------------------------------------------------------------------------------------------------


def test_cache_is_reused_and_keyed_by_every_setting(cache: Path) -> None:
    folder = generate(SolidsSettings(**SMALL), cache)
    calls: list[float] = []
    assert generate(SolidsSettings(**SMALL), cache, lambda text, fraction: calls.append(fraction)) == folder
    assert not calls
    keys = {SolidsSettings(**{**SMALL, name: value + 1}).key() for name, value in SMALL.items()}
    assert len(keys | {SolidsSettings(**SMALL).key()}) == 5


def test_generator_version_is_part_of_the_key(monkeypatch: pytest.MonkeyPatch) -> None:
    before = SolidsSettings().key()
    monkeypatch.setattr(generator, "GENERATOR_VERSION", generator.GENERATOR_VERSION + 1)
    assert SolidsSettings().key() != before


def test_interruption_leaves_nothing_behind(tmp_path: Path) -> None:
    def stop(text: str, fraction: float) -> None:
        if fraction > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(SolidsSettings(**SMALL), tmp_path, stop)
    assert list(tmp_path.iterdir()) == []


def test_damaged_cache_is_drawn_again(tmp_path: Path) -> None:
    folder = generate(SolidsSettings(**SMALL), tmp_path)
    complete = contents(folder)
    (folder / "train" / "r_1.png").unlink()
    assert generate(SolidsSettings(**SMALL), tmp_path) == folder
    assert contents(folder) == complete and [p.name for p in tmp_path.iterdir()] == [folder.name]


def test_progress_runs_from_nothing_to_all(tmp_path: Path) -> None:
    calls: list[tuple[str, float]] = []
    generate(SolidsSettings(**SMALL), tmp_path, lambda text, fraction: calls.append((text, fraction)))
    fractions = [fraction for _, fraction in calls]
    assert fractions == sorted(fractions) and fractions[0] == 0.0 and fractions[-1] == 1.0 and len(fractions) == 6
    assert all(text.startswith("solids: ") for text, _ in calls)


def test_unwritable_cache_names_the_place(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DataError, match=r"cannot write the generated images to .*file"):
        generate(SolidsSettings(**SMALL), tmp_path / "file")


def test_unknown_setting_suggests_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"scene\.supersample: no such setting; did you mean 'scene\.supersampling'"):
        load({"supersample": 2}, SceneContext(seed=0, cache_dir=tmp_path))


@pytest.mark.parametrize(
    ("name", "value"),
    [("size", 0), ("size", 7.5), ("size", "big"), ("train_views", True), ("test_views", 0), ("size", None)],
)
def test_impossible_values_are_refused(name: str, value: object, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=rf"scene\.{name}=.*: expected a whole number from [18] to "):
        load({name: value}, SceneContext(seed=0, cache_dir=tmp_path))
    assert list(tmp_path.iterdir()) == []
