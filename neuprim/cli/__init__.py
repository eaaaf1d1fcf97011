"""The ``neuprim`` command: parse, call, print.

Exit status: 0 done, 1 no backend works (``doctor``), 2 the input's fault (one line on standard error), 130 interrupted.
A bug in neuprim keeps its traceback. ``NEUPRIM_TRACEBACK=1`` shows the traceback of every error, for authors of plugins.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence

from neuprim.cli import (
    bench_command,
    compress_command,
    doctor_command,
    eval_command,
    export_command,
    import_command,
    inspect_command,
    new_task_command,
    prune_command,
    render_command,
    run_command,
    tasks_command,
    tradeoff_command,
    truth_command,
    vdb_command,
    view_command,
)
from neuprim.cli.command import Parser
from neuprim.core.errors import ConfigError, NeuprimError, nearest, one_line
from neuprim.core.io.trust import trusting
from neuprim.core.notices import warnings_as_lines
from neuprim.version import __version__

__all__ = ["COMMANDS", "main"]

_MODULES = (
    run_command,
    truth_command,
    eval_command,
    render_command,
    tradeoff_command,
    export_command,
    compress_command,
    prune_command,
    import_command,
    inspect_command,
    view_command,
    vdb_command,
    tasks_command,
    new_task_command,
    bench_command,
    doctor_command,
)
COMMANDS = {module.COMMAND.name: module.COMMAND for module in _MODULES}
"""Every command by its name, in the order of ``neuprim --help``."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        with warnings_as_lines():
            return _dispatch(words)
    except KeyboardInterrupt as stop:
        print(f"neuprim: interrupted{stop}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # `neuprim tasks | head`; the interpreter's own flush at exit must not fail either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (NeuprimError, OSError, RuntimeError) as error:
        line = one_line(error)
        if line is None:
            raise
        if os.environ.get("NEUPRIM_TRACEBACK"):
            traceback.print_exception(error)
        print(f"neuprim: error: {line}", file=sys.stderr)
        return 2
    except SystemExit as stop:  # argparse, after --help and --version
        return stop.code if isinstance(stop.code, int) else 0


def _dispatch(words: list[str]) -> int:
    parser = _build_parser()
    if not words:
        parser.print_help()
        return 0
    if words[0].startswith("-"):
        parser.parse_args(words)
    if words[0] not in COMMANDS:
        raise ConfigError(f"{words[0]}: no such command{nearest(words[0], COMMANDS)}")
    command = COMMANDS[words[0]]
    arguments = command.parse(words[1:])
    with trusting(getattr(arguments, "trust", False)):
        return command.call(arguments)


def _build_parser() -> Parser:
    """Return the parser of a command line without a command: help and version."""
    parser = Parser(prog="neuprim", description="Radiance fields made of splattable neural primitives.")
    parser.add_argument("--version", action="version", version=f"neuprim {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for command in COMMANDS.values():
        commands.add_parser(command.name, help=command.summary, add_help=False)
    return parser
