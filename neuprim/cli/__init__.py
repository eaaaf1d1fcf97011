"""The ``neuprim`` command: parse arguments, call the library, print results.

Exit status: 0 for success; 1 for a bug, or if ``doctor`` finds no working renderer backend; 2 for wrong input, with one
line on standard error; 130 after Ctrl-C; 141 if the reader of a pipe closes it. A bug in neuprim shows its traceback.
The environment variable ``NEUPRIM_TRACEBACK=1`` shows the traceback of every error, for authors of plugins.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module

from neuprim.cli.command import Command, Parser
from neuprim.core.errors import ConfigError, NeuprimError, nearest, one_line, warnings_as_lines
from neuprim.core.io.trust import trusting
from neuprim.version import __version__

__all__ = ["COMMANDS", "main"]

_MODULES = ("run", "measure", "model", "view", "install")
_ORDER = (
    *("run", "truth", "eval", "render", "tradeoff", "export", "compress", "prune", "import", "inspect", "view", "vdb"),
    *("tasks", "new-task", "blender-addon", "bench", "doctor"),
)
_FOUND = {
    value.name: value
    for module in _MODULES
    for value in vars(import_module(f"neuprim.cli.{module}_commands")).values()
    if isinstance(value, Command)
}
COMMANDS = {name: _FOUND[name] for name in _ORDER}
"""Every command by its name, in the order of ``neuprim --help``."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one ``neuprim`` command and return its exit status.

    ``argv`` has the words after ``neuprim``, e.g. ``["render", "RUN_DIR"]``; None takes them from ``sys.argv``.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        with warnings_as_lines():
            return _run_command_line(words)
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


def _run_command_line(words: list[str]) -> int:
    parser = Parser(prog="neuprim", description="Radiance fields made of splattable neural primitives.")
    parser.add_argument("--version", action="version", version=f"neuprim {__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for command in COMMANDS.values():
        commands.add_parser(command.name, help=command.summary, add_help=False)
    if not words:
        parser.print_help()
        return 0
    if words[0].startswith("-"):
        parser.parse_args(words)
    if words[0] not in COMMANDS:
        raise ConfigError(f"{words[0]}: no such command{nearest(words[0], COMMANDS)}")
    chosen = COMMANDS[words[0]]
    arguments = chosen.parse(words[1:])
    with trusting(getattr(arguments, "trust", False)):
        return chosen.call(arguments)
