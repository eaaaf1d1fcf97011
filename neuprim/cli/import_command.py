"""``neuprim import``: make a run directory of a model file."""

from __future__ import annotations

import argparse
from pathlib import Path

from neuprim.cli.command import Command

__all__ = ["COMMAND"]


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN_DIR", help="new directory")


def _import(arguments: argparse.Namespace) -> int:
    from neuprim.runs.export import import_run

    print(import_run(arguments.file, arguments.out))
    return 0


COMMAND = Command(
    "import", "make a run directory of an exported .ply or .npz, or of a .neuprim", _add_arguments, _import
)
