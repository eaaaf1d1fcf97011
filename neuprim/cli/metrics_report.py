"""Metrics of a run as lines, one per number."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["print_metrics"]


def print_metrics(metrics: Mapping[str, Any]) -> None:
    """On standard output."""
    rows = list(_rows(metrics))
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        print(f"{name:{width}}  {value}")
    if "worse_than_black_image" in metrics:
        from neuprim.core.metrics.words import in_words  # torch, loaded when needed

        print(in_words(metrics))


def _rows(metrics: Mapping[str, Any], where: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in metrics.items():
        name = f"{where}{key}"
        if isinstance(value, Mapping):
            rows += _rows(value, name + ".")
        elif isinstance(value, list) and value and all(isinstance(entry, Mapping) for entry in value):
            rows.append((name, f"{len(value)} entries, in the run's metrics.json"))
        else:
            rows.append((name, f"{value:.4f}" if isinstance(value, float) else str(value)))
    return rows
