"""Search and train: trials, the size that they promise, a full run of it, and what makes its model smaller."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

from neuprim.config import RunConfig, suspects_of, task_of
from neuprim.config.launcher import LauncherSettings
from neuprim.config.target import Target
from neuprim.core.data import Dataset
from neuprim.core.data.dataset_check import check_dataset
from neuprim.core.errors import ConfigError, DataError
from neuprim.runs.events import Events, Preparing, ignore_event
from neuprim.runs.ground_truth import render_ground_truth_for_training
from neuprim.runs.launch.launcher import use_launcher_threads
from neuprim.runs.open import LOGS, load_dataset
from neuprim.runs.run_directory import lock_directory
from neuprim.search.target.record import Record, read_record
from neuprim.search.target.searching import Search
from neuprim.search.target.stages import publish
from neuprim.search.target.trying import Trying

__all__ = ["hold_out", "target_run"]


def target_run(
    config: RunConfig,
    target: Target,
    budget: float,
    events: Events = ignore_event,
    clock: Callable[[], float] = time.monotonic,
    launcher: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
) -> Record:
    """Find and train the smallest model that meets a target; leaves a run directory with ``target.json`` and
    ``model.neuprim``.

    Only training views decide: some are held out. The test views are measured once, at the end.

    Args:
        config: what the search starts from; its primitives are the first size tried, its iterations the most that a run
        may have. budget: seconds of search, training and measuring.
        events: told what happens; a line of each trial and decision is a Note.
        clock: seconds, monotonic.
        launcher: where trainings work; each of them has the same number of threads, so that their paces compare.

    Raises:
        KeyboardInterrupt: after Ctrl-C; the same call with ``resume`` goes on.
        NeuprimError: the input's fault, or a budget in which nothing can be trained.
    """
    _check(config)
    asked = {**target.given(), "budget": budget}
    record = _kept(config, asked)
    if record.achieved:
        return record
    suspects = suspects_of(config)
    begun = clock()
    with (
        lock_directory(config.output_dir, "search"),
        suspects.watch(config.output_dir / LOGS),
        use_launcher_threads(launcher),
    ):
        task = task_of(config)

        def progress(text: str, fraction: float) -> None:
            events(Preparing(text, fraction))

        render_ground_truth_for_training(config, launcher, progress)
        dataset = load_dataset(config, task, progress)
        suspects.know(dataset)
        check_dataset(dataset, task.conditions)
        record.hold_out = hold_out(dataset)
        trying = Trying(config, dataset, record, events, clock, launcher)
        trying.begun = begun - record.spent
        try:
            search = Search(config, target, dataset, record, trying)
            search.run()
            publish(trying, target, search.judge)
        finally:
            trying.write()
    return record


def _check(config: RunConfig) -> None:
    if config.train.max_seconds is not None and "train.max_seconds" in config.non_default:
        raise ConfigError(
            f"train.max_seconds={config.train.max_seconds:g}: a run with a target has its seconds from budget=; expected one of them"
        )
    if config.train.iterations == 0:
        raise ConfigError("train.iterations=0: a run with a target has to train; expected a positive number")
    population = config.train.population
    if population.strategy == "gradient":
        raise ConfigError(
            "train.population.strategy=gradient: it decides by itself how many primitives there are, so that a target cannot; expected relocate or fixed"
        )
    if population.grow_to is not None:
        raise ConfigError(
            f"train.population.grow_to={population.grow_to}: a target decides how many primitives there are; expected null"
        )


def _same(config: RunConfig) -> dict[str, Any]:
    """What makes trainings of before worth keeping, as JSON brings it back."""
    own = ("output_dir", "resume", "overrides", "non_default", "made_by")
    kept: dict[str, Any] = json.loads(json.dumps({k: v for k, v in config.to_dict().items() if k not in own}))
    return kept


def _kept(config: RunConfig, asked: dict[str, float]) -> Record:
    """The record so far. Another target or budget starts its seconds anew and keeps the trainings."""
    before, same = (read_record(config.output_dir) if config.resume else None), _same(config)
    if before is None:
        if (config.output_dir / "config.yaml").exists():
            raise ConfigError(
                f"output_dir={config.output_dir}: holds a run without a target; expected a new directory, or that of a target run"
            )
        return Record(asked, same)
    different = [key for key in same if before.same.get(key) != same[key]]
    if different:
        raise ConfigError(
            f"{config.output_dir / 'target.json'}: begun with another {', '.join(different)}; expected the same words, or a new output_dir"
        )
    if before.asked != asked:
        before.asked, before.spent, before.chosen, before.achieved = asked, 0.0, None, {}
        before.before = len(before.done("full"))
        before.attempts = [a for a in before.attempts if a.outcome is not None]
        before.why, before.out_of_reach, before.warning, before.turns, before.stage = [], None, None, [], 0
    return before


def hold_out(dataset: Dataset) -> int:
    """Every how many-th training view judges: one of eight, more of few, as the mean of a few views says little."""
    count = len(dataset.train)
    if count < 4:
        raise DataError(
            f"{dataset.name}: {count} training views; a target needs 4 or more, as some are held out to judge by"
        )
    return min(8, max(2, count // 8))
