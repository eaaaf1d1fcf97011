"""A stranger's inspector reaches every output, and one that returns what cannot be drawn is refused in one line."""

from __future__ import annotations

import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from neuprim.cli import main
from neuprim.core.errors import BackendUnavailable
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.inspect import window
from neuprim.inspect.field import FieldFrame, ViewOptions
from neuprim.inspect.headless import prepare_headless
from neuprim.inspect.layer_checks import fault
from neuprim.inspect.layers import Ellipsoids, Isosurfaces, Lines, Mesh, Points, Scale, Slices, Text, Volume
from neuprim.inspect.packing import ELLIPSOIDS_LIMIT, Packed
from neuprim.inspect.shapes import cut_ball, level_lines
from neuprim.inspect.views import PRIMITIVE
from neuprim.runs.inspect import Request, inspect_run
from tests.plugins import marked, runs
from tests.plugins.fakes import install, site
from tests.plugins.pages import array, layers_of

__all__ = ["site"]

SOURCE = """
import numpy as np
from neuprim.core.extensions import Inspector
from neuprim.inspect.layers import *

GREEN = np.array([0.0, 1.0, 0.0])

def cube(low, high):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return low + corners * (high - low), np.array(faces)

def layers(frame):
    low, high = frame.box
    part = float(frame.conditions.get("time", 0.5))  # the box fills from its lower end
    return {found}

PLUGIN = Inspector(api=1, name="marks", summary="marks", layers=layers)
"""
EVERYTHING = """[
    Mesh(*cube(low, low + (high - low) * (0.4 + 0.3 * part)), colours=GREEN),
    Volume(frame.sigma, frame.origin, frame.step, frame.scale, depth=frame.gain),
    Slices(frame.sigma, frame.origin, (frame.step,) * 3, Scale(0, frame.top, "viridis")),
    Isosurfaces(frame.sigma, frame.origin, frame.step, frame.scale, levels=(0.5 * frame.top, frame.top)),
    Ellipsoids((low + high)[None] / 2, np.eye(3)[None] * 0.1, values=np.ones(1), scale=Scale(0, 2, title="size", unit="m")),
    Points(frame.box, colours=np.eye(3)[:2], size=12.0, opacity=0.5),
    Lines(frame.box, np.array([[0, 1]]), colours=np.array([1.0, 1.0, 0.0])),
    Text("hello <there>", "upper_right"),
]"""


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return runs.run_directory(tmp_path_factory.mktemp("inspected"))


@pytest.fixture
def off_screen() -> None:
    pytest.importorskip("pyvista", exc_type=ImportError)
    prepare_headless.cache_clear()
    try:
        prepare_headless()
    except BackendUnavailable as error:
        pytest.skip(str(error))


def stranger(site: Path, found: str) -> None:
    source = SOURCE.replace("{found}", found)
    install(
        site,
        "strange-marks",
        {"marks": "strange_marks:PLUGIN"},
        {"strange_marks.py": source},
        group="neuprim.inspectors",
    )


def look(run_dir: Path, out: Path | None, **words: Any) -> list[Path]:
    return inspect_run(Request(run_dir, ["marks"], **{"out": out, "grid": 16, "size": (240, 200), **words}))


def green(picture: Any) -> int:
    """Pixels of the stranger's mesh."""
    image = np.asarray(picture.convert("RGB") if isinstance(picture, Image.Image) else picture).astype(int)
    return int(((image[..., 1] > 60) & (image[..., 1] > 2 * image[..., 0]) & (image[..., 1] > 2 * image[..., 2])).sum())


# ---------------------------------------------------------------- every output


@pytest.mark.usefixtures("off_screen")
def test_it_reaches_pictures_and_films(site: Path, run_dir: Path, tmp_path: Path) -> None:
    stranger(site, EVERYTHING)
    first, last = look(run_dir, tmp_path / "x.png", conditions={"time": "0,1"})
    counts = [green(Image.open(path)) for path in (first, last)]
    assert 500 < counts[0] < 0.8 * counts[1]
    (film,) = look(run_dir, tmp_path / "x.webp", conditions={"time": "0,1"})
    with Image.open(film) as stored:
        shown = [green(frame) for frame in ImageSequence.Iterator(stored)]
    assert len(shown) == 2 and 500 < shown[0] < 0.8 * shown[1]


@pytest.mark.usefixtures("off_screen")
def test_it_reaches_the_window(site: Path, run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stranger(site, EVERYTHING)
    found: list[int] = []

    def interact(self: window.Window, count: int, frame: Any) -> None:
        for number in range(count):
            self.draw(frame(number))
            found.append(green(self.picture()))
            assert len(self.plotter.scalar_bars) == 2, "of the extinction and of the sizes, and none of frames before"

    plain = window.Window.__init__
    monkeypatch.setattr(window.Window, "interact", interact)
    monkeypatch.setattr("neuprim.runs.inspect.has_display", lambda: True)
    monkeypatch.setattr(
        window.Window, "__init__", lambda self, panels, up, off, size=None: plain(self, panels, up, True, (240, 200))
    )
    assert look(run_dir, None, conditions={"time": "0,1"}) == []
    assert len(found) == 2 and 500 < found[0] < 0.8 * found[1]


def test_it_reaches_the_page_beside_the_truth(site: Path, run_dir: Path, tmp_path: Path) -> None:
    stranger(site, EVERYTHING)
    (page,) = look(run_dir, tmp_path / "x.html", conditions={"time": "0,1"}, against=str(run_dir.parent / "files"))
    data = layers_of(page)
    assert (
        data["first"] == "marks"
        and "hello <there>" not in page.read_text()
        and {"viridis", "inferno"} <= set(data["maps"])
    )
    sides = data["frames"][1]["layers"]["marks"]
    kinds = ["mesh", "volume", "slices", "isosurfaces", "ellipsoids", "points", "lines", "text"]
    assert [[layer["kind"] for layer in sides[side]] for side in ("model", "truth")] == [kinds] * 2
    mesh, volume, _, isosurfaces, ellipsoids, points, _, text = sides["model"]
    frame = data["frames"][1]
    corners = array(frame, mesh["points"], "<f4").reshape(-1, 3)
    low, high = np.array(data["box"])
    assert np.allclose(corners[[0, -1]], [low, low + 0.7 * (high - low)], atol=1e-6)
    assert array(frame, mesh["rgb"], "u1").reshape(-1, 3).tolist() == [[0, 255, 0]] * 8
    assert array(frame, mesh["rows"], "<u4").reshape(-1, 3).tolist()[1] == [0, 3, 2]
    assert volume["grid"] == isosurfaces["grid"] and isosurfaces["level"] == pytest.approx(
        0.5 * volume["scale"]["high"]
    )
    row = array(frame, ellipsoids["rows"], "<f4")
    assert np.allclose(row[3:12], 0.1 * np.eye(3).ravel()) and ellipsoids["scale"]["words"] == "size [m]"
    assert (points["size"], points["opacity"], text["text"], text["corner"]) == (
        12.0,
        0.5,
        "hello <there>",
        "upper_right",
    )


@pytest.mark.slow
def test_a_browser_draws_it(site: Path, run_dir: Path, tmp_path: Path) -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium to open the page with")
    counts = []
    for found in (EVERYTHING, "[Mesh(*cube(low, low + 0.4 * (high - low)), colours=GREEN)]", "[]"):
        stranger(site, found)
        (page,) = look(run_dir, tmp_path / "x.html", conditions={"time": "0"}, overwrite=True)
        shot, flags = tmp_path / "shot.png", ["--headless", "--no-sandbox", f"--user-data-dir={tmp_path / 'profile'}"]
        flags += ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--window-size=800,500"]
        flags += ["--proxy-server=127.0.0.1:9", "--virtual-time-budget=10000", f"--screenshot={shot}"]
        subprocess.run(
            [browser, *flags, f"{page.as_uri()}#view=marks&az=-58"], check=True, capture_output=True, timeout=180
        )
        with Image.open(shot) as picture:
            counts.append(green(picture.crop((0, 100, 800, 500))))
        forget(site)
    assert counts[2] == 0 and counts[1] > 3000 and counts[0] > 1500


def forget(site: Path) -> None:
    from tests.plugins.fakes import uninstall

    uninstall(site, "strange-marks")
    (site / "strange_marks.py").unlink()


# ---------------------------------------------------------------- refusals

GRID, ORIGIN, SCALE = np.zeros((4, 5, 6), np.float32), np.zeros(3), Scale(0.0, 1.0)
POINTS, FACES = np.zeros((4, 3)), np.array([[0, 1, 2]])
WRONG: list[tuple[Any, str]] = [
    (None, "returned None; expected a list of layers of neuprim.inspect.layers: Volume, "),
    (Text("x"), "returned a Text; expected a list of layers"),
    ([np.zeros(3)], "returned a ndarray as layer 0; expected one of"),
    ([Text("x"), Text(3)], "layer 1, a Text, whose text is an int; expected text"),  # type: ignore[arg-type]
    ([Text("x", "middle")], "corner is 'middle'; expected 'upper_right' or 'lower_right'"),  # type: ignore[arg-type]
    ([Volume(GRID[0], ORIGIN, 1.0, SCALE)], "layer 0, a Volume, whose values has shape (5, 6); expected (N, P, Q)"),
    ([Volume(GRID[:0], ORIGIN, 1.0, SCALE)], "values has shape (0, 5, 6); expected at least one point along each axis"),
    ([Volume(torch.zeros(2, 2, 2), ORIGIN, 1.0, SCALE)], "values is a Tensor; expected a numpy array"),  # type: ignore[arg-type]
    ([Volume(GRID + np.nan, ORIGIN, 1.0, SCALE)], "values has a number that is not finite"),
    ([Volume(GRID.astype(float) + 1e39, ORIGIN, 1.0, SCALE)], "values has a number that is not finite in float32"),
    ([Volume(GRID, ORIGIN, 10**400, SCALE)], "expected a positive number of scene units"),
    ([Volume(GRID.astype(complex), ORIGIN, 1.0, SCALE)], "values has the type complex128; expected real numbers"),
    ([Volume(GRID, np.zeros(2), 1.0, SCALE)], "origin has shape (2,); expected (3,)"),
    ([Volume(GRID, ORIGIN, 0.0, SCALE)], "spacing is 0.0; expected a positive number of scene units, or three"),
    ([Volume(GRID, ORIGIN, (1.0, 2.0), SCALE)], "spacing is (1.0, 2.0); expected a positive"),  # type: ignore[arg-type]
    ([Volume(GRID, ORIGIN, 1.0, SCALE, depth=-1.0)], "depth is -1.0; expected a number from 0"),
    ([Volume(GRID, ORIGIN, 1.0, None)], "scale is None; expected a Scale"),  # type: ignore[arg-type]
    (
        [Volume(GRID, ORIGIN, 1.0, Scale(1.0, 1.0))],
        "scale reaches from 1.0 to 1.0; expected a lower and a higher number",
    ),
    ([Volume(GRID, ORIGIN, 1.0, Scale(0.0, float("inf")))], "scale reaches from 0.0 to inf"),
    (
        [Volume(GRID, ORIGIN, 1.0, Scale(0.0, 1.0, "infrno"))],
        "the colours 'infrno'; expected a colour map of matplotlib",
    ),
    ([Slices(GRID, ORIGIN, 1.0, SCALE, through=np.zeros((1, 3)))], "through has shape (1, 3); expected (3,)"),
    ([Isosurfaces(GRID, ORIGIN, 1.0, SCALE)], "levels is (); expected a tuple of at least one number"),
    ([Mesh(POINTS[:, :2], FACES)], "layer 0, a Mesh, whose vertices has shape (4, 2); expected (N, 3)"),
    ([Mesh(POINTS, FACES + 2)], "faces has rows 2 to 4 of vertices; there are 4"),
    ([Mesh(POINTS, FACES - 1)], "faces has rows -1 to 1 of vertices; there are 4"),
    ([Mesh(POINTS, FACES.astype(float))], "faces has the type float64; expected integers"),
    ([Mesh(POINTS, np.zeros((1, 4), int))], "faces has shape (1, 4); expected (N, 3)"),
    ([Mesh(POINTS, FACES, values=np.zeros(3), scale=SCALE)], "values has shape (3,); expected (4,)"),
    ([Mesh(POINTS, FACES, values=np.zeros(4))], "scale is None; expected a Scale"),
    ([Mesh(POINTS, FACES, colours=np.zeros((3, 3)))], "colours has shape (3, 3); expected (4, 3)"),
    ([Mesh(POINTS, FACES, colours=np.full(3, 255))], "colours reach from 255 to 255; expected 0 to 1"),
    ([Mesh(POINTS, FACES, colours=np.ones(3), values=np.zeros(4), scale=SCALE)], "values and colours are both given"),
    ([Mesh(POINTS, FACES, opacity=2.0)], "opacity is 2.0; expected a number from 0 to 1"),
    (
        [Ellipsoids(POINTS, np.zeros((3, 3, 3)))],
        "layer 0, an Ellipsoids, whose axes has shape (3, 3, 3); expected (4, 3, 3)",
    ),
    ([Ellipsoids(POINTS + np.inf, np.zeros((4, 3, 3)))], "centres has a number that is not finite"),
    ([Points([[0.0, 0.0, 0.0]])], "centres is a list; expected a numpy array"),  # type: ignore[arg-type]
    ([Points(POINTS, size=0.0)], "size is 0.0; expected a positive number of pixels"),
    ([Lines(POINTS, np.array([[0, 9]]))], "pairs has rows 0 to 9 of vertices; there are 4"),
]


@pytest.mark.parametrize(("found", "text"), WRONG, ids=[text for _, text in WRONG])
def test_what_cannot_be_drawn_is_named(found: Any, text: str) -> None:
    assert text in (fault(found) or "no fault") and "\n" not in str(fault(found))


@pytest.mark.parametrize("out", ["x.png", "x.html"])
@pytest.mark.parametrize(
    ("found", "text"),
    [
        ("None", "returned None; expected a list of layers of neuprim.inspect.layers"),
        (
            "[Mesh(frame.box, np.array([[0, 1, 7]]))]",
            "returned layer 0, a Mesh, whose faces has rows 0 to 7 of vertices; there are 2",
        ),
    ],
)
def test_the_line_names_the_package(
    site: Path,
    run_dir: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    request: pytest.FixtureRequest,
    out: str,
    found: str,
    text: str,
) -> None:
    if out.endswith("png"):
        request.getfixturevalue("off_screen")
    stranger(site, found)
    assert main(["inspect", str(run_dir), "--show", "marks", "--grid", "8", "--out", str(tmp_path / out)]) == 2
    _, error = capsys.readouterr()
    assert f"inspector 'marks' of strange-marks 0.3: {text}" in error and error.count("\n") == 1
    assert not list(tmp_path.glob("x*"))


@pytest.mark.usefixtures("off_screen")
def test_layers_of_nothing_are_drawn(site: Path, run_dir: Path, tmp_path: Path) -> None:
    none = "np.zeros((0, 3))"
    stranger(
        site,
        f"[Mesh({none}, np.zeros((0, 3), int)), Points({none}), Lines({none}, np.zeros((0, 2), int)), Ellipsoids({none}, np.zeros((0, 3, 3))),"
        " Slices(frame.sigma, frame.origin, frame.step, frame.scale, through=high + 9)]",
    )
    for name in ("x.png", "x.html"):
        (path,) = look(run_dir, tmp_path / name)
        assert path.stat().st_size > 1000


# ---------------------------------------------------------------- shapes


def test_a_page_says_how_many_ellipsoids_it_left_out() -> None:
    count = ELLIPSOIDS_LIMIT + 5
    packed = Packed()
    (found,) = packed.layers(
        [Ellipsoids(np.arange(3.0 * count).reshape(-1, 3), np.broadcast_to(np.eye(3), (count, 3, 3)))]
    )
    rows = array({"arrays": packed.arrays}, found["rows"], "<f4").reshape(-1, 15)
    assert (found["count"], found["of"], len(rows)) == (ELLIPSOIDS_LIMIT, count, ELLIPSOIDS_LIMIT)
    assert rows[-1].tolist() == [*(3.0 * (ELLIPSOIDS_LIMIT - 1) + np.arange(3)), *np.eye(3).ravel(), 1.0, 1.0, 1.0]


def test_the_cut_ball_is_closed_but_for_its_edges_and_its_normals_point_outward() -> None:
    points, faces, normals = cut_ball(16)
    a, b, c = (points[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    middle = (a + b + c) / 3
    thick = np.linalg.norm(cross, axis=1) > 1e-9
    assert (np.einsum("fa,fa->f", cross, normals[faces].sum(1))[thick] > 0).all()
    volume = abs(np.einsum("fa,fa->f", middle, cross).sum() / 6)
    assert volume == pytest.approx(0.75 * 4 / 3 * np.pi, rel=0.03)
    assert not ((points[:, 0] > 1e-9) & (points[:, 1] < -1e-9)).any()


def test_level_lines_are_where_a_linear_function_is_zero() -> None:
    points, faces, _ = cut_ball(16)
    slope = np.array([0.3, -0.5, 0.8])
    ends, pairs = level_lines(points, faces, points @ slope - 0.2)
    assert len(pairs) > 30 and np.abs(ends[pairs.ravel()] @ slope - 0.2).max() < 1e-9


@pytest.mark.parametrize("edge", [0, 1, 2])
def test_the_zero_line_of_a_soft_primitive_is_that_of_its_field(edge: int) -> None:
    """f = sin(2 (x + y)/m + 0.4) is zero on one plane through the ball and nowhere else: not on the surface, where the
    weight is."""
    any_model = marked.static_model(neurons=1, degree=0)
    rows = {name: value[:1].clone() for name, value in any_model.params.items()}
    rows |= {
        "means": torch.tensor([[0.3, -0.2, 0.1]]),
        "log_scales": torch.tensor([[0.5, 0.4, 0.3]]).log(),
        "quats": torch.eye(4)[:1],
    }
    rows |= {"W1": torch.tensor([[[2 / 30, 2 / 30, 0.0]]]), "b1": torch.tensor([[(0.4 - math.pi / 2) / 30]])}
    rows |= {"w2": torch.tensor([[3.0]]), "b2": torch.zeros(1, 1)}
    model = Primitives(CosineDensity(1, edge=edge), any_model.colour, rows)
    frame = FieldFrame(
        model, {}, "", torch.eye(4, dtype=torch.float64), (2, 2, 2), 8.0, 1.0, options=ViewOptions(primitive=0)
    )
    (lines,) = (layer for layer in PRIMITIVE.layers(frame) if isinstance(layer, Lines))
    local = (lines.vertices - np.array([0.3, -0.2, 0.1])) / 0.5
    assert len(lines.pairs) > 60 and np.abs(local[:, 0] + local[:, 1] + 0.2).max() < 0.02
    reached = np.linalg.norm(local / [1.0, 0.8, 0.6], axis=1)
    assert reached.max() > 0.99 and reached.min() < 0.4, "around the surface, and across the cut to it"


def test_the_frame_has_the_scale_of_all_frames() -> None:
    frame = FieldFrame(
        runs.model(), {"time": torch.tensor(0.5)}, "", torch.eye(4, dtype=torch.float64), (2, 2, 2), 8.0, 1.0
    )
    assert (
        frame.scale == Scale(0.0, 8.0, "inferno", "extinction", "1/scene unit")
        and frame.scale.words == "extinction [1/scene unit]"
    )
