"""A whole run of the relighting task, small: images under lights in; a report, new lights and an orbit of the light
out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.cli import main
from neuprim.config import compose
from neuprim.core.io.exr import write_exr
from neuprim.runs.run import run
from tests.reports import offered

SCENE = (
    "task=relight scene=lit_solids scene.size=32 scene.train_views=24 scene.test_views=6 scene.supersampling=1".split()
)
SMALL = ["model.primitives=150", "model.neurons=2", "train.max_seconds=null"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("relight") / "run"
    return run(compose([*SCENE, *SMALL, "train.iterations=600", f"output_dir='{target}'"]))


def test_a_run_learns(finished: Path) -> None:
    m = json.loads((finished / "metrics.json").read_text())
    assert m["psnr_linear_clamped"] > m["baselines"]["black"]["psnr_linear_clamped"] + 2
    assert m["backend"] == "cpu" and m["data_source"] == "generated"
    assert "Held-out films" in (finished / "report.html").read_text()


def test_the_light_goes_round(finished: Path, tmp_path: Path) -> None:
    target = tmp_path / "film.webp"
    words = ["render", str(finished), "--camera", "orbit", "--frames", "1", "--light", "orbit:4:40:5"]
    assert main([*words, "--out", str(target)]) == 0
    with Image.open(target) as film:
        assert getattr(film, "n_frames", 1) == 5


def test_the_report_offers_commands_that_work(finished: Path, tmp_path: Path) -> None:
    commands = offered(finished / "report.html")
    assert ["render", str(finished), "--camera", "orbit", "--light", "orbit"] in commands
    assert not any("--time" in words for words in commands), "a scene under lights has no time"
    for i, words in enumerate(commands):
        out = ["--out", str(tmp_path / str(i))]
        small = {"render": ["--size", "6x5", "--frames", "2", *out], "compress": ["--steps", "0", *out]}
        if words[0] != "view":  # serves a page until it is stopped
            assert main([*words, *small.get(words[0], [])]) == 0, words


def test_a_missing_condition_is_asked_for_by_its_flag(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = {"w": 6, "h": 5, "camera_angle_x": 0.5, "frames": [{"name": "a", "transform_matrix": np.eye(4).tolist()}]}
    (tmp_path / "cameras.json").write_text(json.dumps(camera))
    words = ["render", str(finished), "--camera", str(tmp_path / "cameras.json"), "--light", "3,0,3"]
    assert main(words) == 2
    assert "has no light_intensity, which task 'relight' needs; give --light-intensity" in capsys.readouterr().err
    assert main([*words, "--light-intensity", "9", "--out", str(tmp_path / "a.png")]) == 0


def test_light_from_all_around(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sky = torch.linspace(1.0, 0.0, 16)[:, None, None].expand(16, 32, 3)
    write_exr(tmp_path / "sky.exr", sky, half=False)
    around = ["--environment", str(tmp_path / "sky.exr"), "--environment-samples", "5"]
    words = ["render", str(finished), *around, "--frames", "3"]
    assert main([*words, "--camera", "test", "--out", str(tmp_path / "test")]) == 0
    assert len(list((tmp_path / "test").glob("*.png"))) == 6
    assert main([*words, "--camera", "orbit", "--out", str(tmp_path / "film.webp")]) == 0
    assert (
        "of the environment's light comes from more than 15 degrees off every training light" in capsys.readouterr().err
    )
    with Image.open(tmp_path / "film.webp") as film:
        assert getattr(film, "n_frames", 1) == 3
        assert np.asarray(film.convert("RGB")).std() > 5
