"""The training half of a run in chunks: every chunk a run of its own, then all of them as one model, trained on
together for the last of the budget."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

from neuprim.config import RunConfig
from neuprim.config.launcher import LauncherSettings
from neuprim.core.checkpoint import load_model
from neuprim.core.data import Dataset
from neuprim.core.errors import NeuprimError
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import Loss, TaskSpec
from neuprim.core.train.trainer import Trainer
from neuprim.plugins.blame import Suspects, blamed
from neuprim.runs.chunks.plan import TOGETHER, Plan, chunks_of, plan_of
from neuprim.runs.chunks.record import ChunkRecord, recorded
from neuprim.runs.events import Events, Note, Preparing, silent
from neuprim.runs.finetune import fine_tuner, steps_in
from neuprim.runs.fit import Fitted
from neuprim.runs.ground_truth import before_training
from neuprim.runs.launch.jobs import Job, Result
from neuprim.runs.launch.status import ENDED, Status
from neuprim.runs.launch.table import FOLDER as LAUNCH
from neuprim.runs.launch.table import check_launcher, launch
from neuprim.runs.open import LOGS, model_file, read_metrics
from neuprim.runs.training import Between, alone, train

__all__ = ["ChunksMissing", "train_in_chunks"]

_FIT_ONE = "neuprim.runs.sweep.one:fit_one"
"""What a chunk's worker does; named, as that is a run, and a run may be one in chunks."""


class ChunksMissing(NeuprimError):
    """Some chunks of a run failed; the text says which and why. The others are kept."""


def train_in_chunks(
    config: RunConfig,
    suspects: Suspects,
    events: Events = silent,
    launcher: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
    between: Between = alone,
) -> tuple[Fitted, bool]:
    """Fit the chunks that ``scene.chunks`` asks for, join them and train what they make together; as
    :func:`~neuprim.runs.training.train`, where ``auto`` finds one run better.

    What is done is kept: the command with ``resume=true`` makes what is missing.

    Args:
        launcher: where chunks are fitted, and their ground truth made. What follows works here.

    Raises:
        ChunksMissing: some of them failed; the others went on.
        KeyboardInterrupt: Ctrl-C came before all chunks were there; those at work have their checkpoints.
        NeuprimError: what a run may raise, a launcher that cannot work here, or chunks other than those that the run
        was begun with.
    """
    before_training(config, launcher, lambda text, fraction: events(Preparing(text, fraction)))
    chunks = chunks_of(config, events)
    if chunks is None:
        events(Note(f"scene.chunks={config.scene['chunks']}: fitted as one run"))
        return train(replace(config, scene={**config.scene, "chunks": None}), suspects, events, between=between)
    plan = plan_of(config, chunks)
    record = _fitted(config, plan, recorded(plan, config.output_dir, config.resume), events, launcher)

    def make(config: RunConfig, task: TaskSpec, dataset: Dataset, loss: Loss) -> Trainer:
        model = _joined(plan, task, suspects)
        steps = record.joined_steps
        if steps is None:
            assert plan.seconds is not None, "a budget is in steps, in seconds or both"
            steps = min(steps_in(plan.seconds, config, task, dataset, model), plan.steps or 2**62)
            replace(record, joined_steps=steps).write(config.output_dir)
        trainer = fine_tuner(config, task, dataset, model, max(steps, 1), 1 - TOGETHER, config.train.voxels_every)
        trainer.elapsed = sum(float(read_metrics(own.output_dir)["train_seconds"]) for own in plan.configs)
        return trainer

    return train(config, suspects, events, between=between, make=make)


def _fitted(
    config: RunConfig, plan: Plan, record: ChunkRecord, events: Events, launcher: LauncherSettings
) -> ChunkRecord:
    """Have every chunk fitted that is not there yet."""
    folder = config.output_dir
    todo = [n for n, own in enumerate(plan.configs) if not _is_done(record, n, own)]
    check_launcher(launcher, len(todo))
    record.write(folder)
    if not todo:
        return record
    shown = _Shown(events, len(plan.configs), todo)
    results: dict[int, Result] = {}

    def ended(number: int, result: Result) -> None:
        nonlocal record
        results[todo[number]] = result
        record = record.ended(todo[number], result)
        with suppress(OSError):  # a full disk must not end the others; a chunk that is done is then measured again
            record.write(folder)
        if result.state == "failed":
            events(Note(f"{plan.configs[todo[number]].output_dir}: {result.line}"))

    launch(
        [_job(plan.configs[n]) for n in todo],
        launcher,
        folder / LAUNCH,
        lambda n, status: shown(todo[n], status),
        ended,
    )
    for result in results.values():
        if result.trace:
            raise RuntimeError(f"in a chunk's run:\n{result.trace}")
    if len(results) < len(todo) or any(result.state == "interrupted" for result in results.values()):
        raise KeyboardInterrupt
    failed = [(plan.configs[n].output_dir, result.line) for n, result in results.items() if result.state == "failed"]
    if failed:
        done, first = len(plan.configs) - len(failed), "; ".join(f"{directory}: {line}" for directory, line in failed)
        raise ChunksMissing(
            f"{first}; {done} of {len(plan.configs)} chunks are done, and resume=true with output_dir={folder} makes the others"
        )
    record.write(folder)
    return record


def _job(config: RunConfig) -> Job:
    return Job(config.output_dir.name, _FIT_ONE, config.to_dict())


def _is_done(record: ChunkRecord, number: int, config: RunConfig) -> bool:
    whole = all((config.output_dir / name).is_file() for name in ("config.yaml", "metrics.json"))
    return record.rows[number].state == "done" and whole and model_file(config.output_dir).is_file()


def _joined(plan: Plan, task: TaskSpec, suspects: Suspects) -> Primitives:
    models = [load_model(model_file(config.output_dir), task)[0] for config in plan.configs]
    with blamed(
        suspects.scene.origin, f"join of {suspects.scene.what}", plan.configs[0].output_dir.parent.parent / LOGS
    ):
        return plan.chunks.join(models)


class _Shown:
    """Tells of all chunks together as of one piece of work."""

    def __init__(self, events: Events, count: int, todo: Sequence[int]) -> None:
        self._events = events
        self._statuses = [Status("waiting" if n in todo else "done", progress=1.0) for n in range(count)]
        for n in todo:
            self._statuses[n] = Status()

    def __call__(self, number: int, status: Status) -> None:
        self._statuses[number] = status
        counts = Counter(
            "waiting" if s.state == "waiting" else s.state if s.state in ENDED else "at work" for s in self._statuses
        )
        said = ", ".join(
            f"{counts[state]} {state}"
            for state in ("done", "at work", "waiting", "failed", "interrupted")
            if counts[state]
        )
        progress = sum(1.0 if s.state in ENDED else s.progress for s in self._statuses) / len(self._statuses)
        self._events(Preparing(f"fitting {len(self._statuses)} chunks ({said})", progress))
