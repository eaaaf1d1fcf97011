"""The map in CONTRIBUTING.md shows the house as it is: every path on it exists, and every package is on it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.docs.pages import ROOT

LINE = re.compile(r"^ {4}(?P<depth>(?: {2})*)(?P<name>[\w.]+(?:/|\.py))(?: +(?P<text>\S.*))?$")
LONGEST = 100


def the_map() -> list[str]:
    """Lines of the indented block under its heading."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    block = text.split("## The house in one page", 1)[1].split("\nRules:", 1)[0]
    return [line for line in block.splitlines() if line.startswith("    ")]


def entries(lines: list[str], root: Path) -> list[tuple[Path, list[str], str]]:
    """(path, file names in the text beside it, text) of every line."""
    folders: list[Path] = []
    found = []
    for line in lines:
        match = LINE.match(line)
        assert match is not None, f"not a line of the map: {line}"
        depth = len(match["depth"]) // 2
        assert depth <= len(folders), f"indented too far: {line}"
        path = Path(*[folder.name for folder in folders[:depth]], match["name"])
        del folders[depth:]
        if match["name"].endswith("/"):
            folders.append(path)
        text = match["text"] or ""
        found.append((root / path, re.findall(r"\b\w+\.py\b", text), text))
    return found


def missing(lines: list[str], root: Path) -> list[str]:
    """Names on the map that are not in the tree; those in a line's text may lie in its folder or beside it."""
    wrong = []
    for path, others, _ in entries(lines, root):
        if not path.exists():
            wrong.append(path.relative_to(root).as_posix())
        wrong += [
            f"{path.relative_to(root)}: {name}"
            for name in others
            if not any((d / name).is_file() for d in (path, path.parent))
        ]
    return wrong


def left_out(lines: list[str], root: Path) -> list[str]:
    """Packages, and modules directly in the first one or in its core, that no line names; tasks' conf folders are all
    alike."""
    named = {path for path, _, _ in entries(lines, root)}
    named |= {
        folder / name for path, others, _ in entries(lines, root) for name in others for folder in (path, path.parent)
    }
    package = root / lines[0].strip().rstrip("/")
    rooms = {f.parent for f in package.rglob("__init__.py")}
    rooms = {
        room
        for room in rooms
        if "template" not in room.relative_to(package).parts and not (room.name == "conf" and "tasks" in room.parts)
    }
    modules = {f for folder in (package, package / "core") for f in folder.glob("[!_]*.py")}
    return sorted(p.relative_to(root).as_posix() for p in (rooms | modules) - named)


def test_every_path_on_the_map_exists() -> None:
    assert missing(the_map(), ROOT) == []


def test_every_room_is_on_the_map() -> None:
    assert left_out(the_map(), ROOT) == []


def test_the_map_is_one_page_and_says_what_each_place_is_for() -> None:
    lines = the_map()
    assert 50 < len(lines) <= LONGEST
    assert [path.name for path, _, text in entries(lines, ROOT)[1:] if not text] == []


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("      gone.py          text", ["neuprim/gone.py"]),
        ("      gone/            text", ["neuprim/gone"]),
        ("      cli/             gone.py: text", ["neuprim/cli: gone.py"]),
        ("      cli/             doctor.py, moved.py: inside and beside", []),
    ],
)
def test_a_wrong_line_is_noticed(line: str, expected: list[str]) -> None:
    assert missing(["    neuprim/", line], ROOT) == expected
    assert "neuprim/core/render/cpu" in left_out(["    neuprim/", line], ROOT)
