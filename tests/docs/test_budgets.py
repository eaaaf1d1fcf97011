"""The curves of quality against budget are what was recorded, and a fall would be listed."""

from __future__ import annotations

import importlib
import json
import sys
from types import ModuleType
from typing import Any

import pytest

from tests.docs.pages import ROOT


@pytest.fixture
def budget(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return importlib.import_module("budget")


def row(steps: int, seed: int, psnr: float, worst: float = 20.0) -> dict[str, Any]:
    return {
        "scene": "chair",
        "iterations": steps,
        "seed": seed,
        "psnr": psnr,
        "psnr_worst": worst,
        "cpu_seconds": steps / 100,
    }


def test_the_page_shows_what_was_recorded(budget: ModuleType) -> None:
    rows = json.loads(budget.RESULTS.read_text(encoding="utf-8"))["trials"]
    page = (ROOT / "docs" / "budgets.md").read_text(encoding="utf-8")
    for scene in budget.FIRST:
        assert str(budget.table(scene, rows)) in page
    assert budget.falls(rows) in page
    assert budget.PICTURE.exists()


def test_a_fall_is_listed_and_a_small_one_is_not(budget: ModuleType) -> None:
    rows = [row(100, 0, 30.0), row(200, 0, 29.95, 19.8), row(400, 0, 31.0, 21.0)]
    assert budget.gains(rows, "chair", "psnr") == [(100, 200, pytest.approx(-0.05)), (200, 400, pytest.approx(1.05))]
    text = budget.falls(rows)
    assert text.count("\n* ") == 1 and "worst view: -0.20 dB from 100 to 200 steps" in text
    assert "none made anything worse" in budget.falls(rows[::2])


def test_doublings_compare_the_seeds_that_both_budgets_have(budget: ModuleType) -> None:
    rows = [row(100, 0, 30.0), row(100, 1, 40.0), row(200, 0, 31.0)]
    assert budget.gains(rows, "chair", "psnr") == [(100, 200, pytest.approx(1.0))]
    assert "35.00 ± 5.00" in str(budget.table("chair", rows)) and "+1.00 dB" in str(budget.table("chair", rows))


def test_budgets_double_short_ones_first_with_the_population_of_the_preset(budget: ModuleType) -> None:
    args = budget.argparse.Namespace(
        scenes=["lit_solids", "smoke_fire"], doublings=5, seeds=3, set=["train.rates.net_x=1e-2"]
    )
    made = budget.trials(args)
    assert [t.iterations for t in made if t.seed == 0 and t.name.startswith("lit")] == [360 << i for i in range(6)]
    assert sorted({t.iterations for t in made if t.seed == 2 and t.name.startswith("lit")}) == [360, 720, 1440, 2880]
    assert len({t.name for t in made}) == len(made) == 2 * (4 * 3 + 2)
    assert all(t.interventions is None and "train.rates.net_x=1e-2" in t.words for t in made)
