"""Does more training make a better model? Every scene at budgets that double, counted in steps, each a run of its own
from the beginning.

    python benchmarks/budget.py [--scenes chair smoke_fire fire lit_solids] [--chair DIR] [--fire DIR] [--doublings 5]
    [--seeds 3]
        [--set KEY=VALUE ...] [--record FILE] [--jobs 2] [--docs] [--print]

The first budget is about what 15 seconds of one core were when the presets were chosen, the last with --doublings 5
about eight minutes. Schedules run on the used share of a budget, so that each point is what a user gets who asks for so
much, not an early look at a longer run. All is the preset `quick` but the budget; one thread each. The last checkpoint
is judged on the test views. --seeds are for the first four budgets, the longer ones have one. Results go to
benchmarks/results/budget.json after every run, and only what is missing is run; --set changes every run, and wants
another --record.

A *fall* is a doubling after which a measure is more than 0.1 dB worse. --docs puts the tables between the markers of
docs/budgets.md and draws docs/pictures/budgets.png; --print runs nothing.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from shared.forms import SCENES
from shared.tables import ROOT, Table, between_markers, spread
from shared.trials import Trial, recorded, run_all

from neuprim.core.compute.threads import cpu_name

RESULTS = Path(__file__).parent / "results" / "budget.json"
PICTURE = ROOT / "docs" / "pictures" / "budgets.png"
FIRST = {"chair": 640, "smoke_fire": 500, "fire": 500, "lit_solids": 360}
"""Steps of the smallest budget."""
SEVERAL = 4
"""Budgets with all seeds."""
FALL = 0.1
TITLES = {
    "chair": "NeRF-synthetic chair, 200×200",
    "smoke_fire": "`smoke_fire` (simulated), 64×64",
    "fire": "EmberGen fire, 96×96",
    "lit_solids": "`lit_solids` (generated), 128×128",
}
_VOLUME = {"psnr": "all pixels", "psnr_mask": "inside the mask", "psnr_pooled_mask": "inside the mask, pooled"}
_LIT = {
    "psnr_linear_clamped": "clamped",
    "psnr": "unclamped",
    "psnr_pooled_lit": "lit pixels",
    "psnr_pooled_cast_shadow": "cast shadows",
    "psnr_pooled_attached_shadow": "attached shadows",
    "psnr_pooled_highlight": "highlights",
}
MEASURES = {
    "chair": {"psnr": "all pixels", "psnr_worst": "worst view"},
    "smoke_fire": _VOLUME,
    "fire": _VOLUME,
    "lit_solids": _LIT,
}
KEYS = (
    *dict.fromkeys(key for measures in MEASURES.values() for key in measures),
    "ssim",
    "primitives",
    "parameters_per_primitive",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(FIRST), choices=list(FIRST))
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--fire", type=Path, help="a folder of EmberGen's .vdb files")
    parser.add_argument("--doublings", type=int, default=5)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="further settings of every run")
    parser.add_argument("--record", type=Path, default=RESULTS)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    if args.set and args.record == RESULTS:
        parser.error("--set changes what is measured: it wants another --record")
    for name in args.scenes if not args.only_print else []:
        folder = SCENES[name].folder
        if folder and not getattr(args, name):
            parser.error(f"--{name}: wants the folder of its data ({folder}); or leave it out of --scenes")
    if not args.only_print:
        run_all(
            trials(args),
            args.record,
            KEYS,
            args.jobs,
            lambda row: f"{row[SCENES[row['scene']].judged]:.2f} dB",
            {"cpu": cpu_name()},
        )
    rows = recorded(args.record)
    tables = {name: table(name, rows) for name in FIRST if any(row["scene"] == name for row in rows)}
    found = falls(rows)
    print(f"\n{found}")
    if args.docs:
        text = "\n\n".join(f"**{TITLES[name]}**\n\n{made}" for name, made in tables.items())
        between_markers(ROOT / "docs" / "budgets.md", "budgets", f"{text}\n\n{found}")
        draw(rows)


def trials(args: argparse.Namespace) -> list[Trial]:
    """Short budgets first, so that a benchmark that is cut short has whole curves for as far as it came."""
    made = []
    for doubling in range(args.doublings + 1):
        for seed in range(args.seeds if doubling < SEVERAL else 1):
            for name in args.scenes:
                steps = FIRST[name] << doubling
                words = (*SCENES[name].all_words(vars(args), name), *args.set)
                facts = (("scene", name), ("doubling", doubling))
                made.append(Trial(f"{name}-{steps}-{seed}", words, steps, seed, facts=facts, interventions=None))
    return made


def values(rows: Sequence[Mapping[str, Any]], scene: str, measure: str) -> dict[int, list[float]]:
    """Of every budget in steps, one number per seed."""
    own = sorted((row for row in rows if row["scene"] == scene), key=lambda row: (row["iterations"], row["seed"]))
    return {
        steps: [row[measure] for row in own if row["iterations"] == steps]
        for steps in dict.fromkeys(r["iterations"] for r in own)
    }


def gains(rows: Sequence[Mapping[str, Any]], scene: str, measure: str) -> list[tuple[int, int, float]]:
    """(steps, steps, dB) of each doubling, between means over the seeds that both have."""
    found = values(rows, scene, measure)
    result = []
    for (few, before), (many, after) in pairwise(found.items()):
        common = min(len(before), len(after))
        result.append((few, many, statistics.mean(after[:common]) - statistics.mean(before[:common])))
    return result


def table(scene: str, rows: Sequence[Mapping[str, Any]]) -> Table:
    budgets = list(values(rows, scene, next(iter(MEASURES[scene]))))
    seconds = {
        n: statistics.mean(r["cpu_seconds"] for r in rows if r["scene"] == scene and r["iterations"] == n)
        for n in budgets
    }
    made = Table("steps (seconds of a core)", *(f"{n:,} ({seconds[n]:.0f} s)" for n in budgets), "last doubling")
    for measure, title in MEASURES[scene].items():
        last = gains(rows, scene, measure)
        cells = (spread(found, 2) for found in values(rows, scene, measure).values())
        made.row(title, *cells, f"{last[-1][2]:+.2f} dB" if last else "–")
    return made


def falls(rows: Sequence[Mapping[str, Any]]) -> str:
    """What became worse by more than ``FALL``, and the budgets after which it did."""
    found = []
    for scene, measures in MEASURES.items():
        for measure, title in measures.items():
            for few, many, gain in gains(rows, scene, measure):
                if gain < -FALL:
                    found.append(f"{TITLES[scene]}, {title}: {gain:+.2f} dB from {few:,} to {many:,} steps")
    doublings = sum(len(gains(rows, scene, measure)) for scene, measures in MEASURES.items() for measure in measures)
    if not found:
        return f"Of {doublings} doublings (every measure by itself) none made anything worse by more than {FALL} dB."
    listed = "\n".join(f"* {line}" for line in found)
    return (
        f"Of {doublings} doublings (every measure by itself) {len(found)} made something worse by more than "
        f"{FALL} dB:\n\n{listed}"
    )


def draw(rows: Sequence[Mapping[str, Any]]) -> None:
    """One panel a scene, every measure a line."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes = [name for name in FIRST if any(row["scene"] == name for row in rows)]
    figure, axes = pyplot.subplots(
        1, len(scenes), figsize=(3.3 * len(scenes), 3.4), constrained_layout=True, squeeze=False
    )
    for axis, scene in zip(axes[0], scenes, strict=True):
        for measure, title in MEASURES[scene].items():
            found = values(rows, scene, measure)
            means = [statistics.mean(v) for v in found.values()]
            (line,) = axis.plot(list(found), means, marker="o", markersize=3.5, label=title)
            axis.fill_between(
                list(found),
                [min(v) for v in found.values()],
                [max(v) for v in found.values()],
                color=line.get_color(),
                alpha=0.2,
            )
        axis.set_xscale("log", base=2)
        axis.set_xticks(list(found), [f"{n:,}" for n in found], rotation=45, fontsize=7)
        axis.set_title(TITLES[scene].replace("`", ""), fontsize=9)
        axis.set_xlabel("steps", fontsize=8)
        axis.tick_params(axis="y", labelsize=7)
        axis.grid(True, alpha=0.3)
        if len(MEASURES[scene]) > 3:  # room for them all below the curves
            low, high = axis.get_ylim()
            axis.set_ylim(low - 0.25 * (high - low), high)
        axis.legend(frameon=False, fontsize=7, loc="lower right", ncols=2 if len(MEASURES[scene]) > 3 else 1)
    axes[0][0].set_ylabel("dB, test views", fontsize=8)
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=120)


if __name__ == "__main__":
    main()
