"""Document the fields of classes by the comments in their code; used by ``mkdocs.yml`` (``mkdocstrings``).

``width: int  # pixels`` gives the class an entry ``width: pixels`` in the section ``Attributes`` of its docstring.
"""

from __future__ import annotations

import tokenize
from functools import cache
from pathlib import Path
from typing import Any

import griffe


@cache
def read_comments(file: Path) -> tuple[dict[int, str], dict[int, str]]:
    """Return the comments of a file by line: those after code, and those on lines of their own."""
    after: dict[int, str] = {}
    alone: dict[int, str] = {}
    with file.open("rb") as source:
        for token in tokenize.tokenize(source.readline):
            if token.type == tokenize.COMMENT:
                own = not token.line[: token.start[1]].strip()
                (alone if own else after)[token.start[0]] = token.string.lstrip("# ")
    return after, alone


def field_comment(field: griffe.Attribute) -> str:
    """Return the comment of a field: the lines before it and the end of its last line."""
    if not isinstance(field.filepath, Path) or field.lineno is None or field.endlineno is None:
        return ""
    after, alone = read_comments(field.filepath)
    parts, line = [after.get(field.endlineno, "")], field.lineno - 1
    while line in alone:
        parts.insert(0, alone[line])
        line -= 1
    return " ".join(filter(None, parts))


class FieldComments(griffe.Extension):
    """Adds entries to the docstrings of classes."""

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:
        fields = [m for name, m in cls.members.items() if isinstance(m, griffe.Attribute) and name[0] != "_"]
        plain = [field for field in fields if field.docstring is None and "property" not in field.labels]
        found = {field.name: comment for field in plain if (comment := field_comment(field))}
        if not found or cls.docstring is None:
            return
        cls.docstring.value = merge_entries(cls.docstring.value, found, list(cls.members))


def merge_entries(text: str, found: dict[str, str], order: list[str]) -> str:
    """Add entries to the section ``Attributes`` of a docstring, in the order of the fields."""
    head, title, section = text.partition("\nAttributes:\n")
    entries = {name: f"    {name}: {comment}\n" for name, comment in found.items()}
    name = ""
    for line in section.splitlines(keepends=True):
        if line.startswith("    ") and line[4] != " ":
            name = line[4:].partition(":")[0]
            entries[name] = ""
        if not line.strip():
            break
        entries[name] += line if line.endswith("\n") else f"{line}\n"
    rest = section.partition("\n\n")[2]
    rank = {field: number for number, field in enumerate(order)}
    lines = "".join(entries[key] for key in sorted(entries, key=lambda key: rank.get(key, -1)))
    return f"{head.rstrip()}\n{title or chr(10) + 'Attributes:' + chr(10)}{lines}" + (f"\n{rest}" if rest else "")
