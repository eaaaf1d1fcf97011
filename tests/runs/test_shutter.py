"""``neuprim render --shutter``: motion blur is the mean of sub-frames in linear light."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import torch
from PIL import Image
from torch import Tensor

from neuprim.__main__ import main
from neuprim.core.io.images import linear_to_srgb, srgb_to_linear
from neuprim.core.metrics import psnr
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from tests import scenes
from tests.plugins import marked
from tests.timed_models import model as timed

CAMERA = scenes.camera(24, 20, distance=2.6)
FRAMES = (11, 15)  # times 0, 1/4, ... 1
BLACK = torch.zeros(3)


def moving() -> Primitives:
    return timed("motion", count=16, dtype=torch.float32)


@pytest.fixture(scope="module")
def cameras(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pose = np.linalg.inv(CAMERA.viewmat.double().numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
    lens = {"w": 24, "h": 20, "fl_x": CAMERA.fx, "fl_y": CAMERA.fy, "cx": CAMERA.cx, "cy": CAMERA.cy}
    path = tmp_path_factory.mktemp("cameras") / "one.json"
    path.write_text(json.dumps({**lens, "frames": [{"name": "a", "transform_matrix": pose.tolist()}]}))
    return path


def run_directory(folder: Path, space: str = "linear", **header: Any) -> Path:
    words = ["task=dynamic", "scene=vdb", "scene.vdb=nowhere"]
    return marked.write_run(folder, moving(), words, color_space=space, background=[0.0] * 3, **header)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_directory(tmp_path_factory.mktemp("runs") / "moving", data={"frames": FRAMES})


def rendered(run: Path, cameras: Path, out: Path, *words: str) -> Tensor:
    """The pixels of a .npy image."""
    assert main(["render", str(run), "--camera", str(cameras), "--out", str(out), *words]) == 0
    return torch.from_numpy(np.load(out))


def outputs(times: Sequence[float]) -> list[Any]:
    settings = RenderSettings(backend="reference", depth=True)
    with torch.no_grad():
        return [render(moving(), CAMERA, {"time": torch.tensor(time)}, settings, BLACK) for time in times]


def moments(start: float, end: float, count: int) -> list[float]:
    return [start + (end - start) * (i + 0.5) / count for i in range(count)]


def test_eight_sub_frames_are_close_to_the_mean_of_32(run: Path, cameras: Path, tmp_path: Path) -> None:
    found = rendered(run, cameras, tmp_path / "a.npy", "--frame", "13", "--shutter", "0.5")
    mean = torch.stack([o.rgb for o in outputs(moments(0.5 - 1 / 16, 0.5 + 1 / 16, 32))]).mean(0)
    sharp = rendered(run, cameras, tmp_path / "b.npy", "--frame", "13")
    assert psnr(found, mean) > max(45, psnr(sharp, mean) + 10)
    exact = rendered(run, cameras, tmp_path / "c.npy", "--frame", "13", "--shutter", "0.5", "--shutter-samples", "32")
    assert (exact - mean).abs().max() < 1e-5


def test_times_are_clamped_to_the_sequence(run: Path, cameras: Path, tmp_path: Path) -> None:
    words = ["--frame", "11", "--shutter", "1", "--shutter-samples", "2"]
    found = rendered(run, cameras, tmp_path / "a.npy", *words)
    early, late = (o.rgb for o in outputs((0.0, 1 / 16)))
    assert (found - (early + late) / 2).abs().max() < 1e-5


def test_srgb_values_are_averaged_in_linear_light(cameras: Path, tmp_path: Path) -> None:
    run = run_directory(tmp_path / "run", "srgb")
    words = ["--time", "0.25:0.75:3", "--shutter", "0.5", "--shutter-samples", "2", "--format", "npy"]
    assert main(["render", str(run), "--camera", str(cameras), "--out", str(tmp_path / "out"), *words]) == 0
    middle = np.load(sorted((tmp_path / "out").iterdir())[1])
    mean = torch.stack([srgb_to_linear(o.rgb.clamp_min(0)) for o in outputs((0.5 - 1 / 32, 0.5 + 1 / 32))]).mean(0)
    assert np.abs(middle - linear_to_srgb(mean).numpy()).max() < 1e-5


def test_layers_are_means_and_depth_is_weighted_by_alpha(run: Path, cameras: Path, tmp_path: Path) -> None:
    words = ["--frame", "13", "--shutter", "0.5", "--shutter-samples", "4", "--out", str(tmp_path / "a.exr")]
    assert main(["render", str(run), "--camera", str(cameras), *words]) == 0
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        found = {name: torch.from_numpy(np.array(c.pixels)) for name, c in file.channels().items()}
        assert file.header()["neuprim:shutter"] == 0.5
        assert file.header()["neuprim:condition:time"] == 0.5
    images = outputs(moments(0.5 - 1 / 16, 0.5 + 1 / 16, 4))
    alpha = torch.stack([o.alpha for o in images])
    depth = torch.stack([o.depth for o in images])
    assert (
        torch.stack([found[c] for c in "RGB"], -1) - torch.stack([o.rgb for o in images]).mean(0)
    ).abs().max() < 1e-5
    assert (found["A"] - alpha.mean(0)).abs().max() < 1e-5
    weighted = (depth * alpha).sum(0) / alpha.sum(0).clamp_min(1e-12)
    assert (found["depth.Z"] - weighted).abs()[found["A"] > 1e-3].max() < 1e-3


def test_an_animation(run: Path, cameras: Path, tmp_path: Path) -> None:
    film = tmp_path / "film.webp"
    words = ["--time", "0:1:3", "--shutter", "1", "--shutter-samples", "2", "--out", str(film)]
    assert main(["render", str(run), "--camera", str(cameras), *words]) == 0
    with Image.open(film) as image:
        assert getattr(image, "n_frames", 1) == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--shutter", "0"], "'0': expected a part of the frame interval, above 0 and at most 1"),
        (["--shutter", "1.5"], "'1.5': expected a part of the frame interval, above 0 and at most 1"),
        (["--shutter-samples", "4"], "--shutter-samples: needs --shutter, too; pass for example --shutter 0.5"),
        (
            ["--shutter", "0.5"],
            "--shutter 0.5: the frame interval is unknown: all images show one time, and the model has no numbered "
            "frames",
        ),
    ],
)
def test_wrong_shutters_are_refused(
    cameras: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    run = run_directory(tmp_path / "run")
    try:
        assert main(["render", str(run), "--camera", str(cameras), "--time", "0.5", *words]) == 2
    except SystemExit as error:  # argparse
        assert error.code == 2
    assert message in capsys.readouterr().err


def test_models_without_time_are_refused(cameras: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = marked.static_run(tmp_path / "static")
    assert main(["render", str(run), "--camera", str(cameras), "--shutter", "0.5"]) == 2
    assert "--shutter 0.5: the model does not vary in time" in capsys.readouterr().err
