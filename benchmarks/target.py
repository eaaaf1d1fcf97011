"""Does `neuprim run … target.psnr=DB budget=…` find the smallest model? A grid search of sizes against target runs of the same scene.

    python benchmarks/target.py [--scenes solids chair] [--chair DIR] [--work DIR] [--docs] [--print]

The grid trains every size at full length, with two degrees of spherical harmonics, judged by the training views that a target run holds out. Between
its points the bytes that a PSNR takes are interpolated (log of bytes over PSNR), so the smallest model is that of a continuous grid. Target runs
search the same scene for two PSNRs that the grid has. *ratio* is bytes of the full run that a target run chose over those of the grid's smallest, both
stored at the usual level. *first full run* is what was expected of it, from trials alone, and what it had; *stored* what the model has, in as few bits as still
meet the target; *bytes* are of that.

It is a reduced comparison: `solids` at 64 pixels, or the chair at 100, one seed, one thread, some minutes of one core. Trainings are kept in --work, so that a
benchmark that is cut short goes on. Results go to benchmarks/results/target.json; --docs puts the tables between the markers of docs/tradeoffs.md,
--print runs nothing.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import tempfile
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from shared.tables import ROOT, Table, between_markers

from neuprim.config import compose, task_of
from neuprim.config.target import Target
from neuprim.core.checkpoint import load_model, save_compressed
from neuprim.core.compressed import USUAL_LEVEL, bit_table
from neuprim.core.compute.machine import cpu_name
from neuprim.core.io.files import write_json
from neuprim.runs.events import Event, Note
from neuprim.runs.open import load_dataset
from neuprim.runs.target import target_run
from neuprim.runs.target.trying import VIEWS
from neuprim.runs.trials import Trial, run_trial

RESULTS = Path(__file__).parent / "results" / "target.json"


@dataclasses.dataclass(frozen=True)
class Scene:
    """Words of a scene, the sizes of the grid, what target runs ask for and their budget, seconds; ``start`` is the size that they begin with."""

    words: tuple[str, ...]
    sizes: tuple[int, ...]
    targets: tuple[float, ...]
    budget: float
    start: int


SCENES = {
    "solids": Scene(("scene=solids", "scene.size=64", "train.iterations=3000"), (40, 80, 160, 320), (26.0, 28.0), 90.0, 400),
    "chair": Scene(("scene=blender", "scene.downsample=2", "train.iterations=3000"), (50, 100, 200, 400), (29.0, 31.0), 150.0, 1000),
}
DEGREES = (3, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=["solids"], choices=list(SCENES))
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--work", type=Path, help="where trainings are kept (default: a temporary folder)")
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    if "chair" in args.scenes and args.chair is None and not args.only_print:
        parser.error("--chair: wants the folder of its data; or leave it out of --scenes")
    found: dict[str, Any] = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
    if not args.only_print:
        with tempfile.TemporaryDirectory() as temporary:
            for name in args.scenes:
                found[name] = measured(name, args.chair, args.work or Path(temporary))
                write_json(RESULTS, {**found, "cpu": cpu_name()})
    texts = [report(name, found[name]) for name in SCENES if name in found]
    if args.docs:
        between_markers(ROOT / "docs" / "tradeoffs.md", "target", "\n\n".join(texts))


def words(name: str, chair: Path | None, out: Path) -> list[str]:
    path = [f"scene.path='{chair}'"] if name == "chair" else []
    return ["task=static", *SCENES[name].words, *path, "renderer.threads=1", f"output_dir='{out}'"]


def measured(name: str, chair: Path | None, work: Path) -> dict[str, Any]:
    """Target runs, and the grid that is judged by the same views."""
    scene, runs = SCENES[name], []
    for psnr in scene.targets:
        out = work / f"{name}-{psnr:g}"
        config = compose([*words(name, chair, out), f"model.primitives={scene.start}", "resume=true"])
        record = target_run(config, Target(psnr=psnr), scene.budget, tell)
        full = [a for a in record.attempts if a.purpose == "full"]
        chosen = next(a for a in full if a.folder == record.chosen)
        runs.append(
            {
                "target": psnr,
                "budget": scene.budget,
                "seconds": record.achieved["seconds"],
                "primitives": chosen.count,
                "words": chosen.words,
                "predicted": chosen.predicted["psnr"],
                "first": [full[0].predicted["psnr"], full[0].quality("psnr")],
                "full_runs": len(full),
                "trials": len(record.attempts) - len(full),
                "held_out": chosen.quality("psnr"),
                "held_out_stored": record.achieved["held_out"]["psnr"],
                "test_stored": record.achieved["test"]["psnr"],
                "bytes_usual": chosen.packed,
                "bytes": record.achieved["packed_bytes"],
                "rounding": record.achieved["rounding"],
                "warning": record.warning,
            }
        )
        hold_out = record.hold_out
    grid = []
    for degree in DEGREES:
        for size in scene.sizes:
            grid.append({"degree": degree, "primitives": size, **point(name, chair, work, degree, size, hold_out)})
            print(f"{name}: {size} primitives, degree {degree}: {grid[-1]['psnr']:.2f} dB, {grid[-1]['bytes']} bytes", flush=True)
    return {"words": scene.words, "hold_out": hold_out, "runs": runs, "grid": grid}


def point(name: str, chair: Path | None, work: Path, degree: int, size: int, hold_out: int) -> dict[str, Any]:
    """A size at full length."""
    out = work / f"{name}-grid-{size}-{degree}"
    config = compose([*words(name, chair, out), f"model.primitives={size}", f"model.sh_degree={degree}", "resume=true"])
    task = task_of(config)
    outcome = run_trial(Trial(config, hold_out, VIEWS), load_dataset(config, task))
    model, _ = load_model(out / "model.safetensors", task)
    packed = out / "packed.neuprim"
    text = (out / "config.yaml").read_text(encoding="utf-8")
    save_compressed(packed, model, task.name, {}, bit_table(USUAL_LEVEL, (), model.specs), text)
    return {"psnr": outcome.psnr, "bytes": packed.stat().st_size, "seconds": outcome.seconds}


def smallest(grid: Sequence[Mapping[str, Any]], psnr: float) -> float:
    """Bytes of the smallest model of the grid that has a PSNR; NaN where none has."""
    found = []
    for degree in DEGREES:
        own = sorted((g for g in grid if g["degree"] == degree), key=lambda g: int(g["primitives"]))
        for a, b in pairwise(own):
            if a["psnr"] <= psnr <= b["psnr"]:
                share = (psnr - a["psnr"]) / (b["psnr"] - a["psnr"])
                found.append(math.exp((1 - share) * math.log(a["bytes"]) + share * math.log(b["bytes"])))
    return min(found, default=math.nan)


def report(name: str, result: Mapping[str, Any]) -> str:
    """Prints both tables of a scene; returns them."""
    title = f"**{name}** (`{' '.join(result['words'])}`), one of {result['hold_out']} training views held out"
    print(f"\n{title}")
    sizes = Table("grid", *(f"degree {degree}" for degree in DEGREES))
    for size in sorted({g["primitives"] for g in result["grid"]}):
        own = {g["degree"]: g for g in result["grid"] if g["primitives"] == size}
        sizes.row(f"{size} primitives", *(f"{own[d]['psnr']:.2f} dB, {own[d]['bytes']:,} bytes" for d in DEGREES))
    print()
    table = Table("target", "found", "time", "trained", "first full run", "held out", "stored", "test views", "bytes", "ratio")
    for run in result["runs"]:
        (value, doubt), had = run["first"]
        turned = "".join(f", {key.rpartition('.')[2]} {v}" for key, v in run["words"].items())
        table.row(
            f"{run['target']:.1f} dB",
            f"{run['primitives']} primitives{turned}",
            f"{run['seconds']:.0f} of {run['budget']:.0f} s",
            f"{run['trials']} trials, {run['full_runs']} full",
            f"{value:.2f} ± {doubt:.2f}, had {had:.2f}",
            f"{run['held_out']:.2f}",
            f"{run['held_out_stored']:.2f}{', level {}'.format(run['level']) if 'level' in run else ''}",  # of records before numbers were as coarse as views allow
            f"{run['test_stored']:.2f}",
            f"{run['bytes']:,}",
            f"{run['bytes_usual'] / smallest(result['grid'], run['target']):.2f}",
        )
    return f"{title}\n\n{sizes}\n\n{table}"


def tell(event: Event) -> None:
    if isinstance(event, Note):
        print(event.text, flush=True)


if __name__ == "__main__":
    main()
