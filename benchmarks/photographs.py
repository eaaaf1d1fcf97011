"""What the preset `photographs` brings over `quick` on photographs, and what each of its parts does.

    python benchmarks/photographs.py [--cup DIR] [--scenes cup room_80 room_20] [--parts presets pieces] [--seeds 1] [--jobs 2] [--docs] [--print]

    presets   both presets with equally many primitives and steps
    pieces    `quick` on smaller images, and with one thing of `photographs` after another added

``cup`` is a COLMAP reconstruction of photographs of a cup before walls without texture (--cup); ``room_80`` and ``room_20`` are the built-in `scene=room`
with as many photographs. Held-out photographs, last checkpoint; *a gain away* is the PSNR after the best gain per channel of each view, as no model can know
how a photograph that it has not seen was exposed. Times are those that one thread computed. Results go to benchmarks/results/photographs.json after every
run, and only what is missing is run. --docs puts the tables between the markers of docs/static.md.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from shared.machine import cpu_name
from shared.tables import ROOT, Table, between_markers, spread
from shared.trials import Trial, recorded, run_all

RESULTS = Path(__file__).parent / "results" / "photographs.json"
SCENES = {
    "cup": ("scene=colmap", "scene.downsample=2"),
    "room_80": ("scene=room",),
    "room_20": ("scene=room", "scene.train_views=20"),
}
TITLES = {"cup": "cup, 67 photographs, 400×300", "room_80": "`room`, 80 photographs, 200×150", "room_20": "`room`, 20 photographs, 200×150"}
PRESETS = {"cup": (10_000, 1000), "room_80": (3000, 800), "room_20": (3000, 800)}
"""Primitives and steps."""
SMALL = ("scene=colmap", "scene.downsample=4")
PIECES = (
    ("quick", ()),
    ("and surroundings", ("model.init.surroundings=0.3",)),
    ("and a limit to what a camera sees large", ("train.angular_size=0.5",)),
    ("and coarse views at first", ("train.coarse=4", "train.coarse_until=0.4")),
    ("and a gain per photograph", ("train.exposure_rate=3e-3",)),
)


def wanted(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Of a run's metrics, what is recorded."""
    views = sorted(metrics["per_view"], key=lambda v: v["psnr"])
    return {
        "psnr": metrics["psnr"],
        "ssim": metrics["ssim"],
        "psnr_gain": metrics["psnr_gain"],
        "primitives": metrics["primitives"],
        "views": [[v["name"], round(v["psnr"], 3)] for v in views],
    }


def trials(args: argparse.Namespace) -> list[Trial]:
    made = []
    cup = (f"scene.path='{args.cup.resolve()}'",) if args.cup else ()

    def add(part: str, scene: str, row: str, words: Sequence[str], primitives: int, steps: int, seed: int) -> None:
        own = cup if scene == "cup" else ()
        facts = (("part", part), ("scene", scene), ("row", row))
        every = (*words, *own, f"model.primitives={primitives}")
        made.append(Trial(f"{part}-{scene}-{row}-{primitives}-{steps}-{seed}", ("task=static", *every), steps, seed, facts=facts))

    for seed in range(args.seeds):
        if "presets" in args.parts:
            for scene in args.scenes:
                for preset in ("quick", "photographs"):
                    add("presets", scene, preset, (*SCENES[scene], f"preset={preset}"), *PRESETS[scene], seed)
        if "pieces" in args.parts and "cup" in args.scenes:
            words: tuple[str, ...] = ()
            for row, more in PIECES:
                words += more
                add("pieces", "cup", row, (*SMALL, *words), 5000, 1000, seed)
    return made


def table(rows: Sequence[Mapping[str, Any]], part: str) -> Table:
    made = Table(
        "photographs" if part == "presets" else "cup at 200×150, 5,000 primitives, 1,000 steps",
        *(("preset", "primitives", "steps") if part == "presets" else ()), "PSNR", "a gain away", "worst two views", "SSIM", "seconds of a core",
    )  # fmt: skip
    keys = dict.fromkeys((row["scene"], row["row"]) for row in rows if row["part"] == part)
    order = list(SCENES), ["quick", "photographs", *(name for name, _ in PIECES)]
    for scene, name in sorted(keys, key=lambda k: (order[0].index(k[0]), order[1].index(k[1]))):
        own = [row for row in rows if (row["part"], row["scene"], row["row"]) == (part, scene, name)]
        worst = " and ".join(f"{statistics.mean(row['views'][place][1] for row in own):.1f}" for place in (0, 1))
        first = (TITLES[scene], f"`{name}`", f"{own[0]['primitives']:,}", f"{own[0]['iterations']:,}") if part == "presets" else (name,)
        cells = (spread([row[key] for row in own], digits) for key, digits in (("psnr", 2), ("psnr_gain", 2)))
        made.row(
            *first, *cells, worst, spread([row["ssim"] for row in own], 4), f"{statistics.mean(row['cpu_seconds'] for row in own):.0f}"
        )
    return made


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cup", type=Path, help="a COLMAP reconstruction with its images")
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--parts", nargs="*", default=["presets", "pieces"], choices=["presets", "pieces"])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    if not args.only_print:
        if "cup" in args.scenes and args.cup is None:
            parser.error("--cup: wants the folder of its reconstruction; or leave it out of --scenes")
        run_all(trials(args), RESULTS, wanted, args.jobs, lambda row: f"{row['psnr']:.2f} dB", {"cpu": cpu_name()})
    rows = recorded(RESULTS)
    tables = {part: table(rows, part) for part in ("presets", "pieces") if any(row["part"] == part for row in rows)}
    if args.docs:
        for part, made in tables.items():
            between_markers(ROOT / "docs" / "static.md", f"photographs-{part}", str(made))


if __name__ == "__main__":
    main()
