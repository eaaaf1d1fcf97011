"""Train in a run directory, resume from its checkpoint, and fine-tune a changed model.

Fine-tuning trains a changed model, e.g. a pruned one, with schedules similar to the last part of a run's training.
The number of primitives is fixed.
"""

from __future__ import annotations

import errno
import json
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from neuprim.config import Job, RunConfig
from neuprim.core import checkpoint
from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset
from neuprim.core.errors import CheckpointError, RankError, warn_once
from neuprim.core.io import images
from neuprim.core.io.files import write_text
from neuprim.core.io.json_reader import load_json
from neuprim.core.model.primitives import Primitives
from neuprim.core.train.distributed_trainer import DistributedTrainer
from neuprim.core.train.process_group import ProcessGroup
from neuprim.core.train.trainer import Trainer
from neuprim.core.train.trainer_state import select_state_tensors
from neuprim.plugins.attribution import call_task_facts
from neuprim.plugins.provenance import check_resumed_provenance
from neuprim.runs.fit import (
    Events,
    Fitted,
    Note,
    TrainerFactory,
    compile_run_kernels,
    drop_unused_run_rates,
    ignore_run_event,
    make_run_loss,
    prepare_training,
    time_run_step,
    train_run_steps,
    use_one_torch_thread_for_run,
)
from neuprim.runs.forecast import forecast_training, has_forecast
from neuprim.runs.kernel_compiler import KernelCompiler
from neuprim.runs.launch.jobs import interruptible_run
from neuprim.runs.measure import render_image
from neuprim.runs.open import discard_results

CURVE_FILE, PREVIEW_FILE = "metrics.jsonl", "renders/preview.png"

_PREVIEW_PROGRESS = (0.01, 0.5)
"""Used fractions of the budget at which :data:`PREVIEW_FILE` is written; it is written again at the end of the run. The
first one is early, so that a user soon sees whether scene and cameras are right."""

BEGIN = 0.8
"""Progress of a run, 0..1. Fine-tuning begins with the values that the run's schedules have at this progress."""

START, COOL = 3.0, 0.02
"""Learning rates of fine-tuning. START is the rate of the first step divided by the final rate of the run; COOL is the
rate of the last step divided by the rate of the first step. Rates near zero at the end let the parameters converge,
which improves quality, most of all where parameters are rounded."""

LONG, LEAST_START = 2000, 1.0
"""LONG is the least number of fine-tuning steps with which the learning rates begin at :data:`START`. With fewer steps,
the learning rates begin proportionally lower, but not below LEAST_START, because a few hundred steps at high rates
degrade a well trained volume."""

VOXELS_EVERY = 8
"""Largest interval, in fine-tuning steps, between two steps that also use voxels (known extinction), if the run used
voxels. The longer interval of a run makes a few hundred steps miss some frames, whose extinction then drifts. With an
interval of 4, images get worse."""

BetweenSteps = Callable[[Fitted, threading.Event], None]
"""Callback on the training thread, before the first step and after every step. The arguments are the training
and an event that ends the training like Ctrl-C. The callback may read and save the state, and wait,
but must not change the state."""


def train_in_directory(
    config: RunConfig,
    events: Events = ignore_run_event,
    dataset: Dataset | None = None,
    hold_out: int = 0,
    between: BetweenSteps = lambda fitted, stop: None,
    group: ProcessGroup | None = None,
    make: TrainerFactory | None = None,
) -> tuple[Fitted, bool]:
    """Train until the budget is used or the user presses Ctrl-C, which finishes the current step. In both cases write
    configuration, curve, checkpoint and model into the run's directory. If several ranks (processes) train the model,
    only the first one writes.

    Args:
        dataset, hold_out, make, group: as in :func:`~neuprim.runs.fit.prepare_training`.
        between: called between steps, see :data:`BetweenSteps`.

    Returns:
        The trained model with its trainer, and whether Ctrl-C ended the training.

    Raises:
        NeuprimError: the input is wrong, or the training produced numbers that are not finite. Existing files stay
            intact.
        RankError: another rank ended. The first rank, if it still runs, has saved a checkpoint of the last whole step.
    """
    compiler = KernelCompiler(config) if group is None else None
    wanted = compiler is not None and make is None and dataset is None and has_forecast(config)
    forecast, size = None, config.scene.get("size")  # of images that neuprim renders; others are read in no time
    if wanted and isinstance(size, int) and compiler is not None and compiler.ready:
        if (forecast := forecast_training(config, size, size)) is not None:
            events(Note(forecast.describe(config)))
    with nullcontext() if group is None else group.in_turn():
        fitted = prepare_training(config, events, dataset, hold_out, make, group)
        trainer = fitted.trainer
        _resume_training(fitted, events)
        if trainer.rank == 0:
            config.output_dir.mkdir(parents=True, exist_ok=True)
            if config.resume and not trainer.finished:
                discard_results(config.output_dir)
            write_text(config.output_dir / "config.yaml", fitted.config.to_yaml())
        if compiler is not None:
            compiler.wait(events)
        compile_run_kernels(trainer, events)
        if compiler is not None:
            compiler.finish()
        if wanted:
            camera = fitted.dataset.train.view(0).camera
            forecast = forecast or forecast_training(fitted.config, camera.width, camera.height)
            if forecast is not None:
                events(Note(forecast.describe(config, len(fitted.dataset.test))))
    if isinstance(trainer, DistributedTrainer):
        trainer.check_same_start()
    return fitted, _train_and_save(fitted, events, between) if trainer.rank == 0 else _train_run_as_follower(trainer)


def _resume_training(fitted: Fitted, events: Events) -> None:
    config, saved = fitted.config, fitted.config.output_dir / "checkpoint.safetensors"
    if not (config.resume and saved.exists()):
        return
    header, tensors = checkpoint.read_tensors(saved, "checkpoint")
    if header.get("task") != config.task:
        found = f"written for task {header.get('task')!r}"
        raise CheckpointError(f"{saved}: {found}, but this run's task is {config.task!r}")
    check_resumed_provenance(header.get("made_by"), config.made_by, saved)
    fitted.trainer.load_state(tensors, header, str(saved))
    was, now = World.of(header, str(saved)), fitted.dataset.world
    placed = "world" in header or fitted.dataset.placement is None
    if placed and not torch.equal(was.scene_from_world, now.scene_from_world):
        origins = [w.world_points(torch.zeros(3, dtype=torch.float64)).tolist() for w in (was, now)]
        raise CheckpointError(
            f"{saved}: the scene's origin was {origins[0]} in the coordinates of the data's files and is {origins[1]} "
            f"now; continue with the data that the run was started on"
        )
    events(Note(f"resumed at step {fitted.trainer.step}"))


def _train_and_save(fitted: Fitted, events: Events, between: BetweenSteps) -> bool:
    """Train until the budget is used or Ctrl-C, and write a checkpoint; return whether Ctrl-C ended the training."""
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


class RunPreview:
    """Callback between training steps that writes a picture of a held-out view at 1 % and 50 % of the training: ground
    truth on the left, rendering on the right.

    Args:
        events: function that is called with a note after the first picture; the note has the name of the file.
        between: another callback between steps, which is called first.
    """

    def __init__(self, events: Events, between: BetweenSteps) -> None:
        self._events, self._between = events, between
        self._due: tuple[float, ...] = _PREVIEW_PROGRESS

    def __call__(self, fitted: Fitted, stop: threading.Event) -> None:
        self._between(fitted, stop)
        due = tuple(progress for progress in self._due if progress > fitted.trainer.progress)
        if due != self._due:
            path, first = self.write(fitted), self._due == _PREVIEW_PROGRESS
            self._due = due
            if first and path.exists():
                self._events(Note(f"first picture (left ground truth, right model): {path}"))

    def write(self, fitted: Fitted) -> Path:
        """Write the preview picture of the current model; return its path."""
        test, background, display = fitted.dataset.test, fitted.dataset.background, fitted.channels.display
        index, path = 3 * len(test) // 4, fitted.config.output_dir / PREVIEW_FILE  # not the first of a film
        rendered = render_image(fitted.model, test.view(index), fitted.trainer.renderer, background)
        pair = [display(x) for x in (test.pixels(index).over(background), rendered)]
        with _warn_of_unwritable_run_file(fitted, path):
            path.parent.mkdir(exist_ok=True)
            images.write_png(path, torch.cat(pair, dim=1))
        return path


def _train_run_as_follower(trainer: Trainer) -> bool:
    """Train on a rank (process) that writes no files; return whether the training was interrupted, e.g. by Ctrl-C."""
    with interruptible_run(terminated=True) as stop, use_one_torch_thread_for_run():
        trainer.stop_requested = stop.is_set
        return any(trainer.stopping for _ in train_run_steps(trainer))


@contextmanager
def _warn_of_unwritable_run_file(fitted: Fitted, file: Path) -> Iterator[None]:
    """Context manager that turns an error in writing ``file``, e.g. on a full disk, into a single warning."""
    try:
        yield
    except (CheckpointError, OSError) as error:
        reason = f"{file}: cannot be written ({error.strerror or error})" if isinstance(error, OSError) else error
        warn_once(
            f"{reason}; training goes on from step {fitted.trainer.step}; neuprim tries again at the next checkpoint"
        )


def cut_run_curve(path: Path, step: int) -> None:
    """Remove the lines after training step ``step`` from ``metrics.jsonl``; create an empty file if it is missing."""
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
    """Append a line to a file, completely or not at all. Raises OSError if that fails; earlier lines stay intact."""
    with open(path, "ab", buffering=0) as file:
        data, end = line.encode(), os.fstat(file.fileno()).st_size
        try:
            if file.write(data) != len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except OSError:
            os.truncate(file.fileno(), end)
            raise


def save_run_training(fitted: Fitted) -> None:
    """Write ``checkpoint.safetensors`` (to resume from) and ``model.safetensors`` into the run's directory."""
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


# ---------------------------------------------------------------- fine-tuning


def make_run_finetune_trainer(
    job: Job, dataset: Dataset, model: Primitives, steps: int, begin: float = BEGIN, voxels_every: int = VOXELS_EVERY
) -> Trainer:
    """Return a trainer that fine-tunes a copy of a finished run's model for ``steps`` steps.

    The trainer uses the run's schedules from progress ``begin`` to 1, except for the learning rates (:data:`START`,
    :data:`COOL`). The number of primitives is fixed, and steps render whole views. If the run has a checkpoint, the
    trained exposures and camera corrections of its views are loaded from it. ``voxels_every`` is the largest interval
    between steps with voxels (:data:`VOXELS_EVERY`).
    """
    config, params = job.config, {name: value.detach().clone() for name, value in model.params.items()}
    copy = Primitives(model.density, model.colour, params)
    total = round(steps / (1 - begin))
    usual = drop_unused_run_rates(config.train, job.task, copy)
    final = COOL ** (1 / (1 - begin))  # a rate's factor is final ** progress
    scale = max(START * min(steps / LONG, 1.0), LEAST_START) * usual.final_rate / final**begin
    settings = replace(
        usual,
        iterations=total,
        final_rate=final,
        cooldown=0.0,
        rates={spec.name: scale * usual.rates.get(spec.name, spec.lr) for spec in copy.specs},
        max_seconds=None,
        stride=1,
        warmup_steps=0,
        voxels_every=min(usual.voxels_every, voxels_every),
        population=replace(config.train.population, strategy="fixed", grow_from=1.0),
    )
    trainer = Trainer(copy, dataset, make_run_loss(job), settings, config.renderer, config.seed)
    trainer.step = total - steps
    saved = config.output_dir / "checkpoint.safetensors"
    for numbers, name in ((trainer.exposures, "exposure."), (trainer.corrections, "correction.")):
        if numbers is not None and saved.exists():
            numbers.load_state(select_state_tensors(checkpoint.read_tensors(saved, "checkpoint")[1], name))
    return trainer


def count_run_finetune_steps(seconds: float, job: Job, dataset: Dataset, model: Primitives) -> int:
    """Return how many fine-tuning steps fit into ``seconds``, from the measured time per step; 0 for 0 seconds."""
    if seconds <= 0:
        return 0
    pace = time_run_step(make_run_finetune_trainer(job, dataset, model, LONG))
    return max(int(seconds / max(pace, 1e-9)), 1)
