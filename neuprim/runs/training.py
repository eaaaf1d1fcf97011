"""Train in a directory: data, model and steps that go on where they were left."""

from __future__ import annotations

import errno
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import torch

from neuprim.config import RunConfig
from neuprim.core import checkpoint
from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset
from neuprim.core.errors import CheckpointError, RankError
from neuprim.core.io.files import write_text
from neuprim.core.io.plain import load_json
from neuprim.core.notices import warn_once
from neuprim.core.train.distributed.distributed_trainer import DistributedTrainer
from neuprim.core.train.distributed.process_group import ProcessGroup
from neuprim.core.train.trainer import Trainer
from neuprim.plugins.provenance import check_resumed_provenance
from neuprim.plugins.returns import call_task_facts
from neuprim.runs.fit import (
    Events,
    Fitted,
    Note,
    TrainerFactory,
    compile_run_kernels,
    ignore_run_event,
    prepare_training,
    train_run_steps,
    use_one_torch_thread_for_run,
)
from neuprim.runs.launch.worker import interruptible_run
from neuprim.runs.run_directory import discard_results

CURVE_FILE = "metrics.jsonl"

BetweenSteps = Callable[[Fitted, threading.Event], None]
"""Called on the training's thread before its first step and after every one, with what is trained and the event that
ends the training as Ctrl-C does. It may read the state, save it and wait, and must not change it."""


def do_nothing_between_run_steps(fitted: Fitted, stop: threading.Event) -> None:
    """Do nothing."""


def train_in_directory(
    config: RunConfig,
    events: Events = ignore_run_event,
    dataset: Dataset | None = None,
    hold_out: int = 0,
    between: BetweenSteps = do_nothing_between_run_steps,
    group: ProcessGroup | None = None,
    make: TrainerFactory | None = None,
) -> tuple[Fitted, bool]:
    """Train until the budget is used or Ctrl-C, which finishes the step; leaves configuration, curve, checkpoint and
    model in the run's directory either way. Of several ranks the first one writes them.

    Args:
        dataset, hold_out, make, group: as of :func:`~neuprim.runs.fit.prepare_training`.
        between: called between steps, see :data:`BetweenSteps`.

    Returns:
        what was trained, and whether Ctrl-C ended it.

    Raises:
        NeuprimError: the input is at fault, or numbers are not finite; what was on disk before is intact.
        RankError: another rank ended; the first one, if it is there, has written a checkpoint of the last whole step.
    """
    with nullcontext() if group is None else group.in_turn():
        fitted = prepare_training(config, events, dataset, hold_out, make, group)
        trainer = fitted.trainer
        _resume_training(fitted, events)
        if trainer.rank == 0:
            config.output_dir.mkdir(parents=True, exist_ok=True)
            if config.resume and not trainer.finished:
                discard_results(config.output_dir)
            write_text(config.output_dir / "config.yaml", fitted.config.to_yaml())
        compile_run_kernels(trainer, events)
    if isinstance(trainer, DistributedTrainer):
        trainer.check_same_start()
    return fitted, _train_and_save(fitted, events, between) if trainer.rank == 0 else _train_run_as_follower(trainer)


def _resume_training(fitted: Fitted, events: Events) -> None:
    config, saved = fitted.config, fitted.config.output_dir / "checkpoint.safetensors"
    if not (config.resume and saved.exists()):
        return
    header, tensors = checkpoint.read_tensors(saved, "checkpoint")
    if header.get("task") != config.task:
        raise CheckpointError(f"{saved}: written for task {header.get('task')!r}; this run's task is {config.task!r}")
    check_resumed_provenance(header.get("made_by"), config.made_by, saved)
    fitted.trainer.load_state(tensors, header, str(saved))
    was, now = World.of(header, str(saved)), fitted.dataset.world
    placed = "world" in header or fitted.dataset.placement is None
    if placed and not torch.equal(was.scene_from_world, now.scene_from_world):
        origins = [w.world_points(torch.zeros(3, dtype=torch.float64)).tolist() for w in (was, now)]
        raise CheckpointError(
            f"{saved}: the scene's origin is {origins[0]} of the data's files, and now {origins[1]}; expected the "
            f"same data"
        )
    events(Note(f"resumed at step {fitted.trainer.step}"))


def _train_and_save(fitted: Fitted, events: Events, between: BetweenSteps) -> bool:
    """Train until the budget is used or Ctrl-C; returns whether it was interrupted. Leaves a checkpoint either way."""
    trainer, config = fitted.trainer, fitted.config
    curve, saved = config.output_dir / CURVE_FILE, config.output_dir / "checkpoint.safetensors"
    cut_run_curve(curve, trainer.step)
    last_saved, interrupted = time.monotonic(), False
    try:
        with interruptible_run(terminated=trainer.ranks > 1) as stop, use_one_torch_thread_for_run():
            trainer.stop_requested = stop.is_set
            between(fitted, stop)
            for report, held_out in train_run_steps(trainer, events):
                line: dict[str, Any] = {}
                if held_out is not None:
                    line["eval_psnr"] = held_out
                if report.change:
                    line["change"] = report.change
                if line or report.step % config.train.log_every == 0 or trainer.finished:
                    line = {"step": report.step, "seconds": round(report.seconds, 4), "loss": report.loss,
                        **report.parts, "psnr": report.psnr, "primitives": report.primitives, **line}  # fmt: skip
                    with _warn_of_unwritable_run_file(fitted, curve):
                        add_run_curve_line(curve, json.dumps(line) + "\n")
                if time.monotonic() - last_saved > config.train.checkpoint_every_seconds:
                    with _warn_of_unwritable_run_file(fitted, saved):
                        save_run_training(fitted)
                    last_saved = time.monotonic()
                between(fitted, stop)
                if trainer.stopping:
                    interrupted = True
                    break
    except RankError:  # the state is that of the last whole step
        save_run_training(fitted)
        raise
    save_run_training(fitted)
    return interrupted


def _train_run_as_follower(trainer: Trainer) -> bool:
    """Train on a rank that writes nothing; returns whether the training was interrupted."""
    with interruptible_run(terminated=True) as stop, use_one_torch_thread_for_run():
        trainer.stop_requested = stop.is_set
        return any(trainer.stopping for _ in train_run_steps(trainer))


@contextmanager
def _warn_of_unwritable_run_file(fitted: Fitted, file: Path) -> Iterator[None]:
    """Warn once of a file that cannot be written during the training, as on a full disk. Only at the end it is an
    error."""
    try:
        yield
    except (CheckpointError, OSError) as error:
        reason = f"{file}: cannot be written ({error.strerror or error})" if isinstance(error, OSError) else error
        warn_once(f"{reason}; training goes on from step {fitted.trainer.step} to the next checkpoint")


def cut_run_curve(path: Path, step: int) -> None:
    """Cut ``metrics.jsonl`` back to the lines up to a checkpoint's step; without lines it is empty."""
    kept = []
    if step and path.exists():
        for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                if load_json(text, infinite=True)["step"] <= step:
                    kept.append(text)
            except (ValueError, KeyError, TypeError, RecursionError):
                continue  # a line that a kill cut short
    write_text(path, "".join(f"{text}\n" for text in kept))


def add_run_curve_line(path: Path, line: str) -> None:
    """Add a line whole or not at all. Raises OSError; the lines before it are intact."""
    with open(path, "ab", buffering=0) as file:
        data, end = line.encode(), os.fstat(file.fileno()).st_size
        try:
            if file.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            os.truncate(file.fileno(), end)
            raise


def save_run_training(fitted: Fitted) -> None:
    """Write checkpoint and model into the run's directory."""
    trainer, config, dataset = fitted.trainer, fitted.config, fitted.dataset
    tensors, header = trainer.state()
    placement = {} if dataset.placement is None else dataset.placement.to_json()
    moved = not dataset.world.identity or dataset.placement is not None
    world = {"world": {**placement, **dataset.world.to_json()}} if moved else {}
    header = {"task": config.task, "made_by": config.made_by.to_dict(), **world, **header}
    checkpoint.write_tensors(config.output_dir / "checkpoint.safetensors", "checkpoint", tensors, header)
    extra: dict[str, Any] = {
        "background": [float(x) for x in dataset.background],
        "color_space": dataset.color_space,
        "channels": list(fitted.channels.names),
        "data_source": dataset.data_source,
        "data": call_task_facts(fitted.task, dataset),
        **fitted.training,
        **world,
    }
    file = config.output_dir / "model.safetensors"
    checkpoint.save_model(file, trainer.model, config.task, extra, without_zeros=bool(trainer.zero_masks))
