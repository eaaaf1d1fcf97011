"""``neuprim eval``: measure a run on its test views."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuprim.cli.command import RENDER_OVERRIDES_HELP, Command, take_render_overrides


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    text = "measure LPIPS with these weights of your own, a file or a folder"
    parser.add_argument("--lpips", type=Path, metavar="FILE", help=text)


def _evaluate(arguments: argparse.Namespace) -> int:
    from neuprim.core.metrics.image import format_metrics
    from neuprim.runs.measure import evaluate_run

    metrics = evaluate_run(arguments.run_dir, arguments.lpips, arguments.words)
    rows = _list_numbers(metrics)
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        print(f"{name:{width}}  {value}")
    if "worse_than_black_image" in metrics:
        print(format_metrics(metrics))
    return 0


def _list_numbers(metrics: Mapping[str, Any], where: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in metrics.items():
        name = f"{where}{key}"
        if isinstance(value, Mapping):
            rows += _list_numbers(value, f"{name}.")
        elif isinstance(value, list) and value and all(isinstance(entry, Mapping) for entry in value):
            rows.append((name, f"{len(value)} entries, in the run's metrics.json"))
        else:
            rows.append((name, f"{value:.4f}" if isinstance(value, float) else str(value)))
    return rows


COMMAND = Command(
    "eval",
    "measure a run on its test views",
    _evaluate,
    _add_arguments,
    RENDER_OVERRIDES_HELP,
    take_render_overrides,
    opens_run=True,
)
