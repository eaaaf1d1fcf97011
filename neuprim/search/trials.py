"""Short trainings that searches compare, in this process or as jobs of a launcher.

A trial's folder is a run directory without report and pictures. Its ``trial.json`` holds the request and, once known,
the outcome. A finished trial is read back, an interrupted one resumes from its checkpoint, and one that was made with
other settings is trained anew.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neuprim.config import RunConfig, find_run_plugins, made_now, task_of
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.data import Dataset
from neuprim.core.errors import DataError, NeuprimError
from neuprim.core.io.files import read_json, write_json
from neuprim.core.metrics import from_json, psnr, ssim, to_json
from neuprim.runs.curve import read_curve
from neuprim.runs.events import Events, Finishing, Note, Preparing, ignore_event
from neuprim.runs.fit import Fitted
from neuprim.runs.launch.jobs import ENDED, Job, JobStatus, Result
from neuprim.runs.launch.launcher import LAUNCH_FOLDER, OnStatus, launch
from neuprim.runs.measure import render_image
from neuprim.runs.open import load_dataset
from neuprim.runs.run_directory import lock_directory
from neuprim.runs.training import train_in_directory
from neuprim.search.eval_views import eval_views, fill_masked

__all__ = ["TRIAL_FILE", "Outcome", "Trial", "TrialFailed", "launch_jobs", "launch_trials", "read_outcome", "run_trial"]

TRIAL_FILE = "trial.json"

FORMAT = 1

_UNTRAINED = ("output_dir", "resume", "overrides", "non_default")
"""Parts of a configuration that do not change the training."""


@dataclass(frozen=True)
class Trial:
    """A training to make.

    Attributes:
        config: its ``output_dir`` is the trial's folder.
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
        parameters_per_primitive: numbers of a primitive.
        bytes: size of ``model.safetensors``.
        steps, seconds: of training.
        ms_per_frame: median over the evaluation views.
        curve: (used fraction of the budget, PSNR of a few views), a pair every ``train.eval_every``.
    """

    psnr: float
    ssim: float
    primitives: int
    parameters_per_primitive: int
    bytes: int
    steps: int
    seconds: float
    ms_per_frame: float
    curve: tuple[tuple[float, float], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-able values."""
        return {**asdict(self), **to_json("psnr", self.psnr), "curve": [list(point) for point in self.curve]}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Outcome:
        """Invert :meth:`to_dict`; raises KeyError, TypeError or ValueError for anything else."""
        quality = from_json(data, "psnr")
        if quality is None:
            raise ValueError("psnr is not a number")
        counts = {name: int(data[name]) for name in ("primitives", "parameters_per_primitive", "bytes", "steps")}
        numbers = {name: float(data[name]) for name in ("ssim", "seconds", "ms_per_frame")}
        curve = tuple((float(progress), float(value)) for progress, value in data["curve"])
        return cls(psnr=quality, curve=curve, **counts, **numbers)  # type: ignore[arg-type]


class TrialFailed(NeuprimError):
    """A launched trial failed; the text says why."""


# ---------------------------------------------------------------- one trial


def run_trial(trial: Trial, dataset: Dataset | None = None, events: Events = ignore_event) -> Outcome:
    """Train and evaluate, or read the outcome back.

    Ctrl-C finishes the step, writes a checkpoint and raises KeyboardInterrupt; the same call resumes.

    Args:
        dataset: the whole scene of the configuration, if it is loaded already.

    Raises:
        DataError: the folder holds another run, or a damaged ``trial.json``.
        NeuprimError: as :func:`neuprim.runs.run.run`.
    """
    folder = trial.config.output_dir
    with lock_directory(folder, "trial"):
        asked, before = _request(trial), _read_record(folder / TRIAL_FILE)
        if before is None and (folder / "config.yaml").exists():
            raise DataError(f"{folder}: holds a run and no {TRIAL_FILE}; expected a new folder, or that of a trial")
        same = before is not None and before["asked"] == asked
        if before is not None and not same:
            changed = ", ".join(sorted(_changed_keys(before["asked"], asked)))
            events(Note(f"{folder}: made with another {changed}; trained anew"))
            (folder / "checkpoint.safetensors").unlink(missing_ok=True)
        complete = all((folder / name).exists() for name in ("config.yaml", "model.safetensors"))
        if before is not None and same and complete and before["outcome"] and before["views"] == trial.views:
            return _parse_outcome(folder / TRIAL_FILE, before["outcome"])
        record = {"format": FORMAT, "asked": asked, "views": trial.views, "outcome": None}
        write_json(folder / TRIAL_FILE, record)
        plugins = find_run_plugins(trial.config)
        with plugins.attribute_errors():
            fitted, interrupted = train_in_directory(
                replace(trial.config, resume=same), events, dataset, trial.hold_out
            )
            if interrupted:
                raise KeyboardInterrupt
            events(Finishing("measuring evaluation views"))
            outcome = _evaluate(fitted, trial.views)
        write_json(folder / TRIAL_FILE, {**record, "outcome": outcome.to_dict()})
        return outcome


def read_outcome(folder: Path) -> Outcome | None:
    """Return the outcome of the trial in a folder; None where there is none yet.

    Raises:
        DataError: ``trial.json`` is damaged.
    """
    record = _read_record(folder / TRIAL_FILE)
    return (
        None if record is None or record["outcome"] is None else _parse_outcome(folder / TRIAL_FILE, record["outcome"])
    )


def _evaluate(fitted: Fitted, views: int) -> Outcome:
    fitted.unlock()
    model, dataset, config = fitted.model, fitted.dataset, fitted.config
    rows, seconds = [], []
    chosen = eval_views(dataset, views)
    render_image(model, chosen[0].view, config.renderer, dataset.background)  # the first frame loads and compiles
    for one in chosen:
        start = time.perf_counter()
        image = render_image(model, one.view, config.renderer, dataset.background)
        seconds.append(time.perf_counter() - start)
        image = fill_masked(image, one)
        rows.append((psnr(image, one.image, one.mask), ssim(image, one.image)))
    mean_psnr, mean_ssim = (float(np.mean(column)) for column in zip(*rows, strict=True))
    return Outcome(
        psnr=mean_psnr,
        ssim=mean_ssim,
        primitives=model.count,
        parameters_per_primitive=model.parameters_per_primitive,
        bytes=(config.output_dir / "model.safetensors").stat().st_size,
        steps=fitted.trainer.step,
        seconds=fitted.trainer.elapsed,
        ms_per_frame=1e3 * statistics.median(seconds),
        curve=read_curve(config.output_dir / "metrics.jsonl", config.train),
    )


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
    if data.get("format") != FORMAT:
        expected = f"this neuprim reads {FORMAT}; delete its folder to train anew"
        raise DataError(f"{file}: format {data.get('format')!r}; {expected}")
    return data


def _parse_outcome(file: Path, data: Any) -> Outcome:
    try:
        return Outcome.from_dict(data)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        what = f"{type(error).__name__}: {error}"
        raise DataError(f"{file}: not the record of a trial ({what}); delete its folder to train anew") from error


# ---------------------------------------------------------------- trials as jobs

_datasets: dict[str, Dataset] = {}
"""Scene of this worker's last trial; all trials of a search have one scene."""


def trial_job(name: str, trial: Trial, function: Callable[..., Any]) -> Job:
    """Return the job that calls a module-level ``function(data, attempt, events)`` with a trial as plain values."""
    data = {"config": trial.config.to_dict(), "hold_out": trial.hold_out, "views": trial.views}
    return Job(name, f"{function.__module__}:{function.__name__}", data)


def run_trial_job(data: Mapping[str, Any], attempt: int, events: Events) -> Outcome:
    """Run the trial of a job; ``trial.json`` decides whether it resumes."""
    config = RunConfig.from_dict(data["config"])
    key = json.dumps([config.task, config.scene_name, config.scene, config.seed], sort_keys=True)
    if key not in _datasets:
        _datasets.clear()
        _datasets[key] = load_dataset(config, task_of(config), lambda text, part: events(Preparing(text, part)))
    return run_trial(Trial(config, data["hold_out"], data["views"]), _datasets[key], events)


def launch_jobs(jobs: Sequence[Job], settings: LauncherSettings, folder: Path, hear: OnStatus) -> list[Result]:
    """Run jobs of a search in ``folder``; returns results in their order.

    Raises:
        KeyboardInterrupt: after Ctrl-C; finished work is kept.
        RuntimeError: a bug in a job, with its traceback.
    """
    results = [
        r for r in launch(jobs, settings, folder / LAUNCH_FOLDER, hear) if r is not None and r.state != "interrupted"
    ]
    for result in results:
        if result.trace:
            raise RuntimeError(f"in a worker of launcher={settings.name}:\n{result.trace}")
    if len(results) < len(jobs):
        raise KeyboardInterrupt
    return results


def launch_trials(
    groups: Sequence[Sequence[Trial]], settings: LauncherSettings, folder: Path, progress: Callable[[float], None]
) -> list[list[Outcome] | NeuprimError]:
    """Launch groups of trials together; returns the outcomes of each group, or why one of it failed.

    Args:
        folder: of the search.
        progress: called with the finished fraction.

    Raises:
        KeyboardInterrupt, RuntimeError: as :func:`launch_jobs`.
    """
    jobs = [
        trial_job(f"{group}-{number}", trial, run_trial_job)
        for group, trials in enumerate(groups)
        for number, trial in enumerate(trials)
    ]
    done = [0.0] * len(jobs)

    def hear(number: int, status: JobStatus) -> None:
        done[number] = 1.0 if status.state in ENDED else status.progress
        progress(sum(done) / len(done))

    results = iter(launch_jobs(jobs, settings, folder, hear))
    outcomes: list[list[Outcome] | NeuprimError] = []
    for trials in groups:
        own = [next(results) for _ in trials]
        failed = next((result for result in own if result.state == "failed"), None)
        outcomes.append([result.value for result in own] if failed is None else TrialFailed(failed.line))
    return outcomes
