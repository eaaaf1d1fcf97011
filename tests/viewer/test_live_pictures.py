"""What a page is sent: pictures of every quantity, at the level that there is time for, asked for one at a time."""

from __future__ import annotations

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
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.runs.measure import draw
from neuprim.runs.render_config import RenderConfig, parse_render_config
from neuprim.search.tradeoff.record import Measured, Record
from neuprim.tasks.static.fields import SphericalHarmonics
from neuprim.viewer.desk import Desk
from neuprim.viewer.frame import ALPHA, COLOUR, DEPTH, Look, draw_look, quantities
from neuprim.viewer.levels import Front, Level, Levels, read_front
from tests.page_models import camera_at, random_model

SETTINGS = RenderSettings(backend="reference")
RGB = Channels(("R", "G", "B"), "srgb", None, "static")
WHITE = torch.ones(3)


@pytest.fixture(scope="module")
def model() -> Primitives:
    return random_model(CosineDensity(2, edge=2), SphericalHarmonics(1), count=30)


def look_at(shows: str = COLOUR) -> Look:
    return Look(camera_at((0.3, -3.0, 1.0), (40, 30), 44.0), {}, shows)


def test_colour_is_what_a_render_draws(model: Primitives) -> None:
    picture = draw_look(model, look_at(), RenderConfig(SETTINGS), WHITE, RGB)
    expected = to_uint8(RGB.display(draw(model, View("", look_at().camera), SETTINGS, WHITE))).numpy()
    assert picture.image.shape == (30, 40, 3) and picture.image.std() > 10 and picture.seconds > 0
    assert np.array_equal(picture.image, expected) and picture.caption == ""


def test_alpha_depth_and_single_channels(model: Primitives) -> None:
    assert quantities(RGB) == [COLOUR, ALPHA, DEPTH, "channel R", "channel G", "channel B"]
    point = RenderConfig(SETTINGS)
    alpha = draw_look(model, look_at(ALPHA), point, WHITE, RGB).image
    assert (alpha[..., 0] == alpha[..., 2]).all() and alpha.max() > 200 and alpha[0, 0].max() == 0
    depth = draw_look(model, look_at(DEPTH), point, WHITE, RGB)
    assert depth.image[0, 0].tolist() == [0, 0, 0] and len(np.unique(depth.image.reshape(-1, 3), axis=0)) > 20
    near, far = (float(word) for word in depth.caption.split() if word[0].isdigit())
    assert 1.0 < near < far < 6.0
    away = replace(look_at(DEPTH), camera=camera_at((300.0, -3.0, 1.0), (8, 8), 4000.0).resized(4, 4))
    away = replace(away, camera=replace(away.camera, cx=4000.0))
    assert draw_look(model, away, point, WHITE, RGB).caption == "nothing is in sight"
    red = draw_look(model, look_at("channel R"), point, WHITE, RGB)
    colour = draw_look(model, look_at(), point, WHITE, RGB).image
    assert np.array_equal(red.image[..., 0], colour[..., 0]) and "R, 0 is black" in red.caption


def test_lower_resolution_is_sent_as_it_was_drawn(model: Primitives) -> None:
    assert draw_look(model, look_at(), RenderConfig(SETTINGS, resolution=0.25), WHITE, RGB).image.shape == (8, 10, 3)


def test_a_picture_of_too_many_rays_is_refused(model: Primitives) -> None:
    look = replace(look_at(), camera=look_at().camera.resized(2048, 1536))
    with pytest.raises(
        ConfigError, match=r"2048 x 1536 pixels with renderer.samples=16 take more than 67,108,864 rays"
    ):
        draw_look(model, look, RenderConfig(replace(SETTINGS, samples=16)), WHITE, RGB)


def test_levels_without_a_front_are_resolutions(model: Primitives) -> None:
    levels = Levels.of(model, SETTINGS, Front())
    assert [level.point.resolution for level in levels.all] == [1.0, 0.5, 0.25, 0.125, 0.0625]
    assert levels.within(1e9, 100) is levels.all[-1], "nothing is known of how long a picture takes"
    levels.took(levels.all[-1], 0.001, 1000)
    assert levels.seconds(levels.full, 1000) == pytest.approx(0.256)
    assert levels.within(0.05, 1000) is levels.all[2] and levels.within(0.3, 1000) is levels.full
    assert levels.within(0.05, 100_000) is levels.all[-1], "the cheapest, where none is fast enough"
    levels.took(levels.full, 0.04, 1000)
    assert levels.within(0.05, 1000) is levels.full, "its own pace counts where it is known"
    levels.took(levels.all[-1], 0.03, 1000)
    levels.full.pace = 0.08 / 1000
    assert levels.within(0.05, 1000) is levels.all[1], (
        "a slow start of every picture does not rule out what lies between"
    )


def test_levels_are_the_front_that_was_measured(model: Primitives, tmp_path: Path) -> None:
    points = [
        Measured("reference", (), {"psnr": 30.0}, 1, ms=[10.0], ratios=[1.0]),
        Measured("combined", ("renderer.alpha_min=0.05",), {"psnr": 29.0}, 1, ms=[5.0], ratios=[0.5]),
        Measured("combined", ("resolution=0.5", "density.neurons=1"), {"psnr": 28.0}, 1, ms=[2.0], ratios=[0.2]),
        Measured("combined", ("density.neurons=7",), {"psnr": 27.0}, 1, ms=[1.0], ratios=[0.1]),
    ]
    assert read_front(tmp_path) == Front()
    (tmp_path / "tradeoff").mkdir()
    Record({}, points=points, speed=[0, 1, 2, 3]).write(tmp_path / "tradeoff" / "tradeoff.json")
    front = read_front(tmp_path)
    assert [ratio for _, ratio in front.points] == [0.5, 0.2, 0.1]
    told: list[str] = []
    levels = Levels.of(model, SETTINGS, front, told.append)
    assert [level.ratio for level in levels.all[:3]] == [1.0, 0.5, 0.2] and levels.all[
        1
    ].point.settings.alpha_min == 0.05
    assert levels.all[3].point.resolution == 0.25 and levels.all[3].point.reduced == {("density", "neurons"): 1}
    assert len(told) == 1 and "density.neurons=7" in told[0], (
        "a point that does not fit this model is left out and told"
    )
    (tmp_path / "tradeoff" / "tradeoff.json").write_text("{")
    assert read_front(tmp_path, told.append) == Front() and "tradeoff.json" in told[-1]


def test_words_over_the_settings_are_the_full_picture(model: Primitives) -> None:
    levels = Levels.of(model, SETTINGS, Front(), words=("resolution=0.5", "renderer.samples=2"))
    assert levels.full == Level(parse_render_config(["resolution=0.5", "renderer.samples=2"], SETTINGS, model), 1.0)
    with pytest.raises(ConfigError, match="no setting of rendering"):
        Levels.of(model, SETTINGS, Front(), words=("resolutoin=0.5",))


def never(error: Exception) -> None:
    raise AssertionError(error)


def test_a_newer_job_takes_the_place_of_an_older_one() -> None:
    desk, done = Desk(), list[str]()
    assert not desk.waiting and not desk.work(0.0)
    for i in range(5):
        desk.ask(("me", "picture"), lambda i=i: done.append(f"picture {i}"), never)  # type: ignore[misc]
    desk.ask(("you", "picture"), lambda: done.append("yours"), never)
    desk.ask(("me", "picture"), lambda: done.append("late"), never, soft=True)
    assert desk.waiting
    while desk.work(0.0):
        pass
    assert done == ["picture 4", "yours"]


def test_jobs_wait_until_they_are_due_and_are_forgotten_with_their_owner() -> None:
    desk, done = Desk(), list[float]()
    start = time.monotonic()
    desk.ask(("me", "full"), lambda: done.append(time.monotonic() - start), never, after=0.15)
    assert not desk.work(0.0) and desk.work(2.0) and 0.15 <= done[0] < 1.5
    desk.ask(("me", "full"), lambda: done.append(0.0), never)
    desk.forget("me")
    assert not desk.work(0.0) and len(done) == 1


def test_a_waiting_worker_hears_of_new_work_and_faults_are_told() -> None:
    desk, faults = Desk(), list[Exception]()

    def broken() -> None:
        raise ValueError("broken")

    timer = threading.Timer(0.1, lambda: desk.ask(("me", "x"), broken, faults.append))
    timer.start()
    start = time.monotonic()
    assert desk.work(20.0) and time.monotonic() - start < 10 and str(faults[0]) == "broken"
    timer.join()
