"""No length is absolute: a scene trains to the same quality in any unit, in every task."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch

from neuprim.config import compose
from neuprim.core.cameras import Camera, look_at
from neuprim.core.io.images import write_png
from neuprim.runs.fit import fit

SIZE, ANGLE = 32, 0.8
WORDS = {
    "static": ["scene=blender"],
    "dynamic": ["scene=multiview"],
    "relight": ["scene=olat", "scene.falloff=inverse_square"],
}


def shot(index: int, split: int) -> tuple[Camera, float]:
    """A camera 4 from the origin and how far round the light is."""
    azimuth = 2.399963 * index + split
    eye = torch.tensor([3.9 * math.cos(azimuth), 3.9 * math.sin(azimuth), 0.9 + 0.1 * (index % 5)], dtype=torch.float64)
    focal = 0.5 * SIZE / math.tan(0.5 * ANGLE)
    return Camera(
        look_at(eye, torch.zeros(3), torch.tensor([0.0, 0, 1])), focal, focal, SIZE / 2, SIZE / 2, SIZE, SIZE
    ), azimuth + 0.7


def image(camera: Camera, light: torch.Tensor) -> torch.Tensor:
    """(H, W, 4) a shaded ball of radius 1 about the origin, in two colours."""
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    d = (
        torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1).double()
        @ camera.viewmat[:3, :3]
    )
    d = d / d.norm(dim=-1, keepdim=True)
    along = -(d @ camera.position)
    disc = along**2 - camera.position.square().sum() + 1
    p = camera.position + (along - disc.clamp_min(0).sqrt())[..., None] * d
    shade = 0.3 + 0.7 * (p @ (light / light.norm())).clamp(0, 1)
    color = torch.where(
        (p[..., 2:] > 0), torch.tensor([0.9, 0.5, 0.2]).double(), torch.tensor([0.2, 0.5, 0.9]).double()
    )
    return torch.cat([color * shade[..., None], (disc > 0).double()[..., None]], -1).float().clamp(0, 1)


def write(folder: Path, task: str, unit: float) -> None:
    for number, (split, count) in enumerate({"train": 16, "test": 4}.items()):
        (folder / split).mkdir(parents=True)
        frames = []
        for i in range(count):
            camera, turn = shot(i, number)
            light = torch.tensor([3.0, 3.0, 4.0], dtype=torch.float64)
            if task == "relight":
                light = 5 * torch.tensor([math.cos(turn), math.sin(turn), 0.8], dtype=torch.float64)
            write_png(folder / split / f"{i}.png", image(camera, light))
            pose = torch.linalg.inv(camera.viewmat) @ torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
            pose[:3, 3] *= unit
            frame = {"file_path": f"./{split}/{i}", "transform_matrix": pose.tolist()}
            frame |= {"time": i / (count - 1)} if task == "dynamic" else {}
            frame |= {"pl_pos": (unit * light).tolist()} if task == "relight" else {}
            frames.append(frame)
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": ANGLE, "frames": frames}))


@pytest.mark.parametrize("task", WORDS)
def test_a_scene_in_any_unit(task: str, tmp_path: Path) -> None:
    found = {}
    for unit in (1.0, 1e-4, 1e4):
        folder = tmp_path / f"{unit:g}"
        write(folder, task, unit)
        # few steps: rounding is another in every unit, and what it decides grows with each
        small = "model.primitives=120 train.iterations=30 renderer.threads=1"
        words = [f"task={task}", *WORDS[task], f"scene.path={folder}", *small.split()]
        fitted = fit(compose([*words, f"output_dir={tmp_path / 'run'}"]))
        near = fitted.config.renderer.near
        assert near == pytest.approx(0.01 * unit, rel=0.3), "decided in the scene's own unit, and recorded"
        metrics = fitted.metrics()
        assert "views_empty" not in metrics
        found[unit] = metrics["psnr"]
    assert max(found.values()) - min(found.values()) < 0.2, found
