"""``neuprim eval``: measure a run on its test views."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuprim.cli.command import Command
from neuprim.cli.render_overrides import RENDER_OVERRIDES_HELP, split_render_overrides

__all__ = ["COMMAND", "print_metrics"]


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    text = "measure LPIPS with these weights of your own, a file or a folder"
    parser.add_argument("--lpips", type=Path, metavar="FILE", help=text)


def _take_rest(arguments: argparse.Namespace, rest: list[str], parser: argparse.ArgumentParser) -> list[str]:
    arguments.words, rest = split_render_overrides(rest)
    return rest


def _evaluate(arguments: argparse.Namespace) -> int:
    from neuprim.runs.measure import evaluate_run

    print_metrics(evaluate_run(arguments.run_dir, arguments.lpips, arguments.words))
    return 0


def print_metrics(metrics: Mapping[str, Any]) -> None:
    """Print metrics on standard output, one number a line."""
    rows = list(_rows(metrics))
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        print(f"{name:{width}}  {value}")
    if "worse_than_black_image" in metrics:
        from neuprim.core.metrics.image import format_metrics  # torch, loaded when needed

        print(format_metrics(metrics))


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


COMMAND = Command(
    "eval",
    "measure a run on its test views",
    _add_arguments,
    _evaluate,
    epilog=RENDER_OVERRIDES_HELP,
    take_rest=_take_rest,
    opens_run=True,
)
