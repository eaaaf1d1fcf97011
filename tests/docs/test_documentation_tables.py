"""Tables of numbers in README and on the site are what the benchmarks recorded, and the README stays a page."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
from PIL import Image

from tests.docs.pages import ROOT, links, prose

RESULTS = ROOT / "benchmarks" / "results"
README = ROOT / "README.md"


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    """A script of ``benchmarks/`` as a module."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return importlib.import_module


def between(page: str, name: str) -> str:
    """What stands between a page's markers of this name, of which it has one pair."""
    found = re.findall(rf"<!-- {name} -->\n(.*?)\n?<!-- /{name} -->", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)
    assert len(found) == 1, f"{page}: {len(found)} pairs of markers {name}"
    return str(found[0])


@pytest.mark.parametrize(
    ("task", "page", "full"),
    [
        ("static", "docs/static.md", "table"),
        ("dynamic", "docs/dynamic.md", "main_table"),
        ("relight", "docs/relighting.md", "quality_table"),
    ],
)
def test_tables_are_those_of_the_recorded_results(task: str, page: str, full: str, benchmark: Callable[[str], ModuleType]) -> None:
    script = benchmark(f"{task}_quality")
    recorded: dict[str, Any] = json.loads((RESULTS / f"{task}_quality.json").read_text(encoding="utf-8"))
    short = script.short_table(recorded)
    assert between("README.md", f"{task}-quality") == short
    assert between(page, f"{task}-quality").startswith(getattr(script, full)(recorded))
    assert len(short.splitlines()) <= 6, "the README's tables are small"
    header = short.splitlines()[0]
    assert re.search(r"\d+×\d+", header) and "primitives" in header and "training" in header and "hardest" in header


def test_the_dynamic_tables_say_which_preset_is_which(benchmark: Callable[[str], ModuleType]) -> None:
    script = benchmark("dynamic_quality")
    recorded: dict[str, Any] = json.loads((RESULTS / "dynamic_quality.json").read_text(encoding="utf-8"))
    quick = [run for run in recorded["main"] if script.preset_of(run) == "quick"]
    other = [
        run
        | {
            "preset": "equations",
            "as_many_as": run["primitives"],
            "primitives": script.as_many_bytes(run["primitives"], "preset=equations"),
        }
        for run in quick
    ]
    short = script.short_table({"main": [*other, *quick]}).splitlines()
    assert len(short) == 5 and "windows and motion | 5,000 |" in short[3] and "equations 10 to 13 | 2,168 |" in short[4]
    full = script.main_table({"main": [*other, *quick]}).splitlines()
    assert (
        "`quick`, 5,000 primitives" in full[0]
        and "`equations`, 2,168 primitives" in full[0]
        and len({line.count("|") for line in full}) == 1
    )


@pytest.mark.parametrize("task", ["static", "dynamic", "relight"])
def test_a_benchmark_rewrites_its_tables_without_measuring(
    task: str, benchmark: Callable[[str], ModuleType], tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = benchmark(f"{task}_quality")
    page = {"static": "static", "dynamic": "dynamic", "relight": "relighting"}[task]
    before = {}
    for name in ("README.md", f"docs/{page}.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        emptied = re.sub(r"(<!-- (\w+-\w+) -->\n).*?(<!-- /\2 -->)", r"\1\3", text, flags=re.DOTALL)
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(emptied, encoding="utf-8")
        before[name] = text
        assert len(emptied) < len(text)
    monkeypatch.setattr(script, "README", tmp_path / "README.md")
    monkeypatch.setattr(script, "ROOT", tmp_path)
    monkeypatch.setattr(sys, "argv", ["benchmark", "--readme", "--docs", *(["--parts", "none"] if task == "relight" else [])])
    script.main()
    for name, text in before.items():
        wanted = re.findall(rf"<!-- {task}-\w+ -->\n.*?<!-- /{task}-\w+ -->", text, re.DOTALL)
        written = (tmp_path / name).read_text(encoding="utf-8")
        assert wanted
        for table in wanted:
            assert (table in written) == ("-baselines" not in table and "-environment" not in table), table[:40]


def test_the_readme_is_a_page_with_one_large_picture() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 120
    (picture,) = [target for target in links(README) if target.endswith(".png")]
    with Image.open(ROOT / picture) as image:
        assert image.width >= 3 * 256 and image.height >= 2 * 256
    assert "generated data" in prose(README).lower()
