"""Record and runner of a target search: ``target.json`` lists its trainings, so that the search can resume."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from neuprim.config import RunConfig, load_config_task
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.checkpoint import load_model_checkpoint, save_compressed
from neuprim.core.compression.quantizers import DEFAULT_LEVEL, bit_table
from neuprim.core.data import Dataset
from neuprim.core.io.files import read_json_record, write_json
from neuprim.core.task import TaskSpec
from neuprim.core.validation import validate_settings
from neuprim.runs.fit import Events, Note, Preparing
from neuprim.runs.launch.executors import count_parallel_jobs
from neuprim.search.trials import Outcome, Trial, TrialFailed, launch_trials, run_trial

TARGET_FILE, _FORMAT = "target.json", 1
TARGET_FOLDER = "target"  # folder of the trainings, in the run directory
VIEWS = 16  # held-out views to evaluate, at most
_PARALLEL = 2  # trainings that a search requests together: the two lengths of a size
_MIN_EVERY = 5  # least steps between two interventions into the population, which need statistics
_FIXED_SHARE = 0.5  # share of a time that does not depend on the number of primitives, where only one number was tried

Purpose = Literal["pace", "size", "knob", "full"]

SettingValue = int | float | str


@dataclass
class Attempt:
    """One training of a target search.

    Attributes:
        purpose: "pace" measures the time per step, "size" a number of primitives, "knob" a changed setting. "full" is a
            full run: a candidate for the result. Trainings with other purposes are trials.
        words: setting -> changed value, except the number of primitives, e.g. {"model.sh_degree": 1}.
        primitives, steps: requested numbers of primitives and training steps.
        max_seconds: time limit of a full run; None for trials.
        predicted: quality measure -> [predicted value, uncertainty in dB], for full runs.
        outcome: fields of :class:`neuprim.search.trials.Outcome`, on held-out training views; None until finished.
        packed: bytes of the model when compressed at the default level.
        seconds: time of training and evaluation together, by the search's clock.
    """

    purpose: Purpose
    words: dict[str, SettingValue]
    primitives: int
    steps: int
    max_seconds: float | None = None
    predicted: dict[str, list[float]] = field(default_factory=dict)
    outcome: dict[str, Any] | None = None
    packed: int = 0
    seconds: float = 0.0

    @property
    def folder(self) -> str:
        changes = [f"{key.rpartition('.')[2]}-{value}" for key, value in sorted(self.words.items())]
        limit = [] if self.max_seconds is None else [f"{self.max_seconds:g}s"]
        first = f"{'full-' if self.purpose == 'full' else ''}{self.primitives}"
        return "_".join([first, *changes, f"{self.steps}-steps", *limit])

    def measured(self, name: str) -> float:
        """Return the measurement ``name`` of the outcome."""
        assert self.outcome is not None
        return float(self.outcome[name])

    @property
    def count(self) -> int:
        """Number of primitives when the training ended."""
        return int(self.measured("primitives"))

    def repeats(self, other: Attempt) -> bool:
        """Return whether ``other`` is the same training: equal settings, sizes, steps and time limit."""
        mine, its = ((a.purpose == "full", a.words, a.primitives, a.steps, a.max_seconds) for a in (self, other))
        return mine == its


@dataclass
class SettingChange:
    """A change of one setting that a target search tried, to save bytes.

    Attributes:
        loss: quality measure -> loss in dB, at an equal number of primitives.
        size: bytes per primitive after the change, divided by bytes per primitive before.
        adopted: whether the search keeps the change, because it makes a model of equal quality smaller.
    """

    key: str
    before: SettingValue
    after: SettingValue
    loss: dict[str, float]
    size: float
    adopted: bool


@dataclass
class TargetRecord:
    """Content of ``target.json``.

    Attributes:
        asked: requested values of the target, and the "budget" in seconds.
        same: settings that must be equal to reuse the trainings.
        hold_out: n if every n-th training view is held out. The held-out views evaluate the trainings.
        stage: number of finished stages of the search.
        length: training steps of a trial; 0 until the time per step is known.
        spent: seconds of the budget used so far.
        before: number of full runs made for an earlier target.
        turns: changes of settings that were tried to save bytes.
        chosen: name of the folder of the full run that was chosen as the result.
        achieved: measurements of the result: quality of test and held-out views, bytes, frames per second.
        out_of_reach: message that the target cannot be reached; None unless trials show this.
        why: reasons why the search ended.
        warning: message that the target was missed.
    """

    asked: dict[str, float]
    same: dict[str, Any]
    hold_out: int = 0
    stage: int = 0
    length: int = 0
    spent: float = 0.0
    before: int = 0
    attempts: list[Attempt] = field(default_factory=list)
    turns: list[SettingChange] = field(default_factory=list)
    chosen: str | None = None
    achieved: dict[str, Any] = field(default_factory=dict)
    out_of_reach: str | None = None
    why: list[str] = field(default_factory=list)
    warning: str | None = None

    @property
    def words(self) -> dict[str, SettingValue]:
        """Dict of the changes of settings adopted so far: setting -> new value."""
        return {turn.key: turn.after for turn in self.turns if turn.adopted}

    def history(self, key: str) -> list[SettingValue]:
        """Return all values that a changed setting has had, the current one last; [] if it was never changed."""
        own = [turn for turn in self.turns if turn.adopted and turn.key == key]
        return [own[0].before, *(turn.after for turn in own)] if own else []

    def finished(self, *purposes: Purpose) -> list[Attempt]:
        """Return the finished trainings with one of these purposes, in the order of the record."""
        return [a for a in self.attempts if a.purpose in purposes and a.outcome is not None]

    def add_reason(self, text: str) -> None:
        if text not in self.why:
            self.why.append(text)

    def write(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        write_json(folder / TARGET_FILE, {"format": _FORMAT, **asdict(self)})


def read_target_record(folder: Path) -> TargetRecord | None:
    """Read ``target.json`` in a run directory; return None if there is no such file.

    Raises:
        DataError: the file is damaged.
    """
    what, instead = "the record of a target run", "delete it to search anew"
    return read_json_record(folder / TARGET_FILE, what, instead, _FORMAT, _parse_target_record)


def _parse_target_record(data: Mapping[str, Any]) -> TargetRecord:
    record = validate_settings(TargetRecord, {f.name: data[f.name] for f in fields(TargetRecord)})
    for attempt in record.attempts:
        if not (attempt.primitives > 0 and attempt.steps > 0 and Path(attempt.folder).name == attempt.folder):
            raise ValueError("attempts: expected positive primitives and steps, and settings that name a folder")
        if attempt.outcome is not None:
            [attempt.measured(name) for name in ("psnr", "ssim", "primitives", "bytes", "pace", "ms_per_frame")]
    return record


# ---------------------------------------------------------------- trainings


def forecast_time(known: Sequence[tuple[int, float]], primitives: float) -> float:
    """Predict a time for a number of primitives by a least-squares line through known (primitives, time) pairs.

    The line never decreases, and is not negative at 0 primitives.
    """
    counts, times = [float(n) for n, _ in known], [t for _, t in known]
    mean_n, mean_t = sum(counts) / len(counts), sum(times) / len(times)
    spread = sum((n - mean_n) ** 2 for n in counts)
    slope = (1 - _FIXED_SHARE) * mean_t / mean_n
    if spread > 0:
        slope = sum((n - mean_n) * (t - mean_t) for n, t in zip(counts, times, strict=True)) / spread
    slope = min(max(slope, 0.0), mean_t / mean_n)
    return mean_t + slope * (primitives - mean_n)


@dataclass
class TrialRunner:
    """Runner of the trainings of a target search. A training whose outcome is in the record is not repeated.

    Attributes:
        config: configuration from which the search starts.
        dataset: data of the whole scene.
        clock: function that returns monotonic seconds; ``begun`` is its value at the start of the budget.
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
        """Whether trainings that are requested together run at the same time."""
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
        """Return the configuration of a training, which writes to a folder of its own.

        Population control (which adds and moves primitives) runs about as many times as in a full run. If it ran less
        often, short trials would lose 0.5 dB.
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
        """Train the requested attempts that have no outcome in the record; return all requested attempts.

        A KeyboardInterrupt leaves an unfinished attempt in the record. The same call resumes this attempt from its
        checkpoint.
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
        """Return the expected seconds per training step with this number of primitives."""
        # The few steps of the first attempt are the poorest estimate.
        trained = self.record.finished("size", "full") or self.record.finished("pace")
        return forecast_time(list({a.count: a.measured("pace") for a in trained}.items()), primitives)

    def overhead(self) -> float:
        """Return the seconds that a trial needs in addition to its training steps, to initialize and evaluate."""
        finished = self.record.finished("size") or self.record.finished("pace")
        return max([0.0, *(a.seconds - a.measured("pace") * a.steps for a in finished[-3:])])

    def fits(self, primitives: int, steps: float, share: float) -> bool:
        """Return whether a trial of this size and length would end before ``share`` (0..1) of the budget is used."""
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
