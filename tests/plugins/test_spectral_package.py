"""A third-party package written from the documentation alone: its loss, files, exporter, inspector and mistakes."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.cli import main
from neuprim.core.cameras import Camera, orbit
from neuprim.core.io.exr import write_exr
from neuprim.core.io.images import write_png
from neuprim.runs.open import load_run, read_metrics
from tests.inspect.pages import layers_of
from tests.plugins.fakes import site
from tests.plugins.spectral import NAMES, fit, forget, install_spectral

__all__ = ["site"]


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)


@pytest.fixture
def package(site: Path) -> Iterator[Path]:
    yield install_spectral(site)
    forget()


def call(*words: str | Path) -> int:
    return main([str(word) for word in words])


def refusal(capsys: pytest.CaptureFixture[str], *words: str | Path) -> str:
    """The one line that a command ends with."""
    capsys.readouterr()
    assert call(*words) == 2
    said = capsys.readouterr().err
    (line,) = [x for x in said.splitlines() if x.startswith("neuprim: error: ")]
    assert said.endswith(f"{line}\n") and "Traceback" not in said
    return line.removeprefix("neuprim: error: ")


def short(out: Path, *words: str) -> list[str]:
    size = "scene.size=16 scene.train_views=4 scene.test_views=1 model.primitives=20 train.iterations=5"
    return ["run", "task=spectral", *size.split(), "--out", str(out), *words]


# ---------------------------------------------------------------- from the scaffold to a run


def test_its_loss_serves_any_task(package: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("train.loss=spectral-angle", "task.options.angle_weight=0.5")
    assert call(*short(tmp_path / "own", *words)) == 0
    static = ["task=static", "train.max_seconds=null", "model.neurons=1", "model.colour.lobes=0"]
    assert call(*short(tmp_path / "static", *words), *static) == 0
    assert (tmp_path / "static" / "config.yaml").read_text().count("neuprim-spectral") == 1, "of the loss alone"
    assert "task.options.angel: task 'spectral' has no such option; did you mean 'angle'?" in refusal(
        capsys, *short(tmp_path / "x", "task.options.angel=1")
    )


def folder_of_images(folder: Path) -> Path:
    """Two frames as OpenEXR, two as .npy, with masks, and cameras.json."""
    folder.mkdir()
    template = Camera(torch.eye(4), 20.0, 20.0, 8.0, 8.0, 16, 16)
    frames = []
    for i, camera in enumerate(orbit(template, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]), 4.0, 0.4, 4)):
        image = torch.full((16, 16, 5), 0.1 * (i + 1))
        name = f"v{i}.exr" if i % 2 else f"v{i}.npy"
        write_exr(folder / name, image, names=NAMES) if i % 2 else np.save(folder / name, image.numpy())
        write_png(folder / f"m{i}.png", (torch.arange(16)[:, None, None] >= 4).expand(16, 16, 3).float())
        pose = torch.linalg.inv(camera.viewmat.double()) @ torch.diag(
            torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)
        )
        frames.append(
            {"file_path": name, "mask_path": f"m{i}.png", "wavelength_shift": i / 4, "transform_matrix": pose.tolist()}
        )
    (folder / "cameras.json").write_text(json.dumps({"w": 16, "h": 16, "fl_x": 20, "frames": frames}))
    return folder


def test_its_files_are_read(package: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = folder_of_images(tmp_path / "data")
    small = "scene.test_every=4 model.primitives=20 train.iterations=5"
    words = ["run", "task=spectral", "scene=files", f"scene.path={data}", *small.split()]
    assert call(*words, "--out", tmp_path / "run") == 0
    assert read_metrics(tmp_path / "run")["channels"] == list(NAMES)
    assert refusal(capsys, *words, "scene.path=null", "--out", tmp_path / "x").startswith("scene.path: required")
    np.save(data / "v2.npy", np.zeros((16, 16, 3), "f4"))
    assert "v2.npy: float32 (16, 16, 3); expected" in refusal(capsys, *words, "--out", tmp_path / "x")
    write_exr(data / "v1.exr", torch.zeros(16, 16, 3))
    line = refusal(capsys, *words, "--out", tmp_path / "x")
    assert "v1.exr: " in line and "450nm" in line


# ---------------------------------------------------------------- what it hands out


def test_its_exporter_and_inspector(package: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = fit(tmp_path / "run", "train.iterations=5")
    table = ["export", out, "--format", "spectra"]
    line = refusal(capsys, *table)
    assert line.startswith("--wavelength-shift: required, as the model depends on it")
    advice = line.rsplit("for example ", 1)[1].split()
    assert call(*table, *advice, "digits=5") == 0
    rows = list(csv.DictReader((out / "export" / "spectra.csv").open()))
    values = load_run(out).model.params["logit"].detach().sigmoid()
    expected = ((values[:, :-1] + values[:, 1:]) / 2).numpy()
    assert np.allclose([[float(row[name]) for name in NAMES] for row in rows], expected, atol=1e-5)
    assert call(*table, *advice, "most=3", "--out", tmp_path / "a.json") == 0
    assert len(json.loads((tmp_path / "a.json").read_text())) == 3
    for word, text in (
        ("digits=x", "digits=x: expected a whole number from 0 to 12, or null"),
        ("digts=3", "digts: no such option of --format spectra; did you mean 'digits'?"),
        ("--wavelength-shift=0:1", "--wavelength-shift 0:1: 60 values; expected one value"),
    ):
        spoken = [] if word.startswith("--wave") else advice
        assert refusal(capsys, *table, *spoken, word, "--force") == text
    assert refusal(capsys, *table, *advice, "--out", tmp_path / "a.txt").endswith(
        "expected a file name that ends in .csv or .json"
    )

    view = ["inspect", out, "--show", "bands", "--grid", "8"]
    assert call(*view, "--out", tmp_path / "page.html") == 0
    (frame,) = layers_of(tmp_path / "page.html")["frames"]
    assert [layer["kind"] for layer in frame["layers"]["bands"]["model"]] == ["points"]
    pytest.importorskip("pyvista", exc_type=ImportError)
    assert call(*view, "--out", tmp_path / "bands.png") == 0
    with Image.open(tmp_path / "bands.png") as picture:
        assert np.asarray(picture.convert("RGB")).std() > 1


# ---------------------------------------------------------------- mistakes: (module, text, another in its place), and
# the line

CONSTANT = 'return Constant(spectrum(params["logit"], conditions["wavelength_shift"]))'
SUM = "density field TwoScales: lower: sum of two Cosine forms: the first form: "


@pytest.mark.parametrize(
    ("module", "old", "new", "text"),
    [
        (
            "fields",
            'params[f"{part}_w2"], offset',
            'params[f"{part}_w2"][:, :1], offset',
            SUM + "w2 has shape (20, 1); expected (20, 2)",
        ),
        (
            "fields",
            CONSTANT,
            CONSTANT[:-1] + "[:, :3])",
            "colour field ShiftedSpectrum: lower returned a colour of C=3; expected 5, its attribute channels",
        ),
        (
            "scene",
            "(index * 0.37) % 1.0",
            "index * 0.37",
            "scene 'ball' of neuprim-spectral 0.1: train view 3 (view3): condition 'wavelength_shift' is 1.11; "
            "expected 0 to 1, the range of this condition",
        ),
    ],
)
def test_what_does_not_fit_ends_a_run(
    module: str, old: str, new: str, text: str, site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    install_spectral(site, {module: (old, new)})
    assert text in refusal(capsys, *short(tmp_path / "run"))
