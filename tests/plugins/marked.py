"""Run directories of tiny models whose axes cannot be mistaken: a large red ball in the origin, small ones out on +x,
+y and +z."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuprim.config import compose
from neuprim.core import checkpoint
from neuprim.core.io.vdb import VdbGrid, write_vdb
from neuprim.core.model import sh
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.plugins.registry import load_task

PLACES = torch.tensor([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0], [0.0, 0.6, 0.0], [0.0, 0.0, 0.5], [0.5, 0.7, 0.9]])
RADII = torch.tensor([0.3, 0.1, 0.1, 0.1, 0.05])
COLOURS = torch.tensor([[0.9, 0.2, 0.1], [0.1, 0.8, 0.2], [0.1, 0.2, 0.9], [0.8, 0.8, 0.1], [0.2, 0.9, 0.9]])


def static_model(neurons: int = 3, degree: int = 1) -> Primitives:
    """Opaque balls; the neurons only ripple on them."""
    generator = torch.Generator().manual_seed(5)
    task = load_task("static")
    assert task.fields is not None
    field = task.fields["SphericalHarmonics"](degree=degree)
    n, rest = len(PLACES), sh.sh_coefficient_count(degree) - 1
    params = {
        "means": PLACES.clone(),
        "log_scales": RADII.log()[:, None].repeat(1, 3),
        "quats": torch.randn(n, 4, generator=generator),
        "W1": torch.randn(n, neurons, 3, generator=generator) / 10,
        "b1": torch.randn(n, neurons, generator=generator),
        "w2": 0.05 * torch.randn(n, neurons, generator=generator),
        "b2": torch.full((n, 1), 6.0),
        "sh_dc": sh.initial_sh_dc(COLOURS),
    }
    if rest:
        params["sh_rest"] = 0.03 * torch.randn(n, rest, 3, generator=generator)
    return Primitives(CosineDensity(neurons), field, params)  # type: ignore[arg-type]


def write_run(folder: Path, model: Primitives, words: list[str], **header: Any) -> Path:
    """A run directory of the model as `neuprim run` leaves it, without pictures."""
    config = compose([*words, f"output_dir='{folder}'", "renderer.backend=reference"])
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(config.to_yaml())
    extra = {
        "background": [1.0, 1.0, 1.0],
        "color_space": "srgb",
        "data_source": "generated",
        "iterations": 7,
        "train_seconds": 0.1 + 0.2,
    }
    checkpoint.save_model(folder / "model.safetensors", model, config.task, {**extra, **header})
    return folder


def static_run(folder: Path, model: Primitives | None = None) -> Path:
    return write_run(folder, model or static_model(), ["task=static", "scene=solids"])


WORLD_VOXEL = 0.25
WORLD_SHIFT = (10.0, -4.0, 2.0)


def write_sequence(folder: Path, frames: tuple[int, ...] = (3, 4, 5)) -> Path:
    """Three little .vdb files in a world of their own: a block with one bright corner that grows along +x."""
    folder.mkdir(parents=True)
    for i, number in enumerate(frames):
        values = np.zeros((12, 10, 8), np.float32)
        values[2 : 6 + 2 * i, 2:8, 1:7] = 0.5
        values[2 : 6 + 2 * i, 5:8, 4:7] = 2.0
        matrix = np.diag([WORLD_VOXEL] * 3 + [1.0])
        matrix[:3, 3] = WORLD_SHIFT
        write_vdb(
            folder / f"block_{number}.vdb",
            [VdbGrid.from_dense("density", values, lower=(-3, 4, 5), transform=matrix)],
            compression="zip",
        )
    return folder


def dynamic_run(folder: Path, vdb: Path, **header: Any) -> Path:
    """A model of two primitives in the scene that the sequence makes; it is no fit, only something to compare."""
    task = load_task("dynamic")
    assert task.fields is not None
    density, colour = (
        task.fields["TimeDensity"](neurons=2, time="window"),
        task.fields["TimeHarmonics"](degree=0, powers=1, waves=0),
    )
    n = 2
    params = {
        "means": torch.tensor([[-0.2, 0.0, 0.0], [0.1, 0.2, 0.2]]),
        "log_scales": torch.tensor([[0.35, 0.3, 0.3], [0.2, 0.15, 0.15]]).log(),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        "W1": torch.full((n, 2, 3), 0.01),
        "b1": torch.zeros(n, 2),
        "w2": torch.full((n, 2), 0.1),
        "b2": torch.tensor([[2.0], [3.0]]),
        "window_center": torch.tensor([[0.5], [0.9]]),
        "log_window": torch.full((n, 1), math.log(0.8)),
        "sh_dc": torch.zeros(n, 3),
        "time_poly": torch.full((n, 1, 3), 0.1),
    }
    words = ["task=dynamic", "scene=vdb", f"scene.vdb={vdb}"]
    return write_run(folder, Primitives(density, colour, params), words, color_space="linear", **header)  # type: ignore[arg-type]
