"""A finished run, opened again: its configuration, task, model, data and metrics, from disk alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from neuprim.config import RunConfig, find_run_plugins, scene_of, task_of
from neuprim.config.trust import check_stored, refuse_links
from neuprim.core.cameras.world import World
from neuprim.core.checkpoint import load_model, read_header
from neuprim.core.data import Dataset, View
from neuprim.core.errors import DataError
from neuprim.core.extensions import TrainedModel
from neuprim.core.io.files import cache_directory
from neuprim.core.io.plain import finite, load_json
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.core.render.backends import computing_device, device_of, with_available_device
from neuprim.core.task import SceneContext, TaskSpec
from neuprim.core.volumes.source import VolumeSource
from neuprim.plugins.attribution import attribute_errors
from neuprim.plugins.provenance import warn_of_other_neuprim
from neuprim.plugins.registry import PluginError

COMPRESSED = "model.neuprim"
"""A run's model in few bits, as ``neuprim compress`` writes it."""

Progress = Callable[[str, float], None]


def model_file(run_dir: Path) -> Path:
    """The model of a run directory: ``model.safetensors``, or the compressed one where that is the only one."""
    whole, compressed = run_dir / "model.safetensors", run_dir / COMPRESSED
    return compressed if compressed.exists() and not whole.exists() else whole


def load_dataset(
    config: RunConfig,
    task: TaskSpec,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
    run_dir: Path | None = None,
) -> Dataset:
    """The data set of a run's configuration.

    Args:
        run_dir: the finished run that the configuration was read from: messages name its file. None: a run that is only
            about to be made.

    Raises:
        NeuprimError: what the loader refuses, or that it crashed.
    """
    context = make_scene_context(config, progress)
    if (
        run_dir is not None and model_file(run_dir).exists()
    ):  # its cameras and points lie as they did for the model, whatever was added since
        context = replace(context, world=World.of(read_header(model_file(run_dir), "model"), str(model_file(run_dir))))
    load = scene_of(config, task, None if run_dir is None else run_dir / "config.yaml").spec.load
    scene = find_run_plugins(config).scene
    with attribute_errors(scene, "load"):
        dataset = load(config.scene, context)
    if not isinstance(dataset, Dataset):
        found = f"a {type(dataset).__name__}" if dataset is not None else "None"
        raise PluginError(f"{scene.label}: its loader returned {found}; expected a neuprim.core.data.Dataset")
    return dataset


def load_run(run_dir: Path, named: bool = True) -> tuple[RunConfig, TaskSpec, Primitives, dict[str, Any]]:
    """Configuration, task, model and model header of a run directory; the task reads positions in the world of the
    run's files.

    Warns where another version of neuprim or of the task's package made the run.

    Args:
        named: whether what is said about these names the file; not for a directory that the user does not know.

    Raises:
        CheckpointError, ConfigError: naming the file that is missing or damaged.
    """
    refuse_links(run_dir)
    file = run_dir / "config.yaml"
    config, place = RunConfig.from_yaml(file), file if named else None
    task = task_of(config, place)
    if config.made_by is not None:
        warn_of_other_neuprim(config.made_by, place)
    model, header = load_model(model_file(run_dir), task)
    world = World.of(header, str(model_file(run_dir)))
    if any(spec.place for spec in task.conditions) and not world.identity:
        task = replace(task, conditions=tuple(spec.within(world) for spec in task.conditions))
    return replace(config, renderer=with_available_device(config.renderer)), task, model, header


def move_to_render_device(model: Primitives, settings: RenderSettings, view: View) -> Primitives:
    """The model where views like this one are best drawn."""
    return model.to(device_of(model, settings, view.camera, view.conditions))


def make_scene_context(config: RunConfig, progress: Progress) -> SceneContext:
    """What a run's scene is loaded with.

    Raises:
        ConfigError: a stored configuration has the scene contact an address, or write outside of the run
        (:mod:`neuprim.config.trust`).
    """
    check_stored(config)
    return SceneContext(config.seed, cache_directory() / "scenes", progress, computing_device(config.renderer))


def open_run(run_dir: Path, progress: Progress = lambda text, fraction: None) -> TrainedModel:
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
        with attribute_errors(find_run_plugins(config).scene, "volume"):
            return load(config.scene, make_scene_context(config, progress))

    def dataset() -> Dataset:
        return load_dataset(config, task, progress, run_dir)

    return TrainedModel(run_dir, task, model, header, config.scene, config.renderer, dataset, volume)


def read_metrics(run_dir: Path) -> dict[str, Any]:
    """``metrics.json`` of a run.

    Raises:
        DataError: missing or damaged.
    """
    path = run_dir / "metrics.json"
    try:
        data = load_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: {error}") from error
    if not isinstance(data, dict) or any(
        finite(data[name]) is None for name in ("ssim", "train_seconds") if data.get(name) is not None
    ):
        raise DataError(f"{path}: expected an object with metrics")
    return data
