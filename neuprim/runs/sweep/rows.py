"""What came out of the runs of a sweep: read from their directories, and as a table of numbers."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from neuprim.core.errors import DataError
from neuprim.core.io.files import write_text
from neuprim.report.run_record import RunRecord, read_run
from neuprim.report.sweep import Compared
from neuprim.runs.sweep.record import SweepRecord

__all__ = ["sweep_rows", "write_csv"]


def sweep_rows(folder: Path, record: SweepRecord) -> list[Compared]:
    """The runs as they lie in a sweep's directory, in the record's order."""
    return [
        Compared(row.name, row.swept, row.state, row.line, row.seconds, row.attempts, _run(folder / row.name))
        for row in record.rows
    ]


def _run(directory: Path) -> RunRecord | None:
    try:
        return read_run(directory)
    except DataError:  # no run yet, or one that was damaged: its state says that it is not done
        return None


def write_csv(path: Path, rows: Sequence[Compared]) -> None:
    """A row for every run: its name, its swept words, its state, every number of its ``metrics.json``, and its
    directory below the sweep's.

    Cells of what a run does not have are empty.
    """
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
