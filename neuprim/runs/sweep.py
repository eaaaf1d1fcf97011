"""A sweep: runs that differ in some settings, launched together and compared.

``sweep.json`` records what was asked for and what became of each run while they work; ``sweep.csv`` and ``sweep.html``
are written at the end.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from neuprim.config import RunConfig
from neuprim.config.command_settings import LauncherSettings
from neuprim.config.overrides import drop_output_overrides, parse_overrides, swept_override_keys
from neuprim.core.errors import ConfigError, DataError, cut_error_text
from neuprim.core.io.files import write_text
from neuprim.report.run_record import ReportedRun, read_reported_run
from neuprim.report.sweep_page import SweepPageRun, write_sweep_page
from neuprim.runs.launch.jobs import JobResult
from neuprim.runs.launch.launcher import OnStatus, ignore_status
from neuprim.runs.launch_record import LaunchedRun, LaunchRecord, launch_missing_runs, read_launch_record
from neuprim.runs.run_directory import lock_run_directory

SWEEP_FILE = "sweep.json"
"""In a sweep's directory."""


def read_sweep(folder: Path) -> LaunchRecord | None:
    """Read the record in a sweep's directory; None where there is none.

    Raises:
        DataError: the file is damaged, or of another version.
    """
    return read_launch_record(folder / SWEEP_FILE, "the record of a sweep")


def read_sweep_overrides(words: Sequence[str]) -> list[str]:
    """Return the overrides that a sweep was begun with, plus these, which name its directory and ``resume=true``.

    Raises:
        ConfigError: there is no sweep.
    """
    given = {a.key: a.value for a in parse_overrides(words)}
    folder = Path(str(given["output_dir"])).expanduser() if given.get("output_dir") is not None else None
    before = None if folder is None or given.get("resume") is not True else read_sweep(folder)
    if before is None:
        raise ConfigError(
            f"{' '.join(words) or 'nothing'}: no values to sweep; expected KEY=A,B,C, or output_dir=DIR resume=true of "
            f"a sweep ({SWEEP_FILE} in it)"
        )
    for word in before.words:
        if "${" in word:  # a file must not read the environment; see neuprim.config.compose
            raise ConfigError(
                f"{before.file}: {cut_error_text(word)} refers to something outside of the file; "
                f"type the sweep's words again, "
                f"with resume=true"
            )
    return [*before.words, *words]


def read_sweep_runs(record: LaunchRecord) -> list[SweepPageRun]:
    """Read the runs in a sweep's directory, in the record's order."""
    found = [_read_finished_run(record.file.parent / run.name) for run in record.runs]
    return [
        SweepPageRun(run.name, run.swept, run.state, run.line, run.seconds, run.attempts, one)
        for run, one in zip(record.runs, found, strict=True)
    ]


def _read_finished_run(directory: Path) -> ReportedRun | None:
    try:
        return read_reported_run(directory)
    except DataError:  # no run yet, or one that was damaged: its state says that it is not done
        return None


def write_sweep_csv(path: Path, runs: Sequence[SweepPageRun]) -> None:
    """Write a row for every run: its name, its swept settings, its state, every number of its ``metrics.json``, and
    its directory below the sweep's. Cells without a value are empty."""
    keys = list(dict.fromkeys(key for run in runs for key in run.swept))
    metrics = list(dict.fromkeys(name for run in runs for name in run.numbers if name not in keys))
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["run", *keys, "state", "error", "attempts", "seconds", *metrics, "path"])
    for run in runs:
        numbers = run.numbers
        swept, values = (
            (run.swept.get(key, "") for key in keys),
            (_sweep_csv_number(numbers.get(name)) for name in metrics),
        )
        writer.writerow([run.name, *swept, run.state, run.line, run.attempts, f"{run.seconds:.3f}", *values, run.name])
    write_text(path, buffer.getvalue())


def _sweep_csv_number(value: float | None) -> str:
    """With every digit, and whole numbers as such."""
    return "" if value is None else str(int(value)) if value.is_integer() else repr(value)


def run_sweep(
    configs: Sequence[RunConfig],
    words: Sequence[str],
    settings: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
    on_status: OnStatus = ignore_status,
) -> tuple[LaunchRecord, list[JobResult | None]]:
    """Fit all configurations of a sweep, each in its own directory, and compare them.

    Runs that are done already are kept, and with ``resume`` the others go on. One that fails does not stop the others.

    Args:
        configs: as :func:`~neuprim.config.compose_all` gives them, all in one directory.
        words: what the sweep was asked for.
        on_status: called with (place in ``configs``, status) whenever it is new; once for each run that is kept.

    Returns:
        the record, and a result for each configuration; None of those that Ctrl-C came before.

    Raises:
        NeuprimError: another process is at work in the sweep's directory, or a launcher cannot work here.
        OSError: the sweep's own files cannot be written.
    """
    folder, keys = configs[0].output_dir.parent, set(swept_override_keys(words))
    runs = []
    for config in configs:
        own = tuple(drop_output_overrides(config.overrides))
        swept = {a.key: a.text.partition("=")[2] for a in parse_overrides(own) if a.key in keys}
        runs.append(LaunchedRun(config.output_dir.name, own, swept))
    record = LaunchRecord(folder / SWEEP_FILE, tuple(drop_output_overrides(words)), tuple(runs))
    record = record.resume(read_sweep(folder) if configs[0].resume else None, more=True)
    with lock_run_directory(folder, "sweep"):
        record, results = launch_missing_runs(record, configs, settings, on_status)
        rows = read_sweep_runs(record)
        write_sweep_csv(folder / "sweep.csv", rows)
        write_sweep_page(folder, rows, record.words)
    return record, results
