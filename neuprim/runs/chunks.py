"""A run in chunks: every chunk of a scene is a run of its own; then all of them are trained together as one model for
the last part of the budget.

``chunks.json`` records what became of each chunk, so that nothing is done twice.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from neuprim.config import RunConfig, find_run_plugins, scene_of, task_of
from neuprim.config.command_settings import LauncherSettings
from neuprim.config.overrides import drop_place, quote_override
from neuprim.core.checkpoint import load_model
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError, DataError, NeuprimError
from neuprim.core.io.files import read_json, write_json
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import Chunks, Loss, TaskSpec
from neuprim.core.train.trainer import Trainer
from neuprim.core.validation import coerce, validate
from neuprim.plugins.attribution import PluginSource, attribute_errors
from neuprim.runs.events import Events, Note, Preparing, ignore_event
from neuprim.runs.finetune import fine_tuner, steps_in
from neuprim.runs.fit import Fitted
from neuprim.runs.ground_truth import render_ground_truth_for_training
from neuprim.runs.launch.jobs import ENDED, Job, JobStatus, Result
from neuprim.runs.launch.launcher import LAUNCH_FOLDER, check_launcher, launch
from neuprim.runs.open import make_scene_context, model_file, read_metrics
from neuprim.runs.training import BetweenSteps, do_nothing_between, train_in_directory

CHUNKS_FILE, CHUNKS_FOLDER = "chunks.json", "chunks"
"""In a run's directory: the record, and the runs of the chunks."""

JOINT_SHARE = 0.2
"""Share of the budget in which the joined model is trained as one, so that primitives on both sides of a boundary adapt
to each other. More of it makes the result worse (docs/dynamic.md)."""

_FORMAT = 1
_WHAT, _INSTEAD = "the record of a run in chunks", "another output_dir=DIR begins anew"

_MIN_PRIMITIVES = 8
"""Primitives of a chunk, at least: their sizes follow from the distances between them."""

_FIT_JOB = "neuprim.runs.sweep:fit_job"
"""What a chunk's worker does. It is named, not imported: it runs a run, which may be one in chunks."""


class ChunksMissing(NeuprimError):
    """Some chunks of a run failed; the text says which and why. The others are kept."""


@dataclass(frozen=True)
class ChunkPlan:
    """What is to be done.

    Attributes:
        chunks: how the scene's task divides it and puts it together.
        configs: of the chunks' runs.
        steps: that the joined model is trained for; None: as many as fit into ``seconds``.
    """

    chunks: Chunks
    configs: tuple[RunConfig, ...]
    steps: int | None
    seconds: float | None

    def facts(self) -> list[dict[str, Any]]:
        """What tells one division from another, JSON-able."""
        return [
            {
                "name": config.output_dir.name,
                "primitives": config.model.primitives,
                "iterations": config.train.iterations,
                "max_seconds": config.train.max_seconds,
            }
            for config in self.configs
        ]


def _load_chunks(config: RunConfig, events: Events) -> Chunks | None:
    """How the scene of a configuration is fitted in chunks; None for in one.

    Raises:
        NeuprimError: what the scene refuses.
    """
    load = scene_of(config, task_of(config)).spec.chunks
    assert load is not None, "the caller asked for chunks"
    context = make_scene_context(config, lambda text, fraction: events(Preparing(text, fraction)))
    with attribute_errors(find_run_plugins(config).scene, "chunks"):
        return load(config.to_dict(), context)


def _make_plan(config: RunConfig, chunks: Chunks) -> ChunkPlan:
    """The runs of the chunks, with their shares of primitives and budget.

    Raises:
        ConfigError: fewer primitives than the chunks need.
    """
    least = _MIN_PRIMITIVES * len(chunks.parts)
    if config.model.primitives < least:
        raise ConfigError(
            f"model.primitives={config.model.primitives}: expected at least {least} for {len(chunks.parts)} chunks"
        )
    primitives = _divide(config.model.primitives - least, [part.primitives for part in chunks.parts])
    configs = []
    for part, own in zip(chunks.parts, primitives, strict=True):
        share = (1 - JOINT_SHARE) * part.steps
        settings = {**part.settings, "model.primitives": own + _MIN_PRIMITIVES, **_schedule(config, share)}
        configs.append(_override(config, settings, config.output_dir / CHUNKS_FOLDER / part.name))
    train = config.train
    steps = None if train.iterations is None else round(JOINT_SHARE * train.iterations)
    return ChunkPlan(
        chunks, tuple(configs), steps, None if train.max_seconds is None else JOINT_SHARE * train.max_seconds
    )


def _schedule(config: RunConfig, share: float) -> dict[str, Any]:
    """The training of a part in a share of the whole's budget; it has as many interventions into its population as the
    whole has."""
    train = config.train
    found: dict[str, Any] = {"train.population.every": max(round(share * train.population.every), 1)}
    if train.iterations is not None:
        found["train.iterations"] = max(round(share * train.iterations), 1)
    if train.max_seconds is not None:
        found["train.max_seconds"] = share * train.max_seconds
    return found


def _divide(total: int, parts: list[float]) -> list[int]:
    """Whole numbers close to these shares of ``total`` that add up to it."""
    ends = [round(total * sum(parts[: n + 1]) / sum(parts)) for n in range(len(parts))]
    return [end - begin for begin, end in zip([0, *ends], ends, strict=False)]


def _override(config: RunConfig, settings: dict[str, Any], directory: Path) -> RunConfig:
    """A configuration with other settings, by dotted key, as if they had been typed."""
    tree = copy.deepcopy(config.to_dict())
    for key, value in settings.items():
        *path, name = key.split(".")
        node = tree
        for group in path:
            node = node[group]
        tree["non_default"][key] = [node.get(name), value]
        node[name] = value
    tree["output_dir"] = str(directory)
    tree["overrides"] = [
        *drop_place(config.overrides),
        *(quote_override(key, value) for key, value in settings.items()),
    ]
    return RunConfig.from_dict(tree)


# ------------------------------------------------------------ the record


@dataclass(frozen=True)
class ChunkRow:
    """One chunk.

    Attributes:
        name: of its folder.
        primitives, iterations, max_seconds: its shares.
        state: waiting, done, failed or interrupted.
        line: why it failed.
        seconds: from its start to its end, measuring included.
    """

    name: str
    primitives: int
    iterations: int | None
    max_seconds: float | None
    state: str = "waiting"
    line: str = ""
    seconds: float = 0.0

    @property
    def facts(self) -> tuple[Any, ...]:
        """What must not change while the run goes on."""
        return self.name, self.primitives, self.iterations, self.max_seconds


@dataclass(frozen=True)
class ChunkRecord:
    """All chunks of a run, and how many steps the joined model is trained for, once it is known."""

    rows: tuple[ChunkRow, ...]
    joined_steps: int | None = None

    def write(self, folder: Path) -> None:
        """Raises OSError where it cannot be written; what was there is intact."""
        write_json(
            folder / CHUNKS_FILE,
            {"format": _FORMAT, "chunks": [asdict(row) for row in self.rows], "joined_steps": self.joined_steps},
        )

    def end(self, number: int, result: Result) -> ChunkRecord:
        """With how a chunk ended."""
        row = replace(self.rows[number], state=result.state, line=result.line, seconds=round(result.seconds, 3))
        return replace(self, rows=(*self.rows[:number], row, *self.rows[number + 1 :]))


def _start_record(plan: ChunkPlan, folder: Path, resume: bool) -> ChunkRecord:
    """The record of a run that begins, or goes on.

    Raises:
        ConfigError: the run was begun with other chunks.
        DataError: its record is damaged.
    """
    fresh = ChunkRecord(
        tuple(ChunkRow(**facts) for facts in plan.facts()), plan.steps if plan.seconds is None else None
    )
    before = read_chunk_record(folder) if resume else None
    if before is None:
        return fresh
    was, now = ([row.facts for row in record.rows] for record in (before, fresh))
    if was != now:
        raise ConfigError(
            f"{folder / CHUNKS_FILE}: begun with {_describe(was)}; the words now ask for {_describe(now)}; expected "
            f"the same words, or another output_dir"
        )
    return before


def read_chunk_record(folder: Path) -> ChunkRecord | None:
    """What a run directory says of its chunks; None where it has none.

    Raises:
        DataError: the file is damaged, or of another version.
    """
    file = folder / CHUNKS_FILE
    data: Any = read_json(file, _WHAT, _INSTEAD)
    if data is None:
        return None
    try:
        if data["format"] != _FORMAT:
            raise DataError(f"{file}: format {data['format']!r}; this neuprim reads {_FORMAT}; {_INSTEAD}")
        steps = data["joined_steps"]
        return ChunkRecord(
            tuple(validate(ChunkRow, row, "chunks") for row in data["chunks"]),
            coerce(steps, int | None, "joined_steps"),
        )
    except (KeyError, TypeError, ValueError, AttributeError, ConfigError) as error:
        raise DataError(f"{file}: not {_WHAT} ({type(error).__name__}: {error}); {_INSTEAD}") from error


def _describe(rows: list[tuple[Any, ...]]) -> str:
    budget = [f"{iterations} steps" if seconds is None else f"{seconds:g} s" for _, _, iterations, seconds in rows]
    return ", ".join(
        f"{name} ({primitives} primitives, {said})" for (name, primitives, _, _), said in zip(rows, budget, strict=True)
    )


# ------------------------------------------------------------ the run


def train_in_chunks(
    config: RunConfig,
    events: Events = ignore_event,
    launcher: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
    between: BetweenSteps = do_nothing_between,
) -> tuple[Fitted, bool]:
    """Fit the chunks that ``scene.chunks`` asks for, join them and train what they make together; as
    :func:`~neuprim.runs.training.train_in_directory`, where ``auto`` finds one run better.

    What is done is kept: the command with ``resume=true`` makes what is missing.

    Args:
        launcher: where chunks are fitted, and their ground truth made. What follows works here.

    Raises:
        ChunksMissing: some of them failed; the others went on.
        KeyboardInterrupt: Ctrl-C came before all chunks were there; those at work have their checkpoints.
        NeuprimError: what a run may raise, a launcher that cannot work here, or chunks other than those that the run
        was begun with.
    """
    render_ground_truth_for_training(config, launcher, lambda text, fraction: events(Preparing(text, fraction)))
    chunks = _load_chunks(config, events)
    if chunks is None:
        events(Note(f"scene.chunks={config.scene['chunks']}: fitted as one run"))
        return train_in_directory(replace(config, scene={**config.scene, "chunks": None}), events, between=between)
    plan = _make_plan(config, chunks)
    record = _fit_chunks(config, plan, _start_record(plan, config.output_dir, config.resume), events, launcher)

    def make(config: RunConfig, task: TaskSpec, dataset: Dataset, loss: Loss) -> Trainer:
        model = _join(plan, task, find_run_plugins(config).scene)
        steps = record.joined_steps
        if steps is None:
            assert plan.seconds is not None, "a budget is in steps, in seconds or both"
            steps = min(steps_in(plan.seconds, config, task, dataset, model), plan.steps or 2**62)
            replace(record, joined_steps=steps).write(config.output_dir)
        trainer = fine_tuner(config, task, dataset, model, max(steps, 1), 1 - JOINT_SHARE, config.train.voxels_every)
        trainer.elapsed = sum(float(read_metrics(own.output_dir)["train_seconds"]) for own in plan.configs)
        return trainer

    return train_in_directory(config, events, between=between, make=make)


def _fit_chunks(
    config: RunConfig, plan: ChunkPlan, record: ChunkRecord, events: Events, launcher: LauncherSettings
) -> ChunkRecord:
    """Have every chunk fitted that is not there yet."""
    folder = config.output_dir
    todo = [n for n, own in enumerate(plan.configs) if not _is_done(record, n, own)]
    check_launcher(launcher, len(todo))
    record.write(folder)
    if not todo:
        return record
    shown = _ChunkProgress(events, len(plan.configs), todo)
    results: dict[int, Result] = {}

    def on_result(number: int, result: Result) -> None:
        nonlocal record
        results[todo[number]] = result
        record = record.end(todo[number], result)
        with suppress(OSError):  # a full disk must not end the others; a chunk that is done is then measured again
            record.write(folder)
        if result.state == "failed":
            events(Note(f"{plan.configs[todo[number]].output_dir}: {result.line}"))

    launch(
        [_job(plan.configs[n]) for n in todo],
        launcher,
        folder / LAUNCH_FOLDER,
        lambda n, status: shown(todo[n], status),
        on_result,
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
            f"{first}; {done} of {len(plan.configs)} chunks are done, and resume=true with output_dir={folder} makes "
            f"the others"
        )
    record.write(folder)
    return record


def _job(config: RunConfig) -> Job:
    return Job(config.output_dir.name, _FIT_JOB, config.to_dict())


def _is_done(record: ChunkRecord, number: int, config: RunConfig) -> bool:
    whole = all((config.output_dir / name).is_file() for name in ("config.yaml", "metrics.json"))
    return record.rows[number].state == "done" and whole and model_file(config.output_dir).is_file()


def _join(plan: ChunkPlan, task: TaskSpec, scene: PluginSource) -> Primitives:
    models = [load_model(model_file(config.output_dir), task)[0] for config in plan.configs]
    with attribute_errors(scene, "join"):
        return plan.chunks.join(models)


class _ChunkProgress:
    """Tells of all chunks together as of one piece of work."""

    def __init__(self, events: Events, count: int, todo: Sequence[int]) -> None:
        self._events = events
        self._statuses = [JobStatus("waiting" if n in todo else "done", progress=1.0) for n in range(count)]
        for n in todo:
            self._statuses[n] = JobStatus()

    def __call__(self, number: int, status: JobStatus) -> None:
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
