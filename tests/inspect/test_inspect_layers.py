"""A stranger's inspector reaches every output, and one that returns what cannot be drawn is refused in one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from neuprim.cli import main
from neuprim.core.errors import BackendUnavailable
from neuprim.inspect.html_page import ELLIPSOIDS_LIMIT, InspectionFrameArrays
from neuprim.inspect.layers import (
    Ellipsoids,
    Isosurfaces,
    Mesh,
    Points,
    Scale,
    Slices,
    Text,
    Volume,
    validate_inspection_layers,
)
from neuprim.inspect.views import make_inspection_ball
from neuprim.inspect.window import prepare_headless
from neuprim.runs.inspect import InspectRequest, inspect_run
from tests.inspect.pages import array, layers_of
from tests.plugins import runs
from tests.plugins.fakes import install, site

__all__ = ["site"]

SOURCE = """
import numpy as np
from neuprim.core.extensions import Inspector
from neuprim.inspect.layers import *

GREEN = np.array([0.0, 1.0, 0.0])

def cube(low, high):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
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
    Slices(frame.sigma, frame.origin, frame.step, Scale(0, frame.top, "viridis")),
    Isosurfaces(frame.sigma, frame.origin, frame.step, frame.scale, levels=(0.5 * frame.top, frame.top)),
    Ellipsoids(low[None], np.eye(3)[None] / 10, values=np.ones(1), scale=Scale(0, 2, "plasma", "size", "m")),
    Points(frame.box, colours=np.eye(3)[:2], size=12.0, opacity=0.5),
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
    files = {"strange_marks.py": SOURCE.replace("{found}", found)}
    install(site, "strange-marks", {"marks": "strange_marks:PLUGIN"}, files, group="neuprim.inspectors")


def look(run_dir: Path, out: Path | None, **words: Any) -> list[Path]:
    return inspect_run(InspectRequest(run_dir, ["marks"], **{"out": out, "grid": 16, "size": (240, 200), **words}))


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


def test_it_reaches_the_page_beside_the_truth(site: Path, run_dir: Path, tmp_path: Path) -> None:
    stranger(site, EVERYTHING)
    (page,) = look(run_dir, tmp_path / "x.html", conditions={"time": "0,1"}, against=str(run_dir.parent / "files"))
    data = layers_of(page)
    assert data["first"] == "marks" and "hello <there>" not in page.read_text()
    assert {"viridis", "inferno"} <= set(data["maps"])
    sides = data["frames"][1]["layers"]["marks"]
    kinds = ["mesh", "volume", "slices", "isosurfaces", "ellipsoids", "points", "text"]
    assert [[layer["kind"] for layer in sides[side]] for side in ("model", "truth")] == [kinds] * 2
    mesh, volume, _, isosurfaces, ellipsoids, points, text = sides["model"]
    frame = data["frames"][1]
    corners = array(frame, mesh["points"], "<f4").reshape(-1, 3)
    low, high = np.array(data["box"])
    assert np.allclose(corners[[0, -1]], [low, low + 0.7 * (high - low)], atol=1e-6)
    assert array(frame, mesh["rgb"], "u1").reshape(-1, 3).tolist() == [[0, 255, 0]] * 8
    assert array(frame, mesh["rows"], "<u4").reshape(-1, 3).tolist()[1] == [0, 3, 2]
    assert volume["grid"] == isosurfaces["grid"]
    assert isosurfaces["level"] == pytest.approx(0.5 * volume["scale"]["high"])
    row = array(frame, ellipsoids["rows"], "<f4")
    assert np.allclose(row[3:12], 0.1 * np.eye(3).ravel()) and ellipsoids["scale"]["words"] == "size [m]"
    assert (points["size"], points["opacity"]) == (12.0, 0.5)
    assert (text["text"], text["corner"]) == ("hello <there>", "upper_right")


# ---------------------------------------------------------------- refusals

GRID, ORIGIN, SCALE = np.zeros((4, 5, 6), np.float32), np.zeros(3), Scale(0.0, 1.0)
POINTS, FACES = np.zeros((4, 3)), np.array([[0, 1, 2]])
VOLUME, MESH = Volume(GRID, ORIGIN, 1.0, SCALE), Mesh(POINTS, FACES)
WRONG: list[tuple[Any, str]] = [
    (None, "returned a NoneType; expected a list of layers of neuprim.inspect.layers: Volume, "),
    ([np.zeros(3)], "returned a ndarray as layer 0; expected one of"),
    ([Text("x"), Text(3)], "layer 1, a Text, whose text is 3; expected text"),  # type: ignore[arg-type]
    ([Text("x", "middle")], "corner is 'middle'; expected upper_right or lower_right"),  # type: ignore[arg-type]
    ([replace(VOLUME, values=GRID[0])], "a Volume, whose values is of shape (5, 6); expected (N, N, N)"),
    ([replace(VOLUME, values=GRID[:0])], "values is of shape (0, 5, 6); expected at least one point"),
    ([replace(VOLUME, values=torch.zeros(2, 2, 2))], "values is a Tensor; expected a numpy array"),
    ([replace(VOLUME, values=GRID + np.nan)], "values is not finite"),
    ([replace(VOLUME, values=GRID.astype(complex))], "values is of type complex128; expected real numbers"),
    ([replace(VOLUME, origin=np.zeros(2))], "origin is of shape (2,); expected (3)"),
    ([replace(VOLUME, spacing=0.0)], "spacing is 0.0; expected a positive number of scene units"),
    ([replace(VOLUME, depth=-1.0)], "depth is -1.0; expected a number from 0"),
    ([replace(VOLUME, scale=None)], "scale is a NoneType; expected a Scale"),
    ([replace(VOLUME, scale=Scale(1.0, 1.0))], "scale is from 1.0 to 1.0; expected a lower and a higher"),
    ([replace(VOLUME, scale=Scale(0.0, 1.0, "infrno"))], "of colours 'infrno'; expected a colour map"),
    ([Slices(GRID, ORIGIN, 1.0, SCALE, through=np.zeros((1, 3)))], "through is of shape (1, 3); expected (3)"),
    ([Isosurfaces(GRID, ORIGIN, 1.0, SCALE)], "levels is (); expected a tuple of at least one number"),
    ([replace(MESH, vertices=POINTS[:, :2])], "vertices is of shape (4, 2); expected (N, 3)"),
    ([replace(MESH, faces=FACES + 2)], "faces is an index beyond the vertices; expected rows 0 to 3 of them"),
    ([replace(MESH, faces=FACES - 1)], "faces is an index beyond the vertices"),
    ([replace(MESH, faces=FACES.astype(float))], "faces is of type float64; expected integers"),
    ([replace(MESH, values=np.zeros(3), scale=SCALE)], "values is of shape (3,); expected (4)"),
    ([replace(MESH, colours=np.zeros((3, 3)))], "colours is of shape (3, 3); expected (4, 3)"),
    ([replace(MESH, colours=np.full(3, 255))], "colours is beyond 0 or 1; expected numbers from 0 to 1"),
    ([replace(MESH, opacity=2.0)], "opacity is 2.0; expected a number from 0 to 1"),
    ([Ellipsoids(POINTS, np.zeros((3, 3, 3)))], "axes is of shape (3, 3, 3); expected (4, 3, 3)"),
    ([Points([[0.0, 0.0, 0.0]])], "centres is a list; expected a numpy array"),  # type: ignore[arg-type]
    ([Points(POINTS, size=0.0)], "size is 0.0; expected a positive number of pixels"),
]


@pytest.mark.parametrize(("found", "text"), WRONG, ids=[text for _, text in WRONG])
def test_what_cannot_be_drawn_is_named(found: Any, text: str) -> None:
    assert text in (validate_inspection_layers(found) or "valid") and "\n" not in str(validate_inspection_layers(found))


def test_the_line_names_the_package(site: Path, run_dir: Path, tmp_path: Path, capsys: Any) -> None:
    stranger(site, "[Mesh(frame.box, np.array([[0, 1, 7]]))]")
    assert main(["inspect", str(run_dir), "--show", "marks", "--grid", "8", "--out", str(tmp_path / "x.html")]) == 2
    _, error = capsys.readouterr()
    text = "returned layer 0, a Mesh, whose faces is an index beyond the vertices; expected rows 0 to 1 of them"
    assert f"inspector 'marks' of strange-marks 0.3: {text}" in error and error.count("\n") == 1
    assert not list(tmp_path.glob("x*"))


@pytest.mark.usefixtures("off_screen")
def test_layers_of_nothing_are_drawn(site: Path, run_dir: Path, tmp_path: Path) -> None:
    none = "np.zeros((0, 3))"
    stranger(
        site,
        f"[Mesh({none}, np.zeros((0, 3), int)), Points({none}), "
        f"Ellipsoids({none}, np.zeros((0, 3, 3))),"
        " Slices(frame.sigma, frame.origin, frame.step, frame.scale, through=high + 9)]",
    )
    for name in ("x.png", "x.html"):
        (path,) = look(run_dir, tmp_path / name)
        assert path.stat().st_size > 1000


# ---------------------------------------------------------------- shapes


def test_a_page_says_how_many_ellipsoids_it_left_out() -> None:
    count = ELLIPSOIDS_LIMIT + 5
    packed = InspectionFrameArrays()
    balls = Ellipsoids(np.arange(3.0 * count).reshape(-1, 3), np.broadcast_to(np.eye(3), (count, 3, 3)))
    (found,) = packed.pack_layers([balls])
    rows = array({"arrays": packed.arrays}, found["rows"], "<f4").reshape(-1, 15)
    assert (found["count"], found["of"], len(rows)) == (ELLIPSOIDS_LIMIT, count, ELLIPSOIDS_LIMIT)
    assert rows[-1].tolist() == [*(3.0 * (ELLIPSOIDS_LIMIT - 1) + np.arange(3)), *np.eye(3).ravel(), 1.0, 1.0, 1.0]


def test_the_cut_ball_is_closed_and_its_faces_point_outward() -> None:
    points, faces = make_inspection_ball(16)
    a, b, c = (points[faces[:, k]] for k in range(3))
    volume = np.einsum("fa,fa->f", (a + b + c) / 3, np.cross(b - a, c - a)).sum() / 6
    assert volume == pytest.approx(0.75 * 4 / 3 * np.pi, rel=0.03)
    assert not ((points[:, 0] > 1e-9) & (points[:, 1] < -1e-9)).any()
