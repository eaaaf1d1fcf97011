"""Short trainings that searches compare, in this process or as jobs of a launcher.

A trial's folder is a run directory without report and pictures. Its ``trial.json`` stores the request and, at the end,
the outcome. A finished trial is not repeated, and an interrupted trial resumes from its checkpoint. If the
settings have changed, the trial is trained anew.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from neuprim.config import Job, RunConfig, current_config_provenance, find_config_plugins, load_config_task
from neuprim.config.command_settings import LauncherSettings
from neuprim.config.run_config import flatten
from neuprim.core.data import Dataset
from neuprim.core.errors import DataError, NeuprimError
from neuprim.core.io.files import read_json_record, write_json
from neuprim.core.validation import validate_settings
from neuprim.runs.fit import Event, Events, Finishing, Note, Preparing, Step, ignore_run_event
from neuprim.runs.launch.jobs import ENDED, JobResult, JobStatus, LaunchJob
from neuprim.runs.launch.launcher import LAUNCH_FOLDER, launch_jobs
from neuprim.runs.open import load_dataset, lock_run_directory
from neuprim.runs.training import train_in_directory
from neuprim.search.model_quality import choose_trial_views, measure_trial_views

TRIAL_FILE, _FORMAT = "trial.json", 1

NOT_TRAINED_WITH = ("output_dir", "resume", "overrides", "non_default")
"""Entries of a configuration that do not change the training."""

_FEW_STEPS = 64  # with fewer steps, a single slow one would spoil the mean of their times


@dataclass(frozen=True)
class Trial:
    """Request for a trial: a short training in the ``output_dir`` of ``config``.

    Attributes:
        hold_out: n > 1 holds out every n-th training view for the evaluation; 0 evaluates on the test views.
        views: limit on the number of views to evaluate; they are evenly spread.
    """

    config: RunConfig
    hold_out: int = 0
    views: int = 8


@dataclass(frozen=True)
class Outcome:
    """Measured result of a trial.

    Attributes:
        psnr, ssim: means over the evaluation views, in the data set's colour space.
        bytes: size of ``model.safetensors``.
        seconds: time of the training.
        pace: seconds per training step.
        ms_per_frame: median render time over the evaluation views.
    """

    psnr: float
    ssim: float
    primitives: int
    parameters_per_primitive: int
    bytes: int
    steps: int
    seconds: float
    pace: float
    ms_per_frame: float


@dataclass(frozen=True)
class TrialRecord:
    """Content of ``trial.json``.

    Attributes:
        asked: settings of the requested trial.
        views: limit on the number of views to evaluate.
        outcome: result of the trial; None until the trial is finished.
    """

    asked: dict[str, Any]
    views: int
    outcome: Outcome | None = None


class TrialFailed(NeuprimError):
    """Error: a trial that a launcher ran has failed. The message says why."""


def read_trial(folder: Path) -> TrialRecord | None:
    """Read ``trial.json`` in a trial's folder; return None if there is no such file.

    Raises:
        DataError: ``trial.json`` is damaged.
    """
    what, instead = "the record of a trial", "delete its folder to train anew"

    def parse(data: Mapping[str, Any]) -> TrialRecord:
        return validate_settings(TrialRecord, {name: data[name] for name in ("asked", "views", "outcome")})

    return read_json_record(folder / TRIAL_FILE, what, instead, _FORMAT, parse)


def run_trial(trial: Trial, dataset: Dataset | None = None, events: Events = ignore_run_event) -> Outcome:
    """Train and evaluate a trial; return its outcome. If the trial is finished already, return the stored outcome.

    Ctrl-C finishes the training step, writes a checkpoint and raises KeyboardInterrupt. The same call then resumes.

    Args:
        dataset: data of the whole scene, if they are loaded already.

    Raises:
        DataError: the folder holds another run, or a damaged ``trial.json``.
        NeuprimError: the errors of :func:`neuprim.runs.run.run`.
    """
    config, folder = trial.config, trial.config.output_dir
    with lock_run_directory(folder, "trial"):
        asked, before = _trial_request(trial), read_trial(folder)
        if before is None and (folder / "config.yaml").exists():
            raise DataError(
                f"{folder}: contains a run, but no {TRIAL_FILE}; expected a new folder, or the folder of a trial"
            )
        if before is not None and before.asked != asked:
            a, b = flatten(before.asked), flatten(asked)
            changed = sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))
            events(Note(f"{folder}: made with another {', '.join(changed)}; trained anew"))
            (folder / "checkpoint.safetensors").unlink(missing_ok=True)
            before = None
        complete = all((folder / name).exists() for name in ("config.yaml", "model.safetensors"))
        if before is not None and complete and before.outcome and before.views == trial.views:
            return before.outcome
        record = TrialRecord(asked, trial.views)
        write_json(folder / TRIAL_FILE, {"format": _FORMAT, **asdict(record)})
        ends: list[float] = []  # seconds at the end of each step

        def note_steps(event: Event) -> None:
            events(event)
            if isinstance(event, Step):
                ends.append(event.report.seconds)

        with find_config_plugins(config).attribute_errors():
            resumed = replace(config, resume=before is not None)
            fitted, interrupted = train_in_directory(resumed, note_steps, dataset, trial.hold_out)
            if interrupted:
                raise KeyboardInterrupt
            events(Finishing("measuring evaluation views"))
            fitted.unlock_bands()
            views = choose_trial_views(fitted.dataset, trial.views)
            quality = measure_trial_views(fitted.model, views, config.renderer, fitted.dataset.background)
        steps, seconds = fitted.trainer.step, fitted.trainer.elapsed
        times, pace = [b - a for a, b in pairwise(ends)], seconds / max(steps, 1)
        if times:
            pace = max((statistics.median if len(times) < _FEW_STEPS else statistics.fmean)(times), 1e-9)
        outcome = Outcome(
            psnr=quality.psnr,
            ssim=quality.ssim,
            primitives=fitted.model.count,
            parameters_per_primitive=fitted.model.parameters_per_primitive,
            bytes=(folder / "model.safetensors").stat().st_size,
            steps=steps,
            seconds=seconds,
            pace=pace,
            ms_per_frame=quality.ms_per_frame,
        )
        write_json(folder / TRIAL_FILE, {"format": _FORMAT, **asdict(replace(record, outcome=outcome))})
        return outcome


def _trial_request(trial: Trial) -> dict[str, Any]:
    """Return a trial's settings, with the types that reading JSON gives. Equal settings allow reusing a folder."""
    config = replace(trial.config, made_by=current_config_provenance(trial.config, load_config_task(trial.config)))
    settings = {name: value for name, value in config.to_dict().items() if name not in NOT_TRAINED_WITH}
    request: dict[str, Any] = json.loads(json.dumps({**settings, "hold_out": trial.hold_out}))
    return request


# ---------------------------------------------------------------- trials as jobs

_trial_datasets: dict[str, Dataset] = {}  # scene of this worker's last trial; all trials of a search have one scene


def run_trial_job(data: Mapping[str, Any], attempt: int, events: Events) -> Outcome:
    """Run a trial in a launcher's worker. Resume the trial if ``trial.json`` in its folder has the same settings."""
    config = RunConfig.from_dict(data["config"])
    key = json.dumps([config.task, config.scene_name, config.scene, config.seed], sort_keys=True)
    if key not in _trial_datasets:
        _trial_datasets.clear()
        _trial_datasets[key] = load_dataset(Job.of(config), lambda text, part: events(Preparing(text, part)))
    return run_trial(Trial(config, data["hold_out"], data["views"]), _trial_datasets[key], events)


def launch_trials(
    trials: Sequence[Trial], settings: LauncherSettings, folder: Path, progress: Callable[[float], None]
) -> list[JobResult]:
    """Run trials as jobs of a launcher; return a result for each trial: its outcome, or why it failed.

    Args:
        progress: called with the finished fraction of all trials, 0..1.

    Raises:
        KeyboardInterrupt: after Ctrl-C; finished trials stay on disk, and unfinished trials have checkpoints.
        RuntimeError: a job failed because of a bug; the message has its traceback.
    """
    call, jobs = f"{run_trial_job.__module__}:{run_trial_job.__name__}", []
    for number, trial in enumerate(trials):
        data = {"config": trial.config.to_dict(), "hold_out": trial.hold_out, "views": trial.views}
        jobs.append(LaunchJob(f"{number}-{trial.config.output_dir.name}", call, data))
    done = [0.0] * len(jobs)

    def add_progress(number: int, status: JobStatus) -> None:
        done[number] = 1.0 if status.state in ENDED else status.progress
        progress(sum(done) / len(done))

    launched = launch_jobs(jobs, settings, folder / LAUNCH_FOLDER, add_progress)
    results = [result for result in launched if result is not None and result.state != "interrupted"]
    for result in results:
        if result.trace:
            raise RuntimeError(f"in a worker of launcher={settings.name}:\n{result.trace}")
    if len(results) < len(jobs):
        raise KeyboardInterrupt
    return results


# ---------------------------------------------------------------- settings by dotted names


def get_trial_setting(config: RunConfig, key: str) -> Any:
    """Return the value of the setting ``key``, e.g. ``model.sh_degree``; None if the configuration lacks it."""
    node: Any = config.to_dict()
    for part in key.split("."):
        node = node.get(part) if isinstance(node, Mapping) else None
    return node
