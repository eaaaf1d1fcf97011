"""Tables of numbers in README and on the site are what the benchmarks recorded; README and site stay short."""

from __future__ import annotations

import importlib
import re
import statistics
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest

from tests.docs.pages import ROOT, name_of, prose
from tests.numerics.extremes.regions import REGIONS

Load = Callable[[str], ModuleType]
MARKER = re.compile(r"^<!-- (?!/)(.+) -->$", re.MULTILINE)


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Load:
    """A script of ``benchmarks/`` as a module."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return importlib.import_module


@pytest.fixture
def count_words(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return importlib.import_module("count_words")


def between(page: str, name: str) -> str:
    """What stands between a page's markers of this name, of which it has one pair."""
    text = (ROOT / page).read_text(encoding="utf-8")
    (found,) = re.findall(rf"<!-- {name} -->\n(.*?)\n?<!-- /{name} -->", text, re.DOTALL)
    return str(found)


def record_of(script: ModuleType) -> Any:
    return importlib.import_module("shared.tables").read_record(script.RECORD)


def titled(script: ModuleType, tables: dict[str, Any]) -> str:
    return "\n\n".join(f"**{script.TITLES[scene]}**\n\n{table}" for scene, table in tables.items())


def budgets(script: ModuleType) -> str:
    runs = record_of(script)["trials"]
    tables = titled(script, {scene: script.table(scene, runs) for scene in script.FIRST})
    return f"{tables}\n\n{script.describe_falls(runs)}"


def effort(script: ModuleType) -> str:
    runs = {scene: script.read_trials(script.record_of(scene)) for scene in script.TITLES}
    return titled(script, {scene: script.table(own, scene) for scene, own in runs.items()})


def reports(script: ModuleType) -> str:
    record = record_of(script)
    return "\n\n".join(script.report(name, record[name]) for name in script.SCENES)


TABLES: dict[str, tuple[str, str, Callable[[Any], object]]] = {
    "results": ("README.md", "readme", lambda s: s.results_table()),
    "budgets": ("docs/results/budgets.md", "budget", budgets),
    "static": ("docs/results/static.md", "quality", lambda s: s.table(s.read_record(s.RESULTS / "static.json"))),
    "relight": ("docs/results/relighting.md", "quality", lambda s: s.table(s.read_record(s.RESULTS / "relight.json"))),
    **{
        name: ("docs/results/dynamic.md", "dynamic_quality", lambda s, name=name: s.make_tables(record_of(s))[name])
        for name in ("dynamic-quality", "dynamic-equations", "dynamic-control", "dynamic-voxels")
    },
    "webpage": ("docs/results/performance.md", "webpage", lambda s: s.page_table(record_of(s)["runs"])),
    "webpage-prepare": ("docs/results/performance.md", "webpage", lambda s: s.prepare_table(record_of(s)["prepare"])),
    "lit volumes": ("docs/results/dynamic.md", "lit_volumes", lambda s: s.table(record_of(s))),
    "exported grids": ("docs/results/dynamic.md", "exported_grids", lambda s: s.table(record_of(s))),
    "sparse volumes": ("docs/results/dynamic.md", "sparse_volumes", lambda s: s.document(record_of(s))),
    "multiple scattering": ("docs/results/dynamic.md", "multiple_scattering", lambda s: s.table(record_of(s))),
    "capture": ("docs/results/relighting.md", "capture", lambda s: s.tables(record_of(s))),
    "fronts": ("docs/results/tradeoffs.md", "fronts", reports),
    "target": ("docs/results/tradeoffs.md", "target", reports),
    "effort": ("docs/results/tradeoffs.md", "effort", effort),
    **{
        f"effort-{task}": (
            "docs/results/tradeoffs.md",
            "effort",
            lambda s, task=task: s.table_of_views(s.levels_of_views(task), task),
        )
        for task in ("static", "relight")
    },
    "expressivity": ("docs/results/expressivity.md", "expressivity", lambda s: s.forms_table(record_of(s))),
    "expressivity-gaussian": (
        "docs/results/expressivity.md",
        "expressivity",
        lambda s: s.gaussian_table(record_of(s)["trials"]),
    ),
    **{
        name: ("docs/results/gpu.md", "gpu", lambda s, name=name: s.make_tables(s.read_records())[name])
        for name in ("gpu-parity", "gpu-times", "gpu-frames", "gpu-steps", "gpu-training", "gpu-runs")
    },
    "ranks": ("docs/results/performance.md", "ranks", lambda s: s.pace_table(record_of(s))),
    **{
        name: ("docs/results/performance.md", name, lambda s: s.document(record_of(s)))
        for name in ("render", "edges", "scaling", "sorting")
    },
    "relight-environment": (
        "docs/results/relighting.md",
        "relight_environment",
        lambda s: s.document(record_of(s)),
    ),
    "gaussians-export": ("docs/results/static.md", "gaussians", lambda s: s.document(record_of(s))),
    "gpu-kernels": ("docs/results/gpu.md", "gpu_kernels", lambda s: s.document(record_of(s))),
    "limits": ("docs/results/numerics.md", "numerics", lambda s: s.describe(s.read_rows())),
    "larger-steps": ("docs/results/performance.md", "ranks", lambda s: s.steps_table(record_of(s)["larger steps"])),
}
"""Markers -> their page, the script, and what it makes of its record."""


@pytest.mark.parametrize("name", TABLES)
def test_tables_show_what_was_recorded(name: str, load: Load) -> None:
    page, script, make = TABLES[name]
    if script == "gpu_kernels":
        pytest.importorskip("warp")
    assert between(page, name) == str(make(load(script)))


def test_every_table_of_the_results_is_compared() -> None:
    pages = sorted((ROOT / "docs" / "results").glob("*.md"))
    shown = {(name_of(page), marker) for page in pages for marker in MARKER.findall(page.read_text(encoding="utf-8"))}
    assert len(pages) == 9 and shown == {(page, name) for name, (page, *_) in TABLES.items() if page != "README.md"}


def test_every_region_is_recorded(load: Load) -> None:
    rows = load("numerics").read_rows()
    found = {(row["region"], row["backend"], row["precision"], int(row["edge"])) for row in rows}
    backends = {row[1:3] for row in found}
    assert found == {(r.name, *backend, edge) for r in REGIONS for backend in backends for edge in r.edges}


def test_hand_written_words_are_counted(count_words: ModuleType) -> None:
    text = "# Two words\n\n<!-- table -->\n| a | b |\n<!-- /table -->\n\n| c | d |\n\nthree more words\n"
    assert count_words.hand_written(text, tables=True) == 11 and count_words.hand_written(text, tables=False) == 6
    counts = count_words.count()
    assert "README.md" in counts and "docs/results/static.md" in counts
    assert not any(page.startswith("docs/api/") for page in counts)


def test_the_readme_is_one_page_that_says_what_is_generated() -> None:
    readme = ROOT / "README.md"
    assert len(readme.read_text(encoding="utf-8").splitlines()) <= 100
    assert "generated data" in prose(readme).lower()


def test_recorded_numbers_keep_their_promises(load: Load) -> None:
    runs = record_of(load("webpage"))["runs"].values()
    assert {run["task"] for run in runs} == {"static", "dynamic", "relight"}
    assert all(view["whole"] < 1e-5 for run in runs for view in run["views"])
    fronts = load("fronts")
    for result in record_of(fronts).values():
        assert fronts.reach(result, "size", "bytes") >= 10 and fronts.reach(result, "speed", "time_ratio") >= 8
    target = load("target")
    for result in (record_of(target)[name] for name in target.SCENES):
        for run in result["runs"]:
            assert 0 <= run["held_out_stored"] - run["target"] <= 0.3
            assert run["seconds"] <= run["budget"] and run["warning"] is None
        larger = [run["bytes_usual"] / target.smallest(result["grid"], run["target"]) for run in result["runs"]]
        # where a tenth of a decibel is a tenth of the bytes, seeds differ by that
        assert statistics.median(larger) <= 1.15 and max(larger) <= 1.25


def test_levels_of_effort_are_those_that_were_measured(load: Load) -> None:
    script = load("effort")
    for scene in script.TITLES:
        file = script.levels_path(script.SCENES[scene].task)
        assert file.read_text("utf-8") == script.levels_file(script.read_trials(script.record_of(scene)), scene)
