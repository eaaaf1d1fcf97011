"""Short trainings that searches compare, in this process or as jobs of a launcher.

A trial's folder is a run directory without report and pictures. Its ``trial.json`` holds the request and, once known,
the outcome. A finished trial is read back, an interrupted one resumes from its checkpoint, and one that was made with
other settings is trained anew.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from neuprim.config import Job, RunConfig, find_run_plugins, made_now, task_of
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError, DataError, NeuprimError
from neuprim.core.io.files import read_json, write_json
from neuprim.core.validation import validate
from neuprim.runs.fit import Event, Events, Finishing, Note, Preparing, Step, ignore_event
from neuprim.runs.launch.jobs import ENDED, JobResult, JobStatus, LaunchJob
from neuprim.runs.launch.launcher import LAUNCH_FOLDER, launch
from neuprim.runs.open import load_dataset
from neuprim.runs.run_directory import lock_directory
from neuprim.runs.training import train_in_directory
from neuprim.search.eval_views import eval_views, measure_eval_views

TRIAL_FILE = "trial.json"

_FORMAT = 1

_UNTRAINED = ("output_dir", "resume", "overrides", "non_default")
"""Parts of a configuration that do not change the training."""

_FEW_STEPS = 64
"""With fewer steps, a single slow one would spoil the mean of their times."""

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Trial:
    """A training to make, in the ``output_dir`` of its configuration.

    Attributes:
        hold_out: n > 1: evaluate on every n-th training view, which is not trained on; 0: on the test views.
        views: evaluate at most this many views, evenly spread.
    """

    config: RunConfig
    hold_out: int = 0
    views: int = 8


@dataclass(frozen=True)
class Outcome:
    """Result of a trial.

    Attributes:
        psnr, ssim: means over the evaluation views, in the data set's colour space.
        bytes: size of ``model.safetensors``.
        seconds: of training; pace: of a step.
        ms_per_frame: median over the evaluation views.
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


class TrialFailed(NeuprimError):
    """A launched trial failed; the text says why."""


class _StepTimes:
    """Pass events on, and collect the times of training steps."""

    def __init__(self, events: Events) -> None:
        self.events, self._ends = events, list[float]()

    def __call__(self, event: Event) -> None:
        self.events(event)
        if isinstance(event, Step):
            self._ends.append(event.report.seconds)

    def pace(self, usual: float) -> float:
        """Return the seconds of a step: the mean, or the median of few; ``usual`` where none was made."""
        steps = [b - a for a, b in zip(self._ends, self._ends[1:], strict=False)]
        if not steps:
            return usual
        return max((statistics.median if len(steps) < _FEW_STEPS else statistics.fmean)(steps), 1e-9)


def run_trial(trial: Trial, dataset: Dataset | None = None, events: Events = ignore_event) -> Outcome:
    """Train and evaluate, or read the outcome back.

    Ctrl-C finishes the step, writes a checkpoint and raises KeyboardInterrupt; the same call resumes.

    Args:
        dataset: the whole scene of the configuration, if it is loaded already.

    Raises:
        DataError: the folder holds another run, or a damaged ``trial.json``.
        NeuprimError: as :func:`neuprim.runs.run.run`.
    """
    config, folder = trial.config, trial.config.output_dir
    file = folder / TRIAL_FILE
    with lock_directory(folder, "trial"):
        asked, before = _request(trial), _read_record(file)
        if before is None and (folder / "config.yaml").exists():
            raise DataError(f"{folder}: holds a run and no {TRIAL_FILE}; expected a new folder, or that of a trial")
        changed = set() if before is None else _changed_keys(before["asked"], asked)
        if changed:
            events(Note(f"{folder}: made with another {', '.join(sorted(changed))}; trained anew"))
            (folder / "checkpoint.safetensors").unlink(missing_ok=True)
        same = before is not None and not changed
        complete = all((folder / name).exists() for name in ("config.yaml", "model.safetensors"))
        if before is not None and same and complete and before["outcome"] and before["views"] == trial.views:
            return _parse_outcome(file, before["outcome"])
        record = {"format": _FORMAT, "asked": asked, "views": trial.views, "outcome": None}
        write_json(file, record)
        plugins = find_run_plugins(config)
        with plugins.attribute_errors():
            times = _StepTimes(events)
            fitted, interrupted = train_in_directory(replace(config, resume=same), times, dataset, trial.hold_out)
            if interrupted:
                raise KeyboardInterrupt
            events(Finishing("measuring evaluation views"))
            fitted.unlock_bands()
            views = eval_views(fitted.dataset, trial.views)
            quality = measure_eval_views(fitted.model, views, config.renderer, fitted.dataset.background)
        steps, seconds = fitted.trainer.step, fitted.trainer.elapsed
        outcome = Outcome(
            psnr=quality.psnr,
            ssim=quality.ssim,
            primitives=fitted.model.count,
            parameters_per_primitive=fitted.model.parameters_per_primitive,
            bytes=(folder / "model.safetensors").stat().st_size,
            steps=steps,
            seconds=seconds,
            pace=times.pace(seconds / max(steps, 1)),
            ms_per_frame=quality.ms_per_frame,
        )
        write_json(file, {**record, "outcome": asdict(outcome)})
        return outcome


def read_outcome(folder: Path) -> Outcome | None:
    """Return the outcome of the trial in a folder; None where there is none yet.

    Raises:
        DataError: ``trial.json`` is damaged.
    """
    record = _read_record(folder / TRIAL_FILE)
    return None if record is None or not record["outcome"] else _parse_outcome(folder / TRIAL_FILE, record["outcome"])


def _request(trial: Trial) -> dict[str, Any]:
    """Return the settings that must be equal to reuse a folder, as JSON reads them back."""
    config = replace(trial.config, made_by=made_now(trial.config, task_of(trial.config)))
    settings = {name: value for name, value in config.to_dict().items() if name not in _UNTRAINED}
    request: dict[str, Any] = json.loads(json.dumps({**settings, "hold_out": trial.hold_out}))
    return request


def _changed_keys(a: Mapping[str, Any], b: Mapping[str, Any], prefix: str = "") -> set[str]:
    changed = set()
    for key in a.keys() | b.keys():
        before, after, name = a.get(key), b.get(key), f"{prefix}{key}"
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            changed |= _changed_keys(before, after, f"{name}.")
        elif before != after:
            changed.add(name)
    return changed


def _read_record(file: Path) -> dict[str, Any] | None:
    data = read_json(file, "the record of a trial", "delete its folder to train anew")
    if data is None:
        return None
    if not isinstance(data, dict) or not isinstance(data.get("asked"), dict) or not {"outcome", "views"} <= data.keys():
        raise DataError(f"{file}: not the record of a trial; delete its folder to train anew")
    if data.get("format") != _FORMAT:
        expected = f"this neuprim reads {_FORMAT}; delete its folder to train anew"
        raise DataError(f"{file}: format {data.get('format')!r}; {expected}")
    return data


def _parse_outcome(file: Path, data: object) -> Outcome:
    try:
        return validate(Outcome, data, "outcome")
    except ConfigError as error:
        raise DataError(f"{file}: not the record of a trial ({error}); delete its folder to train anew") from error


# ---------------------------------------------------------------- trials as jobs

_datasets: dict[str, Dataset] = {}
"""Scene of this worker's last trial; all trials of a search have one scene."""


def run_trial_job(data: Mapping[str, Any], attempt: int, events: Events) -> Outcome:
    """Run the trial of a job; ``trial.json`` decides whether it resumes."""
    config = RunConfig.from_dict(data["config"])
    key = json.dumps([config.task, config.scene_name, config.scene, config.seed], sort_keys=True)
    if key not in _datasets:
        _datasets.clear()
        _datasets[key] = load_dataset(Job.of(config), lambda text, part: events(Preparing(text, part)))
    return run_trial(Trial(config, data["hold_out"], data["views"]), _datasets[key], events)


def launch_trials(
    trials: Sequence[Trial], settings: LauncherSettings, folder: Path, progress: Progress
) -> list[JobResult]:
    """Run trials as jobs in the folder of a search; returns results with outcomes, or why one failed, in their order.

    Args:
        progress: called with the finished fraction.

    Raises:
        KeyboardInterrupt: after Ctrl-C; finished work is kept.
        RuntimeError: a bug in a job, with its traceback.
    """
    call = f"{run_trial_job.__module__}:{run_trial_job.__name__}"
    jobs = []
    for number, one in enumerate(trials):
        data = {"config": one.config.to_dict(), "hold_out": one.hold_out, "views": one.views}
        jobs.append(LaunchJob(f"{number}-{one.config.output_dir.name}", call, data))
    done = [0.0] * len(jobs)

    def hear(number: int, status: JobStatus) -> None:
        done[number] = 1.0 if status.state in ENDED else status.progress
        progress(sum(done) / len(done))

    results = [result for result in launch(jobs, settings, folder / LAUNCH_FOLDER, hear) if result is not None]
    results = [result for result in results if result.state != "interrupted"]
    for result in results:
        if result.trace:
            raise RuntimeError(f"in a worker of launcher={settings.name}:\n{result.trace}")
    if len(results) < len(jobs):
        raise KeyboardInterrupt
    return results
