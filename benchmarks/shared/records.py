"""What benchmarks measured: JSON files in benchmarks/results, from which the tables of the documentation are made."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from shared.tables import ROOT

RESULTS = ROOT / "benchmarks" / "results"

Record = dict[str, Any]


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
