"""Quality of the static task on a NeRF-synthetic scene: PSNR by primitives and steps, of the preset and of the paper's
form.

    python benchmarks/static_quality.py DIR [--seeds 3] [--rows 2800x2500 2000x2500x8:0 ...] [--jobs 2] [--docs]

DIR holds the scene (transforms_train.json, ...). Every run is the preset `quick`, its own form or another, K:EDGE, for
so many steps, one view each, on one thread: budgets in steps are the same on every machine. Numbers are means over
seeds +- half the spread, on the test views, of the last checkpoint. Results go to
benchmarks/results/static_quality.json after every run, and only what is missing is run. --docs puts the table between
the markers in docs/static.md; without DIR nothing is run.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from shared.arguments import make_parser
from shared.forms import Form
from shared.tables import DOCS, RESULTS, between_markers, group_runs, make_table, read_record, spread_of
from shared.trials import Trial, run_all

RECORD = RESULTS / "static_quality.json"
ROWS = ("2800x2500", "7000x4000", "2000x2500x8:0", "5000x4000x8:0")
DEFAULT = "2:2"  # the preset's form
KEYS = ("psnr", "psnr_worst", "ssim", "train_seconds", "model_bytes", "parameters_per_primitive", "primitives")


def make_trial(scene: Path, row: str, seed: int) -> Trial:
    """The run of a row, PRIMITIVESxSTEPS[xK:EDGE]."""
    primitives, steps, form = (*row.split("x"), DEFAULT)[:3]
    words = ["task=static", "scene=blender", f"scene.path='{scene}'", "train.background=white"]
    words += [f"model.primitives={primitives}", *Form.named(form).words]
    words.append("train.population.every=200")  # as the preset has it, however short
    return Trial(f"{primitives}-{steps}-{form}-{seed}", tuple(words), int(steps), seed, 0, (("form", form),))


def table(record: dict[str, Any]) -> str:
    """A row per budget and form, the default form first."""
    groups = group_runs(record["trials"], "primitives", "iterations", "form")
    ordered = sorted(groups.values(), key=lambda runs: runs[0]["primitives"] * runs[0]["iterations"])
    columns = {
        "primitives": lambda runs: f"{runs[0]['primitives']:,}",
        "form": lambda runs: form_label(runs[0]["form"]),
        "steps": lambda runs: f"{runs[0]['iterations']:,}",
        "PSNR": lambda runs: f"{spread_of(runs, 'psnr')} dB",
        "worst view": lambda runs: f"{spread_of(runs, 'psnr_worst', 1)} dB",
        "SSIM": lambda runs: spread_of(runs, "ssim", 4),
        "model": lambda runs: f"{runs[0]['model_bytes'] / 1e6:.2f} MB",
    }
    made = make_table(columns, sorted(ordered, key=lambda runs: runs[0]["form"] != DEFAULT))
    seeds = max(len(runs) for runs in ordered)
    source = f"{record['scene']}, {record['views']} test views"
    return f"{made}\n\n{source}, {seeds} seed(s), one thread of {record['cpu']}."


def form_label(form: str) -> str:
    return Form.named(form).label + (", the default" if form == DEFAULT else "")


def main() -> None:
    parser = make_parser(__doc__, "--seeds", "--jobs", "--docs")
    parser.add_argument("scene", type=Path, nargs="?")
    parser.add_argument("--rows", nargs="*", default=list(ROWS), help="PRIMITIVESxSTEPS[xK:EDGE]")
    args = parser.parse_args()
    if args.scene:
        scene = args.scene.resolve()
        views = len(json.loads((scene / "transforms_test.json").read_text())["frames"])
        trials = [make_trial(scene, row, seed) for seed in range(args.seeds) for row in args.rows]
        run_all(trials, RECORD, KEYS, args.jobs, scene=scene.name, views=views)
    text = table(read_record(RECORD))
    if args.docs:
        between_markers(DOCS / "static.md", "static-quality", text)


if __name__ == "__main__":
    main()
