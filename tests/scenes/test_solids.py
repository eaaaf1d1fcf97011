"""The built-in solids: their geometry, what rays meet, and the data set."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from neuprim.core.cameras import Camera
from neuprim.core.task import SceneContext
from neuprim.scenes import solids as generator
from neuprim.scenes.raycast import Scene
from neuprim.scenes.shading import DAYLIGHT, scene_daylight_radiance
from neuprim.scenes.shapes import Solid, ball, build_solids, chamfered_box, parse_solid_srgb, uniform_colour
from neuprim.scenes.solids import SolidsSettings, generate_solids
from neuprim.tasks.static.datasets import load_solids_dataset

SMALL = {"size": 32, "train_views": 3, "test_views": 2, "supersampling": 2}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(build_solids())


@pytest.fixture(autouse=True)
def one_scene(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Building the scene takes a second: once is enough."""
    monkeypatch.setattr(generator, "Scene", lambda solids: scene)
    monkeypatch.setattr(generator, "build_solids", list)
    yield


def surface_points(scene: Scene, count: int) -> np.ndarray:
    """(count, 3) points spread evenly over all surfaces."""
    whole = trimesh.util.concatenate([solid.mesh for solid in scene.solids])
    return trimesh.sample.sample_surface(whole, count, seed=0)[0].astype(np.float32)


def project(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(N, 2) pixel coordinates of (N, 3) points."""
    p = torch.tensor(points, dtype=torch.float64) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    image = p @ camera.K.T
    assert (p[:, 2] > 0).all()
    return (image[:, :2] / image[:, 2:]).numpy()


def test_solids_are_closed_outward_and_in_the_box(scene: Scene) -> None:
    assert len({s.name for s in scene.solids}) == len(scene.solids)
    for solid in scene.solids:
        assert solid.mesh.is_watertight and solid.mesh.volume > 0 and 0 <= solid.gloss <= 1, solid.name
        assert np.abs(solid.mesh.vertices).max() <= 1.0, solid.name
        albedo = solid.albedo(solid.mesh.vertices.view(np.ndarray).astype(np.float32))
        assert albedo.shape == solid.mesh.vertices.shape and 0.0 <= albedo.min() and albedo.max() <= 1.0, solid.name


def test_rays_meet_a_ball_where_the_equation_says() -> None:
    scene = Scene([Solid("ball", ball([0.1, 0, 0], 0.5), uniform_colour("#ff8000"), 0.7)])
    origins = np.array([[3.0, 0.1, 0.2], [3.0, 0.0, 0.9]])
    hits = scene.intersect(origins, np.array([[-2.0, 0, 0], [-1.0, 0, 0]]))
    assert hits.hit.tolist() == [True, False]
    x = 0.1 + np.sqrt(0.25 - 0.05)
    np.testing.assert_allclose(hits.position, [[x, 0.1, 0.2]], atol=2e-3)
    np.testing.assert_allclose(hits.distance, [(3 - x) / 2], atol=2e-3)
    np.testing.assert_allclose(hits.normal, (hits.position - [[0.1, 0, 0]]) / 0.5, atol=5e-3)
    np.testing.assert_allclose(hits.albedo, [parse_solid_srgb("#ff8000")])
    assert hits.gloss.tolist() == [np.float32(0.7)] and hits.solid.tolist() == [0]


def test_both_engines_agree(scene: Scene) -> None:
    if scene.engine != "embree":
        pytest.skip("embreex is not installed: there is nothing to compare with")
    solids = [s for s in scene.solids if s.name in ("plate", "body", "grip", "chuck", "wire cube", "banana")]
    scene, other = Scene(solids, "embree"), Scene(solids, "numba")
    targets = surface_points(scene, 4000)
    origins = np.tile(np.array([[2.5, -2.0, 1.5]], np.float32), (4000, 1))
    # Half of them from within the scene, where rays pass many boxes, but not from the surface itself.
    origins[::2] = targets[1::2] + np.array([0.012, 0.017, 0.023], np.float32)
    a, b = scene.intersect(origins, targets - origins), other.intersect(origins, targets - origins)
    assert (a.hit == b.hit).mean() > 0.998  # rays to points on silhouettes may go either way
    both_a, both_b = b.hit[a.hit], a.hit[b.hit]
    close = np.abs(a.distance[both_a] - b.distance[both_b]) < 1e-3
    assert close.mean() > 0.998
    np.testing.assert_allclose(a.normal[both_a][close], b.normal[both_b][close], atol=0.02)
    shadows = scene.occluded(origins, targets - origins, 0.9), other.occluded(origins, targets - origins, 0.9)
    assert (shadows[0] == shadows[1]).mean() > 0.998


def test_shadow_takes_the_sun_away() -> None:
    floor = Solid("floor", chamfered_box([2, 2, 0.1], [0, 0, -0.05], 0.01), uniform_colour("#808080"), 0.0)
    sun = np.array(DAYLIGHT.direction) / np.linalg.norm(DAYLIGHT.direction)
    blocker = Solid("blocker", ball(sun * 0.8, 0.2), uniform_colour("#ffffff"), 0.0)
    origins, down = np.array([[0.0, 0, 0.3], [-0.8, 0.8, 0.3]]), np.tile([[0.0, 0, -1]], (2, 1))
    rgb, hit = scene_daylight_radiance(Scene([floor, blocker]), origins, down)
    assert hit.all()
    grey, sky = parse_solid_srgb("#808080"), np.array(DAYLIGHT.sky)
    np.testing.assert_allclose(rgb[0], grey * sky, rtol=1e-5)
    np.testing.assert_allclose(rgb[1], grey * (sky + np.array(DAYLIGHT.sun) * sun[2] / np.pi), rtol=1e-5)


def test_silhouette_lies_where_the_loaders_cameras_project_it(scene: Scene, tmp_path: Path) -> None:
    dataset = load_solids_dataset({**SMALL, "size": 96}, SceneContext(seed=0, cache_dir=tmp_path))
    vertices, points = np.concatenate([s.mesh.vertices for s in scene.solids]), surface_points(scene, 4000)
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


def test_layout_and_alpha(tmp_path: Path) -> None:
    folder = generate_solids(SolidsSettings(**SMALL), tmp_path)
    for split, count in (("train", 3), ("test", 2)):
        layout = json.loads((folder / f"transforms_{split}.json").read_text())
        assert layout["camera_angle_x"] == pytest.approx(np.radians(40)) and len(layout["frames"]) == count
        for frame in layout["frames"]:
            image = np.asarray(Image.open(folder / f"{frame['file_path']}.png"))
            alpha = image[..., 3] / 255
            assert image.shape == (32, 32, 4) and 0.1 < alpha.mean() < 0.6
            assert (alpha == 1).mean() > 0.05 and ((alpha > 0) & (alpha < 1)).any()
            assert not alpha[[0, -1]].any() and not alpha[:, [0, -1]].any() and not image[alpha == 0].any()
            assert 40 < image[alpha == 1][:, :3].mean() < 200 and image[alpha == 1][:, :3].std() > 30
