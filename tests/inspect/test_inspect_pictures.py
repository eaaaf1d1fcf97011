"""Pictures of a density by pyvista, and the page in a real browser."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from neuprim.core.errors import BackendUnavailable
from neuprim.inspect import window
from neuprim.inspect.window import prepare_headless
from neuprim.runs.inspect import InspectRequest, inspect_run
from tests.browsers import executable
from tests.plugins import runs

pytest.importorskip("pyvista", exc_type=ImportError)


@pytest.fixture(scope="module", autouse=True)
def off_screen() -> None:
    prepare_headless.cache_clear()
    try:
        prepare_headless()
    except BackendUnavailable as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return runs.run_directory(tmp_path_factory.mktemp("inspected"))


def look(run_dir: Path, **words: Any) -> list[Path]:
    return inspect_run(InspectRequest(run_dir, **{"grid": 24, "size": (240, 200), **words}))


def pixels(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def colourful(image: np.ndarray) -> int:
    """Pixels that are neither grey nor the blue-grey of the background."""
    return int(((image.max(-1) - image.min(-1) > 40) & (image[..., 0] > image[..., 2])).sum())


@pytest.mark.parametrize("name", ["volume", "isosurface", "slices", "primitives", "primitive"])
def test_every_view_shows_something(run_dir: Path, tmp_path: Path, name: str) -> None:
    (path,) = look(run_dir, show=[name], out=tmp_path / "x.png")
    image = pixels(path)
    assert image.shape == (200, 240, 3) and colourful(image[20:150]) > 300


def test_frames_are_numbered_files_or_a_film(run_dir: Path, tmp_path: Path) -> None:
    first, last = look(run_dir, conditions={"time": "0,1"}, out=tmp_path / "x.png")
    assert (first.name, last.name) == ("x_0000.png", "x_0001.png")
    red = [np.argwhere(pixels(p)[20:150, :, 0] > 150)[:, 1].mean() for p in (first, last)]
    assert red[1] - red[0] > 15, "the ball moves along x, which is to the right"
    (film,) = look(run_dir, conditions={"time": "0:1:3"}, out=tmp_path / "x.webp")
    with Image.open(film) as stored:
        assert stored.n_frames == 3


def test_model_and_truth_stand_side_by_side_with_their_difference(run_dir: Path, tmp_path: Path) -> None:
    words = {"against": str(run_dir.parent / "files"), "show": ["volume", "difference"], "size": (600, 200)}
    (path,) = look(run_dir, out=tmp_path / "x.png", **words)
    image = pixels(path)
    left, right = image[20:150, :200], image[20:150, 200:400]
    assert colourful(left) > 300 and colourful(right) > 300 and np.abs(left - right).max() > 50


def test_the_slider_draws_the_frame_it_comes_to(run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[float] = []

    def interact(self: window.Window, count: int, frame: Any) -> None:
        self.add_slider(count, frame)
        self.draw(frame(0))
        slider = self.plotter.widgets.slider_widgets[0]
        for value in (1, 2):
            slider.GetRepresentation().SetValue(value)
            slider.InvokeEvent("EndInteractionEvent")
            found.append(float(np.argwhere(self.picture()[20:150, :, 0] > 150)[:, 1].mean()))
            assert len(self.plotter.scalar_bars) == 1

    monkeypatch.setattr(window.Window, "interact", interact)
    monkeypatch.setattr("neuprim.runs.inspect.has_display", lambda: True)
    plain = window.Window.__init__
    small = lambda self, panels, up, off, size=None: plain(self, panels, up, True, (240, 200))  # noqa: E731
    monkeypatch.setattr(window.Window, "__init__", small)
    assert look(run_dir, conditions={"time": "0,1"}) == []
    assert found[1] - found[0] > 15


@pytest.mark.slow
def test_the_page_works_in_a_browser_without_a_network(run_dir: Path, tmp_path: Path) -> None:
    browser = executable()
    words = {"conditions": {"time": "0,1"}, "against": str(run_dir.parent / "files"), "show": ["volume", "primitives"]}
    (page,) = look(run_dir, out=tmp_path / "p.html", **words)

    def shot(part: str, opened: Path = page) -> np.ndarray:
        picture = tmp_path / "shot.png"
        picture.unlink(missing_ok=True)
        flags = ["--headless", "--no-sandbox", "--disable-background-networking", "--window-size=800,500"]
        flags += ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        flags += [
            "--proxy-server=127.0.0.1:9",
            "--virtual-time-budget=10000",
            f"--user-data-dir={tmp_path / 'profile'}",
        ]
        command = [browser, *flags, f"--screenshot={picture}", f"{opened.as_uri()}#{part}"]
        subprocess.run(command, check=True, capture_output=True, timeout=180)
        return pixels(picture)

    first, last = shot("frame=0"), shot("frame=1")
    assert colourful(first[80:400]) > 1000, "the canvas is not blank"
    assert np.abs(first - last)[80:400].max() > 60
    moved = tmp_path / "moved.html"
    hand = 'const s = document.getElementById("frame"); s.value = 1; s.dispatchEvent(new Event("input"));'
    script = f"<script>setTimeout(() => {{ {hand} }}, 1000)</script></body>"
    moved.write_text(page.read_text().replace("</body>", script))
    by_hand = shot("frame=0", moved)
    assert np.abs(by_hand - last).max() < 20 < np.abs(by_hand - first).max(), "the slider moves"
    for part in ("view=isosurface", "view=slices", "view=primitives"):
        assert colourful(shot(part)[80:400]) > 500, part
    assert np.abs(shot("view=difference") - first)[80:400].max() > 60
