"""Runs that are launched together, and the file that records what became of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from neuprim.config import RunConfig
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.errors import ConfigError
from neuprim.core.io.files import read_json_record, write_json
from neuprim.core.validation import validate_settings, validate_value
from neuprim.runs.ground_truth import render_ground_truth_of_runs
from neuprim.runs.launch.jobs import JobResult, JobStatus, LaunchJob
from neuprim.runs.launch.launcher import LAUNCH_FOLDER, OnStatus, check_launcher, launch_jobs
from neuprim.runs.open import model_file

_FORMAT = 1
RECORD_HINT = "another output_dir=DIR begins anew"

FIT_JOB = "neuprim.runs.run:fit_job"
"""What the worker of a run does."""


@dataclass(frozen=True)
class LaunchedRun:
    """One run.

    Attributes:
        name: of its folder.
        words: what was asked for, without those of its place.
        swept: key -> value, as typed, of those that differ between the runs.
        state: waiting, done, failed or interrupted.
        line: why it failed.
        seconds: from its start to its end, measuring included.
        attempts: how often it was started, as its worker died.
    """

    name: str
    words: tuple[str, ...]
    swept: Mapping[str, str] = field(default_factory=dict)
    state: str = "waiting"
    line: str = ""
    seconds: float = 0.0
    attempts: int = 0


@dataclass(frozen=True)
class LaunchRecord:
    """Runs that are launched together.

    Attributes:
        file: of the record; its folder is that of the launch.
        words: what was asked for, without those of its place.
        joined_steps: of a run in chunks: steps of the joined model's training, once they are known.
    """

    file: Path
    words: tuple[str, ...]
    runs: tuple[LaunchedRun, ...]
    joined_steps: int | None = None

    def write(self) -> None:
        """Raises OSError where it cannot be written; what was there is intact."""
        runs = [{**asdict(run), "words": list(run.words), "seconds": round(run.seconds, 3)} for run in self.runs]
        joined = {} if self.joined_steps is None else {"joined_steps": self.joined_steps}
        write_json(self.file, {"format": _FORMAT, "words": list(self.words), "runs": runs, **joined})

    def end_run(self, number: int, result: JobResult) -> LaunchRecord:
        """The record after a run has ended."""
        run = replace(
            self.runs[number], state=result.state, line=result.line, seconds=result.seconds, attempts=result.attempts
        )
        return replace(self, runs=(*self.runs[:number], run, *self.runs[number + 1 :]))

    def resume(self, before: LaunchRecord | None, more: bool) -> LaunchRecord:
        """Take the states of an earlier record, and append the runs that only that one has.

        Args:
            more: whether the two may have different runs.

        Raises:
            ConfigError: a run of the same name had other words, or there are other runs.
        """
        if before is None:
            return self
        old, names = {run.name: run for run in before.runs}, [run.name for run in self.runs]
        if not more and list(old) != names:
            raise ConfigError(
                f"{self.file}: begun with {', '.join(old)}; the words now ask for {', '.join(names)}; expected the "
                f"same words, or another output_dir"
            )
        for run in self.runs:
            if run.name in old and old[run.name].words != run.words:
                was = " ".join(old[run.name].words)
                raise ConfigError(
                    f"{self.file}: {run.name} was begun with {was}; expected the same words, or another output_dir"
                )
        own = tuple(old.get(run.name, run) for run in self.runs)
        others = tuple(run for run in before.runs if run.name not in names)
        return replace(self, runs=(*own, *others), joined_steps=before.joined_steps or self.joined_steps)


def read_launch_record(file: Path, what: str) -> LaunchRecord | None:
    """Read a record; None where there is none.

    Args:
        what: it is, for messages.

    Raises:
        DataError: the file is damaged, or of another version.
    """

    def parse(data: Mapping[str, Any]) -> LaunchRecord:
        words = validate_value(data["words"], tuple[str, ...], "words")
        runs = tuple(validate_settings(LaunchedRun, run, "runs") for run in data["runs"])
        for run in runs:
            if Path(run.name).name != run.name or run.name in ("", ".", ".."):
                raise ValueError(f"name {run.name!r} is no folder's")
        return LaunchRecord(file, words, runs, validate_value(data.get("joined_steps"), int | None, "joined_steps"))

    return read_json_record(file, what, RECORD_HINT, _FORMAT, parse)


def is_finished_run(run_dir: Path) -> bool:
    """Whether a directory has all that the end of a run writes."""
    return all(file.is_file() for file in (run_dir / "config.yaml", run_dir / "metrics.json", model_file(run_dir)))


def make_run_job(config: RunConfig) -> LaunchJob:
    """Make a run a job."""
    return LaunchJob(config.output_dir.name, FIT_JOB, config.to_dict())


def launch_missing_runs(
    record: LaunchRecord, configs: Sequence[RunConfig], settings: LauncherSettings, on_status: OnStatus
) -> tuple[LaunchRecord, list[JobResult | None]]:
    """Launch the runs of a record that are not done, each in its own directory, their ground truth first.

    The record is written at the first status, so that a launcher that is refused leaves nothing, and whenever a run
    ends.

    Args:
        configs: of the record's first runs.
        on_status: called with (place in ``configs``, status) whenever it is new; once for each run that is kept.

    Returns:
        the record, and a result for each configuration; None of those that Ctrl-C came before.

    Raises:
        NeuprimError: a launcher that cannot work here.
        OSError: the record cannot be written.
    """
    results: list[JobResult | None] = [
        JobResult("done", str(config.output_dir))
        if run.state == "done" and is_finished_run(config.output_dir)
        else None
        for run, config in zip(record.runs, configs, strict=False)
    ]
    todo = [number for number, result in enumerate(results) if result is None]
    check_launcher(settings, len(todo))
    for number, result in enumerate(results):
        if result is not None:
            on_status(number, JobStatus("done", "kept"))
    begun = False

    def hear(place: int, status: JobStatus) -> None:
        nonlocal begun
        if not begun:
            begun = True
            record.write()
        on_status(todo[place], status)

    def end(place: int, result: JobResult) -> None:
        nonlocal record
        results[todo[place]] = result
        record = record.end_run(todo[place], result)
        with suppress(OSError):  # a full disk must not end the other runs; the write at the end reports it
            record.write()

    chosen = [configs[number] for number in todo]
    render_ground_truth_of_runs(chosen, settings, hear)
    launch_jobs([make_run_job(config) for config in chosen], settings, record.file.parent / LAUNCH_FOLDER, hear, end)
    record.write()
    return record, results
