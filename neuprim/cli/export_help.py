"""What ``neuprim export --help`` says about formats: which there are, and the options of the one that ``--format``
names."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from typing import Any

__all__ = ["export_help"]

_WIDTH = 100


def export_help(words: Sequence[str]) -> str:
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
    from neuprim.plugins.registry import list_exporters

    yield "formats:"
    for info in list_exporters():
        yield f"  {info.name}  ({info.origin})"
    yield ""
    yield "KEY=VALUE is an option of the format: `neuprim export --format NAME --help` lists them with their defaults."


def _of_one(name: str) -> Iterator[str]:
    from neuprim.plugins.blame import origin_of
    from neuprim.plugins.registry import EXPORTERS, load_exporter

    exporter = load_exporter(name)
    yield f"--format {name}  ({origin_of(EXPORTERS, name).origin}): {exporter.summary}"
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
