"""What every command of ``neuprim`` shares: its description, its parser, and values of flags read from text.

A command is one module, ``NAME_command.py``, with a :class:`Command` named ``COMMAND``; :data:`neuprim.cli.COMMANDS`
lists them. Modules that load torch are imported inside the function that runs the command, so that help stays fast.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.io.trust import FLAG

if TYPE_CHECKING:
    from neuprim.core.task import TaskSpec

__all__ = [
    "Command",
    "Parser",
    "add_trust_flag",
    "check_run_directory",
    "load_run_task",
    "parse_count",
    "parse_decibels",
    "parse_index",
    "parse_numbers",
    "parse_rate",
    "parse_seconds",
    "parse_size",
    "parse_whole",
    "refuse_argument",
    "take_conditions",
    "take_overrides",
]


class Parser(argparse.ArgumentParser):
    """An argument parser that reports a wrong command line as one line."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter, **options)

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (see {self.prog} --help)")


@dataclass(frozen=True)
class Command:
    """One command of the command line.

    Attributes:
        name: what users type after ``neuprim``.
        summary: one line for ``neuprim --help``.
        add_arguments: adds the command's own arguments to its parser.
        call: runs the command with the parsed arguments and returns the exit status.
        epilog: text below the arguments in ``neuprim NAME --help``, or a function that makes it from the typed words.
        take_rest: gets the arguments, the words that argparse did not know and the parser; stores those that the
            command accepts and returns the others, which are refused.
        opens_run: whether the first argument is an existing run directory, ``RUN_DIR``; adds it and ``--trust``.
    """

    name: str
    summary: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    call: Callable[[argparse.Namespace], int]
    epilog: str | Callable[[Sequence[str]], str] = ""
    take_rest: Callable[[argparse.Namespace, list[str], argparse.ArgumentParser], list[str]] | None = None
    opens_run: bool = False

    def build_parser(self, words: Sequence[str] = ()) -> Parser:
        """Return the parser of the words after the command's name."""
        epilog = self.epilog if isinstance(self.epilog, str) else self.epilog(words)
        parser = Parser(prog=f"neuprim {self.name}", description=self.summary, epilog=epilog)
        if self.opens_run:
            parser.add_argument("run_dir", type=Path, metavar="RUN_DIR")
            add_trust_flag(parser)
        self.add_arguments(parser)
        return parser

    def parse(self, words: Sequence[str]) -> argparse.Namespace:
        """Return the arguments of the command, from the words after its name.

        Raises:
            ConfigError: an argument is missing, unknown or has an impossible value, or there is no such run directory.
        """
        parser = self.build_parser(words)
        arguments, rest = parser.parse_known_args(words)
        if self.opens_run:
            check_run_directory(arguments.run_dir)
        if self.take_rest is not None:
            rest = self.take_rest(arguments, rest, parser)
        if rest:
            raise refuse_argument(rest[0], parser)
        return arguments


def add_trust_flag(parser: argparse.ArgumentParser) -> None:
    """Add ``--trust``, which lets a stored configuration reach outside its run (:mod:`neuprim.config.trust`)."""
    text = "use addresses, and write to folders outside of it, that a stored config.yaml names"
    parser.add_argument(FLAG, action="store_true", help=text)


def check_run_directory(path: Path) -> None:
    """Raise ConfigError unless ``path`` is a folder."""
    if not path.is_dir():
        model = path.is_file() and path.suffix in (".neuprim", ".npz", ".ply")
        hint = f"; `neuprim import {path} --out RUN_DIR` makes one of this file" if model else ""
        raise ConfigError(f"{path}: no such run directory{hint}")


def load_run_task(run_dir: Path) -> TaskSpec:
    """Return the task of a run."""
    from neuprim.config import RunConfig, task_of

    file = run_dir / "config.yaml"
    return task_of(RunConfig.from_yaml(file), file)


def take_overrides(arguments: argparse.Namespace, rest: list[str], parser: argparse.ArgumentParser) -> list[str]:
    """Add the words that are no flags to ``arguments.overrides``: argparse gives up on them after the first flag."""
    arguments.overrides += [word for word in rest if not word.startswith("-")]
    return [word for word in rest if word.startswith("-")]


def take_conditions(arguments: argparse.Namespace, rest: list[str], parser: argparse.ArgumentParser) -> list[str]:
    """Set ``arguments.conditions``, name -> text, from the flags that the run's task defines."""
    arguments.conditions = {}
    if not rest:
        return []
    from neuprim.core.conditions import split_words

    task = load_run_task(arguments.run_dir)
    arguments.conditions, unknown = split_words(rest, task.conditions)
    if unknown:
        raise refuse_argument(unknown[0], parser, task)
    return []


def refuse_argument(word: str, parser: argparse.ArgumentParser, task: TaskSpec | None = None) -> ConfigError:
    """Return the error for a word that is neither an argument of the command nor a condition of the task."""
    from neuprim.core.conditions import flag

    conditions = () if task is None else (flag(spec.name) for spec in task.conditions)
    flags = [name for name in (*parser._option_string_actions, *conditions) if name.startswith("--")]
    place = "" if task is None else f" for task {task.name!r}"
    return ConfigError(f"{word}: no such argument of `{parser.prog}`{place}{nearest(word, flags)}")


# ---------------------------------------------------------------- values of flags


def parse_size(text: str) -> tuple[int, int]:
    """Read 640x480 as (640, 480) pixels."""
    match = re.fullmatch(r"([1-9]\d{0,5})[xX]([1-9]\d{0,5})", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r}: expected WIDTHxHEIGHT, for example 640x480")
    return int(match.group(1)), int(match.group(2))


def parse_count(text: str) -> int:
    """Read a positive whole number."""
    return _read_digits(text, r"[1-9]\d{0,6}", "a positive count")


def parse_whole(text: str) -> int:
    """Read a whole number, from 0."""
    return _read_digits(text, r"\d{1,7}", "a whole number, from 0")


def parse_index(text: str) -> int:
    """Read the number of a primitive, from 0."""
    return _read_digits(text, r"\d{1,9}", "the number of a primitive, from 0")


def parse_decibels(text: str) -> float:
    """Read 0.1 or 0.1dB."""
    match = re.fullmatch(r"(\d+\.?\d*|\.\d+) ?(?:dB)?", text, re.IGNORECASE)
    if match is None or not 0 < float(match[1]) <= 100:
        raise argparse.ArgumentTypeError(f"{text!r}: expected decibels above 0, for example 0.1dB")
    return float(match[1])


def parse_seconds(text: str) -> float:
    """Read 30, 90s, 5m or 1h as seconds, 0 or more."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)(s|m|h|)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a time, for example 30s or 5m")
    return float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]


def parse_numbers(text: str) -> list[float]:
    """Read finite numbers separated by commas."""
    values = [_read_number(part) for part in text.split(",")]
    if not all(math.isfinite(value) for value in values):
        raise argparse.ArgumentTypeError(f"{text!r}: expected numbers separated by commas")
    return values


def parse_rate(text: str) -> float:
    """Read frames per second."""
    value = _read_number(text)
    if not 0.1 <= value <= 240.0:
        raise argparse.ArgumentTypeError(f"{text!r}: expected 0.1 to 240 frames per second")
    return value


def _read_digits(text: str, pattern: str, expected: str) -> int:
    if not re.fullmatch(pattern, text):
        raise argparse.ArgumentTypeError(f"{text!r}: expected {expected}")
    return int(text)


def _read_number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
