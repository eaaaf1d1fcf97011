"""Modules, objects and files of the repository that pages and docstrings name are there, under the names of today."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import neuprim
from neuprim.moved import MOVED
from tests.docs.pages import PAGES, ROOT, name_of

GROUPS = {"neuprim.tasks", "neuprim.scenes", "neuprim.losses", "neuprim.exporters", "neuprim.inspectors"}
"""Entry-point groups, which are named like modules and are none."""

OF_THE_READER = {"docs/plugins.md": {"tests/test_glow.py"}}
"""Page -> files of packages that its reader writes."""

DOTTED = re.compile(r"(?<![\w./-])neuprim(?:\.[A-Za-z]\w*)+")
PLACE = re.compile(r"(?<![\w./-])(?:neuprim|tests|benchmarks|docs|examples)/[\w./-]*\w/?")
ROLE = re.compile(r":(?:class|func|meth|mod|data|attr|exc):`~?(neuprim[\w.]+)`")


def exists(name: str) -> bool:
    """Whether a dotted name is a module of today, or an object or field in one."""
    parts = name.split(".")
    modules = [".".join(parts[:end]) for end in range(len(parts), 0, -1)]
    if any(module in MOVED for module in modules):
        return False
    for end, module in zip(range(len(parts), 0, -1), modules, strict=True):
        try:
            found = importlib.import_module(module)
        except ImportError:
            continue
        for part in parts[end:]:
            if dataclasses.is_dataclass(found) and part in {f.name for f in dataclasses.fields(found)}:
                return True
            if not hasattr(found, part):
                return False
            found = getattr(found, part)
        return True
    return False


def roles() -> Iterator[tuple[str, str]]:
    """(file, name) of every reference in the package's docstrings."""
    for file in sorted(Path(neuprim.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield from ((file.relative_to(ROOT).as_posix(), name) for name in ROLE.findall(node.value))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_names_on_pages_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    unknown = [name for name in sorted(set(DOTTED.findall(text)) - GROUPS) if not exists(name)]
    gone = [
        path
        for path in sorted(set(PLACE.findall(text)) - OF_THE_READER.get(name_of(page), set()))
        if not (ROOT / path).exists()
    ]
    assert (unknown, gone) == ([], [])


def test_names_in_docstrings_exist() -> None:
    found = sorted(set(roles()))
    assert len(found) > 50
    assert [(file, name) for file, name in found if not exists(name)] == []


@pytest.mark.parametrize(
    "name",
    ["neuprim.core.fields", "neuprim.core.model.fields.RayNets", "neuprim.cores", "neuprim.core.geometry.Geometry"],
)
def test_a_wrong_name_is_noticed(name: str) -> None:
    assert not exists(name)


@pytest.mark.parametrize(
    "name", ["neuprim.rasterize", "neuprim.core.settings.RenderSettings.near", "neuprim.core.io.vdb"]
)
def test_a_right_name_is_not(name: str) -> None:
    assert exists(name)
