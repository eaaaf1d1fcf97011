"""Tables of numbers in README and on the site are what the benchmarks recorded, and the README stays a page."""

from __future__ import annotations

import importlib
import json
import re
import statistics
import sys
import time
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tests.docs.pages import ROOT, prose

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
    found = re.findall(
        rf"<!-- {name} -->\n(.*?)\n?<!-- /{name} -->", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL
    )
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
def test_quality_tables_show_the_recorded_results(
    task: str, page: str, full: str, benchmark: Callable[[str], ModuleType]
) -> None:
    recorded: dict[str, Any] = json.loads((RESULTS / f"{task}_quality.json").read_text(encoding="utf-8"))
    table = getattr(benchmark(f"{task}_quality"), full)(recorded)
    assert between(page, f"{task}-quality").startswith(table)


def test_the_readme_is_one_page_with_the_recorded_results(benchmark: Callable[[str], ModuleType]) -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 100
    assert between("README.md", "results") == benchmark("readme").results_table()
    assert "generated data" in prose(README).lower()


def test_the_tables_of_web_pages_are_those_of_the_recorded_results(benchmark: Callable[[str], ModuleType]) -> None:
    script, found = benchmark("webpage"), json.loads((RESULTS / "webpage.json").read_text(encoding="utf-8"))
    assert between("docs/export.md", "webpage") == str(script.page_table(found["runs"]))
    assert between("docs/export.md", "webpage-prepare") == str(script.prepare_table(found["prepare"]))
    assert {run["task"] for run in found["runs"].values()} == {"static", "dynamic", "relight"}
    for run in found["runs"].values():
        assert max(view["whole"] for view in run["views"]) < 1e-5 and len(run["views"]) == 8


def test_the_fronts_are_those_that_were_measured_and_reach_far(benchmark: Callable[[str], ModuleType]) -> None:
    script, found = benchmark("fronts"), json.loads((RESULTS / "fronts.json").read_text(encoding="utf-8"))
    assert found.keys() == script.SCENES.keys(), "one of each task"
    assert between("docs/tradeoffs.md", "fronts") == "\n\n".join(
        script.report(name, found[name]) for name in script.SCENES
    )
    assert all(script.reach(result, "size", "bytes") >= 10 for result in found.values())
    assert all(script.reach(result, "speed", "time_ratio") >= 8 for result in found.values())


def test_targets_are_met_by_models_that_are_hardly_larger_than_a_grids(benchmark: Callable[[str], ModuleType]) -> None:
    script, found = benchmark("target"), json.loads((RESULTS / "target.json").read_text(encoding="utf-8"))
    assert between("docs/tradeoffs.md", "target") == "\n\n".join(
        script.report(name, found[name]) for name in script.SCENES
    )
    for result in (found[name] for name in script.SCENES):
        for run in result["runs"]:
            assert (
                0 <= run["held_out_stored"] - run["target"] <= 0.3
                and run["seconds"] <= run["budget"]
                and run["warning"] is None
            )
        larger = [run["bytes_usual"] / script.smallest(result["grid"], run["target"]) for run in result["runs"]]
        assert statistics.median(larger) <= 1.15 and max(larger) <= 1.25, (
            "where a tenth of a decibel is a tenth of the bytes, seeds differ by that"
        )


def test_the_levels_of_effort_are_those_that_were_measured(benchmark: Callable[[str], ModuleType]) -> None:
    """Both the tables and the files that a run reads."""
    script = benchmark("effort")
    found = {scene: script.recorded(script.file_of(scene)) for scene in script.NAMES if script.file_of(scene).exists()}
    tables = [f"**{script.TITLES[scene]}**\n\n{script.table(rows, scene)}" for scene, rows in found.items()]
    assert len(tables) == 3 and between("docs/tradeoffs.md", "effort") == "\n\n".join(tables)
    for scene, rows in found.items():
        task = script.SCENES[scene].task
        assert (ROOT / "neuprim" / "tasks" / task / "conf" / "effort" / f"{task}.yaml").read_text(
            encoding="utf-8"
        ) == script.frozen(rows, scene)


def test_the_tables_of_the_forms_are_those_of_the_recorded_results(benchmark: Callable[[str], ModuleType]) -> None:
    found = json.loads((RESULTS / "expressivity.json").read_text(encoding="utf-8"))
    script = benchmark("expressivity")
    assert between("docs/expressivity.md", "expressivity") == script.forms_table(found)
    assert between("docs/expressivity.md", "expressivity-gaussian") == script.gaussian_table(found["trials"])


class Busy:
    """Stands for a trainer: each step computes a millisecond, every ``every``-th as many more, and waits for ``waits``
    seconds."""

    def __init__(self, every: int = 0, waits: float = 0.0) -> None:
        self.renderer, self.dataset = SimpleNamespace(threads=1), SimpleNamespace(points=None)
        self.step, self.every, self.waits = 0, every, waits

    def train_step(self) -> None:
        self.step += 1
        begin, due = time.thread_time(), self.every and self.step % self.every == 0
        while time.thread_time() - begin < 1e-3 * (1 + (self.every if due else 0)):
            pass
        time.sleep(self.waits)


def test_paces_are_what_a_thread_computes_with_its_share_of_rare_steps(
    benchmark: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A median would not see every sixteenth step, and a clock on the wall would see what else the machine does."""
    script = benchmark("shared.trials")
    monkeypatch.setattr(script, "compile_kernels", lambda trainer: None)
    took = script.paces_of({"plain": Busy(), "waits": Busy(waits=2e-3), "sometimes more": Busy(every=16)}, 64)
    assert took["plain"] == pytest.approx(1e-3, rel=0.1)
    assert took["waits"] / took["plain"] == pytest.approx(1, rel=0.15)
    assert took["sometimes more"] / took["plain"] == pytest.approx(2, rel=0.1)


def test_forms_of_equal_bytes_are_counted_by_their_parameters(benchmark: Callable[[str], ModuleType]) -> None:
    forms = benchmark("expressivity").Form
    assert [forms.named(text).equal_bytes(2000, "static") for text in ("8:0", "2:2", "0:2", "gaussian")] == [
        2000,
        2829,
        3300,
        3356,
    ]
    assert forms.named("0:2@images").equal_bytes(2000, "dynamic") == 5391
    with_source = forms.named("0:2@images")
    assert (
        "train.supervision=images" in with_source.words
        and str(with_source) == "0:2@images"
        and with_source.label.endswith("images alone")
    )


def test_tables_of_the_card_are_those_recorded(benchmark: Callable[[str], ModuleType]) -> None:
    """Each stands where a record has its part; where none has, nothing does."""
    script = benchmark("shared.gpu_tables")
    records = script.recorded()
    for name, table in script.TABLES.items():
        assert between("docs/gpu.md", name) == table(records), name
    assert "same bits" in between("docs/gpu.md", "gpu-parity")


def test_tables_of_a_card_show_every_number(benchmark: Callable[[str], ModuleType]) -> None:
    script = benchmark("shared.gpu_tables")
    times = {
        "form": "K=8 p=0", "primitives": 5000, "width": 800, "height": 600, "pairs": 12345, "slots": 678901, "delicate": 3,
        "forward_ms": 0.5, "both_ms": 1.25, "step_ms": 2.5, "peak_mb": 123.4,
    }  # fmt: skip
    train = {"scene": "lit_solids", "primitives": 900, "steps": 2000, "step_ms": 3.14159, "psnr": 31.2345, "of": "psnr"}
    records = [
        {"device": "A card", "torch": "2.11", "times": [times], "train": [train]},
        {"device": "None", "torch": "1"},
    ]
    found = script.times_table(records)
    assert found.startswith("A card, torch 2.11:\n\n| form |") and "None" not in found
    assert (
        found.splitlines()[-1] == "| K=8 p=0 | 5,000 | 800×600 | 12,345 | 678,901 | 0.50 | 1.25 | 2.50 | 2000 | 123 |"
    )
    assert script.training_table(records).splitlines()[-1] == "| lit solids | 900 | 2,000 | 3.14 | 31.23 (psnr) |"
    assert script.parity_table(records) == ""


def test_the_table_of_photographs_is_that_of_the_recorded_results(benchmark: Callable[[str], ModuleType]) -> None:
    rows = json.loads((RESULTS / "photographs.json").read_text(encoding="utf-8"))["trials"]
    script = benchmark("photographs")
    assert between("docs/static.md", "photographs") == f"{script.table(rows)}\n\n{script.caption(rows)}"
