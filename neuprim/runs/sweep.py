"""A sweep: runs that differ in some settings, launched together and compared.

``sweep.json`` records what was asked for and what became of each run while they work; ``sweep.csv`` and ``sweep.html``
are written at the end.
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
from neuprim.config.overrides import drop_place, parse, swept_keys
from neuprim.core.errors import ConfigError, DataError, cut
from neuprim.core.io.files import read_json, write_json, write_text
from neuprim.core.validation import coerce, validate
from neuprim.report.run_record import RunRecord, read_run
from neuprim.report.sweep import SweepRun, write_sweep_page
from neuprim.runs.events import Events
from neuprim.runs.ground_truth import render_ground_truth_of_runs
from neuprim.runs.launch.jobs import Job, JobStatus, Result
from neuprim.runs.launch.launcher import LAUNCH_FOLDER, OnStatus, check_launcher, ignore_status, launch
from neuprim.runs.open import model_file
from neuprim.runs.run_directory import lock_directory

SWEEP_FILE = "sweep.json"
"""Of a sweep's directory."""

_FORMAT = 1
_WHAT, _INSTEAD = "the record of a sweep", "another output_dir=DIR begins anew"


# ------------------------------------------------------------ jobs


def run_job(config: RunConfig) -> Job:
    """Make a run a job."""
    return Job(config.output_dir.name, f"{__name__}:{fit_job.__name__}", config.to_dict())


def fit_job(data: Mapping[str, Any], attempt: int, events: Events) -> str:
    """Fit, measure and report; returns the run's directory. After its worker died it resumes from its checkpoint, if
    there is one."""
    from neuprim.runs.run import run

    config = RunConfig.from_dict(data)
    directory: Path = run(replace(config, resume=config.resume or attempt > 0), events)
    return str(directory)


# ------------------------------------------------------------ the record


@dataclass(frozen=True)
class SweepRow:
    """One run.

    Attributes:
        name: of its folder in the sweep's.
        words: after ``neuprim run``, without those of its place.
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
class SweepRecord:
    """A sweep.

    Attributes:
        words: after ``neuprim run -m``, without those of its place.
    """

    words: tuple[str, ...]
    rows: tuple[SweepRow, ...]

    def write(self, folder: Path) -> None:
        """Raises OSError where it cannot be written; what was there is intact."""
        rows = [{**asdict(row), "words": list(row.words), "seconds": round(row.seconds, 3)} for row in self.rows]
        write_json(folder / SWEEP_FILE, {"format": _FORMAT, "words": list(self.words), "runs": rows})

    def put(self, row: SweepRow) -> SweepRecord:
        """Replace the row of the same name."""
        return replace(self, rows=tuple(row if old.name == row.name else old for old in self.rows))

    def merge(self, before: SweepRecord | None, file: Path) -> SweepRecord:
        """Take the states of an earlier record, and append the runs that only that one has.

        Raises:
            ConfigError: a run of the same name had other words.
        """
        if before is None:
            return self
        old = {row.name: row for row in before.rows}
        for row in self.rows:
            if row.name in old and old[row.name].words != row.words:
                was = " ".join(old[row.name].words)
                raise ConfigError(
                    f"{file}: {row.name} was begun with {was}; expected the same words, or another output_dir"
                )
        own = tuple(old.get(row.name, row) for row in self.rows)
        names = {row.name for row in own}
        return replace(self, rows=(*own, *(row for row in before.rows if row.name not in names)))


def read_sweep(folder: Path) -> SweepRecord | None:
    """Read the record in a sweep's directory; None where there is none.

    Raises:
        DataError: the file is damaged, or of another version.
    """
    file = folder / SWEEP_FILE
    data: Any = read_json(file, _WHAT, _INSTEAD)
    if data is None:
        return None
    try:
        if data["format"] != _FORMAT:
            raise DataError(f"{file}: format {data['format']!r}; this neuprim reads {_FORMAT}; {_INSTEAD}")
        return SweepRecord(
            coerce(data["words"], tuple[str, ...], "words"), tuple(_parse_row(run) for run in data["runs"])
        )
    except (KeyError, TypeError, ValueError, AttributeError, ConfigError) as error:
        raise DataError(f"{file}: not {_WHAT} ({type(error).__name__}: {error}); {_INSTEAD}") from error


def read_sweep_overrides(words: Sequence[str]) -> list[str]:
    """Return the overrides that a sweep was begun with, plus these, which name its directory and ``resume=true``.

    Raises:
        ConfigError: there is no sweep.
    """
    given = {a.key: a.value for a in parse(words)}
    where = given.get("output_dir")
    before = None if where is None or given.get("resume") is not True else read_sweep(Path(str(where)).expanduser())
    if before is None:
        said = " ".join(words) or "nothing"
        raise ConfigError(
            f"{said}: no values to sweep; expected KEY=A,B,C, or output_dir=DIR resume=true of a sweep ({SWEEP_FILE} "
            f"in it)"
        )
    for word in before.words:
        if "${" in word:  # a file must not read the environment; see neuprim.config.compose
            raise ConfigError(
                f"{Path(str(where)) / SWEEP_FILE}: {cut(word)} refers to something outside of the file; type the "
                f"sweep's words again, with resume=true"
            )
    return [*before.words, *words]


def _parse_row(run: Mapping[str, Any]) -> SweepRow:
    row = validate(SweepRow, run, "runs")
    if Path(row.name).name != row.name or row.name in ("", ".", ".."):
        raise ValueError(f"name {row.name!r} is no folder's")
    return row


# ------------------------------------------------------------ the table


def read_sweep_runs(folder: Path, record: SweepRecord) -> list[SweepRun]:
    """Read the runs in a sweep's directory, in the record's order."""
    return [
        SweepRun(row.name, row.swept, row.state, row.line, row.seconds, row.attempts, _read_run(folder / row.name))
        for row in record.rows
    ]


def _read_run(directory: Path) -> RunRecord | None:
    try:
        return read_run(directory)
    except DataError:  # no run yet, or one that was damaged: its state says that it is not done
        return None


def write_csv(path: Path, rows: Sequence[SweepRun]) -> None:
    """Write a row for every run: its name, its swept settings, its state, every number of its ``metrics.json``, and
    its directory below the sweep's. Cells without a value are empty."""
    keys = list(dict.fromkeys(key for row in rows for key in row.swept))
    numbers = [row.numbers for row in rows]
    metrics = list(dict.fromkeys(name for found in numbers for name in found if name not in keys))
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(["run", *keys, "state", "error", "attempts", "seconds", *metrics, "path"])
    for row, found in zip(rows, numbers, strict=True):
        swept, values = (row.swept.get(key, "") for key in keys), (_cell(found.get(name)) for name in metrics)
        writer.writerow([row.name, *swept, row.state, row.line, row.attempts, f"{row.seconds:.3f}", *values, row.name])
    write_text(path, buffer.getvalue())


def _cell(value: float | None) -> str:
    """With every digit, and whole numbers as such."""
    if value is None:
        return ""
    return str(int(value)) if value.is_integer() else repr(value)


# ------------------------------------------------------------ the sweep


def run_sweep(
    configs: Sequence[RunConfig],
    words: Sequence[str],
    settings: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
    on_status: OnStatus = ignore_status,
) -> tuple[SweepRecord, list[Result | None]]:
    """Fit all configurations of a sweep, each in its own directory, and compare them.

    Runs that are done already are kept, and with ``resume`` the others go on. One that fails does not stop the others.

    Args:
        configs: as :func:`~neuprim.config.compose_all` gives them, all in one directory.
        words: what the sweep was asked for.
        on_status: called with (place in ``configs``, status) whenever it is new; once for each run that is kept.

    Returns:
        the record, and a result for each configuration; None of those that Ctrl-C came before.

    Raises:
        NeuprimError: a directory in which another sweep, or another process, is at work; a launcher that cannot work
        here.
        OSError: the sweep's own files cannot be written.
    """
    folder = configs[0].output_dir.parent
    asked = SweepRecord(tuple(drop_place(words)), tuple(_make_row(config, words) for config in configs))
    before = read_sweep(folder) if configs[0].resume else None
    record = asked.merge(before, folder / SWEEP_FILE)
    todo = [
        n for n, config in enumerate(configs) if not (record.rows[n].state == "done" and is_complete(config.output_dir))
    ]
    check_launcher(settings, len(todo))
    results: list[Result | None] = [Result("done", str(config.output_dir)) for config in configs]
    with lock_directory(folder, "sweep"):
        for number in set(range(len(configs))) - set(todo):
            on_status(number, JobStatus("done", "kept"))
        writer = _RecordWriter(record, folder)

        def heard(number: int, status: JobStatus) -> None:
            writer.begin()
            on_status(todo[number], status)

        def ended(number: int, result: Result) -> None:
            results[todo[number]] = result
            writer.put(todo[number], result)

        for number in todo:
            results[number] = None
        render_ground_truth_of_runs([configs[n] for n in todo], settings, heard)
        launch([run_job(configs[n]) for n in todo], settings, folder / LAUNCH_FOLDER, heard, ended)
        record = writer.record
        record.write(folder)
        rows = read_sweep_runs(folder, record)
        write_csv(folder / "sweep.csv", rows)
        write_sweep_page(folder, rows, record.words)
    return record, results


class _RecordWriter:
    """Writes the record whenever a run ends, so that a launcher that is killed loses nothing."""

    def __init__(self, record: SweepRecord, folder: Path) -> None:
        self.record, self._folder, self._begun = record, folder, False

    def begin(self) -> None:
        """Write it at the first status: a launcher that is refused leaves nothing."""
        if not self._begun:
            self._begun = True
            self.record.write(self._folder)

    def put(self, number: int, result: Result) -> None:
        """Note how a run ended."""
        row = self.record.rows[number]
        self.record = self.record.put(
            replace(row, state=result.state, line=result.line, seconds=result.seconds, attempts=result.attempts)
        )
        # a full disk must not end the other runs; the write at the end reports it
        with suppress(OSError):
            self.record.write(self._folder)


def _make_row(config: RunConfig, words: Sequence[str]) -> SweepRow:
    own = drop_place(config.overrides)
    keys = set(swept_keys(words))
    return SweepRow(
        config.output_dir.name, tuple(own), {a.key: a.text.partition("=")[2] for a in parse(own) if a.key in keys}
    )


def is_complete(directory: Path) -> bool:
    """Whether a directory has all that the end of a run writes."""
    files = directory / "config.yaml", directory / "metrics.json", model_file(directory)
    return all(file.is_file() for file in files)
