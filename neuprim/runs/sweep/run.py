"""A sweep: its runs launched together, ``sweep.json`` kept while they work, ``sweep.csv`` and ``sweep.html`` at the
end."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from neuprim.config import RunConfig
from neuprim.config.launcher import LauncherSettings
from neuprim.config.overrides import drop_place, parse, swept_keys
from neuprim.report.sweep import write_sweep
from neuprim.runs.ground_truth import before_runs
from neuprim.runs.launch.engine import Hear
from neuprim.runs.launch.jobs import Result
from neuprim.runs.launch.status import Status
from neuprim.runs.launch.table import FOLDER, check_launcher, launch, nobody
from neuprim.runs.lock import held
from neuprim.runs.open import model_file
from neuprim.runs.sweep.one import job_of
from neuprim.runs.sweep.record import FILE, Row, SweepRecord, read_sweep
from neuprim.runs.sweep.rows import sweep_rows, write_csv

__all__ = ["sweep_run"]


def sweep_run(
    configs: Sequence[RunConfig],
    words: Sequence[str],
    settings: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
    hear: Hear = nobody,
) -> tuple[SweepRecord, list[Result | None]]:
    """Fit all configurations of a sweep, each in its own directory, and compare them.

    Runs that are done already are kept, and with ``resume`` the others go on. One that fails does not stop the others.

    Args:
        configs: as :func:`~neuprim.config.compose_all` gives them, all in one directory.
        words: what the sweep was asked for.
        hear: told (place in ``configs``, status) whenever there is something new; once of each run that is kept.

    Returns:
        the record, and a result for each configuration; None of those that Ctrl-C came before.

    Raises:
        NeuprimError: a directory in which another sweep, or another process, is at work; a launcher that cannot work
        here.
        OSError: the sweep's own files cannot be written.
    """
    folder = configs[0].output_dir.parent
    asked = SweepRecord(tuple(drop_place(words)), tuple(_row(config, words) for config in configs))
    before = read_sweep(folder) if configs[0].resume else None
    record = asked.beside(before, folder / FILE)
    todo = [n for n, config in enumerate(configs) if not _is_done(record.rows[n], config)]
    check_launcher(settings, len(todo))
    results: list[Result | None] = [Result("done", str(config.output_dir)) for config in configs]
    with held(folder, "sweep"):
        for number in set(range(len(configs))) - set(todo):
            hear(number, Status("done", "kept"))
        keeper = _Keeper(record, folder)

        def heard(number: int, status: Status) -> None:
            keeper.begin()
            hear(todo[number], status)

        def ended(number: int, result: Result) -> None:
            results[todo[number]] = result
            keeper.put(todo[number], result)

        for number in todo:
            results[number] = None
        before_runs([configs[n] for n in todo], settings, heard)
        launch([job_of(configs[n]) for n in todo], settings, folder / FOLDER, heard, ended)
        record = keeper.record
        record.write(folder)
        rows = sweep_rows(folder, record)
        write_csv(folder / "sweep.csv", rows)
        write_sweep(folder, rows, record.words)
    return record, results


class _Keeper:
    """Keeps the record on disk up to date as runs end, so that a launcher that is killed loses nothing."""

    def __init__(self, record: SweepRecord, folder: Path) -> None:
        self.record, self._folder, self._begun = record, folder, False

    def begin(self) -> None:
        """With the first sign of life: a launcher that is refused leaves nothing."""
        if not self._begun:
            self._begun = True
            self.record.write(self._folder)

    def put(self, number: int, result: Result) -> None:
        """How a run ended."""
        row = self.record.rows[number]
        self.record = self.record.put(
            replace(row, state=result.state, line=result.line, seconds=result.seconds, attempts=result.attempts)
        )
        with suppress(
            OSError
        ):  # a full disk must not end the other runs; it is written again at the end, where that is told
            self.record.write(self._folder)


def _row(config: RunConfig, words: Sequence[str]) -> Row:
    own = drop_place(config.overrides)
    keys = set(swept_keys(words))
    return Row(
        config.output_dir.name, tuple(own), {a.key: a.text.partition("=")[2] for a in parse(own) if a.key in keys}
    )


def _is_done(row: Row, config: RunConfig) -> bool:
    """Whether a run of before is kept as it is."""
    there = config.output_dir
    whole = all((there / name).is_file() for name in ("config.yaml", "metrics.json"))
    return row.state == "done" and whole and model_file(there).is_file()
