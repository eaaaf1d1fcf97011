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
def test_tables_are_those_of_the_recorded_results(
    task: str, page: str, full: str, benchmark: Callable[[str], ModuleType]
) -> None:
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
    count = script.as_many_bytes(13500, *script.PRESETS["equations"])
    short = script.short_table(recorded).splitlines()
    assert len(short) == 6 and "K = 0 with a soft edge, voxels and images | 13,500 |" in short[3]
    assert (
        f"equations 10 to 13 | {count:,} |" in short[4] and "K = 8 with a hard edge, images alone | 5,008 |" in short[5]
    )
    full = script.main_table(recorded).splitlines()
    assert "`quick`, 13,500 primitives" in full[0] and f"`equations`, {count:,} primitives" in full[0]
    assert len({line.count("|") for line in full}) == 1


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
    monkeypatch.setattr(
        sys, "argv", ["benchmark", "--readme", "--docs", *(["--parts", "none"] if task == "relight" else [])]
    )
    script.main()
    for name, text in before.items():
        wanted = re.findall(rf"<!-- {task}-\w+ -->\n.*?<!-- /{task}-\w+ -->", text, re.DOTALL)
        written = (tmp_path / name).read_text(encoding="utf-8")
        assert wanted
        for table in wanted:
            assert (table in written) == ("-baselines" not in table and "-environment" not in table), table[:40]


def test_the_readme_is_a_page_with_one_large_picture_curves_and_a_front_per_task() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 120
    picture, *curves = [target for target in links(README) if target.endswith(".png")]
    assert curves == ["docs/pictures/budgets.png", "docs/pictures/fronts.png"]
    with Image.open(ROOT / picture) as image:
        assert image.width >= 3 * 256 and image.height >= 2 * 256
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
    assert between("README.md", "expressivity") == script.short_table(found["trials"])


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
