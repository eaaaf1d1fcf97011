"""What every knob costs and brings, on one scene of each task: the tables of docs/tradeoffs.md.

    python benchmarks/knobs.py [--scenes chair smoke_fire lit_solids] [--chair DIR] [--parts drawing model] [--budget
    15m] [--out DIR] [--docs] [--print]

drawing   the scene trained as its preset has it (into --out, once), then `neuprim tradeoff RUN_DIR`: every knob of
drawing turned alone model     `neuprim tradeoff task=… scene=… budget=…`: every knob of the model turned alone, all
models trained for about the same time

Both take times in rounds that take turns with the run's own settings, or with the model in the middle, so that they are
ratios that survive other work on the machine. What was measured is kept in --out and gone on with; results go to
benchmarks/results/knobs.json. --docs puts the tables between the markers of docs/tradeoffs.md; --print runs nothing.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from shared.forms import SCENES
from shared.tables import ROOT, Table, between_markers

from neuprim.config import compose
from neuprim.core.compute.machine import cpu_name
from neuprim.runs.run import run
from neuprim.search.design.record import Model
from neuprim.search.design.run import DesignRequest, design_run
from neuprim.search.design.variants import CENTRE
from neuprim.search.tradeoff.knobs import COMBINED
from neuprim.search.tradeoff.record import Measured
from neuprim.search.tradeoff.run import Request, seconds_of, tradeoff_run

RESULTS = Path(__file__).parent / "results" / "knobs.json"
NAMES = {"chair": "chair, 200×200", "smoke_fire": "`smoke_fire`, 64×64", "lit_solids": "`lit_solids`, 128×128"}
"""One scene of each task."""
PARTS = ("drawing", "model")
VIEWS, ROUNDS = 5, 15
DRAWING_SECONDS = 300.0
"""Of measuring one run, at most."""
REFERENCE = "reference"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(NAMES), choices=list(NAMES))
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--parts", nargs="*", default=list(PARTS), choices=PARTS)
    parser.add_argument("--budget", default="15m", help="of the models of one scene")
    parser.add_argument("--out", type=Path, default=Path("outputs") / "knobs")
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    if not args.only_print:
        if "chair" in args.scenes and args.chair is None:
            parser.error("--chair: wants the folder of its data; or leave it out of --scenes")
        for scene in args.scenes:
            for part in args.parts:
                keep(scene, part, {"drawing": drawing, "model": models}[part](scene, args))
    found: dict[str, Any] = json.loads(RESULTS.read_text())
    for part in args.parts:
        text = (
            f"{drawing_table(found['drawing'])}\n\n{drawing_caption(found)}"
            if part == "drawing"
            else model_tables(found)
        )
        if args.docs:
            between_markers(ROOT / "docs" / "tradeoffs.md", f"knobs-{part}", text)


def keep(scene: str, part: str, found: Mapping[str, Any]) -> None:
    whole: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    whole["cpu"] = cpu_name()
    whole.setdefault(part, {})[scene] = dict(found)
    RESULTS.write_text(json.dumps(whole, indent=1) + "\n")


def drawing(scene: str, args: argparse.Namespace) -> dict[str, Any]:
    folder = args.out / f"{scene}-run"
    if not (folder / "metrics.json").exists():
        words = SCENES[scene].all_words(vars(args), scene)
        run(compose([*words, f"output_dir='{folder.resolve()}'", "resume=true", "train.eval_every=0"]))
    record = tradeoff_run(Request(folder, VIEWS, ROUNDS, budget=DRAWING_SECONDS), print)
    return {
        "points": [
            point_of(point) for point in record.points if isinstance(point, Measured) and point.knob != COMBINED
        ],
        "left_out": [{"words": list(one.words), "reason": one.reason} for one in record.left_out],
    }


def models(scene: str, args: argparse.Namespace) -> dict[str, Any]:
    words = [
        *SCENES[scene].all_words(vars(args), scene),
        "renderer.threads=1",
        f"output_dir='{(args.out / f'{scene}-models').resolve()}'",
    ]
    _, record = design_run(DesignRequest(words, seconds_of(args.budget), VIEWS, ROUNDS), print)
    made = [point for point in record.points if isinstance(point, Model) and point.knob != COMBINED]
    return {
        "length": record.facts["length"],
        "points": [
            {**point_of(point), "word": point.name, "steps": point.steps, "ms_per_step": point.ms_per_step}
            for point in made
        ],
        "left_out": [{"words": list(one.words) or [one.knob], "reason": one.reason} for one in record.left_out],
    }


def point_of(point: Measured) -> dict[str, Any]:
    return {
        "knob": point.knob,
        "word": " ".join(point.words),
        "psnr": point.quality["psnr"],
        "exact": _finite(point.quality["psnr_exact"]),
        "bytes": point.bytes,
        "time": _finite(point.ratio),
        "spread": point.spread,
        "ms": _finite(point.time),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


# ---------------------------------------------------------------- tables


def reference_of(points: Sequence[Mapping[str, Any]], knob: str = REFERENCE) -> Mapping[str, Any]:
    return next(point for point in points if point["knob"] == knob)


def drawing_table(scenes: Mapping[str, Mapping[str, Any]]) -> Table:
    """Words down; of each scene the time, or the bytes where it changes these, and dB against the run as it is."""
    shown = [scene for scene in NAMES if scene in scenes]
    made = Table("word", *(title for scene in shown for title in (f"{NAMES[scene]}: time", "bytes", "dB")))
    words: dict[str, None] = {}
    for scene in shown:
        words.update(dict.fromkeys(point["word"] for point in scenes[scene]["points"] if point["knob"] != REFERENCE))
    for word in words:
        made.row(f"`{word}`", *(cell for scene in shown for cell in drawing_cells(scenes[scene]["points"], word)))
    return made


def drawing_cells(points: Sequence[Mapping[str, Any]], word: str) -> tuple[str, str, str]:
    own = next((point for point in points if point["word"] == word), None)
    if own is None:
        return "", "", ""
    reference = reference_of(points)
    stored = own["knob"].startswith("store")
    size = f"{own['bytes'] / reference['bytes']:.2f}" if own["bytes"] != reference["bytes"] else ""
    return "" if stored else times(own), size, f"{own['psnr'] - reference['psnr']:+.2f}"


def times(point: Mapping[str, Any]) -> str:
    if point["time"] is None:
        return "not timed"
    return f"{point['time']:.2f}" + ("" if point["spread"] is None else f" ± {point['spread']:.2f}")


def drawing_caption(found: Mapping[str, Any]) -> str:
    parts = []
    for scene, one in found["drawing"].items():
        reference = reference_of(one["points"])
        parts.append(
            f"{NAMES[scene]}: {reference['psnr']:.2f} dB, {reference['bytes']:,} bytes, {reference['ms']:.1f} ms a frame"
        )
    return f"Times and bytes are multiples of the run's own. As the runs draw: {'; '.join(parts)} ({found['cpu']}). {VIEWS} held-out views, one training each."


def model_tables(found: Mapping[str, Any]) -> str:
    """A table per scene: dB against the centre, and what of it the knob changes."""
    parts = []
    for scene, one in found["model"].items():
        centre = reference_of(one["points"], CENTRE)
        print(f"\n{scene}")
        made = Table("model", "dB", "bytes", "time of a frame", "time of a step", "steps", "exact, dB")
        made.row(
            "centre", f"{centre['psnr']:.2f}", f"{centre['bytes']:,}", f"{centre['ms']:.1f} ms", f"{centre['ms_per_step']:.1f} ms", centre["steps"], said(centre)
        )  # fmt: skip
        for point in one["points"]:
            if point is not centre:
                dB, size = f"{point['psnr'] - centre['psnr']:+.2f}", f"{point['bytes'] / centre['bytes']:.2f}"
                made.row(
                    f"`{point['word']}`", dB, size, times(point), f"{point['ms_per_step'] / centre['ms_per_step']:.2f}", point["steps"], said(point)
                )  # fmt: skip
        left = "; ".join(f"`{' '.join(item['words'])}`: {item['reason']}" for item in one["left_out"])
        parts.append(f"**{NAMES[scene]}.** {one['length']}\n\n{made}" + (f"\n\nLeft out: {left}." if left else ""))
    return (
        "\n\n".join(parts)
        + f"\n\nOne training each, {VIEWS} held-out views, {found['cpu']}, one thread; other models' numbers are multiples of the centre's."
    )


def said(point: Mapping[str, Any]) -> str:
    return "–" if point["exact"] is None else f"{point['exact']:.0f}"


if __name__ == "__main__":
    main()
