"""Records of measurements in benchmarks/results, and the tables of README and docs that are made from them."""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
README = ROOT / "README.md"
RESULTS = ROOT / "benchmarks" / "results"
RESULT_PAGES = DOCS / "results"
"""Records, and the pages of the site that show them."""

Record = dict[str, Any]
Run = Mapping[str, Any]
Columns = Mapping[str, Callable[[Any], object]]


def read_record(path: Path) -> Record:
    """The content of a record; empty if there is no file."""
    found: Record = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return found


def read_trials(path: Path) -> list[Record]:
    """The trainings of a record."""
    found: list[Record] = read_record(path).get("trials", [])
    return found


def update_record(path: Path, **entries: Any) -> Record:
    """Replace entries of a record, keep the others, and return it."""
    whole = read_record(path) | entries
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(whole, indent=1) + "\n")
    return whole


def between_markers(page: Path, name: str, text: str) -> None:
    """Replace what stands between <!-- name --> and <!-- /name -->."""
    first, last = f"<!-- {name} -->", f"<!-- /{name} -->"
    head, rest = page.read_text().split(first, 1)
    _, tail = rest.split(last, 1)
    page.write_text(f"{head}{first}\n{text.rstrip()}\n{last}{tail}")


def publish(
    args: argparse.Namespace,
    path: Path,
    page: str,
    marker: str,
    measure: Callable[[], Record],
    document: Callable[[Record], str],
) -> Record:
    """Measure, or with --print read the record at ``path``, print ``document`` of it, and return it.

    --record stores what was measured. The text goes between the markers of docs/results/``page`` with --record, and
    with --print --docs.
    """
    record = read_record(path) if args.only_print else measure()
    text = document(record)
    if args.record and not args.only_print:
        update_record(path, **record)
    if args.record or (args.only_print and args.docs):
        between_markers(RESULT_PAGES / page, marker, text)
    return record


class Table:
    """A Markdown table that prints every row as it comes."""

    def __init__(self, *columns: str) -> None:
        self.lines: list[str] = []
        self.row(*columns)
        self.row(*["---"] * len(columns))

    def row(self, *cells: object) -> None:
        self.lines.append("| " + " | ".join(str(c) for c in cells) + " |")
        print(self.lines[-1], flush=True)

    def __str__(self) -> str:
        return "\n".join(self.lines)


def make_table(columns: Columns, rows: Iterable[Any]) -> Table:
    """A table with a row per entry; ``columns`` maps each heading to what fills its cells."""
    table = Table(*columns)
    for row in rows:
        table.row(*(cell(row) for cell in columns.values()))
    return table


def group_runs(runs: Iterable[Run], *keys: str) -> dict[tuple[Any, ...], list[Run]]:
    """Runs by the values of ``keys``, in the order in which they first occur."""
    groups: dict[tuple[Any, ...], list[Run]] = {}
    for run in runs:
        groups.setdefault(tuple(run[key] for key in keys), []).append(run)
    return groups


def spread(values: Sequence[float], digits: int) -> str:
    """Mean ± half the spread."""
    half = (max(values) - min(values)) / 2
    return f"{statistics.mean(values):.{digits}f}" + (f" ± {half:.{digits}f}" if len(values) > 1 else "")


def spread_of(runs: Sequence[Run], key: str, digits: int = 2) -> str:
    """Mean ± half the spread of a number of some runs; a dash without runs."""
    return spread([run[key] for run in runs], digits) if runs else "–"


def format_range(numbers: Iterable[int], joint: str = " to ") -> str:
    """The smallest and the largest number, once if they are equal."""
    found = sorted(numbers)
    return joint.join(f"{n:,}" for n in dict.fromkeys((found[0], found[-1])))
