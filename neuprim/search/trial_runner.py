"""Run the trainings of a target search: configuration, folder, record, and the time that they will take."""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from neuprim.config import RunConfig, task_of
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.checkpoint import load_model, save_compressed
from neuprim.core.compression import DEFAULT_LEVEL, bit_table
from neuprim.core.data import Dataset
from neuprim.core.task import TaskSpec
from neuprim.core.train.settings import PopulationSettings
from neuprim.runs.events import Event, Events, Note, Preparing, Step
from neuprim.runs.launch.executors import count_parallel_jobs
from neuprim.runs.launch.jobs import ENDED, JobStatus
from neuprim.runs.training import COMPILING
from neuprim.search.config_values import override_settings
from neuprim.search.size_curve import fit_line
from neuprim.search.target_record import Attempt, TargetRecord
from neuprim.search.trials import Outcome, Trial, TrialFailed, launch_jobs, run_trial, run_trial_job, trial_job

__all__ = ["TARGET_FOLDER", "VIEWS", "StepClock", "TrialRunner", "default_compressed_bytes"]

TARGET_FOLDER = "target"
"""Folder of the trainings, in the run directory."""

VIEWS = 16
"""Held-out views to evaluate, at most."""

_PARALLEL = 2
"""Trainings that a search requests together: the two lengths of a size."""

_MIN_EVERY = 5
"""Least steps between two interventions into the population, which need statistics."""

_MAX_PSNR = 200.0
"""dB that stand for equal images, as JSON has no infinity."""

_FEW_STEPS = 64
"""With fewer steps, a single slow one would spoil the mean."""


@dataclass
class StepClock:
    """Pass events on, and measure the time of a step and of compiling kernels."""

    clock: Callable[[], float]
    events: Events
    compiling: float = 0.0
    _steps: list[float] = field(default_factory=list)
    _last: float | None = None
    _compiling_since: float | None = None

    def __call__(self, event: Event) -> None:
        self.events(event)
        now = self.clock()
        if isinstance(event, Preparing) and event.text == COMPILING and self._compiling_since is None:
            self._compiling_since = now
        if isinstance(event, Step):
            if self._compiling_since is not None:
                self.compiling, self._compiling_since = self.compiling + now - self._compiling_since, None
            if self._last is not None:
                self._steps.append(now - self._last)
            self._last = now

    @property
    def pace(self) -> float | None:
        """Seconds of a step: the mean, or the median of few; None of fewer than two."""
        if not self._steps:
            return None
        return max((statistics.median if len(self._steps) < _FEW_STEPS else statistics.mean)(self._steps), 1e-9)


@dataclass
class TrialRunner:
    """Train what a search requests, unless its record has the outcome.

    Attributes:
        config: where the search starts.
        dataset: the whole scene.
        clock: seconds, monotonic.
        begun: clock at the start of the budget.
    """

    config: RunConfig
    dataset: Dataset
    record: TargetRecord
    events: Events
    clock: Callable[[], float] = time.monotonic
    launcher: LauncherSettings = LauncherSettings()  # noqa: RUF009 (frozen)
    begun: float = 0.0

    @property
    def parallel(self) -> bool:
        """Whether trainings requested together run together."""
        return self.launcher.name != "inline"

    @property
    def spent(self) -> float:
        return self.clock() - self.begun

    @property
    def left(self) -> float:
        return self.record.asked["budget"] - self.spent

    def write(self) -> None:
        self.record.spent = self.spent
        self.record.write(self.config.output_dir)

    def tell(self, text: str) -> None:
        self.events(Note(text))

    def configure(self, attempt: Attempt) -> RunConfig:
        """Return the configuration of a training, in its folder."""
        values = {
            **attempt.words,
            "model.primitives": attempt.primitives,
            "train.iterations": attempt.steps,
            "train.max_seconds": attempt.max_seconds,
            "train.population": self._population(attempt.steps),
        }
        folder = self.config.output_dir / TARGET_FOLDER / attempt.folder
        return replace(override_settings(self.config, values), output_dir=folder, resume=attempt.purpose == "full")

    def _population(self, steps: int) -> PopulationSettings:
        """Return as many interventions as in a full run; with fewer, short trials are half a decibel worse."""
        whole, settings = self.config.train.iterations, self.config.train.population
        if whole is None or steps >= whole:
            return settings
        return replace(settings, every=max(round(settings.every * steps / whole), min(_MIN_EVERY, settings.every)))

    def is_finished(self, attempt: Attempt) -> bool:
        return any(a.repeats(attempt) and a.outcome is not None for a in self.record.attempts)

    def run(self, *wanted: Attempt) -> list[Attempt]:
        """Return the attempts with outcomes; those of the record where it has equal ones.

        KeyboardInterrupt leaves an attempt unfinished in the record; it resumes from its checkpoint.
        """
        attempts = [next((a for a in self.record.attempts if a.repeats(one)), one) for one in wanted]
        todo = [attempt for attempt in attempts if attempt.outcome is None]
        self.record.attempts += [attempt for attempt in todo if attempt not in self.record.attempts]
        if todo:
            self.write()
        if self.parallel and todo:
            self._launch(todo)
        else:
            for attempt in todo:
                self._train(attempt)
        return attempts

    def _train(self, attempt: Attempt) -> None:
        watch, start = StepClock(self.clock, self.events), self.clock()
        try:
            outcome = run_trial(self._trial(attempt), self.dataset, watch)
        finally:
            self.begun += watch.compiling  # compiling happens once per installation
            attempt.seconds += self.clock() - start - watch.compiling
            attempt.pace = watch.pace or attempt.pace
            self.write()
        self._finish(attempt, outcome)

    def _launch(self, attempts: Sequence[Attempt]) -> None:
        jobs = [trial_job(attempt.folder, self._trial(attempt), run_attempt_job) for attempt in attempts]
        threads = count_parallel_jobs(self.launcher, _PARALLEL)[
            1
        ]  # the same for one or several, so that step times compare
        done = [0.0] * len(jobs)

        def hear(number: int, status: JobStatus) -> None:
            done[number] = 1.0 if status.state in ENDED else status.progress
            self.events(Preparing(f"{len(jobs)} trainings at work", sum(done) / len(done)))

        folder = self.config.output_dir / TARGET_FOLDER
        results = launch_jobs(jobs, replace(self.launcher, threads=threads), folder, hear)
        self.begun += max((result.value.compiling for result in results if result.value is not None), default=0.0)
        for attempt, result in zip(attempts, results, strict=True):
            if result.value is not None:
                attempt.seconds += result.value.seconds
                attempt.pace = result.value.pace or attempt.pace
                self._finish(attempt, result.value.outcome)
        for result in results:
            if result.state == "failed":
                raise TrialFailed(result.line)

    def _trial(self, attempt: Attempt) -> Trial:
        return Trial(self.configure(attempt), self.record.hold_out, VIEWS)

    def _finish(self, attempt: Attempt, outcome: Outcome) -> None:
        values = dataclasses.asdict(outcome)
        del values["curve"]
        attempt.outcome = {**values, "psnr": min(outcome.psnr, _MAX_PSNR)}
        attempt.pace = attempt.pace or outcome.seconds / max(outcome.steps, 1)
        if attempt.purpose != "pace":
            config = self.configure(attempt)
            attempt.packed = default_compressed_bytes(config.output_dir, task_of(config))
        self.write()

    # ------------------------------------------------------------ time

    def pace(self, primitives: float) -> float:
        """Return the expected seconds of a step."""
        trained = self.record.finished("size", "longer", "full")
        # The few steps of the first attempt are the poorest estimate.
        known = {a.count: a.pace for a in trained or self.record.finished("pace") if a.pace is not None}
        return fit_line(list(known.items()), primitives)

    def overhead(self) -> float:
        """Return the seconds of a trial beside its steps: initialization, evaluation."""
        finished = self.record.finished("size", "longer") or self.record.finished("pace")
        return max((a.seconds - (a.pace or 0.0) * a.steps for a in finished[-3:]), default=0.0)

    def fits(self, primitives: int, steps: float, share: float) -> bool:
        """Return whether a trial ends within a share of the budget."""
        seconds = self.pace(primitives) * steps + max(self.overhead(), 0.0)
        return self.spent + seconds <= share * self.record.asked["budget"]


class LaunchedOutcome(NamedTuple):
    """Result of a job: the outcome, seconds of a step, of compiling, and of everything else."""

    outcome: Outcome
    pace: float | None
    compiling: float
    seconds: float


def run_attempt_job(data: Mapping[str, Any], attempt: int, events: Events) -> LaunchedOutcome:
    """Run the training of a job, and time it."""
    start, watch = time.monotonic(), StepClock(time.monotonic, events)
    outcome = run_trial_job(data, attempt, watch)
    return LaunchedOutcome(outcome, watch.pace, watch.compiling, time.monotonic() - start - watch.compiling)


def default_compressed_bytes(folder: Path, task: TaskSpec) -> int:
    """Return the bytes of a run's model when compressed at the default level."""
    file, config = folder / "packed.neuprim", (folder / "config.yaml").read_text(encoding="utf-8")
    model, _ = load_model(folder / "model.safetensors", task)
    save_compressed(file, model, task.name, {}, bit_table(DEFAULT_LEVEL, (), model.specs), config)
    size = file.stat().st_size
    file.unlink()
    return size
