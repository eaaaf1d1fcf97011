"""Does more training make better models? PSNR on the test views by budget, each twice the one before.

    python benchmarks/budget.py [--scenes chair smoke_fire fire lit_solids] [--chair DIR] [--fire DIR] [--doublings 5] [--seeds 1]
        [--most 3] [--jobs 2] [--set KEY=VALUE ...] [--label NAME] [--docs] [--print]

Every run is its task's preset `quick` with nothing changed but the number of steps, one view each: steps are the same on every machine. The
shortest budget of a scene is about 15 seconds of two cores of a 2.5 GHz Xeon. Seeds beyond the first run up to --most doublings. A schedule
belongs to its budget, so each budget is a run of its own. PSNR is that of the last checkpoint on the test views. Results go to
benchmarks/results/budget.json after every run, and only what is missing is run. --set and --label measure something else beside the preset,
which the tables leave out. --docs puts table and curves into docs/budgets.md; --print runs nothing.
"""

from __future__ import annotations

import argparse
import json
from itertools import pairwise
from pathlib import Path
from statistics import mean
from typing import Any

from shared.forms import SCENES
from shared.machine import cpu_name
from shared.tables import ROOT, Table, between_markers, spread
from shared.trials import Trial, run_all

RESULTS = Path(__file__).parent / "results" / "budget.json"
PAGE, PICTURE = ROOT / "docs" / "budgets.md", ROOT / "docs" / "pictures" / "budgets.png"
FIRST = {"chair": 640, "smoke_fire": 500, "fire": 500, "lit_solids": 360}
"""Steps of the shortest budget."""
EVERY = {"static": 200, "dynamic": 400, "relight": 200}
"""Steps between two looks at the population, as the presets have them."""
_LIT = ("lit", "cast_shadow", "attached_shadow", "highlight")
JUDGED: dict[str, dict[str, str]] = {
    "chair": {"psnr": "PSNR", "psnr_worst": "worst view"},
    "smoke_fire": {"psnr": "PSNR", "psnr_mask": "inside the mask"},
    "fire": {"psnr": "PSNR", "psnr_mask": "inside the mask"},
    "lit_solids": {
        "psnr_linear_clamped": "PSNR, clamped",
        "psnr_linear": "PSNR, not clamped",
        **{f"psnr_pooled_{c}": c.replace("_", " ") for c in _LIT},
    },
}
"""The first of each is the one that its curve is judged by."""
KEYS = ("primitives", "train_seconds", *dict.fromkeys(key for own in JUDGED.values() for key in own))


def plan(args: argparse.Namespace) -> list[Trial]:
    """The shortest first, so that an early end leaves whole columns."""
    found = []
    for doubling in range(args.doublings + 1):
        for seed in range(args.seeds if doubling <= args.most else 1):
            for scene in args.scenes:
                own = SCENES[scene]
                words = (*own.all_words(vars(args), scene), f"train.population.every={EVERY[own.task]}", *args.set)
                steps = FIRST[scene] * 2**doubling
                facts = (("scene", scene), ("label", args.label))
                found.append(Trial(f"{scene}-{args.label}-{steps}-{seed}", words, steps, seed, 0, facts))
    return found


def curves(trials: list[dict[str, Any]], label: str, key: str, scene: str) -> dict[int, list[float]]:
    """Values of all seeds by budget."""
    found: dict[int, list[float]] = {}
    for run in sorted(trials, key=lambda r: (r["iterations"], r["seed"])):
        if (run["scene"], run["label"]) == (scene, label) and key in run:
            found.setdefault(run["iterations"], []).append(run[key])
    return found


def falls(trials: list[dict[str, Any]], label: str) -> list[str]:
    """Where a doubling of the budget lost more than 0.1 dB, in the mean of the seeds that both have."""
    found = []
    for scene, keys in JUDGED.items():
        for key, shown in keys.items():
            for (few, before), (many, after) in pairwise(curves(trials, label, key, scene).items()):
                both = min(len(before), len(after))
                change = mean(after[:both]) - mean(before[:both])
                if change < -0.1:
                    found.append(f"{scene}, {shown}: {change:+.2f} dB from {few:,} to {many:,} steps")
    return found


def budget_table(found: dict[str, Any], label: str) -> str:
    trials = found["trials"]
    made = Table("scene", "steps", "primitives", "seeds", "PSNR", "change", "other numbers")
    for scene, keys in JUDGED.items():
        first, *others = keys
        own = curves(trials, label, first, scene)
        before: list[float] = []
        for steps, values in own.items():
            runs = [r for r in trials if (r["scene"], r["label"], r["iterations"]) == (scene, label, steps)]
            both = min(len(before), len(values))
            change = f"{mean(values[:both]) - mean(before[:both]):+.2f} dB" if both else ""
            rest = ", ".join(f"{keys[k]} {spread([r[k] for r in runs], 1)}" for k in others if k in runs[0])
            made.row(scene, f"{steps:,}", f"{runs[0]['primitives']:,}", len(runs), f"{spread(values, 2)} dB", change, rest)
            before = values
    lost = falls(trials, label)
    said = "No number falls by more than 0.1 dB." if not lost else "Falls of more than 0.1 dB: " + "; ".join(lost) + "."
    return f"{made}\n\n{said} {found['cpu']}, one thread a run."


def draw_curves(found: dict[str, Any], label: str, path: Path) -> None:
    from matplotlib import pyplot

    scenes = [scene for scene in JUDGED if curves(found["trials"], label, next(iter(JUDGED[scene])), scene)]
    figure, axes = pyplot.subplots(1, len(scenes), figsize=(3.4 * len(scenes), 3.0), squeeze=False, layout="constrained")
    for ax, scene in zip(axes[0], scenes, strict=True):
        for key, shown in JUDGED[scene].items():
            own = curves(found["trials"], label, key, scene)
            ax.plot(list(own), [mean(v) for v in own.values()], marker="o", markersize=3, label=shown)
        ax.set_xscale("log", base=2)
        ax.set(title=scene, xlabel="steps", ylabel="dB")
        ax.set_xticks(list(own), [f"{n:,}" for n in own], fontsize=7)
        ax.legend(fontsize=7)
        ax.grid(alpha=0.3)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(JUDGED), choices=list(JUDGED))
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--fire", type=Path, help="a folder of EmberGen's .vdb files")
    parser.add_argument("--doublings", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--most", type=int, default=3, help="doublings up to which seeds beyond the first run")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time, one thread each")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="further settings of every run")
    parser.add_argument("--label", default="preset", help="what these are recorded under")
    parser.add_argument("--print", action="store_true", help="train nothing")
    parser.add_argument("--docs", action="store_true", help="write table and curves into docs")
    args = parser.parse_args()
    if args.set and args.label == "preset":
        parser.error("--set needs a --label: the preset is measured as it is")
    if not args.print:
        run_all(plan(args), RESULTS, KEYS, args.jobs, lambda row: f"{row[next(iter(JUDGED[row['scene']]))]:.2f} dB", {"cpu": cpu_name()})
    found = json.loads(RESULTS.read_text())
    text = budget_table(found, args.label)
    if args.docs:
        between_markers(PAGE, "budgets", text)
        draw_curves(found, args.label, PICTURE)


if __name__ == "__main__":
    main()
