"""``neuprim export``: write a run's model in another format; ``neuprim import``: make a run of one."""

from __future__ import annotations

import argparse
import json
import math
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.cli.command import Command, print_columns, refuse_argument

if TYPE_CHECKING:
    from neuprim.core.extensions import ExportReport

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
    arguments.run = arguments.run_dir
    if any(word.startswith("-") for word in rest):
        from neuprim.core.conditions import split_words
        from neuprim.runs.open import load_run

        arguments.run = load_run(arguments.run_dir)
        task = arguments.run.task
        _, others = split_words(rest, task.conditions, bare=False)
        for word in others:
            if word.startswith("-"):
                raise refuse_argument(word, parser, task)
    arguments.options = rest
    return []


def _export(arguments: argparse.Namespace) -> int:
    from neuprim.cli.progress import LineProgress
    from neuprim.runs.export import export_run

    out, options = arguments.out, arguments.options
    report = export_run(arguments.run, arguments.format, out, options, arguments.force, LineProgress())
    print_report(report, arguments.json)
    return 0


def _help(words: Sequence[str]) -> str:
    """Return the text below the arguments, for the words after ``neuprim export``; "" if they do not ask for help.

    Without a format only package metadata is read; with one, that exporter is imported.

    Raises:
        ConfigError, PluginError: there is no such format, or it is broken.
    """
    if not {"-h", "--help"} & set(words):
        return ""
    name = None
    for word, following in zip(words, [*words[1:], ""], strict=True):
        key, equals, value = word.partition("=")
        if name is None and key == "--format":
            name = value if equals else following * (not following.startswith("-")) or None
    return "\n".join(_describe_formats() if name is None else _describe_format(name))


def _describe_formats() -> Iterator[str]:
    from neuprim.plugins.registry import EXPORTERS

    yield "formats:"
    for info in EXPORTERS.list_plugins():
        yield f"  {info.name}  ({info.origin})"
    yield ""
    yield "KEY=VALUE is an option of the format: `neuprim export --format NAME --help` lists them with their defaults."


def _describe_format(name: str) -> Iterator[str]:
    from neuprim.plugins.registry import EXPORTERS

    info, exporter = EXPORTERS.load_with_info(name)
    yield f"--format {name}  ({info.origin}): {exporter.summary}"
    rows = [(f"{option}={_show_default(default)}", help_) for option, (default, help_) in exporter.options.items()]
    yield f"options of --format {name}, with their defaults:" if rows else f"--format {name} has no options"
    indent = 4 + max((len(first) for first, _ in rows), default=0)
    for first, second in rows:
        yield textwrap.fill(f"  {first:{indent - 4}}  {second}", _WIDTH, subsequent_indent=" " * indent)
    if exporter.conditions:
        yield "conditions of the run's task: --NAME TEXT or NAME=TEXT, as --time 0.5 or light=1,2,3"


def _show_default(value: Any) -> str:
    return "" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


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
    _print_errors(report.errors)
    for note in report.notes:
        print(f"note: {note}")


def _print_errors(errors: Mapping[str, float]) -> None:
    """Print a line per number; numbers of several things, as ``frame_0007.relative_l2``, in a line per thing."""
    rows: dict[str, dict[str, str]] = {}
    for name, value in errors.items():
        thing, _, key = name.rpartition(".")
        rows.setdefault(thing, {})[key] = f"{value:.4f}"
    if "" in rows or len(rows) < 2:
        width = max((len(name) for name in errors), default=0)
        for name, value in errors.items():
            print(f"{name:{width}}  {value:.4f}")
    else:
        columns = list(dict.fromkeys(key for row in rows.values() for key in row))
        print_columns([("", *columns), *((t, *(row.get(key, "") for key in columns)) for t, row in rows.items())])


def _add_import_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE")
    parser.add_argument("--out", type=Path, required=True, metavar="RUN_DIR", help="new directory")


def _import(arguments: argparse.Namespace) -> int:
    from neuprim.runs.export import import_run

    print(import_run(arguments.file, arguments.out))
    return 0


COMMAND = Command(
    "export", "write a run's model in another format", _export, _add_arguments, _help, _take_rest, opens_run=True
)
IMPORT_COMMAND = Command(
    "import", "make a run directory of an exported .ply or .npz, or of a .neuprim", _import, _add_import_arguments
)
