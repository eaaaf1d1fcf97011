"""Run the trainings of a target search: configuration, folder, record, and the time that they will take."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from neuprim.config import RunConfig, load_config_task
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.checkpoint import load_model_checkpoint, save_compressed
from neuprim.core.compression import DEFAULT_LEVEL, bit_table
from neuprim.core.data import Dataset
from neuprim.core.task import TaskSpec
from neuprim.runs.fit import Events, Note, Preparing
from neuprim.runs.launch.executors import count_parallel_jobs
from neuprim.search.size_forecast import forecast_time
from neuprim.search.target_record import Attempt, TargetRecord
from neuprim.search.trials import Outcome, Trial, TrialFailed, launch_trials, run_trial

TARGET_FOLDER = "target"  # folder of the trainings, in the run directory
VIEWS = 16  # held-out views to evaluate, at most
_PARALLEL = 2  # trainings that a search requests together: the two lengths of a size
_MIN_EVERY = 5  # least steps between two interventions into the population, which need statistics


@dataclass
class TrialRunner:
    """Train what a search requests, unless its record has the outcome.

    Attributes:
        config: where the search starts; dataset: the whole scene.
        clock: seconds, monotonic; begun: its value at the start of the budget.
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
    def seconds_spent(self) -> float:
        return self.clock() - self.begun

    @property
    def seconds_left(self) -> float:
        return self.record.asked["budget"] - self.seconds_spent

    def write_record(self) -> None:
        self.record.spent = self.seconds_spent
        self.record.write(self.config.output_dir)

    def notify(self, text: str) -> None:
        self.events(Note(text))

    def configure(self, attempt: Attempt) -> RunConfig:
        """Return the configuration of a training, in its folder.

        It has as many interventions into the population as a full run: with fewer, short trials are half a dB worse.
        """
        whole, every = self.config.train.iterations, self.config.train.population.every
        if whole is not None and attempt.steps < whole:
            every = max(round(every * attempt.steps / whole), min(_MIN_EVERY, every))
        values = {
            **attempt.words,
            "model.primitives": attempt.primitives,
            "train.iterations": attempt.steps,
            "train.max_seconds": attempt.max_seconds,
            "train.population.every": every,
        }
        folder = self.config.output_dir / TARGET_FOLDER / attempt.folder
        return replace(self.config.override(values), output_dir=folder, resume=attempt.purpose == "full")

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
            self.write_record()
        if self.parallel and todo:
            self._launch(todo)
        else:
            for attempt in todo:
                self._train(attempt)
        return attempts

    def _trial(self, attempt: Attempt) -> Trial:
        return Trial(self.configure(attempt), self.record.hold_out, VIEWS)

    def _train(self, attempt: Attempt) -> None:
        start = self.clock()
        try:
            outcome = run_trial(self._trial(attempt), self.dataset, self.events)
        finally:
            attempt.seconds += self.clock() - start
            self.write_record()
        self._finish(attempt, outcome)

    def _launch(self, attempts: list[Attempt]) -> None:
        # The same number of threads for one or several, so that step times compare.
        settings = replace(self.launcher, threads=count_parallel_jobs(self.launcher, _PARALLEL)[1])
        text, folder = f"{len(attempts)} trainings at work", self.config.output_dir / TARGET_FOLDER
        trials = [self._trial(attempt) for attempt in attempts]
        results = launch_trials(trials, settings, folder, lambda part: self.events(Preparing(text, part)))
        for attempt, result in zip(attempts, results, strict=True):
            if result.state != "failed":
                attempt.seconds += result.seconds
                self._finish(attempt, result.value)
        for result in results:
            if result.state == "failed":
                raise TrialFailed(result.line)

    def _finish(self, attempt: Attempt, outcome: Outcome) -> None:
        attempt.outcome = asdict(outcome)
        if attempt.purpose != "pace":
            config = self.configure(attempt)
            attempt.packed = count_compressed_trial_bytes(config.output_dir, load_config_task(config))
        self.write_record()

    def pace(self, primitives: float) -> float:
        """Return the expected seconds of a step."""
        # The few steps of the first attempt are the poorest estimate.
        trained = self.record.finished("size", "full") or self.record.finished("pace")
        return forecast_time(list({a.count: a.measured("pace") for a in trained}.items()), primitives)

    def overhead(self) -> float:
        """Return the seconds of a trial beside its steps: initialization, evaluation."""
        finished = self.record.finished("size") or self.record.finished("pace")
        return max([0.0, *(a.seconds - a.measured("pace") * a.steps for a in finished[-3:])])

    def fits(self, primitives: int, steps: float, share: float) -> bool:
        """Return whether a trial ends within a share of the budget."""
        seconds = self.pace(primitives) * steps + self.overhead()
        return self.seconds_spent + seconds <= share * self.record.asked["budget"]


def count_compressed_trial_bytes(folder: Path, task: TaskSpec) -> int:
    """Return the bytes of a run's model when compressed at the default level."""
    file, config = folder / "packed.neuprim", (folder / "config.yaml").read_text(encoding="utf-8")
    model, _ = load_model_checkpoint(folder / "model.safetensors", task)
    save_compressed(file, model, task.name, {}, bit_table(DEFAULT_LEVEL, (), model.specs), config)
    size = file.stat().st_size
    file.unlink()
    return size
