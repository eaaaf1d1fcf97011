"""The training half of a run: data, model and steps in a directory that goes on where it was left."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
from neuprim.core.train.distributed import ALONE, Alone
from neuprim.core.train.restoring import part
from neuprim.core.train.trainer import Trainer
from neuprim.plugins.blame import Suspects
from neuprim.plugins.judging import facts_of
from neuprim.plugins.provenance import check_resumed
from neuprim.runs.compile import compiled, compiling, mark_compiled, variant
from neuprim.runs.curve import open_curve
from neuprim.runs.events import Events, Note, Preparing, silent
from neuprim.runs.fit import Fitted, Make, compile_kernels, one_torch_thread, start, steps
from neuprim.runs.interrupt import interruptible
from neuprim.runs.parts import in_parts, read_part, write_parts
from neuprim.runs.results import discard_results

__all__ = ["COMPILING", "Between", "alone", "make_ready", "save", "train"]

Between = Callable[[Fitted, threading.Event], None]
"""Called on the training's thread before its first step and after every one, with what is trained and the event that
ends the training as
Ctrl-C does. It may look at the state, save it and wait, and must not change it."""

COMPILING = "compiling kernels, once per installation (about a minute)"


def alone(fitted: Fitted, stop: threading.Event) -> None:
    """Nobody is there between two steps."""


def train(
    config: RunConfig,
    suspects: Suspects,
    events: Events = silent,
    dataset: Dataset | None = None,
    hold_out: int = 0,
    between: Between = alone,
    ranks: Alone = ALONE,
    make: Make | None = None,
) -> tuple[Fitted, bool]:
    """Train until the budget is used or Ctrl-C, which finishes the step; leaves configuration, curve, checkpoint and
    model in the run's directory either way. Of several ranks the first one writes them.

    Args:
        suspects: of the configuration, who is watched for crashes around this call.
        dataset: the scene of the configuration, if it is loaded already.
        hold_out: n > 1: every n-th training view is a test view, and no other is; see
        :func:`~neuprim.core.data.dataset.hold_out_views`. between: called between steps, see :data:`Between`.
        make: what makes the trainer of a model that is there already; None: a fresh model is trained.

    Returns:
        what was trained, and whether Ctrl-C ended it.

    Raises:
        NeuprimError: the input's fault, or numbers that left the finite; whatever was on disk before is intact.
        RankError: another rank is gone; the first one, if it is there, has written a checkpoint of the last whole step.
    """
    ranks = in_parts(config, ranks)
    ahead = (
        precompiled_backend(config.renderer) if dataset is None else None
    )  # beside loading; of data that are there nothing is waited for
    edge = config.model.density.get("edge", 0)  # of a density of ours; of another's, whatever the word means there
    with ranks.in_turn(), compiling(None if ahead is None else ahead.name, edge if edge in EDGES else 0) as kernels:
        fitted = start(config, events, dataset, suspects, hold_out, make)
        begun = _begun(fitted.trainer) if ranks.parts else {}  # while the model is whole
        fitted.trainer.join(ranks)
        _resume(fitted, events)
        if ranks.first:
            config.output_dir.mkdir(parents=True, exist_ok=True)
            if config.resume and not fitted.trainer.finished:
                discard_results(config.output_dir)
            write_text(config.output_dir / "config.yaml", fitted.config.to_yaml())
        if kernels.running:
            events(Preparing(COMPILING))
            kernels.wait()
        make_ready(fitted.trainer, events)
    if ranks.size > 1:
        facts = (
            {**begun, "steps done": fitted.trainer.step, "primitives": fitted.trainer.count}
            if begun
            else _begun(fitted.trainer)
        )
        ranks.agree("expected the same words, data and output directory on all ranks", facts)
    return fitted, _train(fitted, events, between) if ranks.first else _follow(fitted)


def make_ready(trainer: Trainer, events: Events = silent) -> None:
    """Have kernels compiled outside the training clock, and remember for later runs that they are."""
    view = trainer.dataset.train.view(0)
    lowered = trainer.model.lower(view.camera, view.conditions, trainer.renderer)
    form = variant(type(lowered.colour).__name__, lowered.density.edge)
    backend = choose_backend(lowered, trainer.renderer, view.camera)
    if backend.compiles and not compiled(backend.name, form):
        events(Preparing(COMPILING))
    compile_kernels(trainer)
    if backend.compiles:
        mark_compiled(backend.name, form)


def _begun(trainer: Trainer) -> dict[str, Any]:
    from neuprim.core.train.distributed.beginning import beginning

    return beginning(trainer)


def _resume(fitted: Fitted, events: Events) -> None:
    config, saved = fitted.config, fitted.config.output_dir / "checkpoint.safetensors"
    if not (config.resume and saved.exists()):
        return
    ranks = fitted.trainer.ranks
    header, tensors = read_part(saved, "checkpoint", ranks) if ranks.parts else checkpoint.read(saved, "checkpoint")
    if header.get("task") != config.task:
        raise CheckpointError(f"{saved}: written for task {header.get('task')!r}; this run's task is {config.task!r}")
    check_resumed(header.get("made_by"), config.made_by, saved)
    fitted.trainer.load_state(tensors, header, str(saved))
    was, now = World.of(header, str(saved)), fitted.dataset.world
    if ("world" in header or fitted.dataset.placement is None) and not torch.equal(
        was.scene_from_world, now.scene_from_world
    ):
        origins = [w.world_points(torch.zeros(3, dtype=torch.float64)).tolist() for w in (was, now)]
        raise CheckpointError(
            f"{saved}: the scene's origin is {origins[0]} of the data's files, and now {origins[1]}; expected the same data"
        )
    events(Note(f"resumed at step {fitted.trainer.step}"))


def _train(fitted: Fitted, events: Events, between: Between) -> bool:
    """Train until the budget is used or Ctrl-C; returns whether it was interrupted. Leaves a checkpoint either way."""
    trainer, config = fitted.trainer, fitted.config
    curve = open_curve(config.output_dir / "metrics.jsonl", trainer.step)
    last_saved = time.monotonic()
    interrupted = False
    due = trainer.ranks.saves(lambda: time.monotonic() - last_saved > config.train.checkpoint_every_seconds)
    with interruptible(terminated=trainer.ranks.size > 1) as stop, curve, one_torch_thread(), _kept(fitted):
        last = trainer.ranks.last(stop.is_set)
        between(fitted, stop)
        for report, held_out in steps(trainer, events):
            line: dict[str, Any] = {}
            if held_out is not None:
                line["eval_psnr"] = held_out
            if report.change:
                line["change"] = report.change
            if line or report.step % config.train.log_every == 0 or trainer.finished:
                line = {"step": report.step, "seconds": round(report.seconds, 4), "loss": report.loss, **report.parts, "psnr": report.psnr, "primitives": report.primitives, **line}  # fmt: skip
                with _full(fitted, curve.path):
                    curve.add(json.dumps(line) + "\n")
            if due():
                with _full(fitted, config.output_dir / "checkpoint.safetensors"):
                    save(fitted)
                last_saved = time.monotonic()
            between(fitted, stop)
            if last():
                interrupted = True
                break
    save(fitted)
    return interrupted


@contextmanager
def _full(fitted: Fitted, file: Path) -> Iterator[None]:
    """A file of the way that cannot be written, as on a full disk, is one warning: training goes on to the next
    checkpoint, and only the last one is an error. Where several ranks write one file together, it is an error at
    once."""
    try:
        yield
    except (CheckpointError, OSError) as error:
        if fitted.trainer.ranks.parts:
            raise
        said = (
            str(error)
            if isinstance(error, CheckpointError)
            else f"{file}: cannot be written ({error.strerror or error})"
        )
        warn_once(f"{said}; training goes on from step {fitted.trainer.step} to the next checkpoint")


def _follow(fitted: Fitted) -> bool:
    """The same on a rank that writes nothing; one that has a part of the primitives hands it to the first, which
    writes."""
    ranks = fitted.trainer.ranks
    with interruptible(terminated=True) as stop, one_torch_thread():
        last, due = ranks.last(stop.is_set), ranks.saves(lambda: False)
        interrupted = False
        for _ in steps(fitted.trainer):
            if ranks.parts and due():
                save(fitted)
            if last():
                interrupted = True
                break
    if ranks.parts:
        save(fitted)
    return interrupted


@contextmanager
def _kept(fitted: Fitted) -> Iterator[None]:
    """A rank that is gone costs no step: what the others have is saved. Where it had primitives of its own they are
    gone, and the last checkpoint counts."""
    try:
        yield
    except RankError:
        if not fitted.trainer.ranks.parts:
            save(fitted)
        raise


def save(fitted: Fitted) -> None:
    """Checkpoint and model, into the run's directory; where primitives are in parts, called on all ranks."""
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
    files = [config.output_dir / f"{name}.safetensors" for name in ("checkpoint", "model")]
    if not trainer.ranks.parts:
        checkpoint.write(files[0], "checkpoint", tensors, header)
    extra: dict[str, Any] = {
        "background": [float(x) for x in dataset.background],
        "color_space": dataset.color_space,
        "channels": list(fitted.channels.names),
        "data_source": dataset.data_source,
        "data": facts_of(fitted.task, dataset),
        **fitted.training,
        **place,
    }
    if not trainer.ranks.parts:
        checkpoint.save_model(files[1], trainer.model, config.task, extra, without_zeros=bool(trainer.zeros))
        return
    write_parts(files[0], "checkpoint", trainer, tensors, header)
    head = {**checkpoint.model_header(trainer.model, config.task, extra), "primitives": trainer.count}
    write_parts(files[1], "model", trainer, part(tensors, "params."), head, lambda name, value: True)
