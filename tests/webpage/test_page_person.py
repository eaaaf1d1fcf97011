"""What a person does with a page: turns it, plays it, moves the light, jumps to cameras, takes a picture; and what
happens where it cannot draw."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.io.images import encode_webp_data_uri
from neuprim.core.model.cosine import CosineDensity
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.relight.colour import LightNetwork
from neuprim.tasks.static import SphericalHarmonics
from neuprim.webpage import PageView
from tests.browsers import Tab, open_tab
from tests.page_models import LIGHT, camera_at, page_of, random_model

MODES = ("COLOUR", "ALPHA", "DEPTH", "SLICE", "ELLIPSOIDS")


@pytest.fixture(scope="module")
def still_page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A static model with two cameras, the second of which has its true image."""
    path = tmp_path_factory.mktemp("pages") / "static.html"
    truth = encode_webp_data_uri(torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(0)), 320)
    cameras = [camera_at((0.3, -3.0, 1.0)), camera_at((3.0, 0.2, 0.5))]
    views = [PageView("front", cameras[0], {}), PageView("side", cameras[1], {}, truth)]
    page_of(random_model(CosineDensity(2, edge=2), SphericalHarmonics(2)), path, views=views, still=truth)
    return path


def middle(tab: Tab) -> np.ndarray:
    """The part of the window that no control covers, once nothing is drawn any more."""
    tab.settled()
    picture = tab.canvas().astype(int)
    height, width = picture.shape[:2]
    return picture[70 : height - 160, 20 : width - 290]


def change(before: np.ndarray, after: np.ndarray) -> float:
    """Share of the pixels that look different."""
    return float((np.abs(before - after).max(-1) > 8).mean())


def slide(tab: Tab, selector: str, value: float) -> None:
    """Moves a slider as a person does: its value, then what it tells the page."""
    said = "(bar, value) => { bar.value = value; bar.dispatchEvent(new Event('input', {bubbles: true})); }"
    tab.page.eval_on_selector(selector, said, value)


def test_turning_zooming_and_panning_move_the_picture(still_page: Path, chromium: Any) -> None:
    with open_tab(chromium, still_page) as tab:
        seen = [middle(tab)]
        assert seen[0].std() > 20  # something is there
        mouse = tab.page.mouse
        mouse.move(400, 250)
        mouse.down()
        mouse.move(480, 280, steps=4)
        mouse.up()
        seen.append(middle(tab))
        mouse.wheel(0, -400)
        seen.append(middle(tab))
        tab.page.keyboard.down("Shift")
        mouse.down()
        mouse.move(430, 230, steps=4)
        mouse.up()
        tab.page.keyboard.up("Shift")
        seen.append(middle(tab))
        slide(tab, "#fov", 0.5)
        seen.append(middle(tab))
        tab.page.keyboard.press("ArrowLeft")
        for before, after in pairwise(seen):
            assert change(before, after) > 0.05
        tab.page.click("#home")
        assert change(seen[0], middle(tab)) == 0.0
        assert tab.faults == []


def test_one_finger_turns_and_two_come_nearer(still_page: Path, chromium: Any) -> None:
    with open_tab(chromium, still_page) as tab:
        screen = tab.page.context.new_cdp_session(tab.page)

        def touch(kind: str, *points: tuple[int, int]) -> None:
            fingers = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(points)]
            screen.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})

        def now() -> tuple[float, list[float]]:
            tab.settled()
            return tab.page.evaluate("[look.now.distance, look.now.R]")

        away, turned = now()
        touch("touchStart", (300, 250))
        touch("touchMove", (360, 270))
        touch("touchEnd")
        assert now()[0] == away and now()[1] != turned
        turned = now()[1]
        touch("touchStart", (300, 250), (400, 250))
        touch("touchMove", (250, 250), (450, 250))
        touch("touchEnd")
        assert now()[0] == pytest.approx(away / 2, rel=0.05) and now()[1] == turned
        assert tab.faults == []


def test_every_mode_shows_something_else(still_page: Path, chromium: Any) -> None:
    with open_tab(chromium, still_page) as tab:
        seen = []
        for mode in MODES:
            tab.page.select_option("#mode", mode)
            seen.append(middle(tab))
            assert tab.page.is_visible("#planeBox") == (mode == "SLICE")
        for i, one in enumerate(seen):
            assert one.std() > 10 and all(change(one, other) > 0.05 for other in seen[:i])
        tab.page.select_option("#mode", "SLICE")
        before = middle(tab)
        slide(tab, "#plane", 1.1)
        assert change(before, middle(tab)) > 0.02
        assert tab.faults == []


def test_backgrounds_and_fewer_pixels(still_page: Path, chromium: Any) -> None:
    with open_tab(chromium, still_page) as tab:
        corner = {}
        for name in ("model", "black", "white", "grey"):
            tab.page.select_option("#background", name)
            corner[name] = middle(tab)[3, 3].tolist()
        assert corner == {"model": [0, 0, 0], "black": [0, 0, 0], "white": [255, 255, 255], "grey": [128, 128, 128]}
        tab.page.select_option("#pixels", "4")
        middle(tab)
        assert tab.page.evaluate("[canvas.width, canvas.height]") == [225, 160]


def test_held_out_cameras_and_their_truth(still_page: Path, chromium: Any) -> None:
    with open_tab(chromium, still_page) as tab:
        first = middle(tab)
        assert not tab.page.is_visible("#truth")
        tab.page.select_option("#views", label="side")
        assert change(first, middle(tab)) > 0.05
        assert tab.page.is_visible("#truth") and tab.page.inner_text("#truthName").startswith("ground truth of side")
        assert tab.page.evaluate("document.getElementById('truthImage').naturalWidth") == 64
        tab.page.select_option("#views", label="front")
        assert change(first, middle(tab)) == 0.0 and not tab.page.is_visible("#truth")


def test_a_picture_is_what_is_seen(still_page: Path, chromium: Any, tmp_path: Path) -> None:
    with open_tab(chromium, still_page) as tab:
        seen = middle(tab)
        with tab.page.expect_download() as download:
            tab.page.click("#picture")
        download.value.save_as(tmp_path / "picture.png")
        picture = np.asarray(Image.open(tmp_path / "picture.png").convert("RGB")).astype(int)
        assert download.value.suggested_filename == "model.png" and picture.shape == (640, 900, 3)
        assert change(picture[70:480, 20:610], seen) < 0.01


def test_time_moves_and_plays(chromium: Any, tmp_path: Path) -> None:
    model = random_model(TimeDensity(2, "window+motion", edge=2), TimeHarmonics(1), count=120)
    time = {"time": torch.tensor(0.2)}
    views = [PageView("first", camera_at((0.3, -3.0, 1.0)), time, encode_webp_data_uri(torch.rand(8, 8, 3), 320))]
    page_of(model, tmp_path / "p.html", time, views=views)
    with open_tab(chromium, tmp_path / "p.html") as tab:
        before = middle(tab)
        assert tab.page.is_visible("#truth")
        slide(tab, "#conditions input[type=range]", 0.7)
        after = middle(tab)
        assert not tab.page.is_visible("#truth") and tab.page.input_value("#views") == ""  # it is of another time
        assert change(before, after) > 0.05 and tab.page.inner_text("#conditions output") == "0.70"
        tab.page.click("#conditions button")
        first = tab.page.inner_text("#conditions output")
        drawn = tab.page.evaluate("drawn")
        tab.wait(f"document.querySelector('#conditions output').textContent !== '{first}' && drawn > {drawn} + 2")
        tab.page.click("#conditions button")
        held = tab.page.inner_text("#conditions output")
        tab.settled()
        assert tab.page.inner_text("#conditions output") == held and tab.faults == []


def test_time_is_shown_as_a_frame_number(chromium: Any, tmp_path: Path) -> None:
    model = random_model(TimeDensity(2, "window", edge=2), TimeHarmonics(1), count=20)
    page_of(model, tmp_path / "p.html", {"time": torch.tensor(0.25)}, frames=(1001, 1049))
    with open_tab(chromium, tmp_path / "p.html") as tab:
        assert tab.page.inner_text("#conditions output") == "frame 1013"
        slide(tab, "#conditions input[type=range]", 1.0)
        assert tab.page.inner_text("#conditions output") == "frame 1049"


def test_light_and_shadows_move(chromium: Any, tmp_path: Path) -> None:
    page_of(random_model(CosineDensity(2, edge=2), LightNetwork(6), count=80), tmp_path / "p.html", LIGHT)
    with open_tab(chromium, tmp_path / "p.html") as tab:
        before = middle(tab)
        box = tab.page.locator(".pad").bounding_box()
        assert box is not None
        tab.page.mouse.click(box["x"] + 0.25 * box["width"], box["y"] + 0.3 * box["height"])
        after = middle(tab)
        assert change(before, after) > 0.05
        tab.page.locator("#conditions input[type=number]").first.fill("5")
        tab.page.keyboard.press("Enter")
        brighter = middle(tab)
        assert brighter[..., 0].mean() > after[..., 0].mean() and tab.faults == []
        tab.page.locator("#conditions input[type=number]").first.fill("")
        tab.page.keyboard.press("Enter")
        assert tab.page.locator("#conditions input[type=number]").first.input_value() == "5"


def test_a_card_that_is_taken_away_and_comes_back(still_page: Path, chromium: Any) -> None:
    with open_tab(chromium, still_page) as tab:
        before = middle(tab)
        tab.page.evaluate("globalThis.loss = paint.gl.getExtension('WEBGL_lose_context'); loss.loseContext()")
        tab.wait("paint.gl.isContextLost()")
        drawn = tab.page.evaluate("drawn")
        tab.page.evaluate("loss.restoreContext()")
        tab.wait(f"drawn > {drawn}")
        assert change(before, middle(tab)) == 0.0


NO_WEBGL = "HTMLCanvasElement.prototype.getContext = () => null;"
NO_FLOATS = "WebGL2RenderingContext.prototype.getExtension = () => null;"
NO_BLENDING = """const get = WebGL2RenderingContext.prototype.getExtension;
WebGL2RenderingContext.prototype.getExtension = function (name) {
  return name === "EXT_float_blend" ? null : get.call(this, name); };"""


@pytest.mark.parametrize(("without", "words"), [(NO_WEBGL, "no WebGL2"), (NO_FLOATS, "float textures")])
def test_a_still_where_the_page_cannot_draw(without: str, words: str, still_page: Path, chromium: Any) -> None:
    with open_tab(chromium, still_page, script=without, draws=False) as tab:
        tab.wait("document.getElementById('fault').textContent !== ''")
        assert words in tab.page.inner_text("#fault") and tab.page.is_visible("#still")
        assert tab.page.evaluate("document.getElementById('still').naturalWidth") == 64


def test_sixteen_bit_floats_where_the_card_blends_no_others(still_page: Path, chromium: Any) -> None:
    """Said in the page, and close to the exact picture."""
    with open_tab(chromium, still_page) as tab:
        exact = middle(tab)
    with open_tab(chromium, still_page, script=NO_BLENDING) as tab:
        assert np.abs(middle(tab) - exact).max() <= 12
        assert "16-bit floats" in tab.page.inner_text("#info")


def test_strangers_names_are_text(chromium: Any, tmp_path: Path) -> None:
    """What a name says is shown and never run, and nothing is asked of a network."""
    hostile = "</script><script>alert(1)</script><img src=http://127.0.0.1:9/x onerror=alert(2)>"
    views = [PageView(name, camera_at((0.3, -3.0, 1.0)), {}) for name in (hostile, '"onload="alert(3)')]
    model = random_model(CosineDensity(1), SphericalHarmonics(0))
    page_of(model, tmp_path / "p.html", views=views, name=hostile, subtitle=hostile)
    with open_tab(chromium, tmp_path / "p.html") as tab:
        asked: list[str] = []
        tab.page.on("request", lambda request: asked.append(request.url))
        tab.page.select_option("#views", index=1)
        tab.page.select_option("#views", index=2)
        tab.settled()
        assert tab.page.inner_text("h1") == hostile and tab.faults == []
        assert not [url for url in asked if url.startswith("http")]
