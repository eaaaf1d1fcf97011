"""A run directory as plugins see it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from neuprim.config import scene_of, suspects_of
from neuprim.core.data import Dataset
from neuprim.core.extensions import TrainedModel
from neuprim.core.io.files import cache_directory
from neuprim.core.task import SceneContext
from neuprim.core.volumes.source import VolumeSource
from neuprim.plugins.blame import blamed
from neuprim.runs.draw import LOGS, load_dataset, load_run

__all__ = ["trained_model"]

Progress = Callable[[str, float], None]


def trained_model(run_dir: Path, progress: Progress = lambda text, fraction: None) -> TrainedModel:
    """The model of a run directory; its scene is loaded only when asked for.

    Raises:
        CheckpointError, ConfigError: naming the file that is missing or damaged.
    """
    config, task, model, header = load_run(run_dir)
    file = run_dir / "config.yaml"

    def volume() -> VolumeSource | None:
        load = scene_of(config, task, file).spec.volume
        if load is None:
            return None
        scene = suspects_of(config).scene
        with blamed(scene.origin, f"volume of {scene.what}", run_dir / LOGS):
            return load(config.scene, SceneContext(config.seed, cache_directory() / "scenes", progress))

    def dataset() -> Dataset:
        return load_dataset(config, task, progress, run_dir)

    return TrainedModel(run_dir, task, model, header, config.scene, config.renderer, dataset, volume)
