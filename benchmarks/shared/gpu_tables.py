"""The tables of docs/gpu.md from what benchmarks/gpu.py recorded; measures nothing.

python benchmarks/shared/gpu_tables.py
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared.tables import ROOT, between_markers

__all__ = ["PAGE", "RESULTS", "TABLES", "parity_table", "recorded", "times_table", "training_table"]

PAGE, RESULTS = ROOT / "docs" / "gpu.md", ROOT / "benchmarks" / "results" / "gpu"

Record = dict[str, Any]


def recorded() -> list[Record]:
    """A record per device, cards first."""
    found = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("*.json"))]
    return sorted(found, key=lambda record: "times" not in record)


def _rows(head: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows))


def _tables(records: list[Record], part: str, head: list[str], row: Any) -> str:
    """A table per device that has this part, under its name; nothing where none has."""
    parts = []
    for record in records:
        if part in record:
            parts.append(
                f"{record['device']}, torch {record['torch']}:\n\n"
                + _rows(head, [row(entry) for entry in record[part]])
            )
    return "\n\n".join(parts)


def parity_table(records: list[Record]) -> str:
    """Images and gradients per form and scene."""
    names = next((list(entry["gradients"]) for record in records for entry in record.get("parity", [])), [])

    def row(entry: Record) -> list[str]:
        # a gradient of nothing, such as of no neurons, is no number
        grads = [
            f"{entry['gradients'][name]:.0e}" if entry["neurons"] or name not in ("W1", "b1", "w2") else "–"
            for name in names
        ]
        same = "yes" if entry["same"] else "**no**"
        return [f"{entry['neurons']}, {entry['edge']}", entry["scene"], f"{entry['image']:.0e}", *grads, same]

    return _tables(records, "parity", ["K, p", "scene", "image", *names, "same bits again"], row)


def times_table(records: list[Record]) -> str:
    """Milliseconds per form, primitives and size."""

    def row(entry: Record) -> list[str]:
        ms = [entry[key] for key in ("forward_ms", "both_ms", "step_ms")]
        size = f"{entry['width']}×{entry['height']}"
        counts = [f"{entry[key]:,}" for key in ("primitives", "pairs", "slots")]
        return [
            entry["form"],
            counts[0],
            size,
            *counts[1:],
            *(f"{x:.2f}" for x in ms),
            f"{1000 / ms[0]:.0f}",
            f"{entry['peak_mb']:,.0f}",
        ]

    head = [
        "form",
        "primitives",
        "size",
        "pairs",
        "slots",
        "forward, ms",
        "and backward",
        "training step",
        "frames/s",
        "peak MB",
    ]
    text = _tables(records, "times", head, row)
    before = _tables(records, "times_before", head, row)
    return f"{text}\n\nThe first version that ran there, up to a million primitives:\n\n{before}" if before else text


def training_table(records: list[Record]) -> str:
    """Whole training runs."""

    def row(entry: Record) -> list[str]:
        score = f"{entry['psnr']:.2f} ({entry['of']})"
        return [
            entry["scene"].replace("_", " "),
            f"{entry['primitives']:,}",
            f"{entry['steps']:,}",
            f"{entry['step_ms']:.2f}",
            score,
        ]

    return _tables(records, "train", ["scene", "primitives", "steps", "ms a step", "PSNR, dB"], row)


TABLES = {"gpu-parity": parity_table, "gpu-times": times_table, "gpu-training": training_table}
"""Marker in the page -> what stands there."""


def main() -> None:
    records = recorded()
    for name, table in TABLES.items():
        text = table(records)
        if text:
            between_markers(PAGE, name, text)


if __name__ == "__main__":
    main()
