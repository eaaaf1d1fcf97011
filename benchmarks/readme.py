"""Write the README's table of results from what the other benchmarks recorded; measures nothing.

    python benchmarks/readme.py

Each row compares the default density with the paper's form at equal bytes. The records are made by dynamic_quality.py,
relight_quality.py and expressivity.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from shared.tables import README, RESULTS, Run, Table, between_markers, read_trials, spread


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
    runs = read_trials(RESULTS / "relight_quality.json")
    for key, pixels in (("psnr_linear_clamped", "all pixels"), ("psnr_pooled_cast_shadow", "cast shadows")):
        names = ("equation 14, visibility per primitive", "equation 14")
        cells = [psnr_cell(runs, key, form=name) for name in names]
        table.row(f"`lit_solids` (generated), 128×128, {pixels}", "1.3 MB", "equal time", *cells)
    return str(table)


if __name__ == "__main__":
    between_markers(README, "results", results_table())
