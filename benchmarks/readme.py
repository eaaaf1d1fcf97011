"""Write the README's table of results from what the other benchmarks recorded. It measures nothing.

    python benchmarks/readme.py

The records are made by quality.py, dynamic_quality.py and expressivity.py. *The paper's form* is the model of the
paper's equations in neuprim, with about as many bytes, trained for as long.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from quality import published_rows
from shared.tables import README, RESULTS, Run, Table, between_markers, read_trials, spread

MIC = ("mic_800", "800×800")
BUDGETS = {
    "240 s": {"the paper, 5k": "the paper, 5,000 primitives"},
    "1200 s": {"the paper, nolimit": "the paper", "3DGS nolimit": "3DGS", "HAC++, small": "HAC++ in 0.46 MB"},
}
"""Of mic: seconds of one CPU thread, and the titles of published rows that are shown beside them."""
RELIT = {"pt_bunny": "`pt_bunny` (path traced), 160×160", "lit_solids": "`lit_solids` (generated), 256×256"}
EQUAL_BYTES = "model.primitives=9250"
EQUATION_14 = (
    "model.colour.form=additive model.primitives=2655 train.loss=l1 train.rates.c_dc=5e-3 train.size_weight=0 "
    "train.population.fraction=0.05 train.population.stop=0.5 train.population.grow_from=1 model.colour.visibility=none"
)


def decibels(runs: Sequence[Run], key: str, **facts: Any) -> str:
    """Mean of ``key`` over the runs with these facts, with half the spread over seeds."""
    values = [run[key] for run in runs if all(run.get(name) == value for name, value in facts.items())]
    return f"{spread(values, 2)} dB"


def results_table() -> str:
    """The table in Markdown."""
    table = Table("scene", "training", "size", "PSNR", "compare")
    runs, published = read_trials(RESULTS / "static.json"), {row["method"]: row for row in published_rows(*MIC)}
    for budget, others in BUDGETS.items():
        facts = {"scene": MIC[0], "budget": budget, "settings": ""}
        (size,) = {run["model_bytes"] for run in runs if all(run[k] == v for k, v in facts.items()) and not run["seed"]}
        beside = ", ".join(f"{title}: {published[name]['psnr']:.2f} dB" for name, title in others.items())
        row = f"NeRF-synthetic mic, {MIC[1]}", f"{budget} of one CPU thread", f"{size / 1e6:.1f} MB"
        table.row(*row, decibels(runs, "psnr", **facts), beside)
    runs = read_trials(RESULTS / "expressivity.json")
    cells = [decibels(runs, "psnr", part="forms", scene="solids", size=2000, form=form) for form in ("2:2", "8:0")]
    table.row("`solids` (generated), 200×200", "equal time", "0.8 MB", cells[0], f"the paper's form: {cells[1]}")
    runs = read_trials(RESULTS / "dynamic_quality.json")
    cells = [decibels(runs, "psnr_mask", part="main", preset=preset) for preset in ("quick", "equations")]
    title = "EmberGen fire, 40 frames, 96×96, inside the mask"
    table.row(title, "4,000 steps", "1.2 MB", cells[0], f"the paper's form: {cells[1]}")
    runs = read_trials(RESULTS / "relight.json")
    for scene, title in RELIT.items():
        facts = {"scene": scene, "budget": "120 s"}
        cells = [decibels(runs, "psnr_linear_clamped", settings=s, **facts) for s in (EQUAL_BYTES, EQUATION_14)]
        table.row(title, "120 s of one CPU thread", "1.3 MB", cells[0], f"the paper's form: {cells[1]}")
    return str(table)


if __name__ == "__main__":
    between_markers(README, "results", results_table())
