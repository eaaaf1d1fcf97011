"""Prune a finished run: look for what its scene does not require, and write what is left as a run of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neuprim.config import RunConfig, suspects_of
from neuprim.core.channels import channels_of
from neuprim.core.data import Dataset
from neuprim.core.data.dataset import hold_out_views
from neuprim.core.data.dataset_check import check_dataset
from neuprim.core.errors import ConfigError
from neuprim.core.io.files import refuse_existing, write_json, write_text
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import TaskSpec
from neuprim.core.train.trainer import Trainer
from neuprim.runs.evaluate import evaluate_fitted
from neuprim.runs.finetune import steps_in
from neuprim.runs.fit import Fitted, keep_model_settings, make_loss, use_one_torch_thread
from neuprim.runs.kept import PRUNED, kept_shares
from neuprim.runs.measure import measure_quality, render_image
from neuprim.runs.open import LOGS, load_dataset, load_run, model_file, move_to_render_device, read_metrics
from neuprim.runs.training import save_training
from neuprim.search.prune.cut import numbers, zeros_of
from neuprim.search.prune.search import Search, Stage

__all__ = ["Pruning", "Request", "prune_run"]

_TURNS = 12
"""Frames that tell how fast a model is drawn."""


@dataclass(frozen=True)
class Request:
    """What to do.

    Attributes:
        tolerance: dB that the judged training views may lose.
        seconds: of fine-tuning, about, in which as many steps are made as fit; steps: so many instead, which gives the
        same model again. out: the new run directory; None: beside the run, its name with "-pruned".
        overwrite: whether files there may be replaced.
        hold_out: n > 1: one of n training views neither decides nor is trained on, as in
        :func:`~neuprim.core.data.dataset.hold_out_views`; 0: all do.
    """

    run_dir: Path
    tolerance: float = 0.1
    seconds: float = 60.0
    steps: int | None = None
    out: Path | None = None
    overwrite: bool = False
    hold_out: int = 0


@dataclass(frozen=True)
class Pruning:
    """What became of a model.

    Attributes:
        run_dir: the new run's; None where nothing could go, and nothing was written.
        before, after: "primitives", "numbers" (that are not left out), "bytes" (of the model file), "psnr" and "ssim"
        (means over the held-out
            views) and "frames_per_second" (of these, one model after the other).
        words: what fields do with less of, as in ``model.reduced``; kept: piece -> share of the primitives left that
        have it. judged: dB on the training views that decided, before and after; stages: what was tried.
    """

    run_dir: Path | None
    before: dict[str, float]
    after: dict[str, float]
    words: tuple[str, ...]
    kept: dict[str, float]
    judged: tuple[float, float]
    stages: tuple[Stage, ...]
    steps: int
    seconds: float


def prune_run(request: Request, progress: Callable[[str, float], None] = lambda text, fraction: None) -> Pruning:
    """Remove primitives, pieces of primitives and parts of fields as far as training views allow, fine-tuning in
    between.

    What decides are training views alone; held-out views are measured before and after.

    Args:
        progress: called with (text, fraction 0..1 of the search).

    Raises:
        NeuprimError: no such run, data that cannot be read, or files in the way.
    """
    final = (
        request.run_dir.with_name(f"{request.run_dir.resolve().name}-pruned") if request.out is None else request.out
    )
    if final.exists() and not final.is_dir():
        raise ConfigError(f"--out {final}: is a file; expected a new folder")
    if final.exists() and final.resolve() == request.run_dir.resolve():
        raise ConfigError(f"--out {final}: is the run itself; expected a new folder")
    refuse_existing(final, request.overwrite)
    config, task, model, header = load_run(request.run_dir)
    config = replace(config, output_dir=request.run_dir)
    suspects = suspects_of(config)
    with suspects.watch(request.run_dir / LOGS), use_one_torch_thread():
        progress("reading the run's data", 0.0)
        dataset = load_dataset(config, task, run_dir=request.run_dir)
        suspects.know(dataset)
        check_dataset(dataset, task.conditions)
        if request.hold_out:
            dataset = replace(dataset, train=hold_out_views(dataset, request.hold_out).train)
        begun = time.monotonic()
        steps = request.steps if request.steps is not None else steps_in(request.seconds, config, task, dataset, model)
        search = Search(config, task, dataset, request.tolerance, steps, progress)
        small, words = search(model)
        seconds = time.monotonic() - begun
        judged = (search.base, search.judge(small))
        if numbers(small) >= numbers(model):
            there = _facts(
                model,
                model_file(request.run_dir),
                measure_quality(model, task, dataset, config.renderer),
                _paces(config, dataset, (model,))[0],
            )
            return Pruning(None, there, there, (), kept_shares(model), judged, tuple(search.stages), steps, seconds)
        progress("measuring held-out views", 1.0)
        paces = _paces(config, dataset, (model, small))
        before = _facts(
            model, model_file(request.run_dir), measure_quality(model, task, dataset, config.renderer), paces[0]
        )
        progress("pictures and report", 1.0)
        _written(final, config, task, dataset, small, words, header, steps, seconds)
        metrics = read_metrics(final)
        after = _facts(small, final / "model.safetensors", (metrics["psnr"], metrics["ssim"]), paces[1])
    made = Pruning(final, before, after, words, kept_shares(small), judged, tuple(search.stages), steps, seconds)
    write_json(final / PRUNED, _record(request, made))
    return made


# ---------------------------------------------------------------- parts


def _paces(config: RunConfig, dataset: Dataset, models: Sequence[Primitives]) -> list[float]:
    """Median frames/s of each over some held-out views, drawn in turns, so that whatever else the machine does meets
    all of them."""
    there = [move_to_render_device(model, config.renderer, dataset.test.view(0)) for model in models]
    seconds: list[list[float]] = [[] for _ in there]
    for turn in range(_TURNS + 1):
        view = dataset.test.view(turn * len(dataset.test) // (_TURNS + 1))
        for model, own in zip(there, seconds, strict=True):
            begun = time.perf_counter()
            render_image(model, view, config.renderer, dataset.background)
            if turn:  # whatever a first frame loads is no part of its time
                own.append(time.perf_counter() - begun)
    return [1.0 / max(float(np.median(own)), 1e-9) for own in seconds]


def _facts(model: Primitives, file: Path, found: tuple[float, float], pace: float) -> dict[str, float]:
    facts = {"primitives": model.count, "numbers": numbers(model), "bytes": file.stat().st_size}
    return {**facts, "psnr": found[0], "ssim": found[1], "frames_per_second": pace}


def _written(
    final: Path,
    config: RunConfig,
    task: TaskSpec,
    dataset: Dataset,
    model: Primitives,
    words: tuple[str, ...],
    header: dict[str, Any],
    steps: int,
    seconds: float,
) -> None:
    """The run directory: configuration, model, a checkpoint that training can go on from, metrics, pictures and
    report."""
    reduced = [*config.model.reduced, *words]
    typed = [f"model.primitives={model.count}"]
    typed += [f"model.reduced=[{','.join(repr(word) for word in reduced)}]"] if reduced else []
    known = ("model.primitives=", "model.reduced=", "output_dir=", "resume=")
    small = replace(
        config,
        model=replace(config.model, primitives=model.count, reduced=reduced),
        output_dir=final,
        overrides=[*(word for word in config.overrides if not word.startswith(known)), *typed],
    )
    trainer = Trainer(
        model,
        dataset,
        make_loss(small, task),
        keep_model_settings(small.train, task, model),
        small.renderer,
        small.seed,
    )
    trainer.zero_masks = zeros_of(trainer.model)
    trainer.step = int(header.get("iterations") or 0) + steps
    trainer.elapsed = float(header.get("train_seconds") or 0.0) + seconds
    fitted = Fitted(small, task, dataset, channels_of(task, dataset), trainer)
    final.mkdir(parents=True, exist_ok=True)
    write_text(final / "config.yaml", small.to_yaml())
    save_training(fitted)
    evaluate_fitted(fitted, final)


def _record(request: Request, made: Pruning) -> dict[str, Any]:
    """The content of :data:`~neuprim.runs.kept.PRUNED`."""
    return {
        "format": 1,
        "pruned_from": str(request.run_dir),
        "tolerance": request.tolerance,
        "steps": made.steps,
        "seconds": made.seconds,
        "before": made.before,
        "after": made.after,
        "reduced": list(made.words),
        "kept": made.kept,
        "judged_psnr": list(made.judged),
        "stages": [asdict(stage) for stage in made.stages],
    }
