"""Shared code of the ``neuprim`` commands: the class :class:`Command`, parsers of flag values, and plain text output.

The modules ``*_commands.py`` define the commands; :data:`neuprim.cli.COMMANDS` lists them.
Modules that load torch are imported inside the function that runs the command, so that help stays fast.
"""

from __future__ import annotations

import argparse
import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.io.trust import FLAG

if TYPE_CHECKING:
    from rich.console import Console

    from neuprim.config.overrides import CommandLine
    from neuprim.core.task import TaskSpec

TakeRest = Callable[[argparse.Namespace, list[str], argparse.ArgumentParser], list[str]]

RENDER_SETTINGS_HELP = """\
how the run is drawn; `neuprim tradeoff RUN_DIR` measures cost and gain of each
  renderer.KEY=VALUE         any setting of the renderer
  resolution=0.5             render at half the width and height, and upsample
  density.NAME=N colour.NAME=N
                             a smaller field, e.g. colour.degree=1 (bands of spherical harmonics) density.neurons=4"""


class Parser(argparse.ArgumentParser):
    """An argparse parser that raises ConfigError, with a one-line message, for a wrong command line."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, formatter_class=argparse.RawDescriptionHelpFormatter, **options)

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} (see {self.prog} --help)")


@dataclass(frozen=True)
class Command:
    """One command of the command line, e.g. ``neuprim render``.

    Attributes:
        name: what users type after ``neuprim``.
        summary: one line for ``neuprim --help``.
        call: runs the command with the parsed arguments and returns the exit status.
        add_arguments: adds the command's own arguments to its parser.
        epilog: text below the arguments in ``neuprim NAME --help``, or a function that makes it from the typed words.
        settings: help text that says what ``KEY=VALUE`` sets; empty if the command has no settings. Settings may be
            anywhere on the command line, and become ``arguments.overrides``.
        take_rest: function (arguments, rest, parser) for ``rest``, the words that argparse does not know. The function
            stores the words that the command accepts, and returns all other words, which are then refused.
        opens_run: whether the command takes an existing run directory; if so, ``RUN_DIR`` and ``--trust`` are added.
    """

    name: str
    summary: str
    call: Callable[[argparse.Namespace], int]
    add_arguments: Callable[[argparse.ArgumentParser], None] = lambda parser: None
    epilog: str | Callable[[Sequence[str]], str] = ""
    settings: str = ""
    take_rest: TakeRest = lambda arguments, rest, parser: rest
    opens_run: bool = False

    def parse(self, words: Sequence[str]) -> argparse.Namespace:
        """Parse the words after the command's name.

        Raises:
            ConfigError: an argument is missing, unknown or has an invalid value, or the run directory does not exist.
        """
        parser = self.build_parser(words)
        overrides, others = split_settings(words, parser) if self.settings else ([], list(words))
        arguments, rest = parser.parse_known_args(others)
        arguments.overrides = overrides
        if self.opens_run:
            check_run_dir_argument(arguments.run_dir)
        rest = self.take_rest(arguments, rest, parser)
        if rest:
            raise refuse_argument(next((word for word in rest if word.startswith("-")), rest[0]), parser)
        return arguments

    def build_parser(self, words: Sequence[str] = ()) -> Parser:
        """Return a parser for the words after the command's name; the help text may depend on ``words``."""
        epilog = self.epilog if isinstance(self.epilog, str) else self.epilog(words)
        parser = Parser(prog=f"neuprim {self.name}", description=self.summary, epilog=epilog)
        if self.opens_run:
            parser.add_argument("run_dir", type=Path, metavar="RUN_DIR", help="directory of a run")
            add_trust_flag(parser)
        self.add_arguments(parser)
        if self.settings:
            parser.add_argument_group("KEY=VALUE", self.settings)
            parser.usage = f"{parser.format_usage().removeprefix('usage: ').rstrip()} [KEY=VALUE ...]"
        return parser


def add_trust_flag(parser: argparse.ArgumentParser) -> None:
    """Add the flag ``--trust``.

    With this flag, a stored configuration can make neuprim contact network addresses and write outside the run
    directory (:mod:`neuprim.config.stored_run`).
    """
    text = "let a stored config.yaml make neuprim contact network addresses and write outside the run directory"
    parser.add_argument(FLAG, action="store_true", help=text)


def check_run_dir_argument(path: Path) -> None:
    """Raise ConfigError unless ``path`` is a folder."""
    if not path.is_dir():
        model = path.is_file() and path.suffix in (".neuprim", ".npz", ".ply")
        hint = f"; `neuprim import {path} --out RUN_DIR` makes a run directory from this file" if model else ""
        raise ConfigError(f"{path}: no such run directory{hint}")


# ---------------------------------------------------------------- words that argparse does not know


def split_settings(words: Sequence[str], parser: argparse.ArgumentParser) -> tuple[list[str], list[str]]:
    """Split the words of a command line into (settings ``KEY=VALUE``, other words), two lists.

    The other words are flags with their values, and the path of a run directory even if the path contains ``=``.

    Raises:
        ConfigError: a word is ``output_dir=DIR``; commands take the flag ``--out DIR`` instead.
    """
    settings: list[str] = []
    others: list[str] = []
    flags, value_follows = parser._option_string_actions, False
    opens_run = any(action.dest == "run_dir" for action in parser._actions)
    for word in words:
        if "=" not in word or word.startswith("-") or value_follows or (opens_run and os.path.isdir(word)):
            others.append(word)
        elif word.lstrip("+").startswith("output_dir="):
            expected = "expected --out DIR" if "--out" in flags else "leave it out"
            raise ConfigError(f"{word}: `{parser.prog}` does not take output_dir; {expected}")
        else:
            settings.append(word)
        value_follows = word in flags and flags[word].nargs != 0
    return settings, others


def take_condition_arguments(
    arguments: argparse.Namespace, rest: list[str], parser: argparse.ArgumentParser
) -> list[str]:
    """Parse ``rest``, the words that argparse does not know, as condition flags such as ``--time 0.5``.

    A condition is an input of an image besides the camera; the run's task defines the conditions. Other words raise
    ConfigError, so the returned list is empty. Frame numbers (:func:`add_frame_argument`) become times. Set
    ``arguments.conditions``, name -> text, and ``arguments.run``: the run directory, or the run if it was loaded.
    """
    arguments.conditions, arguments.run = {}, arguments.run_dir
    numbers = getattr(arguments, "frame_numbers", None)
    if not rest and numbers is None:
        return []
    from neuprim.core.conditions import frames_to_times, split_conditions
    from neuprim.runs.open import load_run

    arguments.run = load_run(arguments.run_dir)
    arguments.conditions, unknown = split_conditions(rest, arguments.run.task.conditions)
    if unknown:
        raise refuse_argument(unknown[0], parser, arguments.run.task)
    if numbers is not None:
        _, arguments.conditions = frames_to_times(numbers, arguments.conditions, arguments.run.header)
    return []


def add_frame_argument(parser: argparse.ArgumentParser) -> None:
    """Add ``--frame NUMBERS``, which :func:`take_condition_arguments` replaces by ``--time``."""
    text = "frames of the .vdb files by number, instead of --time: 1001-1048x2,1060"
    parser.add_argument("--frame", dest="frame_numbers", metavar="NUMBERS", help=text)


def refuse_argument(word: str, parser: argparse.ArgumentParser, task: TaskSpec | None = None) -> ConfigError:
    """Return the error for a word that is neither an argument of the command nor a condition of the task."""
    from neuprim.core.conditions import condition_flag

    conditions = () if task is None else (condition_flag(spec.name) for spec in task.conditions)
    flags = [name for name in (*parser._option_string_actions, *conditions) if name.startswith("--")]
    place = "" if task is None else f" for task {task.name!r}"
    return ConfigError(f"{word}: no such argument of `{parser.prog}`{place}{nearest(word, flags)}")


# ---------------------------------------------------------------- output


def plain_console(stderr: bool = False, **options: Any) -> Console:
    """Return a rich console that prints text unchanged: no markup, emoji, automatic colours or line wrapping.

    By default, rich reads ``[name]`` as markup and ``:name:`` as an emoji, so that ``pip install 'neuprim[video]'``
    would be printed without ``[video]``.
    """
    from rich.console import Console

    return Console(stderr=stderr, markup=False, emoji=False, highlight=False, soft_wrap=True, **options)


def print_columns(rows: Sequence[Sequence[str]]) -> None:
    """Print rows as a table on standard output: the first column left-aligned, numbers right-aligned."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for first, *others in rows:
        cells = [f"{cell:>{width}}" for cell, width in zip(others, widths[1:], strict=True)]
        print("  ".join([f"{first:{widths[0]}}", *cells]).rstrip())


def describe_interrupted_command(directory: Path, typed: CommandLine) -> str:
    """Return text for the user: whether an interrupted run has a checkpoint, and the command that continues the run.

    ``typed`` has the arguments of the interrupted command.
    """
    begun = any((directory / file).exists() for file in ("checkpoint.safetensors", "chunks.json"))
    state = "contains a checkpoint of the run" if begun else "has no checkpoint yet"
    return f"; {directory} {state}; to continue:\n  {typed.resume_command(directory)}"


# ---------------------------------------------------------------- values of flags


def parse_size_argument(text: str) -> tuple[int, int]:
    """Parse an image size such as ``640x480``; return (width, height) in pixels."""
    match = re.fullmatch(r"([1-9]\d{0,5})[xX]([1-9]\d{0,5})", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r}: expected WIDTHxHEIGHT, for example 640x480")
    return int(match.group(1)), int(match.group(2))


def parse_count(text: str) -> int:
    """Parse a positive whole number."""
    return int(parse_number(text, 1, 9_999_999, "a positive count", whole=True))


def parse_whole(text: str) -> int:
    """Parse a whole number, 0 or more."""
    return int(parse_number(text, 0, 999_999_999, "a whole number, from 0", whole=True))


def parse_rate(text: str) -> float:
    """Parse a number of frames per second."""
    return parse_number(text, 0.1, 240.0, "0.1 to 240 frames per second")


def parse_decibels(text: str) -> float:
    """Parse a number of decibels, written 0.1 or 0.1dB."""
    return parse_number(re.sub(r" ?dB$", "", text, flags=re.IGNORECASE), 1e-9, 100.0, "decibels above 0, as 0.1dB")


def parse_seconds(text: str) -> float:
    """Parse a duration, written 30, 90s, 5m or 1h; return seconds, 0 or more."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)(s|m|h|)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a time, for example 30s or 5m")
    return float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]


def parse_numbers(text: str) -> list[float]:
    """Parse finite numbers separated by commas."""
    return [parse_number(part, -math.inf, math.inf, "numbers separated by commas") for part in text.split(",")]


def parse_number(text: str, low: float, high: float, expected: str, whole: bool = False) -> float:
    """Parse a finite number from ``low`` to ``high``; if ``whole``, allow only digits. Errors cite ``expected``."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and low <= value <= high) or (whole and re.fullmatch("[0-9]+", text) is None):
        raise argparse.ArgumentTypeError(f"{text!r}: expected {expected}")
    return value
