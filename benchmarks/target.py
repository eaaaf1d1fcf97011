"""Does `neuprim run … target.psnr=DB budget=…` find the smallest model? A grid search of sizes against target runs of
the same scene.

    python benchmarks/target.py [--scenes solids chair fire lit_solids] [--chair DIR] [--fire DIR] [--seeds 3] [--work
    DIR] [--grid] [--docs] [--print]

The grid trains every size at full length, as the preset has it and with less of what most of a primitive's numbers hang
on, judged by the training views that a target run holds out; once, with seed 0. Between its points the bytes that a
PSNR takes are interpolated (log of bytes over PSNR), so the smallest model is that of a continuous grid. Target runs
search the same scene with every seed. *ratio* is bytes of the full run that a target run chose over those of the grid's
smallest that has the target, both stored at the usual level. *first full run* is what was expected of it, from trials
alone, and what it had; *stored* what the
model has, pruned and in as few bits as still meet the target; *bytes* are of that.

tests/search/test_size_search.py replays the decisions of a search on the recorded grids in a second.

It is a reduced comparison: half of the presets' views, one thread, some minutes of one core a search. Trainings are
kept in --work, so that a benchmark that is cut short goes on; --grid trains the grid alone. Results go to
benchmarks/results/target.json; --docs puts the tables between the markers of docs/results/tradeoffs.md, --print runs
nothing.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from shared.arguments import make_parser, require_folders
from shared.tables import RESULT_PAGES, RESULTS, Run, Table, between_markers, make_table, read_record, update_record

from neuprim.config import Job, compose, load_config_task
from neuprim.config.command_settings import SearchTarget
from neuprim.core.checkpoint import load_model_checkpoint, save_compressed
from neuprim.core.compression.quantizers import DEFAULT_LEVEL, bit_table
from neuprim.core.compute.threads import cpu_name
from neuprim.runs.fit import Event, Note
from neuprim.runs.open import load_dataset
from neuprim.search.target import choose_target_hold_out, run_target
from neuprim.search.target_record import VIEWS
from neuprim.search.trials import Trial, run_trial

RECORD = RESULTS / "target.json"


@dataclass(frozen=True)
class Scene:
    """What is searched.

    Attributes:
        words: of the scene.
        sizes: of the grid, primitives.
        less: words that the grid turns, "" for none.
        targets: PSNRs asked for, dB, and budget: of each search, seconds.
        start: primitives that a search begins with.
    """

    words: tuple[str, ...]
    sizes: tuple[int, ...]
    less: tuple[str, ...]
    targets: tuple[float, ...]
    budget: float
    start: int


_SOLIDS = ("task=static", "scene=solids", "scene.size=64", "train.iterations=3000")
_CHAIR = ("task=static", "scene=blender", "train.iterations=2500")
_FIRE = ("task=dynamic", "scene=vdb", "scene.size=64", "train.iterations=4000")
_LIT = ("task=relight", "scene=lit_solids", "scene.size=128", "train.iterations=3000", "model.colour.form=additive")
SCENES = {
    "solids": Scene(_SOLIDS, (40, 80, 160, 320), ("", "model.colour.lobes=1"), (26.0, 28.0), 90.0, 400),
    "chair": Scene(_CHAIR, (200, 400, 800, 1600), ("", "model.colour.lobes=1"), (33.0,), 240.0, 2800),
    "fire": Scene(_FIRE, (850, 1700, 3400, 6800), ("", "model.density.time=window"), (43.0,), 240.0, 13500),
    "lit_solids": Scene(_LIT, (330, 660, 1330, 2655), ("", "model.colour.hidden=4"), (28.0,), 450.0, 2655),
}


def main() -> None:
    parser = make_parser(__doc__, "--chair", "--fire", "--seeds", "--docs", "--print", scenes=SCENES)
    parser.set_defaults(scenes=["solids"])
    parser.add_argument("--work", type=Path, help="where trainings are kept (default: a temporary folder)")
    parser.add_argument("--grid", action="store_true", help="no target runs")
    args = parser.parse_args()
    if not args.only_print:
        require_folders(parser, args, args.scenes)
        with tempfile.TemporaryDirectory() as temporary:
            for name in args.scenes:
                work, folder = args.work or Path(temporary), getattr(args, name, None)
                data = [] if folder is None else [f"scene.{'vdb' if name == 'fire' else 'path'}='{folder.resolve()}'"]
                grid = train_grid(name, data, work)
                if not args.grid:
                    runs = [run for seed in range(args.seeds) for run in search(name, data, work, seed)]
                    update_record(RECORD, **{name: {**grid, "runs": runs}, "cpu": cpu_name()})
    if args.grid:
        return
    found = read_record(RECORD)
    texts = [report(name, found[name]) for name in SCENES if name in found]
    if args.docs:
        between_markers(RESULT_PAGES / "tradeoffs.md", "target", "\n\n".join(texts))


def words_of(name: str, data: Sequence[str], out: Path) -> list[str]:
    further = ("renderer.threads=1", "train.eval_every=0", "resume=true")
    return [*SCENES[name].words, *data, *further, f"output_dir='{out}'"]


def search(name: str, data: Sequence[str], work: Path, seed: int) -> list[dict[str, Any]]:
    """Target runs of a seed."""
    scene, runs = SCENES[name], []
    for psnr in scene.targets:
        out = work / f"{name}-{psnr:g}-{seed}"
        config = compose([*words_of(name, data, out), f"model.primitives={scene.start}", f"seed={seed}"])
        record = run_target(config, SearchTarget(psnr=psnr), scene.budget, tell)
        full = [a for a in record.attempts if a.purpose == "full"]
        chosen = next(a for a in full if a.folder == record.chosen)
        runs.append(
            {
                "target": psnr,
                "seed": seed,
                "budget": scene.budget,
                "seconds": record.achieved["seconds"],
                "primitives": chosen.count,
                "words": chosen.words,
                "predicted": chosen.predicted["psnr"],
                "first": [full[0].predicted["psnr"], full[0].measured("psnr")],
                "full_runs": len(full),
                "trials": len(record.attempts) - len(full),
                "held_out": chosen.measured("psnr"),
                "held_out_stored": record.achieved["held_out"]["psnr"],
                "test_stored": record.achieved["test"]["psnr"],
                "bytes_usual": chosen.packed,
                "bytes": record.achieved["packed_bytes"],
                "rounding": record.achieved["rounding"],
                "warning": record.warning,
            }
        )
    return runs


def train_grid(name: str, data: Sequence[str], work: Path) -> dict[str, Any]:
    """Every size at full length."""
    scene, grid, dataset = SCENES[name], [], None
    for less in scene.less:
        for size in scene.sizes:
            out = work / f"{name}-grid-{size}{'-' if less else ''}{less.rpartition('.')[2]}"
            config = compose([*words_of(name, data, out), f"model.primitives={size}", *([less] if less else [])])
            task = load_config_task(config)
            dataset = dataset or load_dataset(Job(config, task))
            every = choose_target_hold_out(dataset)
            outcome = run_trial(Trial(config, every, VIEWS), dataset)
            model, _ = load_model_checkpoint(out / "model.safetensors", task)
            packed, text = out / "packed.neuprim", (out / "config.yaml").read_text(encoding="utf-8")
            save_compressed(packed, model, task.name, {}, bit_table(DEFAULT_LEVEL, (), model.specs), text)
            row = {"less": less, "primitives": size, "psnr": outcome.psnr, "bytes": packed.stat().st_size}
            grid.append(row | {"seconds": outcome.seconds})
            print(f"{name}: {size} primitives {less}: {outcome.psnr:.2f} dB, {row['bytes']} bytes", flush=True)
    return {"words": scene.words, "hold_out": every, "grid": grid}


def smallest(grid: Sequence[Mapping[str, Any]], psnr: float) -> float:
    """Bytes of the smallest model of the grid that has a PSNR; NaN where none has."""
    found = []
    for less in {g["less"] for g in grid}:
        own = sorted((g for g in grid if g["less"] == less), key=lambda g: int(g["primitives"]))
        for a, b in pairwise(own):
            if a["psnr"] <= psnr <= b["psnr"]:
                share = (psnr - a["psnr"]) / (b["psnr"] - a["psnr"])
                found.append(math.exp((1 - share) * math.log(a["bytes"]) + share * math.log(b["bytes"])))
    return min(found, default=math.nan)


def report(name: str, result: Mapping[str, Any]) -> str:
    """Prints both tables of a scene; returns them."""
    title = f"**{name}** (`{' '.join(result['words'])}`), one of {result['hold_out']} training views held out"
    print(f"\n{title}")
    cells = {(g["primitives"], g["less"]): f"{g['psnr']:.2f} dB, {g['bytes']:,} bytes" for g in result["grid"]}
    less = list(dict.fromkeys(word for _, word in cells))
    sizes = Table("grid", *(f"`{word}`" if word else "as the preset has it" for word in less))
    for size in sorted({size for size, _ in cells}):
        sizes.row(f"{size:,} primitives", *(cells[size, word] for word in less))
    print()
    return f"{title}\n\n{sizes}\n\n{runs_table(result)}"


def runs_table(result: Mapping[str, Any]) -> Table:
    def turned(run: Run) -> str:
        return "".join(f", {key.rpartition('.')[2]} {value}" for key, value in run["words"].items())

    def first(run: Run) -> str:
        (value, doubt), had = run["first"]
        return f"{value:.2f} ± {doubt:.2f}, had {had:.2f}"

    columns = {
        "target": lambda run: f"{run['target']:.1f} dB",
        "seed": lambda run: run["seed"],
        "found": lambda run: f"{run['primitives']:,} primitives{turned(run)}",
        "time": lambda run: f"{run['seconds']:.0f} of {run['budget']:.0f} s",
        "trained": lambda run: f"{run['trials']} trials, {run['full_runs']} full",
        "first full run": first,
        "held out": lambda run: f"{run['held_out']:.2f}",
        "stored": lambda run: f"{run['held_out_stored']:.2f}",
        "test views": lambda run: f"{run['test_stored']:.2f}",
        "bytes": lambda run: f"{run['bytes']:,}",
        "ratio": lambda run: f"{run['bytes_usual'] / smallest(result['grid'], run['target']):.2f}",
    }
    return make_table(columns, result["runs"])


def tell(event: Event) -> None:
    if isinstance(event, Note):
        print(event.text, flush=True)


if __name__ == "__main__":
    main()
