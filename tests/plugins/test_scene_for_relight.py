"""A scene of another package for a task that judges more than images: it knows a Dataset alone."""

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

from neuprim.core.extensions import SceneExtension
from neuprim.core.task import SceneSpec
from tests.core.tiny import Views, two_primitives


class Lit(Views):
    def view(self, index):
        light = torch.tensor([3.0, float(index) - 2.0, 3.0])
        return replace(super().view(index), conditions={"light": light, "light_intensity": torch.ones(3)})


def load(settings, context):
    data = two_primitives(views=Lit, background=torch.zeros(3), color_space="linear", exposure=2.0)
    return data


PLUGIN = SceneExtension(api=1, task="relight", scene=SceneSpec("mine", "two ellipsoids", load),
                        config_package="lit_scene.conf")
"""
WORDS = [
    "task=relight", "scene=mine", "renderer.backend=reference", "model.primitives=8", "model.colour.visibility=none",
    "train.iterations=4", "train.max_seconds=null", "--out", "r",
]  # fmt: skip


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)


def run(site: Path) -> int:
    files = {
        "lit_scene/__init__.py": SCENE,
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
    assert run(site) == 0
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
