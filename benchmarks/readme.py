"""Write the README's table of results from what the other benchmarks recorded; measures nothing.

    python benchmarks/readme.py

Each row compares the default with the paper's form at about equal bytes. The records are made by dynamic_quality.py,
quality.py and expressivity.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from shared.tables import README, RESULTS, Run, Table, between_markers, read_trials, spread

RELIGHT_BUDGET = "120 s"
EQUATION_14 = "model.colour.form=additive model.primitives=2655 train.loss=l1 train.rates.c_dc=5e-3"


def psnr_cell(runs: Sequence[Run], key: str, **facts: Any) -> str:
    """Mean of ``key`` over the runs with these facts, with half the spread over seeds."""
    values = [run[key] for run in runs if all(run.get(name) == value for name, value in facts.items())]
    return f"{spread(values, 2)} dB"


def results_table() -> str:
    """The table in Markdown."""
    table = Table("scene", "model", "training", "default", "the paper's form")
    runs = read_trials(RESULTS / "expressivity.json")
    cells = [psnr_cell(runs, "psnr", part="forms", scene="solids", size=2000, form=form) for form in ("2:2", "8:0")]
    table.row("`solids` (generated), 200×200", "0.8 MB", "equal time", *cells)
    runs = read_trials(RESULTS / "dynamic_quality.json")
    cells = [psnr_cell(runs, "psnr_mask", part="main", preset=preset) for preset in ("quick", "equations")]
    table.row("EmberGen fire, 40 frames, 96×96, inside the mask", "1.2 MB", "4,000 steps", *cells)
    runs = read_trials(RESULTS / "relight.json")
    facts = {"scene": "lit_solids", "budget": RELIGHT_BUDGET}
    for key, pixels in (("psnr_display", "all pixels"), ("psnr_pooled_cast_shadow", "cast shadows")):
        cells = [psnr_cell(runs, key, settings=settings, **facts) for settings in ("", EQUATION_14)]
        table.row(f"`lit_solids` (generated), 256×256, {pixels}", "1.3 MB", "equal time", *cells)
    return str(table)


if __name__ == "__main__":
    between_markers(README, "results", results_table())
