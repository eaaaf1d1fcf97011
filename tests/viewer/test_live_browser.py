"""The viewer in a real browser: a finished run and one that is trained, what a person does there, and what a stranger's
names cannot do."""

from __future__ import annotations

import io
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("viser", reason="the package viser is not installed")

from neuprim.config import compose
from neuprim.config.command_settings import ViewerSettings
from neuprim.runs.events import Event
from neuprim.runs.run import run
from neuprim.viewer.live_training import LiveTraining
from neuprim.viewer.view import view_run
from tests.browsers import browser
from tests.core import tiny
from tests.short_runs import fit, words

HOSTILE = "<img src=x onerror=alert(1)>"
PATIENCE = 60.0


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser() as found:
        yield found


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run under a name that is markup."""
    folder = tmp_path_factory.mktemp("viewed")
    scene = tiny.write_blender(folder / "two")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 4)
        fit(words(scene, folder / "plain", 120))
    shutil.move(folder / "plain", folder / HOSTILE)
    return folder / HOSTILE


class Tab:
    """An open page, what it complained about and what it asked of other addresses."""

    def __init__(self, page: Any, address: str) -> None:
        self.page, self.faults, self.elsewhere = page, [], []
        own = address.partition("?")[0]
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        page.on("console", lambda message: self.faults.append(message.text) if message.type == "error" else None)
        page.on("dialog", lambda dialog: self.faults.append(f"dialog: {dialog.message}"))
        page.on(
            "request",
            lambda asked: (
                self.elsewhere.append(asked.url) if not asked.url.startswith((own, f"blob:{own}", "data:")) else None
            ),
        )
        page.goto(address)

    def picture(self) -> np.ndarray:
        """(H, W, 3) int of the part of the window that no panel covers."""
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")).astype(int)[160:, 20:380]

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f"{what}: not within {PATIENCE:.0f} s; {self.faults}"
            self.page.wait_for_timeout(100)

    def moved(self, before: np.ndarray, share: float = 0.02) -> np.ndarray:
        """The picture, once it is another."""
        self.until(lambda: float((np.abs(before - self.picture()).max(-1) > 8).mean()) > share, "another picture")
        return self.settled()

    def settled(self) -> np.ndarray:
        """The picture, once it stays."""
        last = self.picture()
        for _ in range(100):
            self.page.wait_for_timeout(250)
            now = self.picture()
            if (now == last).all():
                return now
            last = now
        raise AssertionError("the picture never stays")

    def choose(self, label: str, option: str) -> None:
        self.page.get_by_label(label, exact=True).click()
        self.page.get_by_role("option", name=option, exact=True).click()


@contextmanager
def open_tab(started: Any, address: str) -> Iterator[Tab]:
    page = started.new_page(viewport={"width": 800, "height": 600})
    tab = Tab(page, address)
    tab.until(
        lambda: page.get_by_label("show", exact=True).count() > 0 or page.get_by_role("tab").count() > 0, "controls"
    )
    yield tab
    page.close()


@pytest.fixture(scope="module")
def address(finished: Path) -> Iterator[str]:
    """Of a viewer of the finished run, which has a thread of its own."""
    addresses, end, opened = list[str](), threading.Event(), threading.Event()

    def told(address: str) -> None:
        addresses.append(address)
        opened.set()

    thread = threading.Thread(target=view_run, args=(finished, ViewerSettings(port=0), told), kwargs={"end": end})
    thread.start()
    try:
        assert opened.wait(PATIENCE)
        yield addresses[0]
    finally:
        end.set()
        thread.join(20)
        assert not thread.is_alive()


def test_a_person_looks_at_a_run(address: str, chromium: Any) -> None:
    with open_tab(chromium, address) as tab:
        page = tab.page
        tab.until(lambda: tab.picture().std() > 15, "a picture of the model")
        seen = tab.settled()
        page.mouse.move(200, 300)
        page.mouse.down()
        page.mouse.move(300, 280, steps=5)
        page.mouse.up()
        seen = tab.moved(seen)
        tab.choose("show", "alpha")
        grey = tab.moved(seen)
        assert (grey[..., 0] == grey[..., 1]).mean() > 0.95
        tab.choose("show", "colour")
        seen = tab.moved(grey)
        page.get_by_label("held-out view", exact=True).click()
        page.get_by_role("option").nth(1).click()
        tab.until(lambda: page.get_by_text("ground truth, and the model", exact=True).count() > 0, "the truth")
        seen = tab.moved(seen)
        page.get_by_role("tab", name="Primitives").click()
        tab.choose("ellipsoids", "solid")
        solid = tab.moved(seen)
        tab.choose("ellipsoids", "none")
        seen = tab.moved(solid)
        page.get_by_label("choose by a click").click()
        where = np.argwhere(np.abs(seen - seen[0, 0]).max(-1) > 60)  # something that is not background
        y, x = where[len(where) // 2]

        def described() -> bool:  # the page listens to clicks a moment after the box was ticked
            page.mouse.click(int(x) + 20, int(y) + 160)
            page.wait_for_timeout(500)
            return "semi-axes" in str(
                page.evaluate("[...document.querySelectorAll('textarea')].map(e => e.value).join()")
            )

        tab.until(described, "its parameters")
        assert page.evaluate("document.body.innerText").count(HOSTILE) == 1, "the run's name is text"
        assert tab.faults == [] and tab.elsewhere == []


def test_a_person_looks_at_a_training(tmp_path: Path, chromium: Any) -> None:
    scene = tiny.write_blender(tmp_path / "two")
    config, events = compose(words(scene, tmp_path / "out", 100_000)), list[Event]()
    with LiveTraining(ViewerSettings(port=0), config, lambda address: None, events.append) as live:
        ended: list[BaseException] = []

        def train() -> None:
            try:
                run(config, live, live.between)
            except KeyboardInterrupt as stop:
                ended.append(stop)

        thread = threading.Thread(target=train)
        thread.start()
        try:
            with open_tab(chromium, live.address) as tab:
                page = tab.page
                tab.until(lambda: page.locator(".uplot").count() == 1, "a curve")
                page.get_by_label("pause").click()
                tab.until(lambda: live.paused, "the pause")
                tab.settled()
                step = live.progress.step
                page.get_by_text("one step").click()
                tab.until(lambda: live.progress.step == step + 1, "one more step")
                page.get_by_text("checkpoint", exact=True).click()
                tab.until((config.output_dir / "checkpoint.safetensors").exists, "a checkpoint")
                page.get_by_text("stop", exact=True).click()
                thread.join(PATIENCE)
                assert not thread.is_alive() and tab.faults == [] and tab.elsewhere == []
        finally:
            live.stop()
            thread.join(PATIENCE)
    assert len(ended) == 1 and (config.output_dir / "report.html").exists()
