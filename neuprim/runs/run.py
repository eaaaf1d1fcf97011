"""Train, measure, render and report a run in its directory, as one model or in chunks.

In chunks: a run trains each chunk (part of the scene) separately. Then the models of the chunks are joined, and trained
as one model for the last part of the budget. ``chunks.json`` records the state of each chunk, so that a resumed run
does not repeat finished chunks.
"""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from neuprim.config import Job, RunConfig, find_config_plugins
from neuprim.config.command_settings import LauncherSettings
from neuprim.config.overrides import drop_output_overrides, quote_override
from neuprim.core.checkpoint import load_model_checkpoint
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.metrics.image import format_failed_views, format_metrics
from neuprim.core.task import Chunks, Loss
from neuprim.core.train.process_group import ProcessGroup
from neuprim.core.train.trainer import Trainer
from neuprim.plugins.attribution import attribute_errors
from neuprim.report.report_page import format_report_bytes
from neuprim.runs.evaluate import evaluate_fitted
from neuprim.runs.fit import Events, Finishing, Fitted, Note, Preparing, ignore_run_event, is_chunked, refuse_chunks
from neuprim.runs.ground_truth import render_ground_truth_before_run
from neuprim.runs.launch.jobs import ENDED, JobStatus
from neuprim.runs.open import lock_run_directory, make_run_scene_context, model_file, read_metrics
from neuprim.runs.sweep import LaunchedRun, LaunchRecord, launch_missing_runs, read_launch_record
from neuprim.runs.training import (
    BetweenSteps,
    RunPreview,
    count_run_finetune_steps,
    make_run_finetune_trainer,
    train_in_directory,
)

CHUNKS_FILE, CHUNKS_FOLDER = "chunks.json", "chunks"
"""File with the record of the chunks, and folder with their runs, in a run's directory."""

__all__ = ["run"]

JOINT_SHARE = 0.2
"""Fraction of the budget for training the joined model, in which primitives on both sides of a boundary adapt to each
other. A larger fraction makes the result worse."""

_MIN_PRIMITIVES = 8
"""Smallest number of primitives in a chunk. Initial sizes of primitives are made from the distances between them."""


class ChunksMissing(NeuprimError):
    """Error: some chunks of a run failed. The message names these chunks and the reasons. Finished chunks stay."""


def run(
    config: RunConfig,
    events: Events = ignore_run_event,
    between: BetweenSteps = lambda fitted, stop: None,
    group: ProcessGroup | None = None,
    launcher: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
) -> Path:
    """Train, measure and write the report; return the run directory.

    Ctrl-C finishes the step, writes a checkpoint and a report, and raises KeyboardInterrupt; a second Ctrl-C stops
    immediately.

    Args:
        config: the configuration.
        events: function that is called with every event.
        between: function (training, event) to call between steps. If the function sets the event, the run
            stops as by Ctrl-C.
        group: processes that train this model together. Each process calls this function; the first process writes
            files.
        launcher: where to train the chunks, if the scene is trained in chunks.

    Raises:
        NeuprimError: the input is wrong, another process uses the directory, or the training produced numbers that are
            not finite. Existing files stay intact.
        RankError: another rank ended; the checkpoint has the last state.
    """
    directory, preview = config.output_dir, RunPreview(events, between)
    first = group is None or group.is_first
    if group is not None:
        refuse_chunks(config, "several ranks train one model together")
    with lock_run_directory(directory) if first else nullcontext(), find_config_plugins(config).attribute_errors():
        if is_chunked(config):
            fitted, interrupted = train_in_chunks(config, events, launcher, preview)
        else:
            fitted, interrupted = train_in_directory(config, events, between=preview, group=group)
        if first:
            preview.write(fitted)
            events(Finishing("measuring held-out views"))
            command = shlex.join(["neuprim", "run", *drop_output_overrides(config.overrides)])
            if failed := format_failed_views(evaluate_fitted(fitted, directory, command)):
                events(Note(failed))
    if interrupted:
        raise KeyboardInterrupt
    return directory


def summarize_run(run_dir: Path) -> str:
    """Return one line with quality and size of a finished run's model, and the path of its report."""
    metrics = read_metrics(run_dir)
    size = format_report_bytes(metrics["model_bytes"])
    return f"{format_metrics(metrics)}, {size}, report: {run_dir / 'report.html'}"


def fit_job(data: Mapping[str, Any], attempt: int, events: Events) -> str:
    """Train and measure a run in a worker process of a launcher; return the run's directory.

    Args:
        data: the configuration, as from :meth:`RunConfig.to_dict`.
        attempt: how often the job's worker died before; above 0, the run resumes from its checkpoint.
        events: function that is called with every event.
    """
    config = RunConfig.from_dict(data)
    return str(run(replace(config, resume=config.resume or attempt > 0), events))


# ---------------------------------------------------------------- chunks


@dataclass(frozen=True)
class ChunkPlan:
    """Plan of a run in chunks (parts of a scene): the runs of the chunks, and the budget for training the joined model.

    Attributes:
        chunks: the scene's chunks, with the function that joins their models.
        configs: configuration of each chunk's run.
        runs: entry of each chunk's run in ``chunks.json``.
        steps: training steps of the joined model; None: as many as fit into ``seconds``.
        seconds: training time of the joined model; None: ``steps`` alone limit it.
    """

    chunks: Chunks
    configs: tuple[RunConfig, ...]
    runs: tuple[LaunchedRun, ...]
    steps: int | None
    seconds: float | None


def _plan_chunks(config: RunConfig, chunks: Chunks) -> ChunkPlan:
    """Plan one run per chunk (part of the scene): divide primitives and budget among the runs.

    In each run, population control (adding and moving primitives) intervenes as often as in a run of the whole scene.

    Raises:
        ConfigError: ``model.primitives`` is too small for the number of chunks.
    """
    least, train = _MIN_PRIMITIVES * len(chunks.parts), config.train
    if config.model.count < least:
        raise ConfigError(
            f"model.primitives={config.model.count}: expected at least {least} for {len(chunks.parts)} chunks"
        )
    counts = _divide_primitives_among_chunks(config.model.count - least, [part.primitives for part in chunks.parts])
    configs, runs = [], []
    for part, count in zip(chunks.parts, counts, strict=True):
        share = (1 - JOINT_SHARE) * part.steps
        settings = {
            **part.settings,
            "model.primitives": count + _MIN_PRIMITIVES,
            "train.population.every": max(round(share * train.population.every), 1),
        }
        if train.iterations is not None:
            settings["train.iterations"] = max(round(share * train.iterations), 1)
        if train.max_seconds is not None:
            settings["train.max_seconds"] = share * train.max_seconds
        words = tuple(quote_override(key, value) for key, value in settings.items())
        folder, typed = config.output_dir / CHUNKS_FOLDER, [*drop_output_overrides(config.overrides), *words]
        configs.append(replace(config.override(settings), output_dir=folder / part.name, overrides=typed))
        runs.append(LaunchedRun(part.name, words))
    steps = None if train.iterations is None else round(JOINT_SHARE * train.iterations)
    seconds = None if train.max_seconds is None else JOINT_SHARE * train.max_seconds
    return ChunkPlan(chunks, tuple(configs), tuple(runs), steps, seconds)


def _divide_primitives_among_chunks(total: int, shares: list[float]) -> list[int]:
    """Split ``total`` in proportion to ``shares`` into whole numbers that add up to ``total``."""
    ends = [round(total * sum(shares[: n + 1]) / sum(shares)) for n in range(len(shares))]
    return [end - begin for begin, end in zip([0, *ends], ends, strict=False)]


def train_in_chunks(
    config: RunConfig,
    events: Events = ignore_run_event,
    launcher: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
    between: BetweenSteps = lambda fitted, stop: None,
) -> tuple[Fitted, bool]:
    """Train the chunks (parts of a scene) of ``scene.chunks``, join their models, and train the joined model.

    If the scene decides against chunks, train it as one run. Finished chunks are not repeated: the same command with
    ``resume=true`` trains the missing chunks. Return the trained model, and whether Ctrl-C ended the training.

    Args:
        launcher: where chunks are trained and their ground truth is rendered. This process trains the joined model.

    Raises:
        ChunksMissing: some chunks failed; the other chunks were completed.
        KeyboardInterrupt: Ctrl-C came before all chunks were done; unfinished chunks have checkpoints.
        NeuprimError: an error of a run, the launcher cannot work here, or the chunks differ from those of the
        interrupted run.
    """

    def progress(text: str, fraction: float) -> None:
        events(Preparing(text, fraction))

    render_ground_truth_before_run(config, launcher, progress)
    whole = Job.of(config)
    assert whole.scene.spec.chunks is not None, "the caller asked for chunks"
    context = make_run_scene_context(config, progress)
    with attribute_errors(whole.plugins.scene, "chunks"):
        chunks = whole.scene.spec.chunks(config.to_dict(), context)
    if chunks is None:
        events(Note(f"scene.chunks={config.scene['chunks']}: fitted as one run"))
        return train_in_directory(replace(config, scene={**config.scene, "chunks": None}), events, between=between)
    plan = _plan_chunks(config, chunks)
    record = LaunchRecord(config.output_dir / CHUNKS_FILE, (), plan.runs, plan.steps if plan.seconds is None else None)
    record = record.resume(read_launch_record(record.file) if config.resume else None, more=False)
    record = _fit_chunks(plan, record, events, launcher)

    def make(job: Job, dataset: Dataset, loss: Loss) -> Trainer:
        models = [load_model_checkpoint(model_file(own.output_dir), job.task)[0] for own in plan.configs]
        with attribute_errors(job.plugins.scene, "join"):
            model = plan.chunks.join(models)
        steps = record.joined_steps
        if steps is None:
            assert plan.seconds is not None, "a budget is in steps, in seconds or both"
            steps = min(count_run_finetune_steps(plan.seconds, job, dataset, model), plan.steps or 2**62)
            replace(record, joined_steps=steps).write()
        trainer = make_run_finetune_trainer(
            job, dataset, model, max(steps, 1), 1 - JOINT_SHARE, config.train.voxels_every
        )
        trainer.elapsed = sum(float(read_metrics(own.output_dir)["train_seconds"]) for own in plan.configs)
        return trainer

    return train_in_directory(config, events, between=between, make=make)


def _fit_chunks(plan: ChunkPlan, record: LaunchRecord, events: Events, launcher: LauncherSettings) -> LaunchRecord:
    """Launch the runs of all unfinished chunks, and report their joint progress; return the updated record of runs."""
    folder, count = record.file.parent, len(plan.configs)
    statuses = [JobStatus()] * count

    def on_status(number: int, status: JobStatus) -> None:
        """Report the progress of all chunks as one event."""
        before, statuses[number] = statuses[number], status
        if status.state == "failed" != before.state:
            events(Note(f"{plan.configs[number].output_dir}: {status.text}"))
        done = sum(s.state == "done" for s in statuses)
        progress = sum(1.0 if s.state in ENDED else s.progress for s in statuses) / count
        events(Preparing(f"fitting {count} chunks ({done} done)", progress))

    record, results = launch_missing_runs(record, plan.configs, launcher, on_status)
    for result in results:
        if result is not None and result.trace:
            raise RuntimeError(f"in a chunk's run:\n{result.trace}")
    if any(result is None or result.state == "interrupted" for result in results):
        raise KeyboardInterrupt
    failed = [f"{own.output_dir}: {r.line}" for own, r in zip(plan.configs, results, strict=True) if r and r.line]
    if failed:
        raise ChunksMissing(
            f"{'; '.join(failed)}; {count - len(failed)} of {count} chunks are finished; run again with "
            f"resume=true --out {folder} to train the others"
        )
    return record
