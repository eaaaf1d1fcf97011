"""What ``neuprim export`` prints when it is done."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping

from neuprim.core.extensions import ExportReport

__all__ = ["print_report"]


def print_report(report: ExportReport, as_json: bool) -> None:
    """The report on standard output, for people or for programs."""
    if as_json:
        errors = {name: value if math.isfinite(value) else None for name, value in report.errors.items()}
        record = {
            "files": [str(p) for p in report.files],
            "lossless": report.lossless,
            "errors": errors,
            "notes": list(report.notes),
        }
        print(json.dumps(record, indent=1, allow_nan=False))
        return
    print(*report.files, sep="\n")
    print("lossless" if report.lossless else "lossy")
    print(*_table(report.errors), sep="\n", end="\n" if report.errors else "")
    for note in report.notes:
        print(f"note: {note}")


def _table(errors: Mapping[str, float]) -> list[str]:
    """A line per number; numbers of several things, as ``frame_0007.relative_l2``, in a line per thing."""
    rows: dict[str, dict[str, str]] = {}
    for name, value in errors.items():
        thing, _, key = name.rpartition(".")
        rows.setdefault(thing, {})[key] = f"{value:.4f}"
    columns = list(dict.fromkeys(key for row in rows.values() for key in row))
    if "" in rows or len(rows) < 2:
        width = max((len(name) for name in errors), default=0)
        return [f"{name:{width}}  {value:.4f}" for name, value in errors.items()]
    first, widths = max(map(len, rows)), [max(len(key), 9) for key in columns]
    lines = [("", columns), *((thing, [row.get(key, "") for key in columns]) for thing, row in rows.items())]
    return [
        "  ".join([f"{thing:{first}}", *(f"{c:>{w}}" for c, w in zip(cells, widths, strict=True))])
        for thing, cells in lines
    ]
