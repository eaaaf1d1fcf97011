"""Looking inside a density without a window: frames, boxes, ground truth, OpenVDB files, the page, and what is
refused."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuprim.cli import main
from neuprim.core.errors import BackendUnavailable, ConfigError, DataError
from neuprim.core.io.vdb import read_grid
from neuprim.core.volumes.density_grid import box_lattice, density_at, density_grid
from neuprim.core.volumes.density_truth import DENSITY_ERRORS
from neuprim.inspect import window
from neuprim.inspect.field import (
    InspectionFrame,
    describe_inspected_conditions,
    find_inspection_box,
    read_inspected_conditions,
)
from neuprim.inspect.html_page import encode_inspected_values
from neuprim.inspect.layers import Scale
from neuprim.inspect.views import PRIMITIVE
from neuprim.plugins.registry import load_task
from neuprim.runs.fit import Event, Note
from neuprim.runs.inspect import InspectRequest, inspect_run
from neuprim.runs.open import load_dataset, load_run
from tests.inspect.pages import array, layers_of
from tests.plugins import runs
from tests.systems import posix


@pytest.fixture(autouse=True)
def no_display(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(window.sys, "platform", "linux")


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return runs.run_directory(tmp_path_factory.mktemp("inspected"))


def look(run_dir: Path, **words: Any) -> tuple[list[Path], list[str]]:
    heard: list[Event] = []
    paths = inspect_run(InspectRequest(run_dir, **words), heard.append)
    return paths, [event.text for event in heard if isinstance(event, Note)]


# ---------------------------------------------------------------- frames and boxes


def test_a_condition_is_one_frame_a_range_a_list_or_the_middle() -> None:
    specs = load_task("dynamic").conditions
    for text, expected in (("0.25", [0.25]), ("0:1:3", [0.0, 0.5, 1.0]), ("0.1,0.9", [0.1, 0.9]), (None, [0.5])):
        found = read_inspected_conditions(specs, {} if text is None else {"time": text})
        assert [round(float(c["time"]), 3) for c in found] == expected
    lights = read_inspected_conditions(load_task("relight").conditions, {})
    assert lights == [{}], "a light has no middle"
    with pytest.raises(ConfigError, match="give --light"):
        lights[0]["light"]
    shown = {"time": torch.tensor(0.5), "light": torch.tensor([1.0, 2.0, 3.0])}
    assert describe_inspected_conditions(shown) == "time 0.5, light (1, 2, 3)"


def test_the_box_holds_the_matter_and_forgets_a_stray() -> None:
    model, frame = runs.model(), {"time": torch.tensor(0.5)}
    low, high = find_inspection_box(model, [frame])
    assert low == pytest.approx([-0.3, -0.3, -0.3], abs=0.02) and high == pytest.approx([0.3, 0.3, 0.6], abs=0.02)
    model.params["means"][1], model.params["b2"][1], model.params["w2"][1] = torch.tensor([0.0, 0.0, 50.0]), 1e-4, 0.0
    assert find_inspection_box(model, [frame])[1] == pytest.approx([0.3, 0.3, 0.3], abs=0.02)
    model.params["b2"][:], model.params["w2"][:] = -1.0, 0.0
    with pytest.raises(DataError, match="absorbs nothing"):
        find_inspection_box(model, [frame])


def frame_of(time: float = 1.0, **options: Any) -> InspectionFrame:
    matrix, shape = box_lattice(np.array([[-0.5, -0.5, -0.4], [0.6, 0.5, 0.7]]), 24)
    return InspectionFrame(runs.model(), {"time": torch.tensor(time)}, "", matrix, shape, 8.0, 1.0, **options)


def test_one_primitive_is_asked_where_it_has_moved_to() -> None:
    frame = frame_of(primitive=0)
    alone = runs.model()
    for name, value in alone.params.items():
        alone.params[name] = value[:1]
    assert float(frame.geometry.means[0, 0]) == pytest.approx(0.15, abs=1e-6)
    mesh, _ = PRIMITIVE.layers(frame)
    inside = frame.geometry.means[0].double() + 0.999 * (torch.from_numpy(mesh.vertices) - frame.geometry.means[0])
    expected = density_at(alone, frame.conditions, inside).numpy()
    assert expected.max() > 3
    assert np.abs(np.maximum(mesh.values, 0) - expected).max() < 0.02 * expected.max()


def test_masses_are_the_integrals_of_the_density_and_colours_the_models() -> None:
    frame = frame_of(0.5)
    density = density_grid(frame.model, frame.conditions, frame.scene_from_index, frame.shape)
    assert frame.masses.sum() == pytest.approx(float(density.double().sum()) * frame.step**3, rel=0.1)
    assert frame.masses.argmax() == 0 and frame.chosen_position() == 0
    assert frame_of(0.5, primitive=1).chosen_position() == 1
    assert np.allclose(frame_of().colours.argmax(1), [0, 2]) and frame_of().colours.max() > 0.5


# ---------------------------------------------------------------- files and truth


def test_a_volume_file_is_the_density_in_scene_units(run_dir: Path, tmp_path: Path) -> None:
    paths, said = look(run_dir, conditions={"time": "0,1"}, grid=20, out=tmp_path / "v.vdb")
    assert [p.name for p in paths] == ["v_0000.vdb", "v_0001.vdb"] and "clamped at 0 from below" in said[-1]
    grid = read_grid(paths[1], "extinction")
    dense, low = grid.to_dense(), np.array(grid.bounds)[0]
    points = (np.indices(dense.shape).reshape(3, -1).T + low) @ grid.transform[:3, :3].T + grid.transform[:3, 3]
    expected = density_at(runs.model(), {"time": torch.tensor(1.0)}, torch.from_numpy(points)).reshape(dense.shape)
    assert float(expected.max()) > 3 and np.allclose(dense, expected, atol=1e-4)


def test_files_have_frame_numbers(run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neuprim.core.conditions.source_frames", lambda header: (1003, 1005))
    assert main(["inspect", str(run_dir), "--frame", "1004-1005", "--grid", "8", "--out", str(tmp_path / "v.vdb")]) == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["v_1004.vdb", "v_1005.vdb"]


def test_the_numbers_are_those_of_the_data_set(run_dir: Path, tmp_path: Path) -> None:
    stored = load_run(run_dir)
    expected = {f["frame"]: f for f in stored.task.diagnose(load_dataset(stored), stored.model)["sigma_frames"]}
    for against in (str(run_dir.parent / "files"), "scene"):
        words = {"against": against, "out": tmp_path / "x.vdb", "overwrite": True}
        _, said = look(run_dir, conditions={"time": "0:1:20"}, grid=8, **words)
        assert len(expected) == 3 and len(said) == 5
        for number, line in zip(runs.NUMBERS, said[1:], strict=False):
            wanted = "  ".join(f"{key} {expected[number][key]:.4f}" for key in DENSITY_ERRORS)
            assert line.endswith(wanted) and line.startswith(f"ball_{number}.vdb  time {(number - 4) / 2:g} ")


def test_a_page_holds_the_grids(run_dir: Path, tmp_path: Path) -> None:
    files = str(run_dir.parent / "files")
    words = {"conditions": {"time": "0,1"}, "grid": 12, "against": files, "show": ["slices", "primitives"]}
    (path,), _ = look(run_dir, out=tmp_path / "p.html", **words)
    assert not re.search(r"https?://|src=|@import", path.read_text()), "a page needs no network"
    data = layers_of(path)
    assert data["first"] == "slices"
    assert list(data["views"]) == ["volume", "isosurface", "slices", "difference", "primitives"]
    assert [f["title"] for f in data["frames"]] == ["time 0", "time 1"]
    frame = data["frames"][1]
    (model,), (truth,) = (frame["layers"]["slices"][side] for side in ("model", "truth"))
    low, shape = np.array(model["low"]), tuple(model["shape"])
    assert [low.tolist(), (low + model["size"]).tolist()] == pytest.approx(np.array(data["box"]))
    matrix = torch.eye(4, dtype=torch.float64) * model["step"]
    matrix[3, 3], matrix[:3, 3] = 1, torch.from_numpy(low + model["step"] / 2)
    expected = density_grid(runs.model(), {"time": torch.tensor(1.0)}, matrix, shape).numpy()
    top = model["scale"]["high"]
    stored = (array(frame, model["grid"], "u1").reshape(shape, order="F") / 255.0) ** 2 * top
    assert (
        model["code"] == "root" and expected.max() > 1 and np.abs(stored - np.minimum(expected, top)).max() < 0.01 * top
    )
    assert array(frame, truth["grid"], "u1").max() > 0
    (shown,) = (layer for layer in frame["layers"]["primitives"]["model"] if layer["kind"] == "ellipsoids")
    assert array(frame, shown["rows"], "<f4").shape == (2 * 15,)
    sides = [side for view in frame["layers"].values() for side in view.values()]
    grids = {layer["grid"] for side in sides for layer in side if "grid" in layer}
    assert len(grids) == 3, "the model's, the truth's and their difference, each once, however many views show it"


def test_eight_bits_keep_thin_matter_and_zero() -> None:
    sigma = np.array([0.0, 0.001, 0.5, 1.0, 7.0], np.float32)
    stored, code = encode_inspected_values(sigma, Scale(0.0, 1.0))
    assert (stored.tolist(), code) == ([0, 8, 180, 255, 255], "root")
    stored, code = encode_inspected_values(np.array([-3.0, -1.0, -0.01, 0.0, 0.01, 0.25, 2.0]), Scale(-1.0, 1.0))
    assert (stored.tolist(), code) == ([1, 1, 115, 128, 141, 192, 255], "signed")
    stored, code = encode_inspected_values(np.array([2.0, 3.0, 4.0]), Scale(2.0, 4.0))
    assert (stored.tolist(), code) == ([0, 128, 255], "linear")


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--out", "x.jpg"], "expected a name that ends in .png"),
        (["--show", "volum", "--out", "x.html"], "did you mean 'volume'"),
        (["--show", "difference", "--out", "x.html"], "no ground truth; give --against"),
        (["--against", "nowhere", "--out", "x.vdb"], "no such file or folder"),
        (["--primitive", "2", "--out", "x.html"], "the model has 2 primitives, 0 to 1"),
        (["--grid", "9999", "--out", "x.vdb"], "expected at most 1024 points per side"),
        (["--box=0,0", "--out", "x.vdb"], "lower and the upper corner"),
        (["--box=0,0,0,1,1,-1", "--out", "x.vdb"], "lower and the upper corner"),
        (["--time", "2", "--out", "x.vdb"], "expected a time from 0 to 1"),
        (["--tme", "2"], "did you mean '--time'"),
        (["--level", "a"], "expected numbers separated by commas"),
        ([], "there is no display to open a window on; give --out"),
    ],
)
def test_wrong_words_are_one_line(run_dir: Path, words: list[str], text: str, capsys: Any, tmp_path: Path) -> None:
    words = [str(tmp_path / word) if word.startswith("x.") else word for word in words]
    assert main(["inspect", str(run_dir), *words]) == 2
    _, error = capsys.readouterr()
    assert text in error and error.count("\n") == 1 and "Traceback" not in error
    assert not list(tmp_path.iterdir())


def test_a_missing_pyvista_is_said(run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(BackendUnavailable, match=r"pip install 'neuprim\[viewer\]'"):
        look(run_dir, out=tmp_path / "x.png")


@pytest.mark.parametrize(
    ("probe", "text"),
    [
        pytest.param("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "ended by SIGSEGV", marks=posix),
        ("raise ImportError('libEGL is not there')", "libEGL is not there"),
        ("print('black')", "the picture is black"),
    ],
)
def test_a_vtk_that_dies_is_named_with_its_cure(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, probe: str, text: str
) -> None:
    pytest.importorskip("pyvista", exc_type=ImportError)
    window.prepare_headless.cache_clear()
    monkeypatch.setattr(window, "_PROBE", probe)
    with pytest.raises(BackendUnavailable, match="apt install libegl1 libgl1-mesa-dri") as caught:
        look(run_dir, out=tmp_path / "x.png")
    assert text in str(caught.value)
