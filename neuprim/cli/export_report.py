"""What ``neuprim export`` prints when it is done."""

from __future__ import annotations

import json
import math

from neuprim.core.extensions import ExportReport

__all__ = ["print_report"]


def print_report(report: ExportReport, as_json: bool) -> None:
    """The report on standard output, for people or for programs."""
    if as_json:
        errors = {name: value if math.isfinite(value) else None for name, value in report.errors.items()}
        record = {"files": [str(p) for p in report.files], "lossless": report.lossless, "errors": errors, "notes": list(report.notes)}
        print(json.dumps(record, indent=1, allow_nan=False))
        return
    print(*report.files, sep="\n")
    print("lossless" if report.lossless else "lossy")
    width = max((len(name) for name in report.errors), default=0)
    for name, value in report.errors.items():
        print(f"{name:{width}}  {value:.4f}")
    for note in report.notes:
        print(f"note: {note}")
