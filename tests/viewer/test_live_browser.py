"""The viewer of a training in a real browser: what a person does there, and that a run's name is never markup."""

from __future__ import annotations

import io
import itertools
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("viser", reason="the package viser is not installed")

from neuprim.config import compose
from neuprim.config.command_settings import ViewerSettings
from neuprim.runs.run import run
from neuprim.viewer.view import LiveTraining
from tests.browsers import browser
from tests.core import tiny
from tests.short_runs import words

HOSTILE = "<img src=x onerror=alert(1)>"
PATIENCE = 180.0


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
        """(H, W, 3) int of the part of the window that no panel and no notice covers."""
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")).astype(int)[200:, 20:380]

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            if time.monotonic() >= end:
                shown = self.page.evaluate("document.body.innerText")
                raise AssertionError(f"{what}: not within {PATIENCE:.0f} s; {self.faults}; {shown}")
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
def training(folder: Path) -> Iterator[LiveTraining]:
    """A training with a page, on a thread of its own, in a folder whose name is markup."""
    config = compose(words(tiny.write_blender(folder / "two"), folder / "plain", 100_000))
    config = replace(config, output_dir=folder / HOSTILE)
    ended: list[BaseException] = []

    def train() -> None:
        try:
            run(config, live, live.between)
        except KeyboardInterrupt as stop:
            ended.append(stop)

    with LiveTraining(ViewerSettings(port=0), config, lambda address: None, lambda event: None) as live:
        thread = threading.Thread(target=train)
        thread.start()
        try:
            yield live
        finally:
            live.stop()
            thread.join(PATIENCE)
    assert not thread.is_alive() and len(ended) == 1 and (config.output_dir / "report.html").exists()


def test_a_person_looks_at_a_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Watches the curve, pauses, steps and saves; turns the model, shows alpha, a held-out view and ellipsoids; picks a
    primitive; and ends it."""
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 4)
    with browser() as chromium, training(tmp_path) as live:
        page = chromium.new_page(viewport={"width": 800, "height": 600})
        tab = Tab(page, live.address)
        tab.until(lambda: page.locator(".uplot").count() == 1 and live.progress.step > 100, "a curve")
        page.get_by_label("pause").click()
        tab.until(lambda: live.paused, "the pause")
        page.get_by_text("checkpoint", exact=True).click()
        tab.until((tmp_path / HOSTILE / "checkpoint.safetensors").exists, "a checkpoint")
        step = live.progress.step  # of the checkpoint: the step during which the pause was requested has ended
        page.get_by_text("one step").click()
        tab.until(lambda: live.progress.step == step + 1, "one more step")

        page.get_by_role("tab", name="View").click()
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
        tries = itertools.count()

        def described() -> bool:  # the page listens to clicks a moment after the box was ticked
            picture = tab.picture()  # the background is white: click on the darkest pixels shown now, in turn
            pixel = np.argsort(picture.min(-1), axis=None, kind="stable")[100 * next(tries)]
            y, x = np.unravel_index(int(pixel), picture.shape[:2])
            page.mouse.click(int(x) + 20, int(y) + 200)
            page.wait_for_timeout(500)
            texts = page.evaluate("[...document.querySelectorAll('textarea')].map(e => e.value).join()")
            return "semi-axes" in str(texts)

        tab.until(described, "its parameters")
        assert page.evaluate("document.body.innerText").count(HOSTILE) >= 1, "the run's name is text"
        page.get_by_role("tab", name="Training").click()
        page.get_by_text("stop", exact=True).click()
        tab.until(lambda: "ended" in page.evaluate("document.body.innerText"), "the end")
        assert tab.faults == [] and tab.elsewhere == []
