"""Every task's first training step through the kernels on Warp's CPU blocks is that of the cpu backend."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.config import compose
from neuprim.runs.fit import prepare_training
from tests.core import tiny
from tests.short_runs import words

SMALL = ["model.primitives=80", "model.neurons=2", "train.max_seconds=null", "train.iterations=12"]
SCENES = {
    "dynamic": "scene=smoke_fire scene.size=16 scene.cameras=4 scene.timesteps=2 scene.resolution=16",
    "relight": "scene=lit_solids scene.size=24 scene.train_views=3 scene.test_views=1 scene.supersampling=1 "
    "model.colour.hidden=3",
}


@pytest.mark.parametrize("task", ["static", *SCENES])
def test_first_gradients_are_the_cpu_backends(task: str, tmp_path: Path) -> None:
    """Before Adam divides them by their size, after which rounding of what is nearly zero is a step like any other."""
    if task == "static":
        config = words(tiny.write_blender(tmp_path / "two"), tmp_path / "run", 12)
    else:
        config = [f"task={task}", *SCENES[task].split(), *SMALL, f"output_dir='{tmp_path / 'run'}'"]
    one = prepare_training(compose([*config, "renderer.backend=cpu"]))
    other = prepare_training(compose([*config, "renderer.backend=cuda", "renderer.device=cpu"]), dataset=one.dataset)
    reports = [x.trainer.train_step() for x in (one, other)]
    assert reports[1].loss == pytest.approx(reports[0].loss, rel=1e-5) and reports[0].loss > 1e-3
    for name, value in one.trainer.optimizer.m.items():
        found = other.trainer.optimizer.m[name]
        least = 1e-8 if name == "quats" else 0.0  # all of it is rounding, as fresh primitives are balls
        assert torch.allclose(found, value, rtol=1e-4, atol=1e-4 * float(value.abs().max()) + least), name
    assert float(one.trainer.optimizer.m["means"].abs().max()) > 0
