"""``neuprim new-task``: write a package with a task of the user's own."""

from __future__ import annotations

import argparse
from pathlib import Path

from neuprim.cli.command import Command

__all__ = ["COMMAND"]


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    name = "what users will type after task=: lower-case letters, digits and _"
    parser.add_argument("name", metavar="NAME", help=name)
    out = "a folder that does not exist yet (default: neuprim-NAME)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=out)


def _new_task(arguments: argparse.Namespace) -> int:
    from neuprim.plugins.new_task import write_task_package

    print(*write_task_package(arguments.name, arguments.out), sep="\n")
    return 0


COMMAND = Command(
    "new-task",
    "write a small working package with a task of your own: see docs/plugins.md",
    _add_arguments,
    _new_task,
)
