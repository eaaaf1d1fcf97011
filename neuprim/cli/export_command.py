"""``neuprim export``: write a run's model in another format."""

from __future__ import annotations

import argparse
import json
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.cli.command import Command, load_run_task, refuse_argument

if TYPE_CHECKING:
    from neuprim.core.extensions import ExportReport

__all__ = ["COMMAND", "print_report"]

_USAGE = "neuprim export RUN_DIR --format NAME [KEY=VALUE ...] [--CONDITION TEXT ...] [--out PATH] [--force] [--json]"
_WIDTH = 100


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.usage = _USAGE
    formats = "which format; all of them, those of plugins too, are listed below"
    parser.add_argument("--format", required=True, metavar="NAME", help=formats)
    parser.add_argument("--out", type=Path, metavar="PATH", help="where to write (default: in RUN_DIR/export)")
    parser.add_argument("--force", action="store_true", help="replace files that exist")
    parser.add_argument("--json", action="store_true", help="print JSON")


def _take_rest(arguments: argparse.Namespace, rest: list[str], parser: argparse.ArgumentParser) -> list[str]:
    """Keep options and conditions for the exporter; refuse flags that are no condition of the run's task."""
    if any(word.startswith("-") for word in rest):
        from neuprim.core.conditions import split_words

        task = load_run_task(arguments.run_dir)
        _, others = split_words(rest, task.conditions, bare=False)
        for word in others:
            if word.startswith("-"):
                raise refuse_argument(word, parser, task)
    arguments.options = rest
    return []


def _export(arguments: argparse.Namespace) -> int:
    from neuprim.cli.console import plain_console
    from neuprim.cli.progress import LineProgress
    from neuprim.runs.export import export_run

    progress = LineProgress(plain_console(stderr=True))
    report = export_run(
        arguments.run_dir, arguments.format, arguments.out, arguments.options, arguments.force, progress
    )
    print_report(report, arguments.json)
    return 0


def _help(words: Sequence[str]) -> str:
    """The text below the arguments, for the words after ``neuprim export``; "" if they do not ask for help.

    Without a format only package metadata is read; with one, that exporter is imported.

    Raises:
        ConfigError, PluginError: there is no such format, or it is broken.
    """
    if not {"-h", "--help"} & set(words):
        return ""
    return "\n".join(_of_all() if (name := _format(words)) is None else _of_one(name))


def _format(words: Sequence[str]) -> str | None:
    for word, following in zip(words, [*words[1:], ""], strict=True):
        key, equals, value = word.partition("=")
        if key == "--format" and (value if equals else following and not following.startswith("-")):
            return value if equals else following
    return None


def _of_all() -> Iterator[str]:
    from neuprim.plugins.registry import EXPORTERS

    yield "formats:"
    for info in EXPORTERS.list_plugins():
        yield f"  {info.name}  ({info.origin})"
    yield ""
    yield "KEY=VALUE is an option of the format: `neuprim export --format NAME --help` lists them with their defaults."


def _of_one(name: str) -> Iterator[str]:
    from neuprim.plugins.registry import EXPORTERS

    info, exporter = EXPORTERS.load_with_info(name)
    yield f"--format {name}  ({info.origin}): {exporter.summary}"
    rows = [(f"{option}={_shown(default)}", help_) for option, (default, help_) in exporter.options.items()]
    yield f"options of --format {name}, with their defaults:" if rows else f"--format {name} has no options"
    indent = 4 + max((len(first) for first, _ in rows), default=0)
    for first, second in rows:
        yield textwrap.fill(f"  {first:{indent - 4}}  {second}", _WIDTH, subsequent_indent=" " * indent)
    if exporter.conditions:
        yield "conditions of the run's task: --NAME TEXT or NAME=TEXT, as --time 0.5 or light=1,2,3"


def _shown(value: Any) -> str:
    """As a user writes it; nothing for an option that is not set."""
    return {None: "", True: "true", False: "false"}[value] if value is None or isinstance(value, bool) else str(value)


def print_report(report: ExportReport, as_json: bool) -> None:
    """The report on standard output, for people or for programs."""
    if as_json:
        errors = {name: value if math.isfinite(value) else None for name, value in report.errors.items()}
        record = {
            "files": [str(p) for p in report.files],
            "lossless": report.lossless,
            "errors": errors,
            "notes": list(report.notes),
        }
        print(json.dumps(record, indent=1, allow_nan=False))
        return
    print(*report.files, sep="\n")
    print("lossless" if report.lossless else "lossy")
    print(*_table(report.errors), sep="\n", end="\n" if report.errors else "")
    for note in report.notes:
        print(f"note: {note}")


def _table(errors: Mapping[str, float]) -> list[str]:
    """A line per number; numbers of several things, as ``frame_0007.relative_l2``, in a line per thing."""
    rows: dict[str, dict[str, str]] = {}
    for name, value in errors.items():
        thing, _, key = name.rpartition(".")
        rows.setdefault(thing, {})[key] = f"{value:.4f}"
    columns = list(dict.fromkeys(key for row in rows.values() for key in row))
    if "" in rows or len(rows) < 2:
        width = max((len(name) for name in errors), default=0)
        return [f"{name:{width}}  {value:.4f}" for name, value in errors.items()]
    first, widths = max(map(len, rows)), [max(len(key), 9) for key in columns]
    lines = [("", columns), *((thing, [row.get(key, "") for key in columns]) for thing, row in rows.items())]
    return [
        "  ".join([f"{thing:{first}}", *(f"{c:>{w}}" for c, w in zip(cells, widths, strict=True))])
        for thing, cells in lines
    ]


COMMAND = Command(
    "export",
    "write a run's model in another format",
    _add_arguments,
    _export,
    epilog=_help,
    take_rest=_take_rest,
    opens_run=True,
)
