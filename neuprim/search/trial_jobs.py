"""Trials as jobs of a launcher: several at once, here or elsewhere."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuprim.config import RunConfig, task_of
from neuprim.config.launcher import LauncherSettings
from neuprim.core.data import Dataset
from neuprim.core.errors import NeuprimError
from neuprim.runs.events import Events, Preparing
from neuprim.runs.launch.jobs import ENDED, Job, JobStatus, Result
from neuprim.runs.launch.launcher import LAUNCH_FOLDER, OnStatus, launch
from neuprim.runs.open import load_dataset
from neuprim.search.trials import Outcome, Trial, run_trial

__all__ = ["TrialFailed", "do_trial", "launch_jobs", "launched_trials", "trial_of", "words_of"]

_kept: dict[str, Dataset] = {}
"""The scene of this worker's last trial: those of a search have one scene."""


class TrialFailed(NeuprimError):
    """A trial that was launched could not be made; the text says why."""


def words_of(trial: Trial) -> dict[str, Any]:
    """A trial as plain values; :func:`trial_of` reads them back."""
    return {"config": trial.config.to_dict(), "hold_out": trial.hold_out, "views": trial.views}


def trial_of(data: Mapping[str, Any]) -> Trial:
    """What :func:`words_of` gave."""
    return Trial(RunConfig.from_dict(data["config"]), data["hold_out"], data["views"])


def do_trial(data: Mapping[str, Any], attempt: int, events: Events) -> Outcome:
    """The function of a job; ``trial.json`` says whether it goes on where it was left."""
    trial = trial_of(data)
    return run_trial(trial, _dataset(trial.config, events), events)


def launch_jobs(jobs: Sequence[Job], settings: LauncherSettings, folder: Path, hear: OnStatus) -> list[Result]:
    """Results in the order of the jobs.

    Args:
        folder: of the search.

    Raises:
        KeyboardInterrupt: Ctrl-C came; what was trained so far is kept.
        RuntimeError: a bug in one of them, with its traceback.
    """
    results = launch(jobs, settings, folder / LAUNCH_FOLDER, hear)
    over = [result for result in results if result is not None and result.state != "interrupted"]
    for result in over:
        if result.trace:
            raise RuntimeError(f"in a worker of launcher={settings.name}:\n{result.trace}")
    if len(over) < len(jobs):
        raise KeyboardInterrupt
    return over


def launched_trials(
    trials: Sequence[Sequence[Trial]], settings: LauncherSettings, folder: Path, progress: Callable[[float], None]
) -> list[list[Outcome] | NeuprimError]:
    """Outcomes of groups of trials, or of each group why one of it could not be made; all are launched together.

    Args:
        folder: of the search.
        progress: called with the fraction of all steps that is done.

    Raises:
        as :func:`launch_jobs`.
    """
    jobs = [
        Job(f"{group}-{number}", f"{__name__}:{do_trial.__name__}", words_of(trial))
        for group, several in enumerate(trials)
        for number, trial in enumerate(several)
    ]
    done = [0.0] * len(jobs)

    def hear(number: int, status: JobStatus) -> None:
        done[number] = 1.0 if status.state in ENDED else status.progress
        progress(sum(done) / len(done))

    results = iter(launch_jobs(jobs, settings, folder, hear))
    made: list[list[Outcome] | NeuprimError] = []
    for several in trials:
        own = [next(results) for _ in several]
        failed = next((result for result in own if result.state == "failed"), None)
        made.append([result.value for result in own] if failed is None else TrialFailed(failed.line))
    return made


def _dataset(config: RunConfig, events: Events) -> Dataset:
    key = json.dumps([config.task, config.scene_name, config.scene, config.seed], sort_keys=True)
    if key not in _kept:
        _kept.clear()
        _kept[key] = load_dataset(config, task_of(config), lambda text, fraction: events(Preparing(text, fraction)))
    return _kept[key]
