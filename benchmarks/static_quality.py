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

import argparse
import json
from pathlib import Path
from typing import Any

from PIL import Image
from shared.forms import Form
from shared.tables import ROOT, between_markers, spread
from shared.trials import Trial, run_all

from neuprim.core.compute.threads import cpu_name

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "static_quality.json"
ROWS = ("2800x2500", "7000x4000", "2000x2500x8:0", "5000x4000x8:0")
DEFAULT = "2:2"
"""What the preset has."""
KEYS = ("psnr", "psnr_worst", "ssim", "train_seconds", "model_bytes", "parameters_per_primitive", "primitives")
Group = tuple[int, int, str]
"""Primitives, steps, form."""


def group_of(text: str) -> Group:
    parts = text.split("x")
    return int(parts[0]), int(parts[1]), parts[2] if len(parts) > 2 else DEFAULT


def trial(scene: Path, group: Group, seed: int) -> Trial:
    primitives, steps, form = group
    words = [
        "task=static",
        "scene=blender",
        f"scene.path='{scene}'",
        "train.background=white",
        f"model.primitives={primitives}",
    ]
    words += [*Form.named(form).words, "train.population.every=200"]  # as the preset has it, however short
    return Trial(f"{primitives}-{steps}-{form}-{seed}", tuple(words), steps, seed, 0, (("form", form),))


def described(scene: Path) -> dict[str, Any]:
    """Name, image width and test views of the scene."""
    frames = json.loads((scene / "transforms_test.json").read_text())["frames"]
    with Image.open(scene / f"{frames[0]['file_path']}.png") as image:
        return {
            "scene": scene.name,
            "name": "NeRF-synthetic " + scene.name.partition("_")[0],
            "size": image.width,
            "views": len(frames),
        }


def groups(results: dict[str, Any]) -> dict[Group, list[dict[str, Any]]]:
    """Runs by what they have in common, the default first, then by budget."""
    found: dict[Group, list[dict[str, Any]]] = {}
    for run in results["trials"]:
        found.setdefault((run["primitives"], run["iterations"], run["form"]), []).append(run)
    return dict(sorted(found.items(), key=lambda g: (g[0][2] != DEFAULT, g[0][0] * g[0][1])))


def table(results: dict[str, Any]) -> str:
    lines = [
        "| primitives | form | steps | PSNR | worst view | SSIM | model |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for (primitives, steps, form), runs in groups(results).items():
        lines.append(
            f"| {primitives:,} | {shown(form)} | {steps:,} | {spread([r['psnr'] for r in runs], 2)} dB "
            f"| {spread([r['psnr_worst'] for r in runs], 1)} dB | {spread([r['ssim'] for r in runs], 4)} "
            f"| {runs[0]['model_bytes'] / 1e6:.2f} MB |"
        )
    seeds = max(len(runs) for runs in groups(results).values())
    note = f"\n{results['scene']}, {results['views']} test views, {seeds} seed(s), one thread of {results['cpu']}."
    return "\n".join(lines) + "\n" + note


def shown(form: str) -> str:
    return Form.named(form).label + (", the default" if form == DEFAULT else "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, nargs="?")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--rows", nargs="*", default=list(ROWS), help="PRIMITIVESxSTEPS[xK:EDGE]")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time, one thread each")
    parser.add_argument("--docs", action="store_true", help="write the recorded table into docs/static.md")
    args = parser.parse_args()
    if args.scene:
        scene = args.scene.resolve()
        trials = [trial(scene, group_of(row), seed) for seed in range(args.seeds) for row in args.rows]
        run_all(
            trials,
            RESULTS,
            KEYS,
            args.jobs,
            lambda row: f"{row['psnr']:.2f} dB",
            {"cpu": cpu_name(), **described(scene)},
        )
    results = json.loads(RESULTS.read_text())
    print(table(results))
    if args.docs:
        between_markers(ROOT / "docs" / "static.md", "static-quality", table(results))


if __name__ == "__main__":
    main()
