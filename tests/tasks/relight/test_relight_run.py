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
from neuprim.core.errors import ConfigError
from neuprim.core.io.exr import exr_channels, write_exr
from neuprim.core.io.images import read_image
from neuprim.plugins.registry import load_task
from neuprim.runs.fit import make_trainer
from neuprim.runs.open import load_dataset, load_run
from neuprim.runs.render_images import RenderRequest, render_run
from neuprim.runs.run import run
from tests.reports import offered

SCENE = [
    "task=relight",
    "scene=lit_solids",
    "scene.size=32",
    "scene.train_views=24",
    "scene.test_views=6",
    "scene.supersampling=1",
]
SMALL = ["model.primitives=150", "model.neurons=2", "model.colour.hidden=3", "train.max_seconds=null"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("relight") / "run"
    return run(compose([*SCENE, *SMALL, "train.iterations=600", f"output_dir='{target}'"]))


def test_a_run_learns(finished: Path) -> None:
    m = json.loads((finished / "metrics.json").read_text())
    assert m["psnr_linear_clamped"] > m["baselines"]["black"]["psnr_linear_clamped"] + 2
    assert m["backend"] == "cpu" and m["data_source"] == "generated"
    assert "Held-out films" in (finished / "report.html").read_text()


def test_a_new_light_changes_the_picture(finished: Path, tmp_path: Path) -> None:
    one, other = (
        render_run(
            finished,
            RenderRequest("orbit", format="exr", out=tmp_path / name, frames=1, conditions={"light": where}),
        )[0]
        for name, where in (("a", "3,0,3"), ("b", "-3,1,2"))
    )
    assert one.read_bytes() != other.read_bytes()


def test_the_light_goes_round(finished: Path, tmp_path: Path) -> None:
    target = tmp_path / "film.webp"
    words = [
        "render",
        str(finished),
        "--camera",
        "orbit",
        "--frames",
        "1",
        "--light",
        "orbit:4:40:5",
        "--out",
        str(target),
    ]
    assert main(words) == 0
    with Image.open(target) as film:
        assert getattr(film, "n_frames", 1) == 5


def test_the_report_offers_commands_that_work(finished: Path, tmp_path: Path) -> None:
    commands = offered(finished / "report.html")
    assert ["render", str(finished), "--camera", "orbit", "--light", "orbit"] in commands
    assert not any("--time" in words for words in commands), "a scene under lights has no time"
    for i, words in enumerate(commands):
        small = ["--size", "6x5", "--frames", "2", "--out", str(tmp_path / str(i))] if words[0] == "render" else []
        assert main([*words, *small]) == 0, words


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
    words = [
        "render",
        str(finished),
        "--environment",
        str(tmp_path / "sky.exr"),
        "--environment-samples",
        "5",
        "--frames",
        "3",
    ]
    assert main([*words, "--camera", "test", "--out", str(tmp_path / "test")]) == 0
    assert len(list((tmp_path / "test").glob("*.png"))) == 6
    assert main([*words, "--camera", "orbit", "--out", str(tmp_path / "film.webp")]) == 0
    assert (
        "of the environment's light comes from more than 15 degrees off every training light" in capsys.readouterr().err
    )
    with Image.open(tmp_path / "film.webp") as film:
        assert getattr(film, "n_frames", 1) == 3
        assert np.asarray(film.convert("RGB")).std() > 5


def test_layers_from_the_command_line(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["render", str(finished), "--camera", "test", "--size", "12x10", "--format", "exr", "--out"]
    assert main([*words, str(tmp_path / "all")]) == 0
    first = sorted((tmp_path / "all").glob("*.exr"))[0]
    light = [f"unshadowed.{c}" for c in "BGR"]
    assert list(exr_channels(first)) == ["A", "B", "G", "R", "density.Y", "depth.Z", *light, "visibility.Y"]
    write_exr(tmp_path / "sky.exr", torch.ones(4, 8, 3), half=False)
    sky = ["--environment", str(tmp_path / "sky.exr"), "--environment-samples", "3"]
    assert main([*words, str(tmp_path / "sky"), *sky, "--layers", "beauty,alpha,lights", "--datatype", "half"]) == 0
    apart = sorted((tmp_path / "sky").glob("*.exr"))[0]
    assert set(exr_channels(apart)) == {*"RGBA", *(f"light_{i:03d}.{c}" for i in range(3) for c in "RGB")}
    parts = sum(read_image(apart, channels=[f"light_{i:03d}.{c}" for c in "RGB"]).float() for i in range(3))
    beauty = read_image(apart, channels="RGB")
    assert beauty.dtype == torch.float16 and isinstance(parts, torch.Tensor) and beauty.max() > 0
    assert (parts - beauty.float()).abs().max() < 2e-3 * beauty.max(), "as far as 16 bits go"
    for more, message in (
        (
            ["--layers", "shadow"],
            "--layers shadow: no such layer; expected some of beauty, alpha, depth, density, unshadowed, visibility",
        ),
        (["--layers", "lights"], "--layers lights: no such layer"),
        (
            [*sky, "--layers", "visibility"],
            "--layers visibility: no such layer; expected some of beauty, alpha, depth, density, unshadowed, lights",
        ),
    ):
        assert main([*words, str(tmp_path / "no"), *more]) == 2
        assert message in capsys.readouterr().err
    assert main(["render", str(finished), "--camera", "test", "--format", "png", "--datatype", "half"]) == 2
    assert "--datatype half: of OpenEXR files; expected --format exr, found png" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "colour"),
    [
        (["model.colour.form=multiplicative"], {"form": "multiplicative", "hidden": 3, "visibility": "primitive"}),
        (["model.colour.form=harmonics", "model.colour.degree=3"], {"degree": 3}),
        (
            ["model.colour.visibility=none", "train.loss=compressed"],
            {"form": "additive", "hidden": 3, "visibility": "none"},
        ),
        (
            ["model.colour.hidden=0", "train.loss=relative"],
            {"form": "additive", "hidden": 0, "visibility": "primitive"},
        ),
        (["preset=paper", "train.population.every=5"], {"form": "additive", "hidden": 3, "visibility": "none"}),
    ],
)
def test_every_variant_runs(tmp_path: Path, words: list[str], colour: dict[str, object]) -> None:
    """To the end: the model on disk is what was asked for, has moved from where it started, and was measured."""
    small = [w for w in SMALL if not (w.startswith("model.colour") and "harmonics" in str(words))]
    config = compose([*SCENE, *small, *words, "train.iterations=8", f"output_dir='{tmp_path / 'run'}'"])
    task = load_task("relight")
    start = make_trainer(config, task, load_dataset(config, task)).model
    m = json.loads((run(config) / "metrics.json").read_text())
    assert m["iterations"] == 8 and len(m["per_view"]) == 6 and m["psnr_linear_clamped"] > 5
    end = load_run(tmp_path / "run")[2]
    assert colour.items() <= end.colour.settings().items()
    for name in end.params:
        changed = not torch.equal(start.params[name], end.params[name])
        assert changed == (end.params[name].numel() > 0), name


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("model.colour.form=add", r"model\.colour\.form=add: expected additive, multiplicative or harmonics"),
        ("model.colour.hidden=99", r"model\.colour: .*expected 0\.\.16"),
        ("model.density.time=phase", r"model\.density\.time: no such setting"),
    ],
)
def test_wrong_choices(word: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        compose(["task=relight", word])


def test_a_wrong_loss() -> None:
    with pytest.raises(ConfigError, match=r"train\.loss=l2: no such loss; did you mean 'l1'\?"):
        compose(["task=relight", "train.loss=l2"], False)
    with pytest.raises(
        ConfigError, match=r"task\.options\.loss: task 'relight' has no such option; did you mean 'train\.loss'\?"
    ):
        compose(["task=relight", "+task.options.loss=compressed"], False)
