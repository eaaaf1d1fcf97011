"""One training of the search: its configuration, its folder, its outcome in the record, and its line for the user."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from neuprim.config import RunConfig, task_of
from neuprim.config.launcher import LauncherSettings
from neuprim.core.checkpoint import load_model, save_compressed
from neuprim.core.compression import DEFAULT_LEVEL, bit_table
from neuprim.core.data import Dataset
from neuprim.core.task import TaskSpec
from neuprim.core.train.settings import PopulationSettings
from neuprim.runs.events import Events, Note, Preparing
from neuprim.runs.launch.executors import count_parallel_jobs
from neuprim.runs.launch.jobs import ENDED, Job, JobStatus
from neuprim.search.changed import changed
from neuprim.search.target.pace import Stopwatch, linear
from neuprim.search.target.record import Attempt, Record
from neuprim.search.trial_jobs import TrialFailed, do_trial, launch_jobs, words_of
from neuprim.search.trials import Outcome, Trial, run_trial

__all__ = ["FOLDER", "VIEWS", "Trying", "packed_bytes"]

FOLDER = "target"
"""Of the run's directory, for the trainings of the search."""

VIEWS = 16
"""Views held out that are measured, at most."""

TOGETHER = 2
"""Trainings that a search asks for at once: the two lengths of a size."""

_EVERY = 5
"""Steps between two interventions, at least: fewer tell nothing about who is used."""

_PSNR_MAX = 200.0  # dB; equal images have an infinite one, which JSON does not


@dataclass
class Trying:
    """Trains what is asked for, unless the record has it.

    Attributes:
        config: what the search starts from.
        dataset: its scene, whole.
        clock: seconds, monotonic.
        launcher: where trainings work.
    """

    config: RunConfig
    dataset: Dataset
    record: Record
    events: Events
    clock: Callable[[], float] = time.monotonic
    launcher: LauncherSettings = LauncherSettings()  # noqa: RUF009 (frozen)
    begun: float = field(init=False)

    def __post_init__(self) -> None:
        self.begun = self.clock() - self.record.spent

    @property
    def folder(self) -> Path:
        return self.config.output_dir

    @property
    def together(self) -> bool:
        """Whether several trainings asked for at once are made so."""
        return self.launcher.name != "inline"

    @property
    def spent(self) -> float:
        """Seconds of the budget that are used."""
        return self.clock() - self.begun

    @property
    def left(self) -> float:
        return self.record.asked["budget"] - self.spent

    def write(self) -> None:
        self.record.spent = self.spent
        self.record.write(self.folder)

    def tell(self, text: str) -> None:
        self.events(Note(text))

    def config_of(self, attempt: Attempt) -> RunConfig:
        """The configuration of a training, in its folder."""
        values = {
            **attempt.words,
            "model.primitives": attempt.primitives,
            "train.iterations": attempt.steps,
            "train.max_seconds": attempt.max_seconds,
            "train.population": self._population(attempt.steps),
        }
        made = changed(self.config, values)
        return replace(made, output_dir=self.folder / FOLDER / attempt.folder, resume=attempt.purpose == "full")

    def _population(self, steps: int) -> PopulationSettings:
        """With as many interventions as in a run of whole length: with fewer, short runs are half a decibel worse than
        they need be."""
        whole, settings = self.config.train.iterations, self.config.train.population
        if whole is None or steps >= whole:
            return settings
        return replace(settings, every=max(round(settings.every * steps / whole), min(_EVERY, settings.every)))

    def run(self, attempt: Attempt) -> Attempt:
        """The attempt, done; the one of the record where it has an equal one.

        KeyboardInterrupt leaves it unfinished in the record; it goes on from its checkpoint.
        """
        return self.run_all([attempt])[0]

    def run_all(self, wanted: Sequence[Attempt]) -> list[Attempt]:
        """Several attempts as :meth:`run` has one: one after the other in this process, together where the launcher has
        them elsewhere."""
        attempts = [self._find(attempt) or attempt for attempt in wanted]
        todo = [attempt for attempt in attempts if attempt.outcome is None]
        for attempt in todo:
            if self._find(attempt) is None:
                self.record.attempts.append(attempt)
        if todo:
            self.write()
        if self.together and todo:
            self._elsewhere(todo)
        else:
            for attempt in todo:
                self._here(attempt)
        return attempts

    def _here(self, attempt: Attempt) -> None:
        watch, start = Stopwatch(self.clock, self.events), self.clock()
        try:
            outcome = run_trial(self._trial(attempt), self.dataset, watch)
        finally:
            self.begun += watch.compiling
            attempt.seconds += self.clock() - start - watch.compiling
            attempt.pace = watch.pace or attempt.pace
            self.write()
        self._keep(attempt, outcome)

    def _elsewhere(self, attempts: Sequence[Attempt]) -> None:
        jobs = [
            Job(attempt.folder, f"{__name__}:{do_attempt.__name__}", words_of(self._trial(attempt)))
            for attempt in attempts
        ]
        threads = count_parallel_jobs(self.launcher, TOGETHER)[
            1
        ]  # the same whether one works or several: paces must compare
        done = [0.0] * len(jobs)

        def hear(number: int, status: JobStatus) -> None:
            done[number] = 1.0 if status.state in ENDED else status.progress
            self.events(Preparing(f"{len(jobs)} training{'s' * (len(jobs) > 1)} at work", sum(done) / len(done)))

        results = launch_jobs(jobs, replace(self.launcher, threads=threads), self.folder / FOLDER, hear)
        self.begun += max((result.value.compiling for result in results if result.value is not None), default=0.0)
        for attempt, result in zip(attempts, results, strict=True):
            if result.value is not None:
                attempt.seconds += result.value.seconds
                attempt.pace = result.value.pace or attempt.pace
                self._keep(attempt, result.value.outcome)
        for result in results:
            if result.state == "failed":
                raise TrialFailed(result.line)

    def _trial(self, attempt: Attempt) -> Trial:
        return Trial(self.config_of(attempt), self.record.hold_out, VIEWS)

    def _keep(self, attempt: Attempt, outcome: Outcome) -> None:
        found = {k: v for k, v in dataclasses.asdict(outcome).items() if k != "curve"}
        attempt.outcome = {**found, "psnr": min(outcome.psnr, _PSNR_MAX)}
        if attempt.pace is None:  # read back, or two steps at most
            attempt.pace = outcome.seconds / max(outcome.steps, 1)
        if attempt.purpose != "pace":
            config = self.config_of(attempt)
            attempt.packed = packed_bytes(config.output_dir, task_of(config))
        self.write()

    def known(self, attempt: Attempt) -> bool:
        """Whether an equal attempt is done already."""
        found = self._find(attempt)
        return found is not None and found.outcome is not None

    def _find(self, attempt: Attempt) -> Attempt | None:
        return next((a for a in self.record.attempts if _same(a, attempt)), None)

    # ------------------------------------------------------------ time

    def pace(self, primitives: float) -> float:
        """Seconds of a step with so many primitives. The pace of trials counts by the primitives they had, the last of
        equal ones alone."""
        known = {a.count: a.pace for a in self.record.done("pace", "size", "longer", "full") if a.pace is not None}
        if len(known) > 1:  # a few steps of a young model are the poorest guess
            known = {a.count: a.pace for a in self.record.done("size", "longer", "full") if a.pace is not None} or known
        return linear(list(known.items()), primitives)

    def overhead(self) -> float:
        """Seconds of a trial beside its steps: starting points, measuring."""
        done = self.record.done("size", "longer") or self.record.done("pace")
        return max((a.seconds - (a.pace or 0.0) * a.steps for a in done[-3:]), default=0.0)

    def cost(self, primitives: int, steps: float) -> float:
        """Seconds that a trial will take."""
        return self.pace(primitives) * steps + max(self.overhead(), 0.0)


@dataclass(frozen=True)
class Attempted:
    """What comes back from where an attempt was made.

    Attributes:
        pace: seconds of a step. compiling: seconds of compiling kernels. seconds: of all but that.
    """

    outcome: Outcome
    pace: float | None
    compiling: float
    seconds: float


def do_attempt(data: Mapping[str, Any], attempt: int, events: Events) -> Attempted:
    """The function of a job."""
    start = time.monotonic()
    watch = Stopwatch(time.monotonic, events)
    outcome = do_trial(data, attempt, watch)
    return Attempted(outcome, watch.pace, watch.compiling, time.monotonic() - start - watch.compiling)


def packed_bytes(folder: Path, task: TaskSpec) -> int:
    """Bytes of a training's model when compressed at the usual level."""
    file, words = folder / "packed.neuprim", (folder / "config.yaml").read_text(encoding="utf-8")
    model, _ = load_model(folder / "model.safetensors", task)
    save_compressed(file, model, task.name, {}, bit_table(DEFAULT_LEVEL, (), model.specs), words)
    size = file.stat().st_size
    file.unlink()
    return size


def _same(a: Attempt, b: Attempt) -> bool:
    def alike(x: Attempt) -> tuple[Any, ...]:
        return x.words, x.primitives, x.steps, x.purpose == "full", x.max_seconds

    return alike(a) == alike(b)
