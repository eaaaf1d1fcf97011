"""What each of the settings for photographs does, one at a time and together.

    python benchmarks/photographs.py [--scenes cup room_80 room_20] [--cup DIR] [--primitives 5000] [--steps 800]
    [--seeds 1] [--only ROW …] [--jobs 2] [--docs] [--print]

``cup`` is a COLMAP reconstruction of photographs of a cup before walls without texture (--cup), averaged down to 200 x
150; ``room_80`` and ``room_20`` are the built-in `scene=room` with as many photographs. All is the preset `quick` but
what the row names. Held-out photographs, last checkpoint; *a gain away* is the
PSNR after the best gain per channel of each view, as no model can know how a photograph that it has not seen was
exposed. Times are those that one thread computed. Results go to benchmarks/results/photographs.json after every run,
and only what is missing is run. --docs puts the table between the markers of docs/static.md.
"""

from __future__ import annotations

import argparse
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from shared.tables import ROOT, Table, between_markers, spread
from shared.trials import Trial, recorded, run_all

from neuprim.core.compute.threads import cpu_name

RESULTS = Path(__file__).parent / "results" / "photographs.json"
SCENES = {
    "cup": ("scene=colmap", "scene.downsample=4"),
    "room_80": ("scene=room",),
    "room_20": ("scene=room", "scene.train_views=20"),
}
TITLES = {"cup": "cup, 67 photographs", "room_80": "`room`, 80 photographs", "room_20": "`room`, 20 photographs"}
PIECES = {
    "`quick`": (),
    "`train.angular_size=null`": ("train.angular_size=null",),
    "all primitives from the start, no limit, no cool-down": (
        "train.angular_size=null",
        "train.population.grow_from=1",
        "train.cooldown=0",
    ),
    "`model.init.surroundings=0.3`": ("model.init.surroundings=0.3",),
    "`train.angular_size=0.5`": ("train.angular_size=0.5",),
    "`train.coarse=4 train.coarse_until=0.4`": ("train.coarse=4", "train.coarse_until=0.4"),
    "`train.exposure_rate=3e-3`": ("train.exposure_rate=3e-3",),
}
FOUR = tuple(PIECES)[3:]
TOGETHER = "these four"


def wanted(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Of a run's metrics, what is recorded."""
    views = sorted(metrics["per_view"], key=lambda v: v["psnr"])
    kept = {key: metrics[key] for key in ("psnr", "ssim", "psnr_gain", "primitives")}
    return kept | {"views": [[v["name"], round(v["psnr"], 3)] for v in views]}


def trials(args: argparse.Namespace) -> list[Trial]:
    rows = {**PIECES, TOGETHER: tuple(word for name in FOUR for word in PIECES[name])}
    made = []
    for seed in range(args.seeds):
        for scene in args.scenes:
            data = (*SCENES[scene], *((f"scene.path='{args.cup.resolve()}'",) if scene == "cup" else ()))
            for row, words in rows.items():
                if args.only and row not in args.only:
                    continue
                name = f"{scene}-{row.replace('`', '')}-{args.primitives}-{args.steps}-{seed}"
                every = ("task=static", *data, *words, f"model.primitives={args.primitives}")
                made.append(Trial(name, every, args.steps, seed, facts=(("scene", scene), ("row", row))))
    return made


def table(rows: Sequence[Mapping[str, Any]]) -> Table:
    made = Table("200×150 pixels", "setting", "PSNR", "a gain away", "worst two views", "SSIM", "seconds of a core")
    order = [*PIECES, TOGETHER]
    for scene in SCENES:
        for name in order:
            own = [row for row in rows if (row["scene"], row["row"]) == (scene, name)]
            if not own:
                continue
            worst = " and ".join(f"{statistics.mean(row['views'][place][1] for row in own):.1f}" for place in (0, 1))
            cells = (spread([row[key] for row in own], 2) for key in ("psnr", "psnr_gain"))
            made.row(
                TITLES[scene],
                name,
                *cells,
                worst,
                spread([row["ssim"] for row in own], 4),
                f"{statistics.mean(row['cpu_seconds'] for row in own):.0f}",
            )
    return made


def caption(rows: Sequence[Mapping[str, Any]]) -> str:
    counts, steps = ({row[key] for row in rows} for key in ("primitives", "iterations"))
    seeds = sorted(Counter((row["scene"], row["row"]) for row in rows).values())
    said = " to ".join(str(n) for n in dict.fromkeys((seeds[0], seeds[-1])))
    return (
        f"{' or '.join(f'{n:,}' for n in sorted(counts))} primitives, "
        f"{' or '.join(f'{n:,}' for n in sorted(steps))} steps, {said} seed(s)."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--cup", type=Path, help="a COLMAP reconstruction with its images")
    parser.add_argument("--primitives", type=int, default=5000)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument(
        "--only",
        nargs="*",
        default=[],
        choices=[*PIECES, TOGETHER],
        metavar="ROW",
        help="these rows alone, as the table calls them",
    )
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    if not args.only_print:
        if "cup" in args.scenes and args.cup is None:
            parser.error("--cup: wants the folder of its reconstruction; or leave it out of --scenes")
        run_all(trials(args), RESULTS, wanted, args.jobs, lambda row: f"{row['psnr']:.2f} dB", {"cpu": cpu_name()})
    rows = recorded(RESULTS)
    made = table(rows)
    if args.docs:
        between_markers(ROOT / "docs" / "static.md", "photographs", f"{made}\n\n{caption(rows)}")


if __name__ == "__main__":
    main()
