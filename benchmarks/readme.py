"""Write the README's table of results from what the other benchmarks recorded; measures nothing.

    python benchmarks/readme.py

Each row compares the default with the paper's form at about equal bytes. The records are made by dynamic_quality.py,
quality.py and expressivity.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from shared.tables import README, RESULTS, Run, Table, between_markers, read_trials, spread

RELIT = {"pt_bunny": "`pt_bunny` (path traced), 160×160", "lit_solids": "`lit_solids` (generated), 256×256"}
EQUAL_BYTES = "model.primitives=9250"
EQUATION_14 = (
    "model.colour.form=additive model.primitives=2655 train.loss=l1 train.rates.c_dc=5e-3 train.size_weight=0 "
    "train.population.fraction=0.05 train.population.stop=0.5 train.population.grow_from=1 model.colour.visibility=none"
)


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
    for scene, title in RELIT.items():
        facts = {"scene": scene, "budget": "120 s"}
        cells = [psnr_cell(runs, "psnr_linear_clamped", settings=s, **facts) for s in (EQUAL_BYTES, EQUATION_14)]
        table.row(title, "1.3 MB", "equal time", *cells)
    return str(table)


if __name__ == "__main__":
    between_markers(README, "results", results_table())
