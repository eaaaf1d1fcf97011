"""The reference pages are those that ``docs/make_reference.py`` makes, and describe every argument and setting."""

from __future__ import annotations

import argparse
import importlib.util
import re
import sys
from types import ModuleType

import pytest

from neuprim.cli import COMMANDS
from tests.docs.pages import ROOT


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_reference", ROOT / "docs" / "make_reference.py")
    assert spec is not None and spec.loader is not None
    sys.modules[spec.name] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_pages_are_current(script: ModuleType) -> None:
    for page, text in script.pages().items():
        assert page.read_text(encoding="utf-8") == text, f"{page.name}: run python docs/make_reference.py"


def test_every_setting_has_a_meaning(script: ModuleType) -> None:
    """A setting without one in its docstring is a KeyError; one of a scene has an empty cell."""
    rows = re.findall(r"^\| `?([\w.]+)`? \|.*\| ([^|]*) \|$", script.make_settings_page(), re.MULTILINE)
    keys = {key for key, _ in rows}
    assert keys >= {"task", "train.iterations", "train.population.stop", "renderer.near", "launcher", "target.psnr"}
    assert keys >= {"viewer.port", "seed", "scene.path", "scene.optics.albedo", "metrics.lpips"} and len(rows) > 150
    assert [key for key, meaning in rows if not meaning.strip()] == []


def test_every_argument_has_a_help(script: ModuleType) -> None:
    page = script.make_cli_page()
    for name, command in COMMANDS.items():
        assert f"\n## neuprim {name}\n" in page
        for action in command.build_parser()._actions:
            assert action.help and action.help != argparse.SUPPRESS, (name, action.dest)
            assert all(flag in page for flag in action.option_strings if flag not in ("-h", "--help"))


def test_cells_are_safe_in_a_table(script: ModuleType) -> None:
    text = "a|b <c> :class:`~neuprim.core.Lpips` ``x|y`` and\n ``z``"
    assert script.cell(text) == "a&#124;b &lt;c&gt; `Lpips` <code>x&#124;y</code> and `z`"
