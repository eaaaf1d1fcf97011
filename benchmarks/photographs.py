"""What each of the settings for photographs does, one at a time and together.

    python benchmarks/photographs.py [--scenes cup room_80 room_20] [--cup DIR] [--primitives 5000] [--steps 800]
    [--seeds 1] [--only ROW …] [--jobs 2] [--docs] [--print]

``cup`` is a COLMAP reconstruction of photographs of a cup before walls without texture (--cup), averaged down to 200 x
150; ``room_80`` and ``room_20`` are the built-in `scene=room` with as many photographs. All is the preset `quick` but
what the row names. Held-out photographs, last checkpoint; *a gain away* is the PSNR after the best gain per channel of
each view, as no model can know how a photograph that it has not seen was exposed. Times are those that one thread
computed. Results go to benchmarks/results/photographs.json after every run, and only what is missing is run. --docs
puts the table between the markers of docs/static.md.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from shared.arguments import make_parser, require_folders
from shared.tables import (
    DOCS,
    RESULTS,
    Run,
    Table,
    between_markers,
    format_range,
    group_runs,
    make_table,
    read_trials,
    spread_of,
)
from shared.trials import Trial, run_all

RECORD = RESULTS / "photographs.json"
SCENES = {
    "cup": ("scene=colmap", "scene.downsample=4"),
    "room_80": ("scene=room",),
    "room_20": ("scene=room", "scene.train_views=20"),
}
TITLES = {"cup": "cup, 67 photographs", "room_80": "`room`, 80 photographs", "room_20": "`room`, 20 photographs"}
ALL_FROM_START = ("train.angular_size=null", "train.population.grow_from=1", "train.cooldown=0")
ALONE = {
    "`model.init.surroundings=0.3`": ("model.init.surroundings=0.3",),
    "`train.angular_size=0.5`": ("train.angular_size=0.5",),
    "`train.exposure_rate=3e-3`": ("train.exposure_rate=3e-3",),
}
ROWS = {
    "`quick`": (),
    "`train.angular_size=null`": ("train.angular_size=null",),
    "all primitives from the start, no limit, no cool-down": ALL_FROM_START,
    **ALONE,
    "these three": tuple(word for words in ALONE.values() for word in words),
}


def select_numbers(fitted: Any, metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Of a run's metrics, what is recorded."""
    views = sorted(metrics["per_view"], key=lambda v: v["psnr"])
    chosen = {key: metrics[key] for key in ("psnr", "ssim", "psnr_gain", "primitives")}
    return chosen | {"views": [[v["name"], round(v["psnr"], 3)] for v in views]}


def plan(args: argparse.Namespace) -> list[Trial]:
    trials = []
    for seed in range(args.seeds):
        for scene in args.scenes:
            data = (*SCENES[scene], *((f"scene.path='{args.cup.resolve()}'",) if scene == "cup" else ()))
            for row in args.only or ROWS:
                name = f"{scene}-{row.replace('`', '')}-{args.primitives}-{args.steps}-{seed}"
                words = ("task=static", *data, *ROWS[row], f"model.primitives={args.primitives}")
                trials.append(Trial(name, words, args.steps, seed, facts=(("scene", scene), ("row", row))))
    return trials


def worst_views(runs: Sequence[Run]) -> str:
    return " and ".join(f"{statistics.mean(run['views'][place][1] for run in runs):.1f}" for place in (0, 1))


def table(runs: Sequence[Run]) -> Table:
    groups = group_runs(runs, "scene", "row")
    columns = {
        "200×150 pixels": lambda own: TITLES[own[0]["scene"]],
        "setting": lambda own: own[0]["row"],
        "PSNR": lambda own: spread_of(own, "psnr"),
        "a gain away": lambda own: spread_of(own, "psnr_gain"),
        "worst two views": worst_views,
        "SSIM": lambda own: spread_of(own, "ssim", 4),
        "seconds of a core": lambda own: f"{statistics.mean(run['cpu_seconds'] for run in own):.0f}",
    }
    return make_table(columns, [groups[key] for scene in SCENES for row in ROWS if (key := (scene, row)) in groups])


def caption(runs: Sequence[Run]) -> str:
    counts = format_range((run["primitives"] for run in runs), " or ")
    steps = format_range((run["iterations"] for run in runs), " or ")
    seeds = format_range(len(own) for own in group_runs(runs, "scene", "row").values())
    return f"{counts} primitives, {steps} steps, {seeds} seed(s)."


def main() -> None:
    parser = make_parser(__doc__, "--seeds", "--jobs", "--docs", "--print", scenes=SCENES)
    parser.set_defaults(seeds=1)
    parser.add_argument("--cup", type=Path, help="a COLMAP reconstruction with its images")
    parser.add_argument("--primitives", type=int, default=5000)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--only", nargs="*", choices=list(ROWS), metavar="ROW", help="these rows, as in the table")
    args = parser.parse_args()
    if not args.only_print:
        require_folders(parser, args, args.scenes)
        run_all(plan(args), RECORD, select_numbers, args.jobs)
    runs = read_trials(RECORD)
    made = table(runs)
    if args.docs:
        between_markers(DOCS / "static.md", "photographs", f"{made}\n\n{caption(runs)}")


if __name__ == "__main__":
    main()
