"""Command-line options that several benchmarks have."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

_OPTIONS: dict[str, dict[str, Any]] = {
    "--chair": {"type": Path, "help": "a NeRF-synthetic folder"},
    "--fire": {"type": Path, "help": "a folder of EmberGen's .vdb files"},
    "--seeds": {"type": int, "default": 3},
    "--jobs": {"type": int, "default": 2, "help": "runs at a time, one thread each"},
    "--rounds": {"type": int, "default": 9, "help": "the fastest of so many is taken"},
    "--threads": {"type": int, "default": 0},
    "--record": {"action": "store_true", "help": "write the record, and the table into docs"},
    "--docs": {"action": "store_true", "help": "write the recorded tables into docs"},
    "--print": {"action": "store_true", "dest": "only_print", "help": "run nothing"},
}


def make_parser(doc: str | None, *options: str, scenes: Iterable[str] = ()) -> argparse.ArgumentParser:
    """A parser with the named common options; with ``scenes`` also --scenes, all of them by default."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if names := list(scenes):
        parser.add_argument("--scenes", nargs="*", default=names, choices=names)
    for option in options:
        parser.add_argument(option, **_OPTIONS[option])
    return parser


def require_folders(parser: argparse.ArgumentParser, args: argparse.Namespace, names: Iterable[str]) -> None:
    """End with one line where the data of a scene in ``names`` was not given by the option of its name."""
    for name in names:
        if hasattr(args, name) and getattr(args, name) is None:
            parser.error(f"--{name}: wants the folder of its data; or leave it out")
