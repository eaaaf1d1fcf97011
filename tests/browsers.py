"""Headless Chromium for tests of pages: the system's own browser, driven by Playwright, drawing WebGL2 in software."""

from __future__ import annotations

import base64
import io
import os
import shutil
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.webpage.model_page import webpage_camera_numbers

__all__ = ["Tab", "browser", "executable", "open_tab"]

_FLAGS = (
    "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip
_PATIENCE = 120.0


def executable() -> str:
    """The browser: $CHROMIUM, or one of the names that systems give it; skips the test without one."""
    names = [
        os.environ.get("CHROMIUM"),
        *map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")),
    ]
    found = next((name for name in names if name), None)
    if found is None:
        pytest.skip("no Chromium on this machine ($CHROMIUM, chromium, google-chrome)")
    return found


@contextmanager
def browser() -> Iterator[Any]:
    """A browser; skips the test where there is none, or no Playwright."""
    sync = pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")
    path = executable()
    with sync.sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=path, args=list(_FLAGS))
        yield found
        found.close()


class Tab:
    """An open page of a model. Everything that it complained about is in ``faults``."""

    def __init__(self, page: Any) -> None:
        self.page, self.faults = page, []
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        page.on("console", self._keep_fault)
        page.on("dialog", lambda dialog: self.faults.append(f"dialog: {dialog.message}"))

    def _keep_fault(self, message: Any) -> None:
        """Keep errors and warnings, except that reading pixels is slow, which the tests do."""
        if message.type in ("error", "warning") and "GPU stall due to ReadPixels" not in message.text:
            self.faults.append(message.text)

    def wait(self, condition: str, patience: float = _PATIENCE) -> None:
        """Until a JavaScript expression is true; the page's policy forbids the driver's own way, which evaluates texts
        inside of it."""
        end = time.monotonic() + patience
        while not self.page.evaluate(condition):
            assert time.monotonic() < end, (
                f"{condition}: not within {patience} s; {self.faults} {self.page.inner_text('#fault')}"
            )
            time.sleep(0.02)

    def numbers(
        self, camera: Camera, conditions: Mapping[str, Tensor] | None = None, mode: str = "COLOUR", plane: float = 1.0
    ) -> np.ndarray:
        """(H, W, 4) float64: colour before the background (of DEPTH, sum of w z), and transmittance."""
        values = {name: value.double().tolist() for name, value in (conditions or {}).items()}
        found = self.page.evaluate(
            "([c, v, m, p]) => probe.numbers(c, v, m, p)", [webpage_camera_numbers(camera), values, mode, plane]
        )
        assert found["exact"], "this browser blends 16-bit floats only"
        pixels = np.frombuffer(base64.b64decode(found["pixels"]), np.float32)
        return pixels.reshape(camera.height, camera.width, 4).astype(np.float64)

    def shown(self, camera: Camera, conditions: Mapping[str, Tensor] | None = None) -> np.ndarray:
        """(H, W, 3) uint8 of the canvas."""
        values = {name: value.double().tolist() for name, value in (conditions or {}).items()}
        found = self.page.evaluate("([c, v]) => probe.shown(c, v)", [webpage_camera_numbers(camera), values])
        return np.frombuffer(base64.b64decode(found), np.uint8).reshape(camera.height, camera.width, 4)[::-1, :, :3]

    def canvas(self) -> np.ndarray:
        """What the window shows now, (H, W, 3) uint8, controls included."""
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot())).convert("RGB"))

    def settled(self) -> None:
        """Until nothing is drawn any more."""
        self.wait("probe.idle() && !again")
        before = -1
        while (now := self.page.evaluate("drawn")) != before:
            before = now
            time.sleep(0.4)
            self.wait("probe.idle() && !again")


@contextmanager
def open_tab(
    started: Any, path: Path, width: int = 900, height: int = 640, script: str = "", draws: bool = True
) -> Iterator[Tab]:
    """A page from disk, drawn once. ``script`` runs before the page's own; with ``draws=False`` nobody waits for a
    picture."""
    page = started.new_page(viewport={"width": width, "height": height})
    if script:
        page.add_init_script(script)
    tab = Tab(page)
    page.goto(path.resolve().as_uri())
    if draws:
        tab.wait("probe.idle()")
    yield tab
    page.close()
