"""A run directory of a few primitives that move, without training, and volumes that show the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from neuprim.config import compose
from neuprim.core.checkpoint import save_model
from neuprim.core.io.vdb import VdbGrid, vdb_scale_transform, write_vdb
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity

NUMBERS = (4, 5, 6)
VOXEL = 0.5


def model() -> Primitives:
    """A dense ball of radius 0.3 that moves along x, and a thin one above it."""
    generator = torch.Generator().manual_seed(1)
    means = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.45]])
    context = InitContext(means, torch.tensor([0.3, 0.15]), torch.tensor([[0.9, 0.2, 0.1], [0.1, 0.3, 0.9]]), generator)
    made = Primitives.initialise(TimeDensity(2, "window+motion"), TimeHarmonics(), context)
    made.params["velocity"][:] = torch.tensor([0.3, 0.0, 0.0])
    made.params["window_center"][:], made.params["log_window"][:] = 0.5, 3.0
    made.params["b2"][:] = torch.tensor([[2.0], [0.4]])
    made.params["w2"][0] *= 10.0
    return made


def volumes(folder: Path) -> Path:
    """Frames 4, 5 and 6 of a ball that moves along x, in a world of its own."""
    folder.mkdir(parents=True)
    index = np.stack(np.meshgrid(*(np.arange(24, dtype=np.float32),) * 3, indexing="ij"), -1)
    for number in NUMBERS:
        radius = np.linalg.norm(index - np.array([8.0 + 4 * (number - 4), 12, 12], np.float32), axis=-1)
        value = np.clip(1 - radius / 6, 0, None)
        grid = VdbGrid.from_dense("density", value, transform=vdb_scale_transform(VOXEL, (10.0, 0.0, -3.0)))
        write_vdb(folder / f"ball_{number}.vdb", [grid], compression="zip")
    return folder


def run_directory(folder: Path) -> Path:
    """A run of ``scene=vdb`` whose files are in ``folder``/files."""
    files, run = volumes(folder / "files"), folder / "run"
    words = [
        "task=dynamic",
        "scene=vdb",
        f"scene.vdb={files}",
        "scene.size=8",
        "scene.cameras=4",
        "scene.samples=1",
        f"output_dir={run}",
    ]
    run.mkdir()
    (run / "config.yaml").write_text(compose(words).to_yaml())
    save_model(run / "model.safetensors", model(), "dynamic", {"color_space": "linear", "background": [0.0, 0.0, 0.0]})
    return run
