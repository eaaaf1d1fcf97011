"""What a viewer shows: images of every quantity, ellipsoids, held-out views, and its queue."""

from __future__ import annotations

import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.channels import Channels
from neuprim.core.data import View
from neuprim.core.errors import ConfigError
from neuprim.core.io.images import to_uint8
from neuprim.core.metrics import psnr
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.runs.measure import render_image
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.static import TASK as STATIC
from neuprim.tasks.static import SphericalHarmonics
from neuprim.viewer.session import RenderQueue, ViewerPose, fit_viewer_size, next_resolution
from neuprim.viewer.viewer_scene import (
    ALPHA,
    COLOUR,
    DEPTH,
    ViewerScene,
    Viewpoint,
    describe_viewer_primitive,
    list_viewer_ellipsoids,
    list_viewer_quantities,
    open_viewer_scene,
    pick_primitive,
)
from tests.core import tiny
from tests.page_models import camera_at, random_model
from tests.pretend_card import CARD, pretended
from tests.short_runs import fit, words

SETTINGS = RenderSettings(backend="reference")
RGB = Channels(("R", "G", "B"), "srgb", None, "static")
WHITE = torch.ones(3)


def scene_of(model: Primitives, settings: RenderSettings = SETTINGS) -> ViewerScene:
    return ViewerScene("it", STATIC, lambda: model, RGB, settings, WHITE, (0.0, 0.0, 1.0), np.zeros(3))


@pytest.fixture(scope="module")
def model() -> Primitives:
    return random_model(CosineDensity(2, edge=2), SphericalHarmonics(1), count=30)


def view_at(shows: str = COLOUR) -> Viewpoint:
    return Viewpoint(camera_at((0.3, -3.0, 1.0), (40, 30), 44.0), {}, shows)


def test_colour_alpha_depth_and_single_channels(model: Primitives) -> None:
    scene = scene_of(model)
    assert list_viewer_quantities(RGB) == [COLOUR, ALPHA, DEPTH, "channel R", "channel G", "channel B"]
    colour = scene.draw(view_at(), SETTINGS)
    expected = to_uint8(RGB.display(render_image(model, View("", view_at().camera), SETTINGS, WHITE))).numpy()
    assert colour.image.shape == (30, 40, 3) and colour.image.std() > 10 and colour.seconds > 0
    assert np.array_equal(colour.image, expected) and colour.caption == ""
    alpha = scene.draw(view_at(ALPHA), SETTINGS).image
    assert (alpha[..., 0] == alpha[..., 2]).all() and alpha.max() > 200 and alpha[0, 0].max() == 0
    depth = scene.draw(view_at(DEPTH), SETTINGS)
    assert depth.image[0, 0].tolist() == [0, 0, 0] and len(np.unique(depth.image.reshape(-1, 3), axis=0)) > 20
    near, far = (float(word) for word in depth.caption.split() if word[0].isdigit())
    assert 1.0 < near < far < 6.0
    away = replace(view_at(DEPTH), camera=replace(view_at().camera, cx=4000.0))
    assert scene.draw(away, SETTINGS).caption == "nothing is in sight"
    red = scene.draw(view_at("channel R"), SETTINGS)
    assert np.array_equal(red.image[..., 0], colour.image[..., 0]) and "R, 0 is black" in red.caption


def test_a_picture_of_too_many_rays_is_refused(model: Primitives) -> None:
    look = replace(view_at(), camera=view_at().camera.resized(2048, 1536))
    with pytest.raises(ConfigError, match=r"2048 x 1536 pixels with renderer.samples=16 need more than 67,108,864"):
        scene_of(model).draw(look, replace(SETTINGS, samples=16))


def test_the_resolution_of_a_moving_picture_follows_its_time() -> None:
    found = [1 / 16]
    for seconds in (0.001, 0.004, 0.03, 0.01, 0.002, 0.002, 0.002, 0.2, 0.06):
        found.append(next_resolution(found[-1], seconds))
    assert found == [1 / 16, 1 / 8, 1 / 4, 1 / 4, 1 / 2, 1, 1, 1, 1 / 2, 1 / 4]
    assert next_resolution(1 / 16, 1.0) == 1 / 16


def never(error: Exception) -> None:
    raise AssertionError(error)


def test_a_newer_job_takes_the_place_of_an_older_one() -> None:
    queue, done = RenderQueue(), list[str]()
    assert not queue.pending and not queue.work(0.0)
    for i in range(5):
        queue.submit(("me", "picture"), lambda i=i: done.append(f"picture {i}"), never)  # type: ignore[misc]
    queue.submit(("you", "picture"), lambda: done.append("yours"), never)
    queue.submit(("me", "picture"), lambda: done.append("late"), never, replace=False)
    assert queue.pending
    while queue.work(0.0):
        pass
    assert done == ["picture 4", "yours"]


def test_jobs_wait_until_they_are_due_and_are_forgotten_with_their_owner() -> None:
    queue, done = RenderQueue(), list[float]()
    start = time.monotonic()
    queue.submit(("me", "full"), lambda: done.append(time.monotonic() - start), never, delay=0.15)
    assert not queue.work(0.0) and queue.work(2.0) and 0.15 <= done[0] < 1.5
    queue.submit(("me", "full"), lambda: done.append(0.0), never)
    queue.drop_client("me")
    assert not queue.work(0.0) and len(done) == 1


def test_a_waiting_worker_hears_of_new_work_and_faults_are_told() -> None:
    queue, faults = RenderQueue(), list[Exception]()

    def broken() -> None:
        raise ValueError("broken")

    timer = threading.Timer(0.1, lambda: queue.submit(("me", "x"), broken, faults.append))
    timer.start()
    start = time.monotonic()
    assert queue.work(20.0) and time.monotonic() - start < 10 and str(faults[0]) == "broken"
    timer.join()


def test_a_pose_is_its_camera_in_any_window() -> None:
    camera = camera_at((1.3, -3.0, 1.0))
    same = ViewerPose.from_camera(camera).to_camera(camera.width, camera.height)
    assert torch.allclose(same.viewmat, camera.viewmat.double(), atol=1e-6) and same.fy == pytest.approx(camera.fy)
    wide = ViewerPose.from_camera(camera).to_camera(2 * camera.width, camera.height)
    assert wide.fx == wide.fy == pytest.approx(camera.fy) and wide.cx == camera.width
    for size, expected in (
        ((1280, 800), (960, 600)),
        ((400, 800), (400, 800)),
        ((1, 5000), (1, 960)),
        ((0, 0), (1, 1)),
    ):
        assert fit_viewer_size(size, 960) == expected


def weights(model: Primitives, look: Viewpoint, x: float, y: float) -> torch.Tensor:
    """(N,) what each primitive contributes to the image at a place of it: an image of as many channels as there are
    primitives, each of which is white in its own."""
    camera, count = look.camera, model.count
    one = type(camera)(camera.viewmat, camera.fx, camera.fy, camera.cx - x + 0.5, camera.cy - y + 0.5, 1, 1)
    own = {name: value for name, value in model.params.items() if name not in model.of(model.colour)}
    lit = (torch.eye(count) - 0.5) / 0.28209479177387814
    white = Primitives(model.density, SphericalHarmonics(0, count), {**own, "sh_dc": lit})
    with torch.no_grad():
        return render(white, one, look.conditions, SETTINGS).rgb[0, 0]


@pytest.mark.parametrize("timed", [False, True])
def test_the_primitive_under_the_mouse_is_the_one_that_contributes_most(timed: bool) -> None:
    fields = (
        (TimeDensity(2, "window+motion", edge=2), TimeHarmonics(1))
        if timed
        else (CosineDensity(2, edge=2), SphericalHarmonics(1))
    )
    model = random_model(*fields, count=60, seed=2)
    look = Viewpoint(camera_at((0.3, -3.0, 1.0)), {"time": torch.tensor(0.3)} if timed else {})
    camera, found = look.camera, []
    for x, y in [(20.5, 18.5), (35.5, 28.5), (40.5, 30.5), (52.5, 33.5), (36.5, 20.5), (1.5, 1.5)]:
        ray = torch.tensor([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0], dtype=torch.float64)
        expected = weights(model, look, x, y)
        row = pick_primitive(model, look, 3.0 * (camera.viewmat[:3, :3].T @ ray).numpy(), SETTINGS)
        assert row == (int(expected.argmax()) if float(expected.max()) > 0 else None)
        found.append(row)
    assert len(set(found)) > 3 and None in found


def test_ellipsoids_are_where_the_frame_has_them() -> None:
    model = random_model(TimeDensity(2, "window+motion", edge=2), TimeHarmonics(1), count=40)
    look = Viewpoint(camera_at((0.3, -3.0, 1.0)), {"time": torch.tensor(0.3)})
    active = model.active(look.conditions)
    every = list_viewer_ellipsoids(model, look, RGB, 1000)
    assert np.array_equal(every.rows, active.rows.numpy()) and 0 < len(every.rows) < 40  # type: ignore[union-attr]
    assert np.allclose(every.positions, active.geometry.means) and np.allclose(every.scales, active.geometry.scales)
    assert np.allclose(np.linalg.norm(every.wxyz, axis=1), 1, atol=1e-6)
    assert every.colours.dtype == np.uint8 and every.colours.std() > 5
    few = list_viewer_ellipsoids(model, look, RGB, 5)
    assert len(few.rows) == 5 and set(few.rows) < set(every.rows)
    one = list_viewer_ellipsoids(model, look, RGB, 1, int(every.rows[3]))
    assert len(one.rows) == 1 and np.array_equal(one.positions[0], every.positions[3])
    gone = next(i for i in range(40) if i not in every.rows)
    assert len(list_viewer_ellipsoids(model, look, RGB, 1, gone).rows) == 0


def test_parameters_in_words() -> None:
    model = random_model(CosineDensity(2, edge=2), SphericalHarmonics(3), count=3)
    lines = describe_viewer_primitive(model, 1).splitlines()
    assert lines[0] == "primitive 1 of 3" and lines[1].startswith("semi-axes ")
    assert [line.partition(":")[0] for line in lines[2:]] == list(model.params)
    assert any(line.endswith("(45 numbers)") for line in lines)
    assert f"means: {' '.join(f'{x:.4g}' for x in model.params['means'][1].tolist())}" in lines
    with pytest.raises(ConfigError, match="primitive 3: the model has 3 primitives, 0 to 2"):
        describe_viewer_primitive(model, 3)


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 4)
        return fit(words(tiny.write_blender(folder / "two"), folder / "run", 60))


def quiet(*args: object) -> None:
    pass


def test_a_run_with_its_data(run_dir: Path) -> None:
    scene = open_viewer_scene(run_dir, quiet, quiet)
    names = list(scene.view_indices)
    assert scene.dataset is not None and len(names) == len(scene.dataset.test) and scene.start_view.name in names
    assert np.allclose(scene.center, scene.dataset.center) and scene.up == tuple(scene.dataset.up.tolist())
    found_truth, found_drawn, found_psnr = scene.compare_view(names[1])
    view, background = scene.load_view(names[1]), scene.dataset.background
    truth = scene.dataset.test.pixels(1).over(background)
    drawn = render_image(scene.model(), view, scene.settings, background)
    assert found_psnr == psnr(drawn, truth) > 10
    assert np.array_equal(found_truth, to_uint8(truth).numpy()) and np.array_equal(found_drawn, to_uint8(drawn).numpy())


def test_a_run_whose_data_are_gone_is_shown_without_held_out_views(run_dir: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run_dir, copy)
    config = (copy / "config.yaml").read_text()
    (copy / "config.yaml").write_text(config.replace(str(run_dir.parent / "two"), str(tmp_path / "gone")))
    told: list[str] = []
    scene = open_viewer_scene(copy, told.append, quiet)
    assert scene.dataset is None and scene.view_indices == {} and len(told) == 1 and "no held-out views: " in told[0]
    start = scene.start_view
    image = scene.draw(Viewpoint(start.camera.resized(96, 54), start.conditions), scene.settings).image
    assert image.std() > 10, "the model is in the picture"
    middle = image[18:36, 32:64].astype(float)
    assert np.abs(middle - image[0, 0]).mean() > np.abs(image.astype(float) - image[0, 0]).mean(), "and in its middle"


def test_a_model_on_a_card_is_drawn_and_asked_like_any(monkeypatch: pytest.MonkeyPatch) -> None:
    model = random_model(CosineDensity(2, edge=2), SphericalHarmonics(1), count=40)
    settings, look = RenderSettings(), Viewpoint(camera_at((0.3, -3.0, 1.0)), {}, DEPTH)
    direction = look.camera.viewmat[2, :3].numpy()

    def asked() -> tuple[np.ndarray, np.ndarray, int | None]:
        scene = scene_of(model, settings)
        assert scene.start_view.camera.viewmat.isfinite().all()
        rows = list_viewer_ellipsoids(model, look, RGB, 5).rows
        return scene.draw(look, settings).image, rows, pick_primitive(model, look, direction, settings)

    expected = asked()
    with pretended(monkeypatch):
        model = model.to(CARD)
        assert model.device == CARD
        found = asked()
    assert np.array_equal(found[0], expected[0]) and np.array_equal(found[1], expected[1])
    assert found[2] == expected[2] is not None
