"""The pages of the Python API show what ``__all__`` names, with examples, and docstrings that can be parsed."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from tests.docs.pages import ROOT, blocks, name_of

PAGES = sorted((ROOT / "docs" / "api").glob("*.md"))
NAMED = [(page, name) for page in PAGES for name in re.findall(r"^::: (\S+)$", page.read_text("utf-8"), re.MULTILINE)]
RIDDLE = re.compile(r"\(|(As|How|It|Its|Of|That|Those|What|Where|Whether) ")
"""How the first line of a function's docstring must not begin."""

NOT_SHOWN = {
    "neuprim": {"__version__"},
    "neuprim.config": {
        "Job",
        "check_config_groups",
        "check_scene_config",
        "current_config_provenance",
        "expand_sweep_overrides",
        "find_config_plugins",
        "find_config_scene",
        "list_task_presets",
        "load_config_task",
        "preset_settings",
        "read_task_config",
    },
    "neuprim.core.metrics": {"SSIM_SIGMA", "SSIM_WINDOW"},
}
"""Module -> names in its ``__all__`` that only neuprim's own modules use."""


def module_of(name: str) -> tuple[ModuleType, str]:
    """The module that a documented object is in, and its name there."""
    path, _, last = name.rpartition(".")
    return importlib.import_module(path), last


def objects() -> dict[str, Any]:
    """Every documented object by its full name."""
    return {name: getattr(*module_of(name)) for _, name in NAMED}


def test_pages_show_public_names_once() -> None:
    assert len({name for _, name in NAMED}) == len(NAMED) > 150
    for name, value in objects().items():
        module, last = module_of(name)
        places = [module.__name__.rsplit(".", level)[0] for level in range(module.__name__.count(".") + 1)]
        modules = [module, *map(importlib.import_module, places[1:])]
        assert any(last in getattr(m, "__all__", ()) and getattr(m, last) is value for m in modules), name


def test_every_public_name_is_shown() -> None:
    shown = [value for value in objects().values() if inspect.isclass(value) or inspect.isfunction(value)]
    names = {name for _, name in NAMED}
    missing = []
    for module in {module_of(name)[0] for name in names}:
        public = set(getattr(module, "__all__", ())) - NOT_SHOWN.get(module.__name__, set())
        missing += [
            f"{module.__name__}.{name}"
            for name in sorted(public)
            if f"{module.__name__}.{name}" not in names and not any(getattr(module, name) is value for value in shown)
        ]
    assert missing == []


def test_every_class_has_an_example() -> None:
    code = "\n".join(block.text for page in PAGES for block in blocks(page) if block.language == "python")
    classes = [v for v in objects().values() if inspect.isclass(v) and not issubclass(v, Exception)]
    assert [v.__name__ for v in classes if not re.search(rf"\b{v.__name__}\b", code)] == []


@pytest.mark.parametrize("page", [p for p in PAGES if p.stem != "index"], ids=name_of)
def test_pages_begin_with_their_use(page: Path) -> None:
    first = page.read_text("utf-8").split("\n\n")[1]
    assert first.startswith("Use ") and 2 <= len(re.findall(r"[.](?=\s|$)", first)) <= 4


def test_first_lines_say_what_is_returned_or_done() -> None:
    functions = [value for value in objects().values() if inspect.isfunction(value)]
    for cls in (value for value in objects().values() if inspect.isclass(value)):
        members = [getattr(value, "__func__", value) for name, value in vars(cls).items() if name[0] != "_"]
        functions += [value for value in members if inspect.isfunction(value)]
    assert len(functions) > 250
    assert [f.__qualname__ for f in functions if f.__doc__ and RIDDLE.match(f.__doc__)] == []


def test_every_entry_describes_one_name() -> None:
    """Also those of attributes, which the strict build of the site does not compare with the class."""
    griffe = pytest.importorskip("griffe")
    package = griffe.GriffeLoader(search_paths=[ROOT]).load("neuprim")
    wrong, count = [], 0
    for value in objects().values():
        if not (inspect.isclass(value) or inspect.isfunction(value)):
            continue
        documented = package[f"{value.__module__}.{value.__qualname__}".split(".")[1:]]
        fields = {field.name for field in dataclasses.fields(value)} if dataclasses.is_dataclass(value) else None
        members = [m for m in documented.members.values() if m.is_function] if documented.is_class else []
        for item in (documented, *members):
            for section in item.docstring.parse("google", warnings=False) if item.docstring else ():
                names = [e.name for e in section.value] if section.kind.value in ("attributes", "parameters") else []
                count += len(names)
                known = fields if section.kind.value == "attributes" else {p.name for p in item.parameters}
                wrong += [
                    f"{item.path}: {name}"
                    for name in names
                    if not name.lstrip("*").isidentifier() or (known is not None and name.lstrip("*") not in known)
                ]
    assert count > 350 and wrong == []
