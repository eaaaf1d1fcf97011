"""Runs of a tiny scene that are over in a second or two."""

from __future__ import annotations

from pathlib import Path

import neuprim.runs.run as running
from neuprim.config import compose

STEPS = 240


def words(scene: Path, out: Path, iterations: int = STEPS, *more: str) -> list[str]:
    """Overrides of a run that is over in a second or two and reproducible to the bit."""
    return [
        "task=static", "scene=blender", f"scene.path={scene}", "scene.background=random", f"output_dir={out}",
        "model.primitives=40", "model.neurons=4", "model.colour.form=sh", "model.sh_degree=3", "model.sh_every=0.5",
        "seed=3",
        f"train.iterations={iterations}",
        "train.max_seconds=null", "train.log_every=10", "train.eval_every=0.25", "train.population.every=20",
        "train.population.start=0.05",
        *more,
    ]  # fmt: skip


def command_line(overrides: list[str]) -> list[str]:
    """The words of ``neuprim run`` for overrides of a configuration: there the directory is a flag."""
    places = [word.partition("=")[2].strip("'") for word in overrides if word.startswith("output_dir=")]
    return [*(word for word in overrides if not word.startswith("output_dir=")), *(f"--out={p}" for p in places)]


def fit(overrides: list[str]) -> Path:
    return running.run(compose(overrides))
