"""What a viewer shows: images of every quantity at the right quality, ellipsoids, held-out views, and its queue."""

from __future__ import annotations

import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.cameras import Camera
from neuprim.core.channels import Channels
from neuprim.core.checkpoint import save_model
from neuprim.core.data import View
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.images import to_uint8
from neuprim.core.metrics import psnr
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.runs.measure import render_image
from neuprim.runs.open import load_run
from neuprim.runs.render_config import RenderConfig, parse_run_rendering
from neuprim.search.tradeoff_record import TradeoffPoint, TradeoffRecord
from neuprim.tasks.dynamic.time_colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.static import TASK as STATIC
from neuprim.tasks.static import SphericalHarmonics
from neuprim.viewer.controls import (
    describe_viewer_primitive,
    list_viewer_ellipsoids,
    make_viewer_ellipsoid,
    pick_primitive,
)
from neuprim.viewer.quality import QualityLadder, QualityLevel, read_viewer_front
from neuprim.viewer.render_queue import RenderQueue
from neuprim.viewer.session import ViewerPose, fit_viewer_size
from neuprim.viewer.view import open_viewer_scene
from neuprim.viewer.viewer_scene import (
    ALPHA,
    COLOUR,
    DEPTH,
    ViewerScene,
    Viewpoint,
    draw_viewer_picture,
    list_viewer_quantities,
)
from tests.core import tiny
from tests.page_models import camera_at, random_model
from tests.pretend_card import CARD, pretended
from tests.short_runs import fit, words

SETTINGS = RenderSettings(backend="reference")
RGB = Channels(("R", "G", "B"), "srgb", None, "static")
WHITE = torch.ones(3)


@pytest.fixture(scope="module")
def model() -> Primitives:
    return random_model(CosineDensity(2, edge=2), SphericalHarmonics(1), count=30)


def view_at(shows: str = COLOUR) -> Viewpoint:
    return Viewpoint(camera_at((0.3, -3.0, 1.0), (40, 30), 44.0), {}, shows)


def test_colour_is_what_a_render_draws(model: Primitives) -> None:
    picture = draw_viewer_picture(model, view_at(), RenderConfig(SETTINGS), WHITE, RGB)
    expected = to_uint8(RGB.display(render_image(model, View("", view_at().camera), SETTINGS, WHITE))).numpy()
    assert picture.image.shape == (30, 40, 3) and picture.image.std() > 10 and picture.seconds > 0
    assert np.array_equal(picture.image, expected) and picture.caption == ""


def test_alpha_depth_and_single_channels(model: Primitives) -> None:
    assert list_viewer_quantities(RGB) == [COLOUR, ALPHA, DEPTH, "channel R", "channel G", "channel B"]
    point = RenderConfig(SETTINGS)
    alpha = draw_viewer_picture(model, view_at(ALPHA), point, WHITE, RGB).image
    assert (alpha[..., 0] == alpha[..., 2]).all() and alpha.max() > 200 and alpha[0, 0].max() == 0
    depth = draw_viewer_picture(model, view_at(DEPTH), point, WHITE, RGB)
    assert depth.image[0, 0].tolist() == [0, 0, 0] and len(np.unique(depth.image.reshape(-1, 3), axis=0)) > 20
    near, far = (float(word) for word in depth.caption.split() if word[0].isdigit())
    assert 1.0 < near < far < 6.0
    away = replace(view_at(DEPTH), camera=camera_at((300.0, -3.0, 1.0), (8, 8), 4000.0).resized(4, 4))
    away = replace(away, camera=replace(away.camera, cx=4000.0))
    assert draw_viewer_picture(model, away, point, WHITE, RGB).caption == "nothing is in sight"
    red = draw_viewer_picture(model, view_at("channel R"), point, WHITE, RGB)
    colour = draw_viewer_picture(model, view_at(), point, WHITE, RGB).image
    assert np.array_equal(red.image[..., 0], colour[..., 0]) and "R, 0 is black" in red.caption


def test_lower_resolution_is_sent_as_it_was_drawn(model: Primitives) -> None:
    assert draw_viewer_picture(model, view_at(), RenderConfig(SETTINGS, resolution=0.25), WHITE, RGB).image.shape == (
        8,
        10,
        3,
    )


def test_a_picture_of_too_many_rays_is_refused(model: Primitives) -> None:
    look = replace(view_at(), camera=view_at().camera.resized(2048, 1536))
    with pytest.raises(
        ConfigError, match=r"2048 x 1536 pixels with renderer.samples=16 take more than 67,108,864 rays"
    ):
        draw_viewer_picture(model, look, RenderConfig(replace(SETTINGS, samples=16)), WHITE, RGB)


def test_levels_without_a_front_are_resolutions(model: Primitives) -> None:
    levels = QualityLadder.build(model, SETTINGS, ())
    assert [level.config.resolution for level in levels.levels] == [1.0, 0.5, 0.25, 0.125, 0.0625]
    assert levels.best_within(1e9, 100) is levels.levels[-1], "nothing is known of how long a picture takes"
    levels.add_timing(levels.levels[-1], 0.001, 1000)
    assert levels.expected_seconds(levels.full, 1000) == pytest.approx(0.256)
    assert levels.best_within(0.05, 1000) is levels.levels[2] and levels.best_within(0.3, 1000) is levels.full
    assert levels.best_within(0.05, 100_000) is levels.levels[-1], "the cheapest, where none is fast enough"
    levels.add_timing(levels.full, 0.04, 1000)
    assert levels.best_within(0.05, 1000) is levels.full, "its own pace counts where it is known"
    levels.add_timing(levels.levels[-1], 0.03, 1000)
    levels.full.pace = 0.08 / 1000
    assert levels.best_within(0.05, 1000) is levels.levels[1], (
        "a slow start of every picture does not rule out what lies between"
    )


def test_levels_are_the_front_that_was_measured(model: Primitives, tmp_path: Path) -> None:
    points = [
        TradeoffPoint("reference", (), {"psnr": 30.0}, 1, ms=[10.0], ratios=[1.0]),
        TradeoffPoint("combined", ("renderer.alpha_min=0.05",), {"psnr": 29.0}, 1, ms=[5.0], ratios=[0.5]),
        TradeoffPoint("combined", ("resolution=0.5", "density.neurons=1"), {"psnr": 28.0}, 1, ms=[2.0], ratios=[0.2]),
        TradeoffPoint("combined", ("density.neurons=7",), {"psnr": 27.0}, 1, ms=[1.0], ratios=[0.1]),
    ]
    assert read_viewer_front(tmp_path) == ()
    (tmp_path / "tradeoff").mkdir()
    TradeoffRecord({}, points=points, speed=[0, 1, 2, 3]).write(tmp_path / "tradeoff" / "tradeoff.json")
    front = read_viewer_front(tmp_path)
    assert [ratio for _, ratio in front] == [0.5, 0.2, 0.1]
    told: list[str] = []
    levels = QualityLadder.build(model, SETTINGS, front, told.append)
    assert [level.ratio for level in levels.levels[:3]] == [1.0, 0.5, 0.2] and levels.levels[
        1
    ].config.settings.alpha_min == 0.05
    assert levels.levels[3].config.resolution == 0.25 and levels.levels[3].config.reduced == {("density", "neurons"): 1}
    assert len(told) == 1 and "density.neurons=7" in told[0], (
        "a point that does not fit this model is left out and told"
    )
    (tmp_path / "tradeoff" / "tradeoff.json").write_text("{")
    assert read_viewer_front(tmp_path, told.append) == () and "tradeoff.json" in told[-1]


def test_words_over_the_settings_are_the_full_picture(model: Primitives) -> None:
    levels = QualityLadder.build(model, SETTINGS, (), overrides=("resolution=0.5", "renderer.samples=2"))
    assert levels.full == QualityLevel(
        parse_run_rendering(["resolution=0.5", "renderer.samples=2"], SETTINGS, model), 1.0
    )
    with pytest.raises(ConfigError, match="no setting of rendering"):
        QualityLadder.build(model, SETTINGS, (), overrides=("resolutoin=0.5",))


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
    assert isinstance(wide, Camera) and wide.fx == wide.fy == pytest.approx(camera.fy) and wide.cx == camera.width
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
    assert (
        np.allclose(np.linalg.norm(every.wxyz, axis=1), 1, atol=1e-6)
        and every.colours.dtype == np.uint8
        and every.colours.std() > 5
    )
    few = list_viewer_ellipsoids(model, look, RGB, 5)
    assert len(few.rows) == 5 and set(few.rows) < set(every.rows)
    one = make_viewer_ellipsoid(model, look, int(every.rows[3]))
    assert one is not None and np.array_equal(one.positions[0], every.positions[3])
    gone = next(i for i in range(40) if i not in every.rows)
    assert make_viewer_ellipsoid(model, look, gone) is None
    with pytest.raises(ConfigError, match="primitive 40: the model has 40 primitives, 0 to 39"):
        make_viewer_ellipsoid(model, look, 40)


def test_parameters_in_words() -> None:
    model = random_model(CosineDensity(2, edge=2), SphericalHarmonics(3), count=3)
    lines = describe_viewer_primitive(model, 1).splitlines()
    assert lines[0] == "primitive 1 of 3" and lines[1].startswith("semi-axes ")
    assert [line.partition(":")[0] for line in lines[2:]] == list(model.params)
    assert any(line.endswith("(45 numbers)") for line in lines)
    assert f"means: {' '.join(f'{x:.4g}' for x in model.params['means'][1].tolist())}" in lines


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 4)
        return fit(words(tiny.write_blender(folder / "two"), folder / "run", 60))


def test_a_run_with_its_data(run_dir: Path) -> None:
    scene = open_viewer_scene(run_dir)
    names = scene.list_views()
    assert scene.dataset is not None and len(names) == len(scene.dataset.test) and scene.start_view().name in names
    assert np.allclose(scene.center, scene.dataset.center) and scene.up == tuple(scene.dataset.up.tolist())
    found = scene.compare_view(names[1])
    view, background = scene.load_view(names[1]), scene.dataset.background
    truth = scene.dataset.test.pixels(1).over(background)
    drawn = render_image(scene.model(), view, scene.settings, background)
    assert found.psnr == psnr(drawn, truth) > 10
    assert np.array_equal(found.truth, to_uint8(truth).numpy()) and np.array_equal(found.drawn, to_uint8(drawn).numpy())
    few = parse_run_rendering(["density.neurons=1"], scene.settings, scene.model())
    look = Viewpoint(view.camera, view.conditions)
    assert not np.array_equal(scene.draw(look, few).image, scene.draw(look, RenderConfig(scene.settings)).image)


def test_a_run_whose_data_are_gone_is_shown_without_held_out_views(run_dir: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run_dir, copy)
    config = (copy / "config.yaml").read_text()
    (copy / "config.yaml").write_text(config.replace(str(run_dir.parent / "two"), str(tmp_path / "gone")))
    told: list[str] = []
    scene = open_viewer_scene(copy, told.append)
    assert scene.dataset is None and scene.list_views() == [] and len(told) == 1 and "no held-out views: " in told[0]
    start = scene.start_view()
    image = scene.draw(Viewpoint(start.camera.resized(96, 54), start.conditions), RenderConfig(scene.settings)).image
    assert image.std() > 10, "the model is in the picture"
    middle = image[18:36, 32:64].astype(float)
    assert np.abs(middle - image[0, 0]).mean() > np.abs(image.astype(float) - image[0, 0]).mean(), "and in its middle"


def test_a_damaged_header_is_named(run_dir: Path, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(run_dir, copy)
    stored = load_run(copy)
    model, header = stored.model, stored.header
    more = {k: v for k, v in header.items() if k in ("background", "color_space", "channels", "data_source")}
    save_model(copy / "model.safetensors", model, "static", {**more, "data": {"up": [0, "x", 1], "center": [0, 0, 0]}})
    with pytest.raises(DataError, match=r"the model's header: data: up\[1\] is .*expected a finite number"):
        open_viewer_scene(copy)


def test_a_model_on_a_card_is_drawn_and_asked_like_any(monkeypatch: pytest.MonkeyPatch) -> None:
    model = random_model(CosineDensity(2, edge=2), SphericalHarmonics(1), count=40)
    settings, look = RenderSettings(), Viewpoint(camera_at((0.3, -3.0, 1.0)), {}, DEPTH)
    direction = look.camera.viewmat[2, :3].numpy()

    def asked() -> tuple[np.ndarray, np.ndarray, int | None]:
        channels = Channels(("R", "G", "B"), "srgb", None, "static")
        scene = ViewerScene(
            "it", STATIC, lambda: model, channels, settings, torch.ones(3), (0.0, 0.0, 1.0), np.zeros(3)
        )
        start = scene.start_view()
        assert start.camera.viewmat.isfinite().all()
        picture = scene.draw(look, RenderConfig(settings)).image
        return (
            picture,
            list_viewer_ellipsoids(model, look, channels, 5).rows,
            pick_primitive(model, look, direction, settings),
        )

    expected = asked()
    with pretended(monkeypatch):
        model = model.to(CARD)
        assert model.device == CARD
        found = asked()
    assert (
        np.array_equal(found[0], expected[0])
        and np.array_equal(found[1], expected[1])
        and found[2] == expected[2] is not None
    )
