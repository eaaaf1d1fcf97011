"""Launch several runs together: the runs of a sweep, or the chunks of one run.

The file ``sweep.json`` or ``chunks.json`` records the requested settings and the state of each run, and is updated
during the work. At the end of a sweep, ``sweep.csv`` and ``sweep.html`` compare its runs.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from neuprim.config import RunConfig
from neuprim.config.command_settings import LauncherSettings
from neuprim.config.overrides import drop_output_overrides, parse_overrides, swept_override_keys
from neuprim.core.errors import ConfigError, DataError, cut_error_text
from neuprim.core.io.files import read_json_record, write_json, write_text
from neuprim.core.validation import validate_settings, validate_value
from neuprim.report.run_record import ReportedRun, read_reported_run
from neuprim.report.sweep_page import SweepPageRun, write_sweep_page
from neuprim.runs.ground_truth import render_ground_truth_of_runs
from neuprim.runs.launch.jobs import JobResult, JobStatus, LaunchJob
from neuprim.runs.launch.launcher import LAUNCH_FOLDER, OnStatus, check_launcher, ignore_status, launch_jobs
from neuprim.runs.open import lock_run_directory, model_file

__all__ = ["run_sweep"]

SWEEP_FILE = "sweep.json"
"""File name of the record in a sweep's directory."""

FIT_JOB = "neuprim.runs.run:fit_job"
"""Function that a worker calls to perform a run."""

_FORMAT = 1


# ---------------------------------------------------------------- record


@dataclass(frozen=True)
class LaunchedRun:
    """Record of one launched run.

    Attributes:
        name: name of the run's folder.
        words: the run's overrides, without ``output_dir`` and ``resume``.
        swept: key -> value, as typed, of the settings that differ between the runs.
        state: waiting, done, failed or interrupted.
        line: one line that says why the run failed.
        seconds: time of the whole run, including the measurements.
        attempts: number of starts. A run is started again if its worker dies.
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
    """Record of all runs that are launched together, stored as JSON.

    Attributes:
        file: the file that stores the record.
        words: the requested overrides, without ``output_dir`` and ``resume``.
        joined_steps: for a run in chunks: training steps of the joined model; None until they are known.
    """

    file: Path
    words: tuple[str, ...]
    runs: tuple[LaunchedRun, ...]
    joined_steps: int | None = None

    def write(self) -> None:
        """Write the record to its file. Raises OSError if that fails; the old file is then intact."""
        runs = [{**asdict(run), "words": list(run.words), "seconds": round(run.seconds, 3)} for run in self.runs]
        joined = {} if self.joined_steps is None else {"joined_steps": self.joined_steps}
        write_json(self.file, {"format": _FORMAT, "words": list(self.words), "runs": runs, **joined})

    def end_run(self, number: int, result: JobResult) -> LaunchRecord:
        """Return a copy of the record that includes the result of run ``number``."""
        runs, (state, line) = list(self.runs), (result.state, result.line)
        runs[number] = replace(runs[number], state=state, line=line, seconds=result.seconds, attempts=result.attempts)
        return replace(self, runs=tuple(runs))

    def resume(self, before: LaunchRecord | None, more: bool) -> LaunchRecord:
        """Return this record with the states that its runs have in the earlier record ``before``.

        Runs that only ``before`` contains are appended.

        Args:
            more: whether the two records may have different runs.

        Raises:
            ConfigError: a run of the same name had other overrides, or the runs differ although ``more`` is False.
        """
        if before is None:
            return self
        old, names = {run.name: run for run in before.runs}, [run.name for run in self.runs]
        if not more and list(old) != names:
            raise ConfigError(
                f"{self.file}: contains the runs {', '.join(old)}, but the settings now give {', '.join(names)}; "
                f"expected the same settings, or another --out DIR"
            )
        for run in self.runs:
            if run.name in old and old[run.name].words != run.words:
                was = " ".join(old[run.name].words)
                raise ConfigError(
                    f"{self.file}: {run.name} was started with {was}; expected the same settings, or another --out DIR"
                )
        own = tuple(old.get(run.name, run) for run in self.runs)
        others = tuple(run for run in before.runs if run.name not in names)
        return replace(self, runs=(*own, *others), joined_steps=before.joined_steps or self.joined_steps)


def read_launch_record(file: Path) -> LaunchRecord | None:
    """Read the record of launched runs from ``file``; None if the file does not exist.

    Raises:
        DataError: the file is damaged, or has another format version.
    """

    def parse(data: Mapping[str, Any]) -> LaunchRecord:
        words = validate_value(data["words"], tuple[str, ...], "words")
        runs = tuple(validate_settings(LaunchedRun, run, "runs") for run in data["runs"])
        for run in runs:
            if Path(run.name).name != run.name or run.name in ("", ".", ".."):
                raise ValueError(f"{run.name!r} is not allowed as a folder name")
        return LaunchRecord(file, words, runs, validate_value(data.get("joined_steps"), int | None, "joined_steps"))

    return read_json_record(file, "a record of launched runs", "another --out DIR begins anew", _FORMAT, parse)


# ---------------------------------------------------------------- launch


def make_run_job(config: RunConfig) -> LaunchJob:
    """Return a job that trains and measures the run of a configuration."""
    return LaunchJob(config.output_dir.name, FIT_JOB, config.to_dict())


def launch_missing_runs(
    record: LaunchRecord, configs: Sequence[RunConfig], settings: LauncherSettings, on_status: OnStatus
) -> tuple[LaunchRecord, list[JobResult | None]]:
    """Render the ground truth of a record's unfinished runs, then launch these runs, each in its own directory.

    The record is written at the first status and whenever a run ends. If the launcher fails to start, no file is left.

    Args:
        configs: configurations of the record's runs, in the same order; the record may have further runs.
        on_status: called with (index in ``configs``, status) at every change, and once for each run finished earlier.

    Returns:
        The updated record, and a result for each configuration; None for runs that did not start because of Ctrl-C.

    Raises:
        NeuprimError: the launcher cannot work here.
        OSError: the record cannot be written.
    """
    results = list[JobResult | None]([None] * len(configs))
    for number, (run, config) in enumerate(zip(record.runs, configs, strict=False)):
        if run.state == "done" and _is_finished_run(config.output_dir):
            results[number] = JobResult("done", str(config.output_dir))
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


def _is_finished_run(run_dir: Path) -> bool:
    """Return whether a directory has the configuration, metrics and model of a finished run."""
    return all(file.is_file() for file in (run_dir / "config.yaml", run_dir / "metrics.json", model_file(run_dir)))


# ---------------------------------------------------------------- sweep


def read_sweep_overrides(words: Sequence[str]) -> list[str]:
    """Return the ``key=value`` overrides of the sweep to resume, followed by ``words``, the overrides typed now.

    ``words`` contain the sweep's ``output_dir`` and ``resume=true``.

    Raises:
        ConfigError: the directory holds no sweep, or the sweep's overrides contain ``${``.
    """
    given = {a.key: a.value for a in parse_overrides(words)}
    before = None
    if given.get("output_dir") is not None and given.get("resume") is True:
        before = read_launch_record(Path(str(given["output_dir"])).expanduser() / SWEEP_FILE)
    if before is None:
        raise ConfigError(
            f"{' '.join(words) or '-m'}: no values to sweep; expected KEY=A,B,C, or resume=true with "
            f"--out DIR of a sweep (it contains {SWEEP_FILE})"
        )
    for word in before.words:
        if "${" in word:  # a file must not read the environment; see neuprim.config.compose
            raise ConfigError(
                f"{before.file}: {cut_error_text(word)} refers to a value outside of the file, which is refused; "
                f"type the settings of the sweep again, with resume=true"
            )
    return [*before.words, *words]


def read_sweep_runs(record: LaunchRecord) -> list[SweepPageRun]:
    """Read the results of all runs of a sweep from their directories, in the record's order."""
    rows = []
    for run in record.runs:
        directory = record.file.parent / run.name
        try:
            found = read_reported_run(directory)
        except DataError:  # it was damaged: its state says that it is not done
            found = ReportedRun(directory, {}, [], [], [])
        rows.append(SweepPageRun(run.name, run.swept, run.state, run.line, run.seconds, run.attempts, found))
    return rows


def write_sweep_csv(path: Path, runs: Sequence[SweepPageRun]) -> None:
    """Write one row per run: its name, swept settings, state, every number of its ``metrics.json``, and its directory
    relative to the sweep's. Cells without a value are empty."""
    keys = list(dict.fromkeys(key for run in runs for key in run.swept))
    metrics = list(dict.fromkeys(name for run in runs for name in run.numbers if name not in keys))
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["run", *keys, "state", "error", "attempts", "seconds", *metrics, "path"])
    for run in runs:
        swept = [run.swept.get(key, "") for key in keys]
        values = [_sweep_csv_number(run.numbers.get(name)) for name in metrics]
        writer.writerow([run.name, *swept, run.state, run.line, run.attempts, f"{run.seconds:.3f}", *values, run.name])
    write_text(path, buffer.getvalue())


def _sweep_csv_number(value: float | None) -> str:
    """Format a number with all its digits, a whole number as an integer; None as an empty cell."""
    return "" if value is None else str(int(value)) if value.is_integer() else repr(value)


def run_sweep(
    configs: Sequence[RunConfig],
    words: Sequence[str],
    settings: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
    on_status: OnStatus = ignore_status,
) -> tuple[LaunchRecord, list[JobResult | None]]:
    """Train all configurations of a sweep, each in its own directory, and write the page that compares them.

    With ``resume``, finished runs are not repeated, and unfinished runs continue. A failed run stops no other run.

    Args:
        configs: configurations of :func:`~neuprim.config.compose_all`, all in one directory.
        words: overrides of the sweep.
        settings: where to train, and how many runs at a time.
        on_status: function that is called with (index of the run, status).

    Returns:
        The record of the sweep, and a result for each configuration; None for runs that Ctrl-C kept from starting.

    Raises:
        NeuprimError: the launcher cannot work here, or another process uses the directory.
        OSError: the record cannot be written.
    """
    folder, keys = configs[0].output_dir.parent, set(swept_override_keys(words))
    runs = []
    for config in configs:
        own = tuple(drop_output_overrides(config.overrides))
        swept = {a.key: a.text.partition("=")[2] for a in parse_overrides(own) if a.key in keys}
        runs.append(LaunchedRun(config.output_dir.name, own, swept))
    record = LaunchRecord(folder / SWEEP_FILE, tuple(drop_output_overrides(words)), tuple(runs))
    record = record.resume(read_launch_record(record.file) if configs[0].resume else None, more=True)
    with lock_run_directory(folder, "sweep"):
        record, results = launch_missing_runs(record, configs, settings, on_status)
        rows = read_sweep_runs(record)
        write_sweep_csv(folder / "sweep.csv", rows)
        write_sweep_page(folder, rows, record.words)
    return record, results
