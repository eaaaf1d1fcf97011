"""A scene of another package for a task that judges more than images: it knows a Dataset, and may know one class
more."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from neuprim.cli import main
from neuprim.core import checkpoint
from neuprim.core.io.exr import write_exr
from tests.plugins.fakes import install, site

__all__ = ["site"]

SCENE = """
from dataclasses import replace

import torch

from neuprim.core.data import Clip
from neuprim.core.extensions import SceneExtension
from neuprim.core.task import SceneSpec
from neuprim.tasks.relight.lighting import Lighting
from tests.core.tiny import SIZE, Views, two_primitives


class Lit(Views):
    def view(self, index):
        light = torch.tensor([3.0, float(index) - 2.0, 3.0])
        return replace(super().view(index), conditions={{"light": light, "light_intensity": torch.ones(3)}})


def known(views):
    classes = torch.ones(SIZE, SIZE, dtype=torch.uint8)
    classes[:, 12:] = 2
    return Lighting(
        "inverse_square",
        classes=lambda index: classes,
        parts=("v0",),
        baselines={{"grey": lambda index: torch.full((SIZE, SIZE, 3), 0.2)}},
        clips=(Clip("all", range(6), 5.0, views),),
    )


def load(settings, context):
    data = two_primitives(views=Lit, background=torch.zeros(3), color_space="linear", exposure=2.0)
    return replace(data, extra={extra})


PLUGIN = SceneExtension(api=1, task="relight", scene=SceneSpec("mine", "two ellipsoids", load),
                        config_package="lit_scene.conf")
"""
WORDS = [
    "task=relight", "scene=mine", "renderer.backend=reference", "model.primitives=8", "model.colour.visibility=none",
    "train.iterations=4", "train.max_seconds=null", "output_dir=r",
]  # fmt: skip


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)


def run(site: Path, extra: str) -> int:
    files = {
        "lit_scene/__init__.py": SCENE.format(extra=extra),
        "lit_scene/conf/__init__.py": "",
        "lit_scene/conf/scene/relight/mine.yaml": "{}",
    }
    install(site, "lit-scene", {"relight.mine": "lit_scene:PLUGIN"}, files, group="neuprim.scenes")
    return main(["run", *WORDS])


def written() -> tuple[dict[str, Any], dict[str, Any]]:
    """Metrics, and what the model's header says of the data."""
    header = checkpoint.read_tensors(Path("r/model.safetensors"), "model")[0]
    return json.loads(Path("r/metrics.json").read_text()), header["data"]


def test_images_cameras_and_lights_are_enough(site: Path) -> None:
    assert run(site, "None") == 0
    metrics, data = written()
    assert (metrics["exposure"], metrics["falloff"], list(metrics["baselines"])) == (2.0, "none", ["black"])
    assert all({"psnr_linear_clamped", "psnr_display", "psnr_mask"} <= view.keys() for view in metrics["per_view"])
    lights = data["lights"]
    assert (lights["falloff"], lights["exposure"], len(lights["directions"])) == ("none", 2.0, 6)
    with Image.open("r/renders/orbit.webp") as film:
        assert getattr(film, "n_frames", 1) == 2
    write_exr(Path("sky.exr"), torch.ones(8, 16, 3))
    words = "--camera orbit --frames 2 --environment sky.exr --environment-samples 4 --format png --out sky"
    assert main(["render", "r", *words.split()]) == 0
    assert len(list(Path("sky").glob("*.png"))) == 2


def test_what_else_it_knows_of_its_pixels_counts(site: Path) -> None:
    assert run(site, "known(data.train)") == 0
    metrics, data = written()
    assert metrics["falloff"] == data["lights"]["falloff"] == "inverse_square"
    assert list(metrics["baselines"]) == ["black", "grey"]
    assert (
        metrics["pixels_lit"] == metrics["pixels_cast_shadow"] == 2 * 24 * 12 and "psnr_pooled_cast_shadow" in metrics
    )
    assert ["psnr_linear_clamped_v0" in view for view in metrics["per_view"]] == [True, False]
    assert metrics["class_percent"] == {"lit": 50.0, "cast_shadow": 50.0, "attached_shadow": 0.0, "highlight": 0.0}
    with Image.open("r/renders/clip_all.webp") as film:
        assert getattr(film, "n_frames", 1) == 6


def test_another_class_is_refused_before_training(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(site, "3") == 2
    expected = (
        "scene 'mine' of lit-scene 0.3: two: extra is a int; expected a "
        "neuprim.tasks.relight.lighting.Lighting, or None"
    )
    assert expected in capsys.readouterr().err and not Path("r").exists()
