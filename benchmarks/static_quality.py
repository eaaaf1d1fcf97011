"""Quality of the static task on a NeRF-synthetic scene: PSNR by primitives and seconds, of the preset and of other forms of the primitive.

    python benchmarks/static_quality.py DIR [--seeds 3] [--rows 2800x60 2000x60x8:0 ...] [--keep] [--readme] [--docs]

DIR holds the scene (transforms_train.json, ...). Every run is `neuprim run task=static scene=blender` with the preset
`quick`, its own form or another, K:EDGE; numbers are means over seeds +- half the spread, on the test views, of the last checkpoint. Results go to
benchmarks/results/static_quality.json. --docs puts the table between the markers in docs/static.md, --readme a short one in README.md;
without DIR nothing is run, and both are made of the recorded results.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image
from shared.forms import PAPER, Form
from shared.machine import cpu_name
from shared.tables import README, ROOT, between_markers, spread

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "static_quality.json"
ROWS = ("2800x60", "7000x120", "7000x300", "2000x60x8:0", "5000x120x8:0", "5000x300x8:0")
DEFAULT = "2:2"
"""What the preset has."""


def one_run(scene: Path, primitives: int, seconds: int, form: str, seed: int) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        words = [f"scene.path='{scene}'", f"model.primitives={primitives}", *Form.named(form).words, f"train.max_seconds={seconds}"]
        words += [f"seed={seed}", f"output_dir='{out}'", "train.iterations=1000000", "train.background=white", "train.eval_every=0"]
        subprocess.run(
            [sys.executable, "-m", "neuprim", "run", "task=static", "scene=blender", *words], check=True, stdout=subprocess.DEVNULL
        )
        return json.loads((out / "metrics.json").read_text())  # type: ignore[no-any-return]


def image_size(scene: Path) -> int:
    """Width of the test images in pixels."""
    frame = json.loads((scene / "transforms_test.json").read_text())["frames"][0]
    with Image.open(scene / f"{frame['file_path']}.png") as image:
        return image.width


def table(results: dict[str, Any]) -> str:
    lines = [
        "| primitives | form | training | PSNR | worst view | SSIM | steps | model |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in results["rows"]:
        runs = row["runs"]
        lines.append(
            f"| {row['primitives']} | {shown(row)} | {row['seconds']} s | {spread([r['psnr'] for r in runs], 2)} dB "
            f"| {spread([r['psnr_worst'] for r in runs], 1)} dB | {spread([r['ssim'] for r in runs], 4)} "
            f"| {round(statistics.mean(r['iterations'] for r in runs))} | {runs[0]['model_bytes'] / 1e6:.2f} MB |"
        )
    note = f"\n{results['scene']}, {results['views']} test views, {results['seeds']} seed(s), {results['cores']} cores of {results['cpu']}."
    return "\n".join(lines) + "\n" + note


def shown(row: dict[str, Any]) -> str:
    return Form.named(row["form"]).label + (", the default" if row["form"] == DEFAULT else "")


def short_table(results: dict[str, Any]) -> str:
    """The default and the paper's form, the fewest and the most primitive-seconds of each."""
    rows = sorted(results["rows"], key=lambda row: row["primitives"] * row["seconds"])
    lines = [
        f"| {results['name']}, {results['size']}×{results['size']} | primitives | training | PSNR | SSIM | hardest of {results['views']} views |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for form in (DEFAULT, str(PAPER)):
        own = [row for row in rows if row["form"] == form]
        for row in dict.fromkeys((id(own[0]), id(own[-1]))) if own else ():
            lines.append(_short(next(r for r in own if id(r) == row)))
    return "\n".join(lines)


def _short(row: dict[str, Any]) -> str:
    runs = row["runs"]
    return (
        f"| {shown(row)} | {row['primitives']:,} | {row['seconds']} s | {spread([r['psnr'] for r in runs], 2)} dB "
        f"| {spread([r['ssim'] for r in runs], 4)} | {spread([r['psnr_worst'] for r in runs], 1)} dB |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("scene", type=Path, nargs="?")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--rows", nargs="*", default=list(ROWS), help="PRIMITIVESxSECONDS[xK:EDGE]")
    parser.add_argument("--keep", action="store_true", help="keep the recorded rows that are not measured now")
    parser.add_argument("--readme", action="store_true", help="write the recorded results into README.md, in short")
    parser.add_argument("--docs", action="store_true", help="write the recorded table into docs/static.md")
    args = parser.parse_args()
    if args.scene:
        from neuprim.core.compute.threads import core_count

        results: dict[str, Any] = {"cpu": cpu_name(), "cores": core_count(), "seeds": args.seeds, "rows": []}
        if args.keep:
            results["rows"] = json.loads(RESULTS.read_text())["rows"]
        for text in args.rows:
            parts = text.split("x")
            primitives, seconds = int(parts[0]), int(parts[1])
            form = parts[2] if len(parts) > 2 else DEFAULT
            runs = [one_run(args.scene.resolve(), primitives, seconds, form, seed) for seed in range(args.seeds)]
            keys = ("psnr", "psnr_worst", "ssim", "iterations", "train_seconds", "model_bytes", "parameters_per_primitive", "seed")
            results["rows"] = [r for r in results["rows"] if (r["primitives"], r["seconds"], r["form"]) != (primitives, seconds, form)]
            results["rows"].append(
                {"primitives": primitives, "seconds": seconds, "form": form, "runs": [{k: r[k] for k in keys} for r in runs]}
            )
            results["name"], results["size"] = "NeRF-synthetic " + args.scene.resolve().name.partition("_")[0], image_size(args.scene)
            results["scene"], results["views"], results["versions"] = runs[0]["dataset"], len(runs[0]["per_view"]), runs[0]["versions"]
            RESULTS.parent.mkdir(exist_ok=True)
            RESULTS.write_text(json.dumps(results, indent=1) + "\n")  # after every row: a long benchmark may be cut short
            print(table(results), flush=True)
    results = json.loads(RESULTS.read_text())
    if args.readme:
        between_markers(README, "static-quality", short_table(results))
    if args.docs:
        between_markers(ROOT / "docs" / "static.md", "static-quality", table(results))
    if not args.scene:
        print(table(results))


if __name__ == "__main__":
    main()
