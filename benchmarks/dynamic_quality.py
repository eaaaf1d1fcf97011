"""Quality of the dynamic task on a real sequence, and which way of varying in time is worth its parameters.

    python benchmarks/dynamic_quality.py DIR [--frames 1:40] [--rows 13500x4000] [--presets quick equations hard]
        [--seeds 3] [--parts main control between equations] [--edges 0 2] [--neurons 0 8] [--jobs 2] [--docs]

DIR is a folder of .vdb files of JangaFX EmberGen (the recorded numbers: a free fire animation, frames 1 to 40). Parts:

    main       presets by primitives and steps (--rows), at equal bytes; `hard` is the paper's primitive, learned from
               images alone, with the windows and motion of `quick`
    control    times shuffled among the training images: a model of time must lose by it
    between    every second frame is learned; the others are compared with the real ones, and steps between frames
               are measured
    equations  the form of `quick`, that of the paper's equations 10 to 13 and their union, for each of --edges and
               --neurons, all with the bytes of --primitives of quick's and the same iterations

Images are 96 x 96, 40 cameras (two held out), linear RGB over the exposure's peak, black background; means over seeds
+- half the spread, of the last checkpoint. Results go to benchmarks/results/dynamic_quality.json, part by part; of main
and equations only what is missing is run, --jobs at a time, one thread each. --docs puts the recorded tables between
the markers of docs/dynamic.md; without DIR nothing is run.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from shared.tables import ROOT, between_markers, spread
from shared.trials import Trial, run_all

from neuprim.config import compose
from neuprim.core.compute.threads import core_count, cpu_name
from neuprim.core.data import Dataset
from neuprim.core.model.geometry import GEOMETRY_SPECS
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import prepare_training, train_to_end
from neuprim.runs.measure import render_image
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.density import TimeDensity
from neuprim.tasks.dynamic.evaluation import recording_of
from neuprim.tasks.dynamic.volume.dataset import Recording

RESULTS = Path(__file__).parent / "results" / "dynamic_quality.json"
SIZE = 96
COLOUR = ("model.colour.powers=4", "model.colour.waves=4")
FORMS = {
    "quick: window, motion": ("model.density.time=window+motion",),
    "equations 10 to 13, degree 3": ("preset=equations",),
    "equations 10 to 13, degree 0": ("preset=equations", "model.sh_degree=0"),
    "union: phase, window, motion, colour in time": ("model.density.time=phase+window+motion", *COLOUR),
}
HARD = (
    "model.neurons=8",
    "model.density.edge=0",
    "model.density.gain=false",
    "train.supervision=images",
    "train.rates.log_scales=0.02",
)
"""The paper's primitive from images alone."""
EVERY = "train.population.every=400"  # as the preset has it, however short
PRESETS = {"quick": (), "equations": ("preset=equations",), "hard": HARD}
KEYS = (
    "psnr",
    "psnr_mask",
    "psnr_pooled_mask",
    "psnr_black_image",
    "psnr_black_image_mask",
    "psnr_srgb",
    "ssim",
    "ssim_srgb",
    "sigma_correlation_early",
    "sigma_correlation_middle",
    "sigma_correlation_late",
    "sigma_relative_l2_early",
    "sigma_relative_l2_middle",
    "sigma_relative_l2_late",
    "invisible_fraction",
    "primitives",
    "parameters_per_primitive",
    "model_bytes",
    "vdb_bytes",
    "iterations",
    "train_seconds",
    "seed",
)


def fit(words: list[str], change: Callable[[Trainer], None] = lambda trainer: None) -> tuple[Trainer, dict[str, Any]]:
    """What `neuprim run` does, less its files: the trainer after its budget, and the metrics."""
    torch.set_num_threads(1)
    fitted = prepare_training(compose(["task=dynamic", *words], check_output=False))
    change(fitted.trainer)
    return fitted.trainer, train_to_end(fitted).metrics()


def numbers(*words: str) -> int:
    """Numbers per primitive of a form whose colours are red, green and blue."""
    model = compose(["task=dynamic", *words], check_output=False).model
    fields = (
        TimeDensity(model.neurons, **model.density),
        TimeHarmonics(model.sh_degree, 3, model.sh_every, **model.colour),
    )
    return sum(spec.size for spec in (*GEOMETRY_SPECS, *fields[0].parameters(), *fields[1].parameters()))


def as_many_bytes(primitives: int, *words: str) -> int:
    """How many primitives of a form have the bytes of ``primitives`` of the preset quick."""
    return max(round(primitives * numbers() / numbers(*words)), 1)


def kept(metrics: dict[str, Any]) -> dict[str, Any]:
    """Of a run's metrics, what is recorded of the parts ``main`` and ``equations``."""
    return {k: metrics[k] for k in KEYS} | {"per_frame": [round(f["psnr_mask"], 3) for f in metrics["per_frame"]]}


def main_trials(args: argparse.Namespace, data: list[str]) -> list[Trial]:
    found = []
    for seed, row, preset in itertools.product(range(args.seeds), args.rows, args.presets):
        primitives, steps = (int(n) for n in row.split("x"))
        words = [*data, *PRESETS[preset], f"model.primitives={as_many_bytes(primitives, *PRESETS[preset])}", EVERY]
        facts = (("part", "main"), ("preset", preset), ("as_many_as", primitives))
        found.append(Trial(f"main-{preset}-{primitives}-{steps}-{seed}", tuple(words), steps, seed, 0, facts))
    return found


def equation_trials(args: argparse.Namespace, data: list[str]) -> list[Trial]:
    found = []
    for seed, form, edge, neurons in itertools.product(range(args.seeds), args.forms, args.edges, args.neurons):
        words = [
            *FORMS[form],
            f"model.density.edge={edge}",
            f"model.neurons={neurons}",
            f"model.density.gain={'true' if edge else 'false'}",
        ]
        words.append(f"model.primitives={as_many_bytes(args.primitives, *words)}")
        facts = (("part", "equations"), ("form", form), ("edge", edge), ("neurons", neurons), ("gain", edge > 0))
        name = f"equations-{form}-{edge}-{neurons}-{args.primitives}-{args.iterations}-{seed}"
        found.append(Trial(name, (*data, *words), args.iterations, seed, 0, facts))
    return found


def shuffled_times(trainer: Trainer) -> None:
    """Every training camera keeps its images, under the times of other frames."""
    views: Any = trainer.dataset.train
    order = torch.randperm(len(views.times), generator=torch.Generator().manual_seed(5)).tolist()
    views.times = [views.times[i] for i in order]


def recorded_in(trainer: Trainer) -> tuple[Dataset, Recording]:
    """The data set, and the sequence that it was rendered from."""
    recording = recording_of(trainer.dataset)
    assert recording is not None
    return trainer.dataset, recording


def between_frames(trainer: Trainer) -> dict[str, float]:
    """PSNR inside the mask of test frames that were learned from and of those between them, and the largest step
    between frames.

    The steps: the image at every quarter of a frame's interval. ``largest_step`` is the largest mean absolute
    difference of two such neighbours over that of the two whole frames around them; smooth motion gives about 1/4, a
    jump 1 or more.
    """
    data, recording = recorded_in(trainer)
    frames, every = len(recording.test.times), recording.every
    errors: dict[bool, list[float]] = {True: [], False: []}
    worst = 0.0
    for index in range(len(data.test)):
        view, t = data.test.view(index), index % frames
        rendered, truth = (
            render_image(trainer.model, view, trainer.renderer, data.background),
            data.test.pixels(index).over(data.background),
        )
        error = (rendered - truth)[recording.matter_mask(index)].double().square().mean().item()
        errors[t % every == 0].append(-10 * math.log10(error))
        if t + 1 < frames and index < frames:
            after = data.test.view(index + 1)
            steps = [
                view.conditions["time"] + q / 4 * (after.conditions["time"] - view.conditions["time"]) for q in range(5)
            ]
            images = [
                render_image(trainer.model, type(view)("", view.camera, {"time": s}), trainer.renderer, data.background)
                for s in steps
            ]
            whole = (images[4] - images[0]).abs().mean().item()
            worst = max(worst, *((b - a).abs().mean().item() / max(whole, 1e-9) for a, b in itertools.pairwise(images)))
    found = {"learned": statistics.mean(errors[True]), "largest_step": worst}
    return found | ({"between": statistics.mean(errors[False])} if errors[False] else {})


def repeat_neighbour(trainer: Trainer) -> float:
    """PSNR inside the mask of showing, for each frame that was not learned, the real frame before it: what
    interpolation must beat."""
    data, recording = recorded_in(trainer)
    frames, every, values = len(recording.test.times), recording.every, []
    for index in range(len(data.test)):
        if (index % frames) % every:
            pair = [data.test.pixels(i).over(data.background) for i in (index - (index % frames) % every, index)]
            error = (pair[0] - pair[1])[recording.matter_mask(index)].double().square().mean().item()
            values.append(-10 * math.log10(error))
    return statistics.mean(values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--frames", default="1:40")
    parser.add_argument("--parts", nargs="*", default=["main", "control", "between"])
    parser.add_argument("--rows", nargs="*", default=["13500x4000"], help="PRIMITIVESxSTEPS, of main")
    parser.add_argument("--presets", nargs="*", default=list(PRESETS), choices=list(PRESETS), help="of main")
    parser.add_argument("--edges", nargs="*", type=int, default=[0, 2], help="of equations")
    parser.add_argument("--neurons", nargs="*", type=int, default=[0, 8], help="of equations")
    parser.add_argument("--forms", nargs="*", default=list(FORMS), help="of equations")
    parser.add_argument("--primitives", type=int, default=5400, help="of equations")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=2500, help="of every run but those of main")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time of main and equations, one thread each")
    parser.add_argument("--docs", action="store_true")
    args = parser.parse_args()
    recorded: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    if args.folder:
        if {"control", "between"} & set(args.parts):
            recorded |= {"cpu": cpu_name(), "cores": core_count()}
        data = [
            "scene=vdb",
            f"scene.vdb='{args.folder.resolve()}'",
            f"scene.frames='{args.frames}'",
            "scene.look=embergen_fire",
            f"scene.size={SIZE}",
            "train.eval_every=0",
        ]
        short = [*HARD, "model.primitives=2000", "train.max_seconds=null", f"train.iterations={args.iterations}"]

        def keep(part: str, entry: dict[str, Any]) -> None:
            recorded.setdefault(part, []).append(entry)
            RESULTS.write_text(
                json.dumps(recorded, indent=1) + "\n"
            )  # after every run: a long benchmark may be cut short
            print(
                part, json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in entry.items()}), flush=True
            )

        for part in {"control", "between"} & set(args.parts):
            recorded[part] = []
        trials = main_trials(args, ["task=dynamic", *data]) if "main" in args.parts else []
        trials += equation_trials(args, ["task=dynamic", *data]) if "equations" in args.parts else []
        run_all(trials, RESULTS, kept, args.jobs, lambda row: f"{row['psnr_mask']:.2f} dB", {"main_cpu": cpu_name()})
        recorded |= json.loads(RESULTS.read_text())
        for seed in range(args.seeds):
            own = [*data, f"seed={seed}"]
            if "control" in args.parts:
                for name, change in (("true times", lambda trainer: None), ("shuffled times", shuffled_times)):
                    _, m = fit([*own, *short], change)
                    keep("control", {"name": name, **{k: m[k] for k in KEYS}})
            if "between" in args.parts:
                for every in (1, 2):
                    trainer, m = fit([*own, *short, f"scene.train_every={every}"])
                    base = {"repeat": repeat_neighbour(trainer)} if every > 1 else {}
                    keep("between", {"every": every, "seed": seed, **between_frames(trainer), **base})
    notes = {where: f"\n\nMeans over seeds ± half the spread; {cpu}." for where, cpu in _machines(recorded).items()}
    tables = {
        "dynamic-quality": main_table,
        "dynamic-control": control_table,
        "dynamic-equations": equations_table,
    }
    for name, make in tables.items():
        text = make(recorded)
        text += notes["side by side" if make in (main_table, equations_table) else "one by one"] if text else ""
        if args.docs:
            between_markers(ROOT / "docs" / "dynamic.md", name, text)
        print(f"\n{text}")


def _machines(recorded: dict[str, Any]) -> dict[str, str]:
    """What the two kinds of parts were measured on."""
    return {
        "side by side": f"one thread of {recorded.get('main_cpu', 'nothing yet')} a run",
        "one by one": f"{recorded.get('cores', 0)} cores of {recorded.get('cpu', 'nothing yet')}",
    }


def _spread(runs: list[dict[str, Any]], key: str, digits: int = 2) -> str:
    return spread([r[key] for r in runs], digits) if runs else "–"


def _part(recorded: dict[str, Any], part: str) -> list[dict[str, Any]]:
    return [r for r in recorded.get("trials", []) if r["part"] == part]


def _budget(run: dict[str, Any]) -> tuple[int, int]:
    """Primitives of the preset quick with as many bytes, and steps."""
    return run["as_many_as"], run["iterations"]


def _columns(runs: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    """The runs of each budget and preset, quick first."""
    keys = sorted({(_budget(r), r["preset"] != "quick", r["preset"]) for r in runs})
    return [[r for r in runs if (_budget(r), r["preset"]) == (budget, preset)] for budget, _, preset in keys]


def main_table(recorded: dict[str, Any]) -> str:
    """One column per budget and preset, one row per number, beside what a black image scores."""
    runs = _part(recorded, "main")
    if not runs:
        return "not measured"
    columns = _columns(runs)
    black, inside = runs[0]["psnr_black_image"], runs[0]["psnr_black_image_mask"]

    def line(name: str, cell: Callable[[list[dict[str, Any]]], str], baseline: str = "") -> str:
        return f"| {name} | " + " | ".join(cell(own) for own in columns) + f" | {baseline} |"

    def thirds(key: str) -> Callable[[list[dict[str, Any]]], str]:
        return lambda own: " / ".join(_spread(own, f"sigma_{key}_{third}", 3) for third in ("early", "middle", "late"))

    return "\n".join(
        [
            line(
                "",
                lambda own: (
                    f"`{own[0]['preset']}`, {own[0]['primitives']:,} primitives, {own[0]['iterations']:,} steps"
                ),
                "black image",
            ),
            "| --- |" + " --- |" * (len(columns) + 1),
            line("PSNR, whole image", lambda own: f"{_spread(own, 'psnr')} dB", f"{black:.1f} dB"),
            line("PSNR inside the union mask", lambda own: f"{_spread(own, 'psnr_mask')} dB", f"{inside:.1f} dB"),
            line("PSNR of the pooled error inside the mask", lambda own: f"{_spread(own, 'psnr_pooled_mask')} dB"),
            line("PSNR after the sRGB curve", lambda own: f"{_spread(own, 'psnr_srgb')} dB"),
            line("SSIM, linear / sRGB", lambda own: f"{_spread(own, 'ssim', 4)} / {_spread(own, 'ssim_srgb', 4)}"),
            line("correlation of σ with the files, early / middle / late frames", thirds("correlation")),
            line("relative L2 error of σ, early / middle / late frames", thirds("relative_l2")),
            line("model, with the errors above", lambda own: f"{own[0]['model_bytes'] / 1e6:.2f} MB"),
            line("the .vdb files, which have none", lambda own: f"{own[0]['vdb_bytes'] / 1e6:.2f} MB"),
            line(
                "primitives that never show",
                lambda own: f"{100 * statistics.mean(r['invisible_fraction'] for r in own):.1f} %",
            ),
            line("seeds", lambda own: f"{len(own)}"),
        ]
    )


def equations_table(recorded: dict[str, Any]) -> str:
    """The forms of quick, of the paper's equations and their union by edge and neurons, all at equal bytes; nothing
    where none was measured."""
    runs = _part(recorded, "equations")
    if not runs:
        return ""
    lines = [
        "| form | edge | K | numbers | primitives | PSNR | inside the mask | pooled, inside | invisible | ms a step |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for key in dict.fromkeys((r["form"], r["edge"], r["neurons"]) for r in runs):
        own = [r for r in runs if (r["form"], r["edge"], r["neurons"]) == key]
        step = 1e3 * statistics.mean(r["cpu_seconds"] / r["iterations"] for r in own)
        lines.append(
            f"| {key[0]} | {key[1]}{', gain' if own[0]['gain'] else ''} | {key[2]} | "
            f"{own[0]['parameters_per_primitive']} "
            f"| {own[0]['primitives']:,} | {_spread(own, 'psnr')} dB | {_spread(own, 'psnr_mask')} dB | "
            f"{_spread(own, 'psnr_pooled_mask')} dB "
            f"| {100 * statistics.mean(r['invisible_fraction'] for r in own):.0f} % | {step:.0f} |"
        )
    steps = [r["iterations"] for r in runs]
    many = f"{steps[0]:,}" if len(set(steps)) == 1 else f"{min(steps):,} to {max(steps):,}"
    seeds = len({r["seed"] for r in runs})
    return "\n".join([*lines, "", f"{runs[0]['model_bytes'] / 1e6:.2f} MB each, {many} iterations, {seeds} seed(s)."])


def control_table(recorded: dict[str, Any]) -> str:
    """Shuffled times, and frames between those that were learned."""
    lines = ["| control | PSNR | inside the mask |", "| --- | --- | --- |"]
    runs = recorded.get("control", [])
    for name in dict.fromkeys(r["name"] for r in runs):
        own = [r for r in runs if r["name"] == name]
        lines.append(f"| {name} | {_spread(own, 'psnr')} dB | {_spread(own, 'psnr_mask')} dB |")
    lines += [
        "",
        "| learned from | learned frames, inside the mask | frames between | real frame before instead | largest "
        "step |",
    ]
    lines.append("| --- | --- | --- | --- | --- |")
    for every in dict.fromkeys(r["every"] for r in recorded.get("between", [])):
        own = [r for r in recorded["between"] if r["every"] == every]
        what = "every frame" if every == 1 else f"every {every}nd frame"
        between, repeat = (_spread(own, k) + " dB" if every > 1 else "–" for k in ("between", "repeat"))
        lines.append(
            f"| {what} | {_spread(own, 'learned')} dB | {between} | {repeat} | {_spread(own, 'largest_step')} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
