"""One run: data, model, training, evaluation, pictures, report, all in one directory."""

from __future__ import annotations

import json
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from rich.console import Console

from neuprim.config import RunConfig, made_now, suspects_of, task_of
from neuprim.console import plain_console
from neuprim.core import checkpoint, images
from neuprim.core.channels import Channels, channels_of
from neuprim.core.data import Clip, Dataset, View
from neuprim.core.data_check import check_dataset
from neuprim.core.errors import CheckpointError
from neuprim.core.files import write_json, write_text
from neuprim.core.metrics import psnr
from neuprim.core.primitives import Primitives
from neuprim.core.render import choose_backend
from neuprim.core.task import Loss, TaskSpec
from neuprim.core.train.trainer import Trainer, initial_model
from neuprim.core.uses import build_settings, loss_settings
from neuprim.evaluate import LOGS, load_dataset
from neuprim.measure import draw, measure, summary
from neuprim.plugins.blame import blamed
from neuprim.plugins.checked import check_fields, checked_loss
from neuprim.plugins.mechanism import PluginError
from neuprim.plugins.provenance import check_resumed
from neuprim.plugins.registry import load_loss
from neuprim.progress import RunProgress
from neuprim.report import error_map, write_report
from neuprim.warm import compiled, compiling, mark_compiled

__all__ = ["make_loss", "make_trainer", "run", "warm_up"]

_COMPILING = "compiling kernels, once per installation (about a minute)"
_CURVE_VIEWS = 5  # held-out views behind the curve's eval_psnr
_CURVE_PSNR_MAX = 200.0  # dB; equal images have an infinite one
_SHOWN_VIEWS = 8  # held-out views in renders/ and the report
_ORBIT_FRAMES = 36


def run(config: RunConfig, console: Console | None = None) -> Path:
    """Fit, measure and report; returns the run directory.

    Ctrl-C finishes the step, writes a checkpoint and a report, and raises KeyboardInterrupt; a second one stops at once.

    Raises:
        NeuprimError: the input's fault, or numbers that left the finite; whatever was on disk before is intact.
    """
    console = console or plain_console(stderr=True)
    task = task_of(config)
    config = replace(config, made_by=made_now(config, task))
    directory = config.output_dir
    loss = make_loss(config, task)  # options that it refuses must not cost the loading of the data
    suspects = suspects_of(config)
    with (
        compiling(config.renderer.backend != "reference") as kernels,
        RunProgress(console, f"{config.task}/{config.scene_name}") as progress,
        suspects.watch(directory / LOGS),
    ):
        dataset = load_dataset(config, task, progress.preparing)
        suspects.know(dataset)
        check_dataset(dataset, task.conditions)
        channels = channels_of(task, dataset)
        if channels.partial:
            progress.note(f"shown: {channels.shown}; task {task.name!r} has no display that shows them all")
        progress.preparing("starting points", 0.0)
        trainer = make_trainer(config, task, dataset, loss)
        saved = directory / "checkpoint.safetensors"
        if config.resume and saved.exists():
            header, tensors = checkpoint.read(saved, "checkpoint")
            if header.get("task") != config.task:
                raise CheckpointError(f"{saved}: written for task {header.get('task')!r}; this run's task is {config.task!r}")
            check_resumed(header.get("made_by"), config.made_by, saved)
            trainer.load_state(tensors, header, str(saved))
            progress.note(f"resumed at step {trainer.step}")
        directory.mkdir(parents=True, exist_ok=True)
        write_text(directory / "config.yaml", config.to_yaml())
        if kernels.running:
            progress.preparing(_COMPILING, 0.0)
            kernels.wait()
        interrupted = _train(trainer, config, dataset, channels, progress)
        progress.finishing("measuring held-out views")
        _finish(trainer, config, dataset, channels, directory, task)
    if interrupted:
        raise KeyboardInterrupt
    return directory


def make_loss(config: RunConfig, task: TaskSpec) -> Loss:
    """The loss of a run's configuration: the task's own, or the one that ``train.loss`` names.

    Raises:
        ConfigError: no such loss, or an option that it refuses.
        PluginError: it is another package's and cannot be made.
    """
    chosen = None if config.train.loss is None else load_loss(config.train.loss)
    party = suspects_of(config).loss
    with blamed(party.origin, party.what, config.output_dir / LOGS) as guard:
        made = (task.loss if chosen is None else chosen.make)(loss_settings(chosen or task, config.train, config.options))
    if not callable(made):
        raise PluginError(f"{party.what} of {party.origin.origin}: made a {type(made).__name__}; expected a function")
    return checked_loss(made, guard)


def make_trainer(config: RunConfig, task: TaskSpec, dataset: Dataset, loss: Loss | None = None) -> Trainer:
    """A fresh model of a run's configuration and what fits it.

    Args:
        loss: as :func:`make_loss` makes it, which is called without one.

    Raises:
        ConfigError: a rate or starting value for something the model does not have.
        DataError: the data set offers no starting point.
        PluginError: the task of another package does not build what the data set needs.
    """
    origin = suspects_of(config).task.origin
    with blamed(origin, f"build of task {task.name!r}", config.output_dir / LOGS):
        density, colour = task.build(build_settings(task, config.model, config.options), dataset)
    check_fields(density, colour, dataset, f"build of task {task.name!r} of {origin.origin}")
    model = initial_model(density, colour, dataset, config.model, config.seed)
    # A preset has rates for every density and colour of its task; the trainer refuses names that the model does not have.
    others = task.parameter_names() - model.params.keys()
    settings = replace(config.train, rates={k: v for k, v in config.train.rates.items() if k not in others})
    return Trainer(model, dataset, loss or make_loss(config, task), settings, config.renderer, config.seed)


def _train(trainer: Trainer, config: RunConfig, dataset: Dataset, channels: Channels, progress: RunProgress) -> bool:
    """Train until the budget is used or Ctrl-C; returns whether it was interrupted. Leaves a checkpoint either way."""
    directory = config.output_dir
    view = trainer.dataset.train.view(0)
    lowered = trainer.model.lower(view.camera, view.conditions, trainer.renderer)
    form = type(lowered.colour).__name__
    on_cpu = choose_backend(lowered, trainer.renderer, view.camera) == "cpu"
    if on_cpu and not compiled(form):
        progress.preparing(_COMPILING, 0.0)
    warm_up(trainer)
    if on_cpu:
        mark_compiled(form)
    curve = _open_curve(directory / "metrics.jsonl", trainer.step)
    last_saved, next_eval = time.monotonic(), _next_evaluation(trainer)
    interrupted = False
    with _interruptible() as stop, curve, _one_torch_thread():
        for report in trainer.run():
            progress.step(report, trainer.progress)
            line: dict[str, Any] = {}
            if trainer.progress >= next_eval:
                line["eval_psnr"] = _curve_psnr(trainer)
                progress.held_out(line["eval_psnr"])
                next_eval = _next_evaluation(trainer)
            if report.change:
                line["change"] = report.change
            if line or report.step % config.train.log_every == 0 or trainer.finished:
                line = {"step": report.step, "seconds": round(report.seconds, 4), "loss": report.loss, **report.parts, "psnr": report.psnr, "primitives": report.primitives, **line}  # fmt: skip
                curve.write(json.dumps(line) + "\n")
                curve.flush()
            if time.monotonic() - last_saved > config.train.checkpoint_every_seconds:
                _save(trainer, config, dataset, channels)
                last_saved = time.monotonic()
            if stop.is_set():
                interrupted = True
                break
    _save(trainer, config, dataset, channels)
    return interrupted


def _save(trainer: Trainer, config: RunConfig, dataset: Dataset, channels: Channels) -> None:
    tensors, header = trainer.state()
    made_by = {} if config.made_by is None else {"made_by": config.made_by.to_dict()}
    checkpoint.write(config.output_dir / "checkpoint.safetensors", "checkpoint", tensors, {"task": config.task, **made_by, **header})
    extra: dict[str, Any] = {
        "background": [float(x) for x in dataset.background],
        "color_space": dataset.color_space,
        "channels": list(channels.names),
        "data_source": dataset.data_source,
        "data": dataset.facts(),
        "iterations": trainer.step,
        "train_seconds": trainer.elapsed,
    }
    placement = dataset.placement()
    if placement is not None:
        extra["world"] = placement.to_json()
    checkpoint.save_model(config.output_dir / "model.safetensors", trainer.model, config.task, extra)


def _finish(trainer: Trainer, config: RunConfig, dataset: Dataset, channels: Channels, directory: Path, task: TaskSpec) -> None:
    """Metrics, pictures and report of the last checkpoint, from the same tensors that lie on disk."""
    model = trainer.model
    for field in (model.density, model.colour):
        field.set_progress(1.0)
    count = len(dataset.test)
    shown = {round(i * (count - 1) / max(min(count, _SHOWN_VIEWS) - 1, 1)) for i in range(min(count, _SHOWN_VIEWS))}
    folder = directory / "renders"
    folder.mkdir(exist_ok=True)

    clips = dataset.clips()
    reels = {i: clip for clip in clips if clip.source is None for i in clip.views}
    pictures: list[torch.Tensor] = []

    def film(clip: Clip, index: int, rendered: torch.Tensor, truth: torch.Tensor) -> None:
        pictures.append(images.to_uint8(torch.cat([channels.display(x) for x in (truth, rendered)], dim=1)))
        if index == clip.views[-1]:
            images.write_animation(folder / f"clip_{clip.name}.webp", pictures, clip.fps)
            pictures.clear()

    def keep(index: int, view: View, rendered: torch.Tensor, truth: torch.Tensor) -> None:
        clip = reels.get(index)
        if clip is not None:
            film(clip, index, rendered, truth)
        if index in shown:
            stem = f"test_{index:03d}_" + "".join(c if c.isalnum() or c in "-_" else "_" for c in view.name)
            images.write_png(folder / f"{stem}.png", channels.display(rendered))
            images.write_png(folder / f"{stem}_truth.png", channels.display(truth))
            images.write_png(folder / f"{stem}_error.png", torch.from_numpy(error_map(rendered, truth)))

    views = measure(model, dataset, config.renderer, channels, keep)
    for clip in clips:
        if clip.source is None:
            continue  # drawn above
        for i in clip.views:
            truth = clip.source.pixels(i).over(dataset.background)
            film(clip, i, draw(model, clip.source.view(i), config.renderer, dataset.background), truth)
    size = (directory / "model.safetensors").stat().st_size
    training = {"iterations": trainer.step, "train_seconds": trainer.elapsed}
    write_json(directory / "metrics.json", summary(config, model, dataset, channels, views, size, training))
    frames = [channels.display(draw(model, v, config.renderer, dataset.background)) for v in dataset.orbit(_ORBIT_FRAMES)]
    images.write_animation(folder / "orbit.webp", frames, fps=12.0)
    write_report(directory, task.conditions)


# ---------------------------------------------------------------- the curve


def _open_curve(path: Path, step: int) -> Any:
    """metrics.jsonl, cut back to what the checkpoint knows."""
    kept = []
    if step and path.exists():
        for text in path.read_text(encoding="utf-8").splitlines():
            try:
                if json.loads(text)["step"] <= step:
                    kept.append(text)
            except (ValueError, KeyError, TypeError):
                continue  # a line that a kill cut short
    write_text(path, "".join(f"{text}\n" for text in kept))
    return open(path, "a", encoding="utf-8")


def _next_evaluation(trainer: Trainer) -> float:
    every = trainer.settings.eval_every
    return (int(trainer.progress / every + 1e-9) + 1) * every if every > 0 else float("inf")


def _curve_psnr(trainer: Trainer) -> float:
    """Mean PSNR of a few held-out views as :func:`~neuprim.measure.measure` has it, but at most 200 dB, so that a line of JSON can hold
    it; does not touch the training state."""
    views = trainer.dataset.test
    picks = sorted({i * len(views) // _CURVE_VIEWS for i in range(_CURVE_VIEWS)})
    total = 0.0
    for i in picks:
        pixels = views.pixels(i)
        rendered = draw(trainer.model, views.view(i), trainer.renderer, trainer.dataset.background)
        total += min(psnr(rendered, pixels.over(trainer.dataset.background), pixels.mask), _CURVE_PSNR_MAX)
    return total / len(picks)


# ---------------------------------------------------------------- before and around the loop


def warm_up(trainer: Trainer) -> None:
    """Compile the kernels outside the training clock: one throw-away step on a copy of a few primitives."""
    model = trainer.model
    rows = torch.arange(0, model.count, max(model.count // 64, 1))  # some of them live in the view
    few = Primitives(model.density, model.colour, model.rows(rows))
    warm = Trainer(few, trainer.dataset, trainer.loss, trainer.settings, trainer.renderer, 0)
    warm.step = max(warm.settings.iterations, 1)  # at the end of the budget every band of colour is in use
    warm.train_step()


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Between kernels torch has only small tensors; its own thread pool would spin on the cores the kernels need."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; the second interrupts at once. Outside the main thread Ctrl-C is not ours."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    previous = signal.getsignal(signal.SIGINT)

    def handler(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    signal.signal(signal.SIGINT, handler)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, previous)
