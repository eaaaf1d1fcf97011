"""Lock a run directory, load a finished run from its directory, and list its result files.

The lock keeps other processes from using the directory. Nothing here trains or changes a model.
"""

from __future__ import annotations

import json
import os
import re
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from neuprim.config import Job, RunConfig
from neuprim.config.stored_run import refuse_untrusted_run_links, refuse_untrusted_settings
from neuprim.core.cameras.world import World
from neuprim.core.checkpoint import load_model_checkpoint
from neuprim.core.compute.threads import limit_threads
from neuprim.core.data import Dataset, View
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.extensions import TrainedModel
from neuprim.core.io.files import cache_directory, remove_leftovers
from neuprim.core.io.json_reader import finite_json_number, load_json
from neuprim.core.model.fields import prunable_units_of_model
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.prunable import count_unit_numbers, primitives_with_unit
from neuprim.core.render import RenderSettings
from neuprim.core.render.backends import best_render_backend_device, with_available_render_backend
from neuprim.core.task import SceneContext, TaskSpec
from neuprim.core.volumes.density_truth import DensityGridSource
from neuprim.plugins.attribution import attribute_errors
from neuprim.plugins.provenance import warn_of_other_provenance
from neuprim.plugins.registry import PluginError

__all__ = ["StoredRun", "load_dataset", "load_run", "open_run", "read_metrics"]

COMPRESSED = "model.neuprim"
"""File name of a run's compressed model, as ``neuprim compress`` writes it."""

PRUNED = "pruned.json"
"""File in the run directory of a pruned model that records the pruning."""

LOCK_FILE = ".lock"
"""File in a locked run directory that names the process which holds the lock."""

_RESULT_FILES = ("metrics.json", "report.html", "viewer.html")
_RESULT_PICTURES = re.compile(r"test_\d{3,}_.*\.png|clip_.*\.webp|orbit\.webp|worst_\d{3,}\.png|preview\.png")

Progress = Callable[[str, float], None]


def ignore_progress(text: str, fraction: float) -> None:
    """Do nothing: the default of ``progress`` arguments, functions that are called with (text, fraction 0..1)."""


@dataclass(frozen=True)
class StoredRun(Job):
    """A finished run, loaded from its directory.

    ``task`` reads positions that users type (e.g. of a light) in the coordinates of the data's files.
    """

    directory: Path
    model: Primitives
    header: dict[str, Any]  # header of the model file
    scene_task: TaskSpec  # the task, which reads positions in the coordinates of the model

    @property
    def world(self) -> World:
        """Transform between the coordinates of the model and the coordinates of the data's files."""
        return World.of(self.header, str(model_file(self.directory)))


def model_file(run_dir: Path) -> Path:
    """Return the path of a run's model: ``model.safetensors`` or, if this file is missing, the compressed file."""
    full, compressed = run_dir / "model.safetensors", run_dir / COMPRESSED
    return compressed if compressed.exists() and not full.exists() else full


def load_run(run: Path | StoredRun, named: bool = True) -> StoredRun:
    """Load configuration, task and model from a run directory; an already loaded run is returned unchanged.

    Warns if another version of neuprim or of the task's package made the run.

    Args:
        named: whether warnings name the file; False for a temporary directory that the user does not know.

    Raises:
        CheckpointError: a file is missing or damaged.
        ConfigError: a setting in ``config.yaml`` is wrong.
    """
    if isinstance(run, StoredRun):
        return run
    refuse_untrusted_run_links(run)
    config = RunConfig.from_yaml(run / "config.yaml")
    if not named:
        config = replace(config, source=None)
    task = Job.of(config).task
    warn_of_other_provenance(config.made_by, config.source)
    model, header = load_model_checkpoint(model_file(run), task)
    config = replace(config, renderer=with_available_render_backend(config.renderer))
    stored = StoredRun(config, task, run, model, header, task)
    if not any(spec.place for spec in task.conditions):
        return stored

    def place_task(world: World) -> TaskSpec:
        return replace(task, conditions=tuple(spec.within(world) for spec in task.conditions))

    return replace(stored, task=place_task(stored.world), scene_task=place_task(World(up=stored.world.up)))


def make_run_scene_context(config: RunConfig, progress: Progress) -> SceneContext:
    """Return what a run's scene loader needs besides its settings: seed, cache directory and progress function.

    Raises:
        ConfigError: an untrusted stored configuration would make the scene contact an address, or write outside the run
        (:mod:`neuprim.config.stored_run`).
    """
    refuse_untrusted_settings(config)
    return SceneContext(config.seed, cache_directory() / "scenes", progress)


def load_dataset(job: Job, progress: Progress = ignore_progress) -> Dataset:
    """Load the data set of a job. For a stored run, the data have the coordinates of the stored model.

    Raises:
        NeuprimError: the files or settings are wrong, or the loader crashed.
    """
    context = make_run_scene_context(job.config, progress)
    if isinstance(job, StoredRun):
        context = replace(context, world=job.world)
    scene, source = job.scene, job.plugins.scene
    with attribute_errors(source, "load"), limit_threads(job.config.renderer.threads):
        dataset = scene.spec.load(job.config.scene, context)
    if not isinstance(dataset, Dataset):
        found = f"a {type(dataset).__name__}" if dataset is not None else "None"
        raise PluginError(f"{source.label}: its loader returned {found}; expected a neuprim.core.data.Dataset")
    return dataset


def open_run(run: Path | StoredRun, progress: Progress = ignore_progress) -> TrainedModel:
    """Load a run as the object that exporters and inspectors take. The scene's data are only loaded on demand.

    Raises the errors of :func:`load_run`.
    """
    stored = load_run(run)
    config = stored.config

    def volume() -> DensityGridSource | None:
        load = stored.scene.spec.volume
        if load is None:
            return None
        with attribute_errors(stored.plugins.scene, "volume"):
            return load(config.scene, make_run_scene_context(config, progress))

    return TrainedModel(
        stored.directory,
        stored.task,
        stored.model,
        stored.header,
        config.scene,
        config.renderer,
        lambda: load_dataset(stored, progress),
        volume,
    )


def move_to_render_device(model: Primitives, settings: RenderSettings, view: View) -> Primitives:
    """Move the model to the device on which the backend for ``settings`` renders views like ``view``."""
    return model.to(best_render_backend_device(model, settings, view.camera, view.conditions))


def read_metrics(run_dir: Path) -> dict[str, Any]:
    """Return the content of ``metrics.json`` of a run.

    Raises:
        DataError: the file is missing or damaged.
    """
    path = run_dir / "metrics.json"
    try:
        data = load_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: {error}") from error
    if not isinstance(data, dict) or any(
        finite_json_number(data[name]) is None for name in ("ssim", "train_seconds") if data.get(name) is not None
    ):
        raise DataError(f"{path}: not a metrics file; expected an object with numbers for ssim and train_seconds")
    return data


def kept_shares(model: Primitives) -> dict[str, float]:
    """Return name -> fraction of parameters that pruning has not removed, 0..1, e.g. ``{"density.neuron 0": 0.8}``.

    Each name is the name of a unit, or of a group of units. A unit is e.g. one neuron. In each primitive, pruning sets
    all or none of a unit's parameters to zero.
    """
    kept: dict[str, float] = {}
    sizes: dict[str, int] = {}
    for name, unit in prunable_units_of_model(model.density, model.colour).items():
        group, size = f"{name.partition('.')[0]}.{unit.group or unit.name}", count_unit_numbers(unit, model.params)
        share = float(primitives_with_unit(unit, model.params).float().mean()) if model.count else 0.0
        kept[group], sizes[group] = kept.get(group, 0.0) + size * share, sizes.get(group, 0) + size
    return {group: value / sizes[group] for group, value in kept.items()}


# ---------------------------------------------------------------- lock


@contextmanager
def lock_run_directory(directory: Path, what: str = "run") -> Iterator[None]:
    """Lock a directory against other processes. A missing directory is created, and removed again if it stays empty.

    The lock is an advisory lock of the system (``flock``; on Windows ``msvcrt``). The lock ends with the process. It
    works between machines on shared folders whose file system supports such locks: NFS from version 4 on, CephFS,
    GPFS, Lustre mounted with ``flock``.

    Args:
        what: what the error message calls the directory's content, e.g. "run".

    Raises:
        ConfigError: another process, or another thread, holds the lock.
        OSError: the directory cannot be created or written.
    """
    new = not directory.exists()
    directory.mkdir(parents=True, exist_ok=True)
    file = directory / LOCK_FILE
    lock = FileLock(file)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ConfigError(
            f"{directory}: {_describe_lock_holder(file)} is using this {what}; wait until it ends, or choose "
            f"another --out DIR"
        ) from None
    owner = {"host": socket.gethostname(), "pid": os.getpid(), "since": time.strftime("%F %T")}
    try:
        with suppress(OSError):  # a note for others; on Windows a locked file cannot be written
            file.write_text(json.dumps(owner), encoding="utf-8")
        remove_leftovers(directory)
        yield
    finally:
        with suppress(OSError):
            # before the release: a process that opened the file meanwhile sees that it is gone and makes a new one
            file.unlink()
        lock.release()
        with suppress(OSError):  # not empty
            if new:
                directory.rmdir()


def _describe_lock_holder(file: Path) -> str:
    try:
        data = load_json(file.read_text(encoding="utf-8"))
        return f"process {int(data['pid'])} on {data['host']} (since {data['since']})"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"


# ---------------------------------------------------------------- results


def result_files(run_dir: Path) -> list[Path]:
    """List a run's metrics, pictures and report, without files that other commands write into ``renders/``."""
    pictures = (path for path in sorted((run_dir / "renders").glob("*")) if _RESULT_PICTURES.fullmatch(path.name))
    return [*(path for name in _RESULT_FILES if (path := run_dir / name).is_file()), *pictures]


def discard_results(run_dir: Path) -> None:
    """Remove a run's result files. A resumed run calls this function before its model changes, so that an
    interruption never leaves metrics of another model."""
    for path in result_files(run_dir):
        path.unlink(missing_ok=True)


def refuse_run_results(run_dir: Path, targets: Iterable[Path]) -> None:
    """Raise ConfigError if one of ``targets``, the files that a command will write, is a result file of the run."""
    own = {path.resolve() for path in result_files(run_dir)}
    for target in targets:
        if target.resolve() in own:
            raise ConfigError(
                f"{target}: is a picture of the run's report; pass --force to replace it, or --out PATH to write "
                "elsewhere"
            )
