"""The add-on for Blender: the file that users install, and its work in Blender itself."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from neuprim.cli import main
from neuprim.core.cameras.camera_files import read_camera_file
from neuprim.version import __version__
from tests.tasks.dynamic.sequences import write_blobs

NUMBERS = range(1001, 1005)


@pytest.fixture
def addon(tmp_path: Path) -> Path:
    assert main(["blender-addon", "--out", str(tmp_path / "addon.zip")]) == 0
    return tmp_path / "addon.zip"


def test_file_is_an_extension_that_knows_this_python(addon: Path) -> None:
    with zipfile.ZipFile(addon) as archive:
        assert sorted(archive.namelist()) == ["__init__.py", "blender_manifest.toml", "installation.json", "job.py"]
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        compile(archive.read("__init__.py"), "__init__.py", "exec")
        assert json.loads(archive.read("installation.json")) == {"python": sys.executable}
    assert manifest["id"] == "neuprim" and manifest["version"] == __version__ and manifest["type"] == "add-on"
    assert tuple(map(int, manifest["blender_version_min"].split("."))) == (4, 2, 0)


def test_missing_folder_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["blender-addon", "--out", str(tmp_path / "no" / "addon.zip")]) == 2
    assert f"no such folder {tmp_path / 'no'}" in capsys.readouterr().err


def run_in_blender(check: str, addon: Path, folder: Path) -> None:
    """Run a check with the package bpy: of this Python, or of the one that BLENDER_PYTHON names."""
    python = os.environ.get("BLENDER_PYTHON", sys.executable)
    if python == sys.executable and find_spec("bpy") is None:
        pytest.skip("needs the package bpy: install it in an environment of its own, and set BLENDER_PYTHON")
    write_blobs(folder, {number: 8.0 + 2 * k for k, number in enumerate(NUMBERS)})
    words = [python, str(Path(__file__).with_name("in_blender.py")), check, str(addon), str(folder)]
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(folder / "user")}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]


def alpha(file: Path) -> np.ndarray:
    with OpenEXR.File(str(file)) as opened:
        return np.array(opened.channels()["RGBA"].pixels[..., 3], np.float64)


@pytest.mark.slow
def test_blender_shows_and_renders_a_model_where_the_sequence_is(addon: Path, tmp_path: Path) -> None:
    folder = tmp_path / "files"
    run_in_blender("fit_and_render", addon, folder)
    (second,) = folder.glob("models/ball_1001/blender/*.0002.exr")
    drawn, cycles = alpha(second), alpha(folder / "cycles.exr")
    assert drawn.shape == cycles.shape == (90, 160)
    assert np.corrcoef(drawn.ravel(), cycles.ravel())[0, 1] > 0.95
    y, x = np.mgrid[:90, :160]
    for where in (x, y):
        assert abs((drawn * where).sum() / drawn.sum() - (cycles * where).sum() / cycles.sum()) < 1.5, "pixels"


@pytest.mark.slow
def test_sun_of_blender_lights_a_model(addon: Path, tmp_path: Path) -> None:
    folder = tmp_path / "files"
    run_in_blender("sun", addon, folder)
    bright, dark = (OpenEXR.File(str(folder / f"sun_{k}.exr")).channels()["RGBA"].pixels for k in range(2))
    assert np.array_equal(bright[..., 3], dark[..., 3])
    assert bright[..., :3].mean() > 1.5 * dark[..., :3].mean()


@pytest.mark.slow
def test_cameras_that_blender_writes_as_usd(addon: Path, tmp_path: Path) -> None:
    folder = tmp_path / "files"
    run_in_blender("usd_cameras", addon, folder)
    named = read_camera_file(folder / "shot.usda", (320, 180)).named
    expected = json.loads((folder / "shot.json").read_text())
    assert len(named) == len(expected) == 4
    for (_, camera), (pose, P) in zip(named, expected, strict=True):
        found = np.linalg.inv(camera.viewmat.numpy())
        found[:, 1:3] *= -1  # OpenGL axes
        assert np.allclose(found, pose, atol=1e-6)
        lens = (P[0][0] * 160, P[1][1] * 90, (1 - P[0][2]) * 160, (1 + P[1][2]) * 90)
        assert np.allclose((camera.fx, camera.fy, camera.cx, camera.cy), lens, atol=1e-3), "pixels"


@pytest.mark.slow
@pytest.mark.parametrize("check", ["wrong_input", "interrupted_fit"])
def test_blender_reports_errors_and_continues_fits(check: str, addon: Path, tmp_path: Path) -> None:
    run_in_blender(check, addon, tmp_path / "files")
