"""What the settings for photographs do, one at a time in equal steps, and the preset that has some of them in equal time.

    python benchmarks/photographs.py [--scenes cup room_80 room_20 cup_400] [--cup DIR] [--steps 800] [--seeds 1] [--only ROW …] [--jobs 2] [--docs] [--print]

``cup`` is a COLMAP reconstruction of photographs of a cup before walls without texture (--cup), averaged down to 200 x 150 and with 5,000 primitives, ``cup_400`` the
same at 400 x 300 with 10,000; ``room_80`` and ``room_20`` are the built-in `scene=room` with as many photographs. All is the preset `quick` but what the row names.
Held-out photographs, last checkpoint; *a gain away* is the PSNR after the best gain per channel of each view, as no model can know how a photograph that it has not
seen was exposed. Times are those that one thread computed; the preset makes more of its cheaper steps, so that they are to be read beside those of `quick`, which are
taken anew with it (--only, --jobs 2: both at once). Results go to benchmarks/results/photographs.json after every run, and only what is missing is run. --docs puts the table between
the markers of docs/static.md.
"""

from __future__ import annotations

import argparse
import json
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from shared.machine import cpu_name
from shared.tables import ROOT, Table, between_markers, spread
from shared.trials import Trial, recorded, run_all

RESULTS = Path(__file__).parent / "results" / "photographs.json"
SCENES = {
    "cup": (5000, ("scene=colmap", "scene.downsample=4")),
    "cup_400": (10000, ("scene=colmap", "scene.downsample=2")),
    "room_80": (5000, ("scene=room",)),
    "room_20": (5000, ("scene=room", "scene.train_views=20")),
}
"""Primitives, and words of the scene."""

TITLES = {
    "cup": "cup, 67 photographs, 200×150, 5,000 primitives",
    "cup_400": "cup, 400×300, 10,000 primitives",
    "room_80": "`room`, 80 photographs, 200×150, 5,000 primitives",
    "room_20": "`room`, 20 photographs, 200×150, 5,000 primitives",
}
PIECES = {
    "`quick`": (),
    "`model.init.surroundings=0.3`": ("model.init.surroundings=0.3",),
    "`train.angular_size=0.5`": ("train.angular_size=0.5",),
    "`train.coarse=4 train.coarse_until=0.4`": ("train.coarse=4", "train.coarse_until=0.4"),
    "`train.exposure_rate=3e-3`": ("train.exposure_rate=3e-3",),
    "`train.size_weight=0.15`": ("train.size_weight=0.15",),
    "`preset=photographs`": ("preset=photographs",),
}
MORE = {"`preset=photographs`": 2.0}
"""Steps over those of `quick`, in about the same time."""


def wanted(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Of a run's metrics, what is recorded."""
    views = sorted(metrics["per_view"], key=lambda v: v["psnr"])
    kept = {key: metrics[key] for key in ("psnr", "ssim", "psnr_gain", "primitives")}
    return kept | {"views": [[v["name"], round(v["psnr"], 3)] for v in views]}


def trials(args: argparse.Namespace) -> list[Trial]:
    made = []
    for seed in range(args.seeds):
        for scene in args.scenes:
            primitives, words = SCENES[scene]
            data = (*words, *((f"scene.path='{args.cup.resolve()}'",) if scene.startswith("cup") else ()))
            for row in args.only or PIECES:
                steps = round(args.steps * MORE.get(row, 1.0))
                name = f"{scene}-{row.replace('`', '')}-{primitives}-{steps}-{seed}"
                every = ("task=static", *data, *PIECES[row], f"model.primitives={primitives}")
                made.append(Trial(name, every, steps, seed, facts=(("scene", scene), ("row", row)), interventions=None))
    return made


def table(rows: Sequence[Mapping[str, Any]]) -> Table:
    made = Table("photographs", "setting", "steps", "PSNR", "a gain away", "worst two views", "SSIM", "seconds of a core")
    for scene in SCENES:
        for name in PIECES:
            own = [row for row in rows if (row["scene"], row["row"]) == (scene, name)]
            if not own:
                continue
            worst = " and ".join(f"{statistics.mean(row['views'][place][1] for row in own):.1f}" for place in (0, 1))
            cells = (spread([row[key] for row in own], 2) for key in ("psnr", "psnr_gain"))
            made.row(
                TITLES[scene],
                name,
                f"{statistics.mean(row['iterations'] for row in own):,.0f}",
                *cells,
                worst,
                spread([row["ssim"] for row in own], 4),
                f"{statistics.mean(row['cpu_seconds'] for row in own):.0f}",
            )
    return made


def caption(rows: Sequence[Mapping[str, Any]]) -> str:
    return f"{len({row['seed'] for row in rows})} seed(s), one thread of {json.loads(RESULTS.read_text())['cpu']}."


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--cup", type=Path, help="a COLMAP reconstruction with its images")
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument(
        "--only", nargs="*", default=[], choices=list(PIECES), metavar="ROW", help="these rows alone, as the table calls them"
    )
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    if not args.only_print:
        if any(scene.startswith("cup") for scene in args.scenes) and args.cup is None:
            parser.error("--cup: wants the folder of its reconstruction; or leave it out of --scenes")
        run_all(trials(args), RESULTS, wanted, args.jobs, lambda row: f"{row['psnr']:.2f} dB", {"cpu": cpu_name()})
    rows = recorded(RESULTS)
    made = table(rows)
    if args.docs:
        between_markers(ROOT / "docs" / "static.md", "photographs", f"{made}\n\n{caption(rows)}")


if __name__ == "__main__":
    main()
