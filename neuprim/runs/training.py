"""The training half of a run: data, model and steps in a directory that goes on where it was left."""

from __future__ import annotations

import json
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
from neuprim.core.model.edge import EDGES
from neuprim.core.notices import warn_once
from neuprim.core.render.backends import choose_backend, precompiled_backend
from neuprim.core.train.distributed.distributed_trainer import DistributedTrainer
from neuprim.core.train.distributed.process_group import ProcessGroup
from neuprim.core.train.trainer import Trainer
from neuprim.plugins.provenance import check_resumed_provenance
from neuprim.plugins.returns import call_task_facts
from neuprim.runs.compile import compile_in_background, is_compiled, kernel_variant, mark_compiled
from neuprim.runs.curve import open_curve
from neuprim.runs.events import Events, Note, Preparing, ignore_event
from neuprim.runs.fit import (
    Fitted,
    TrainerFactory,
    compile_kernels,
    prepare_training,
    train_steps,
    use_one_torch_thread,
)
from neuprim.runs.interrupt import interruptible
from neuprim.runs.run_directory import discard_results

BetweenSteps = Callable[[Fitted, threading.Event], None]
"""Called on the training's thread before its first step and after every one, with what is trained and the event that
ends the training as Ctrl-C does. It may read the state, save it and wait, and must not change it."""

COMPILING = "compiling kernels, once per installation (about a minute)"


def do_nothing_between(fitted: Fitted, stop: threading.Event) -> None:
    """Do nothing."""


def train_in_directory(
    config: RunConfig,
    events: Events = ignore_event,
    dataset: Dataset | None = None,
    hold_out: int = 0,
    between: BetweenSteps = do_nothing_between,
    group: ProcessGroup | None = None,
    make: TrainerFactory | None = None,
) -> tuple[Fitted, bool]:
    """Train until the budget is used or Ctrl-C, which finishes the step; leaves configuration, curve, checkpoint and
    model in the run's directory either way. Of several ranks the first one writes them.

    Args:
        dataset: the scene of the configuration, if it is loaded already.
        hold_out: n > 1: every n-th training view is a test view, and no other is; see
            :func:`~neuprim.core.data.dataset.hold_out_views`.
        between: called between steps, see :data:`BetweenSteps`.
        make: what makes the trainer of a model that is there already; None: a fresh model is trained.
        group: the ranks that train the model together; None for one process.

    Returns:
        what was trained, and whether Ctrl-C ended it.

    Raises:
        NeuprimError: the input's fault, or numbers that left the finite; whatever was on disk before is intact.
        RankError: another rank ended; the first one, if it is there, has written a checkpoint of the last whole step.
    """
    # kernels compile beside the loading of data; nothing waits for them where the data are there
    ahead = precompiled_backend(config.renderer) if dataset is None else None
    edge = config.model.density.get("edge", 0)  # of a built-in density; another package may mean anything by it
    turn = nullcontext() if group is None else group.in_turn()
    with turn, compile_in_background(None if ahead is None else ahead.name, edge if edge in EDGES else 0) as kernels:
        fitted = prepare_training(config, events, dataset, hold_out, make, group)
        trainer = fitted.trainer
        _resume(fitted, events)
        if trainer.rank == 0:
            config.output_dir.mkdir(parents=True, exist_ok=True)
            if config.resume and not trainer.finished:
                discard_results(config.output_dir)
            write_text(config.output_dir / "config.yaml", fitted.config.to_yaml())
        if kernels.running:
            events(Preparing(COMPILING))
            kernels.wait()
        compile_for_run(trainer, events)
    if isinstance(trainer, DistributedTrainer):
        trainer.check_same_start()
    return fitted, _train(fitted, events, between) if trainer.rank == 0 else _follow(trainer)


def compile_for_run(trainer: Trainer, events: Events = ignore_event) -> None:
    """Have kernels compiled outside the training clock, and remember for later runs that they are."""
    view = trainer.dataset.train.view(0)
    lowered = trainer.model.lower(view.camera, view.conditions, trainer.renderer)
    form = kernel_variant(type(lowered.colour).__name__, lowered.density.edge)
    backend = choose_backend(lowered, trainer.renderer, view.camera)
    if backend.compiles and not is_compiled(backend.name, form):
        events(Preparing(COMPILING))
    compile_kernels(trainer)
    if backend.compiles:
        mark_compiled(backend.name, form)


def _resume(fitted: Fitted, events: Events) -> None:
    config, saved = fitted.config, fitted.config.output_dir / "checkpoint.safetensors"
    if not (config.resume and saved.exists()):
        return
    header, tensors = checkpoint.read(saved, "checkpoint")
    if header.get("task") != config.task:
        raise CheckpointError(f"{saved}: written for task {header.get('task')!r}; this run's task is {config.task!r}")
    check_resumed_provenance(header.get("made_by"), config.made_by, saved)
    fitted.trainer.load_state(tensors, header, str(saved))
    was, now = World.of(header, str(saved)), fitted.dataset.world
    if ("world" in header or fitted.dataset.placement is None) and not torch.equal(
        was.scene_from_world, now.scene_from_world
    ):
        origins = [w.world_points(torch.zeros(3, dtype=torch.float64)).tolist() for w in (was, now)]
        raise CheckpointError(
            f"{saved}: the scene's origin is {origins[0]} of the data's files, and now {origins[1]}; expected the "
            f"same data"
        )
    events(Note(f"resumed at step {fitted.trainer.step}"))


def _train(fitted: Fitted, events: Events, between: BetweenSteps) -> bool:
    """Train until the budget is used or Ctrl-C; returns whether it was interrupted. Leaves a checkpoint either way."""
    trainer, config = fitted.trainer, fitted.config
    curve = open_curve(config.output_dir / "metrics.jsonl", trainer.step)
    last_saved = time.monotonic()
    interrupted = False
    with (
        interruptible(terminated=trainer.ranks > 1) as stop,
        curve,
        use_one_torch_thread(),
        _save_when_a_rank_ends(fitted),
    ):
        trainer.stop_requested = stop.is_set
        between(fitted, stop)
        for report, held_out in train_steps(trainer, events):
            line: dict[str, Any] = {}
            if held_out is not None:
                line["eval_psnr"] = held_out
            if report.change:
                line["change"] = report.change
            if line or report.step % config.train.log_every == 0 or trainer.finished:
                line = {"step": report.step, "seconds": round(report.seconds, 4), "loss": report.loss, **report.parts,
                    "psnr": report.psnr, "primitives": report.primitives, **line}  # fmt: skip
                with _warn_of_full_disk(fitted, curve.path):
                    curve.add(json.dumps(line) + "\n")
            if time.monotonic() - last_saved > config.train.checkpoint_every_seconds:
                with _warn_of_full_disk(fitted, config.output_dir / "checkpoint.safetensors"):
                    save_training(fitted)
                last_saved = time.monotonic()
            between(fitted, stop)
            if trainer.stopping:
                interrupted = True
                break
    save_training(fitted)
    return interrupted


@contextmanager
def _warn_of_full_disk(fitted: Fitted, file: Path) -> Iterator[None]:
    """Warn once of a file that cannot be written during the training, as on a full disk. Training goes on to the next
    checkpoint; only the last one is an error."""
    try:
        yield
    except (CheckpointError, OSError) as error:
        said = (
            str(error)
            if isinstance(error, CheckpointError)
            else f"{file}: cannot be written ({error.strerror or error})"
        )
        warn_once(f"{said}; training goes on from step {fitted.trainer.step} to the next checkpoint")


def _follow(trainer: Trainer) -> bool:
    """Train on a rank that writes nothing; returns whether the training was interrupted."""
    with interruptible(terminated=True) as stop, use_one_torch_thread():
        trainer.stop_requested = stop.is_set
        return any(trainer.stopping for _ in train_steps(trainer))


@contextmanager
def _save_when_a_rank_ends(fitted: Fitted) -> Iterator[None]:
    """Save the state of the last whole step when another rank ends."""
    try:
        yield
    except RankError:
        save_training(fitted)
        raise


def save_training(fitted: Fitted) -> None:
    """Write checkpoint and model into the run's directory."""
    trainer, config, dataset = fitted.trainer, fitted.config, fitted.dataset
    tensors, header = trainer.state()
    made_by = {} if config.made_by is None else {"made_by": config.made_by.to_dict()}
    world = (
        dataset.world.to_json()
        if dataset.placement is None
        else {**dataset.placement.to_json(), **dataset.world.to_json()}
    )
    place = {} if dataset.world.identity and dataset.placement is None else {"world": world}
    header = {"task": config.task, **made_by, **place, **header}
    checkpoint.write(config.output_dir / "checkpoint.safetensors", "checkpoint", tensors, header)
    extra: dict[str, Any] = {
        "background": [float(x) for x in dataset.background],
        "color_space": dataset.color_space,
        "channels": list(fitted.channels.names),
        "data_source": dataset.data_source,
        "data": call_task_facts(fitted.task, dataset),
        **fitted.training,
        **place,
    }
    file = config.output_dir / "model.safetensors"
    checkpoint.save_model(file, trainer.model, config.task, extra, without_zeros=bool(trainer.zero_masks))
