"""Quality of the dynamic task on a real sequence, and which way of varying in time is worth its parameters.

    python benchmarks/dynamic_quality.py DIR [--frames 1:40] [--rows 13500x4000] [--presets quick equations hard]
        [--seeds 3] [--parts main control between equations voxels] [--edges 0 2] [--neurons 0 8] [--jobs 2] [--docs]

DIR is a folder of .vdb files of JangaFX EmberGen (the recorded numbers: a free fire animation, frames 1 to 40). Parts:

    main       presets by primitives and steps (--rows), at equal bytes; `hard` is the paper's primitive, learned from
               images alone, with the windows and motion of `quick`
    control    times shuffled among the training images: a model of time must lose by it
    between    every second frame is learned; the others are compared with the real ones, and steps between frames
               are measured
    equations  the form of `quick`, that of the paper's equations 10 to 13 and their union, for each of --edges and
               --neurons, all with the bytes of --primitives of quick's and the same iterations
    voxels     quick from images alone, and with voxels in every 16th, 4th and each step, in 4,000 steps; also on the
               simulated scene smoke_fire at 160 x 160

Images of DIR are 96 x 96, 40 cameras (two held out), linear RGB over the exposure's peak, black background; means over
seeds +- half the spread, of the last checkpoint. Results go to benchmarks/results/dynamic_quality.json after every run,
and only what is missing is run. --docs puts the recorded tables between the markers of docs/results/dynamic.md; without
DIR nothing is run.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from shared.arguments import make_parser
from shared.tables import (
    RESULT_PAGES,
    RESULTS,
    Run,
    Table,
    between_markers,
    format_range,
    group_runs,
    make_table,
    read_record,
    spread_of,
)
from shared.trials import Trial, run_all
from torch import Tensor

from neuprim.config import compose
from neuprim.core.compute.threads import cpu_name
from neuprim.core.metrics import psnr
from neuprim.core.model.geometry import GEOMETRY_SPECS
from neuprim.runs.fit import Fitted
from neuprim.runs.measure import render_image
from neuprim.tasks.dynamic import vdb_recording_of
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity

RECORD = RESULTS / "dynamic_quality.json"
PARTS = ("main", "control", "between", "equations", "voxels")
VOXELS = {
    "images alone": "train.supervision=images",
    "voxels in every 16th step": "train.voxels_every=16",
    "voxels in every 4th step": "train.voxels_every=4",
    "voxels in each step": "train.voxels_every=1",
}
FORMS = {
    "quick: window, motion": ("model.density.time=window+motion",),
    "equations 10 to 13, degree 3": ("preset=equations",),
    "equations 10 to 13, degree 0": ("preset=equations", "model.sh_degree=0"),
    "union: phase, window, motion, colour in time": (
        "model.density.time=phase+window+motion",
        "model.colour.powers=4",
        "model.colour.waves=4",
    ),
}
HARD = (
    *("model.neurons=8", "model.density.edge=0", "model.density.gain=false"),
    *("train.supervision=images", "train.rates.log_scales=0.02"),
)
"""The paper's primitive from images alone."""
PRESETS = {"quick": (), "equations": ("preset=equations",), "hard": HARD}
THIRDS = ("early", "middle", "late")
KEYS = (
    *("psnr", "psnr_mask", "psnr_pooled_mask", "psnr_black_image", "psnr_black_image_mask"),
    *("psnr_srgb", "ssim", "ssim_srgb"),
    *(f"sigma_correlation_{third}" for third in THIRDS),
    *(f"sigma_relative_l2_{third}" for third in THIRDS),
    *("invisible_fraction", "primitives", "parameters_per_primitive", "model_bytes", "vdb_bytes", "train_seconds"),
)


# ---------------------------------------------------------------- what is trained


def numbers_per_primitive(*words: str) -> int:
    """Of a form whose colours are red, green and blue."""
    model = compose(["task=dynamic", *words], check_output=False).model
    density = TimeDensity(model.neurons, **model.density)
    colour = TimeHarmonics(model.sh_degree, 3, model.sh_every, **model.colour)
    return sum(spec.size for spec in (*GEOMETRY_SPECS, *density.parameters(), *colour.parameters()))


def equal_bytes(primitives: int, *words: str) -> str:
    """The setting of as many primitives of a form as have the bytes of ``primitives`` of the preset quick."""
    count = max(round(primitives * numbers_per_primitive() / numbers_per_primitive(*words)), 1)
    return f"model.primitives={count}"


def main_trials(args: argparse.Namespace, data: Sequence[str], seed: int) -> list[Trial]:
    found = []
    for row, preset in itertools.product(args.rows, args.presets):
        primitives, steps = (int(n) for n in row.split("x"))
        # the population as the preset has it, however short
        own = (*PRESETS[preset], equal_bytes(primitives, *PRESETS[preset]), "train.population.every=400")
        facts = (("part", "main"), ("preset", preset), ("as_many_as", primitives))
        found.append(Trial(f"main-{preset}-{primitives}-{steps}-{seed}", (*data, *own), steps, seed, 0, facts))
    return found


def equation_trials(args: argparse.Namespace, data: Sequence[str], seed: int) -> list[Trial]:
    found = []
    for form, edge, neurons in itertools.product(args.forms, args.edges, args.neurons):
        gain = f"model.density.gain={'true' if edge else 'false'}"
        own = (*FORMS[form], f"model.density.edge={edge}", f"model.neurons={neurons}", gain)
        facts = (("part", "equations"), ("form", form), ("edge", edge), ("neurons", neurons), ("gain", edge > 0))
        name = f"equations-{form}-{edge}-{neurons}-{args.primitives}-{args.iterations}-{seed}"
        words = (*data, *own, equal_bytes(args.primitives, *own))
        found.append(Trial(name, words, args.iterations, seed, 0, facts))
    return found


def short_trial(args: argparse.Namespace, name: str, words: Sequence[str], seed: int, **more: Any) -> Trial:
    """A run of the parts control and between."""
    words = (*words, *HARD, "model.primitives=2000")
    return Trial(f"{name}-{args.iterations}-{seed}", words, args.iterations, seed, interventions=None, **more)


def control_trials(args: argparse.Namespace, data: Sequence[str], seed: int) -> list[Trial]:
    return [
        short_trial(args, f"control-{name}", data, seed, facts=(("part", "control"), ("name", name)), change=change)
        for name, change in (("true times", None), ("shuffled times", shuffle_times))
    ]


def between_trials(args: argparse.Namespace, data: Sequence[str], seed: int) -> list[Trial]:
    found = []
    for every in (1, 2):
        words, facts = (*data, f"scene.train_every={every}"), (("part", "between"), ("every", every))
        found.append(short_trial(args, f"between-{every}", words, seed, facts=facts))
    return found


def voxel_trials(args: argparse.Namespace, data: Sequence[str], seed: int) -> list[Trial]:
    found = []
    scenes = {"EmberGen fire": data, "`smoke_fire`": ("task=dynamic", "scene=smoke_fire")}
    for (scene, words), (name, setting) in itertools.product(scenes.items(), VOXELS.items()):
        facts = (("part", "voxels"), ("scene", scene), ("learned_from", name))
        found.append(
            Trial(f"voxels-{scene}-{name}-{seed}", (*words, setting), 4000, seed, 0, facts, interventions=None)
        )
    return found


def shuffle_times(fitted: Fitted) -> None:
    """Every training camera keeps its images, under the times of other frames."""
    views: Any = fitted.dataset.train
    order = torch.randperm(len(views.times), generator=torch.Generator().manual_seed(5)).tolist()
    views.times = [views.times[i] for i in order]


def measure_between_frames(fitted: Fitted, metrics: dict[str, Any]) -> dict[str, float]:
    """PSNR inside the mask of test frames that were learned from and of those between them, of the real frame before
    the latter, which interpolation must beat, and the largest step between frames.

    The steps: the image at every quarter of a frame's interval. ``largest_step`` is the largest mean absolute
    difference of two such neighbours over that of the two whole frames around them; smooth motion gives about 1/4, a
    jump 1 or more.
    """
    data, model, settings = fitted.dataset, fitted.model, fitted.trainer.renderer
    recording = vdb_recording_of(data)
    assert recording is not None
    frames, every = len(recording.test.times), recording.every
    errors: dict[str, list[float]] = {"learned": [], "between": [], "repeat": []}
    worst = 0.0

    def truth(index: int) -> Tensor:
        return data.test.pixels(index).over(data.background)

    for index in range(len(data.test)):
        view, since = data.test.view(index), (index % frames) % every
        mask = recording.matter_mask(index)
        rendered = render_image(model, view, settings, data.background)
        errors["between" if since else "learned"].append(psnr(rendered, truth(index), mask))
        if since:
            errors["repeat"].append(psnr(truth(index - since), truth(index), mask))
        if index + 1 < frames:
            first, last = view.conditions["time"], data.test.view(index + 1).conditions["time"]
            moments = [type(view)("", view.camera, {"time": first + q / 4 * (last - first)}) for q in range(5)]
            images = [render_image(model, moment, settings, data.background) for moment in moments]
            whole = max((images[4] - images[0]).abs().mean().item(), 1e-9)
            worst = max(worst, *((b - a).abs().mean().item() / whole for a, b in itertools.pairwise(images)))
    return {"largest_step": worst} | {name: statistics.mean(values) for name, values in errors.items() if values}


# ---------------------------------------------------------------- tables


def main_table(runs: Sequence[Run]) -> str:
    """One column per budget and preset, one row per number, beside what a black image scores."""
    groups = group_runs(runs, "as_many_as", "iterations", "preset")
    columns = [groups[key] for key in sorted(groups, key=lambda key: (key[:2], key[2] != "quick", key[2]))]
    heads = (
        f"`{own[0]['preset']}`, {own[0]['primitives']:,} primitives, {own[0]['iterations']:,} steps" for own in columns
    )
    table = Table("", *heads, "black image")

    def thirds(key: str) -> Callable[[list[Run]], str]:
        return lambda own: " / ".join(spread_of(own, f"sigma_{key}_{third}", 3) for third in THIRDS)

    rows: dict[str, Callable[[list[Run]], str]] = {
        "PSNR, whole image": lambda own: f"{spread_of(own, 'psnr')} dB",
        "PSNR inside the union mask": lambda own: f"{spread_of(own, 'psnr_mask')} dB",
        "PSNR of the pooled error inside the mask": lambda own: f"{spread_of(own, 'psnr_pooled_mask')} dB",
        "PSNR after the sRGB curve": lambda own: f"{spread_of(own, 'psnr_srgb')} dB",
        "SSIM, linear / sRGB": lambda own: f"{spread_of(own, 'ssim', 4)} / {spread_of(own, 'ssim_srgb', 4)}",
        "correlation of σ with the files, early / middle / late frames": thirds("correlation"),
        "relative L2 error of σ, early / middle / late frames": thirds("relative_l2"),
        "model, with the errors above": lambda own: f"{own[0]['model_bytes'] / 1e6:.2f} MB",
        "the .vdb files, which have none": lambda own: f"{own[0]['vdb_bytes'] / 1e6:.2f} MB",
        "primitives that never show": lambda own: f"{mean_percentage(own):.1f} %",
        "seeds": lambda own: f"{len(own)}",
    }
    black = {
        "PSNR, whole image": f"{runs[0]['psnr_black_image']:.1f} dB",
        "PSNR inside the union mask": f"{runs[0]['psnr_black_image_mask']:.1f} dB",
    }
    for name, cell in rows.items():
        table.row(name, *(cell(own) for own in columns), black.get(name, ""))
    return str(table)


def mean_percentage(runs: Sequence[Run]) -> float:
    """Primitives that never show, in percent."""
    return 100 * statistics.mean(run["invisible_fraction"] for run in runs)


def equations_table(runs: Sequence[Run]) -> str:
    """The forms of quick, of the paper's equations and their union by edge and neurons, all at equal bytes."""
    columns = {
        "form": lambda own: own[0]["form"],
        "edge": lambda own: f"{own[0]['edge']}{', gain' if own[0]['gain'] else ''}",
        "K": lambda own: own[0]["neurons"],
        "numbers": lambda own: own[0]["parameters_per_primitive"],
        "primitives": lambda own: f"{own[0]['primitives']:,}",
        "PSNR": lambda own: f"{spread_of(own, 'psnr')} dB",
        "inside the mask": lambda own: f"{spread_of(own, 'psnr_mask')} dB",
        "pooled, inside": lambda own: f"{spread_of(own, 'psnr_pooled_mask')} dB",
        "invisible": lambda own: f"{mean_percentage(own):.0f} %",
        "ms a step": lambda own: f"{1e3 * statistics.mean(r['cpu_seconds'] / r['iterations'] for r in own):.0f}",
    }
    table = make_table(columns, group_runs(runs, "form", "edge", "neurons").values())
    steps = format_range(run["iterations"] for run in runs)
    seeds = len({run["seed"] for run in runs})
    return f"{table}\n\n{runs[0]['model_bytes'] / 1e6:.2f} MB each, {steps} iterations, {seeds} seed(s)."


def control_table(control: Sequence[Run], between: Sequence[Run]) -> str:
    """Shuffled times, and frames between those that were learned."""
    groups = group_runs(control, "name")
    first = make_table(
        {
            "control": lambda own: own[0]["name"],
            "PSNR": lambda own: f"{spread_of(own, 'psnr')} dB",
            "inside the mask": lambda own: f"{spread_of(own, 'psnr_mask')} dB",
        },
        [groups[name,] for name in ("true times", "shuffled times") if (name,) in groups],
    )
    second = make_table(
        {
            "learned from": lambda own: "every frame" if own[0]["every"] == 1 else f"every {own[0]['every']}nd frame",
            "learned frames, inside the mask": lambda own: f"{spread_of(own, 'learned')} dB",
            "frames between": lambda own: f"{spread_of(own, 'between')} dB" if "between" in own[0] else "–",
            "real frame before instead": lambda own: f"{spread_of(own, 'repeat')} dB" if "repeat" in own[0] else "–",
            "largest step": lambda own: spread_of(own, "largest_step"),
        },
        group_runs(between, "every").values(),
    )
    return f"{first}\n\n{second}"


def voxels_table(runs: Sequence[Run]) -> str:
    """Images alone beside images and voxels, at equal steps."""
    columns = {
        "scene": lambda own: own[0]["scene"],
        "learned from": lambda own: own[0]["learned_from"],
        "inside the mask": lambda own: f"{spread_of(own, 'psnr_mask')} dB",
        "error of σ": lambda own: " / ".join(spread_of(own, f"sigma_relative_l2_{third}", 2) for third in THIRDS),
        "CPU seconds": lambda own: f"{statistics.mean(run['cpu_seconds'] for run in own):.0f}",
    }
    groups = group_runs(runs, "scene", "learned_from")
    order = list(VOXELS)
    rows = [groups[key] for key in sorted(groups, key=lambda key: (key[0], order.index(key[1])))]
    seeds = len({run["seed"] for run in runs})
    return f"{make_table(columns, rows)}\n\n{runs[0]['iterations']:,} steps, {seeds} seed(s)."


def make_tables(record: dict[str, Any]) -> dict[str, str]:
    """The text of each pair of markers."""
    parts = {key: runs for (key,), runs in group_runs(record["trials"], "part").items()}
    control = control_table(parts.get("control", []), parts.get("between", []))
    tables = {"dynamic-quality": main_table(parts["main"])} if "main" in parts else {}
    tables |= {"dynamic-equations": equations_table(parts["equations"])} if "equations" in parts else {}
    tables |= {"dynamic-voxels": voxels_table(parts["voxels"])} if "voxels" in parts else {}
    notes = {name: f"\n\nMeans over seeds ± half the spread; {cpu}." for name, cpu in record["machines"].items()}
    return {name: text + notes["main"] for name, text in tables.items()} | {
        "dynamic-control": control + notes["control"]
    }


def main() -> None:
    parser = make_parser(__doc__, "--seeds", "--jobs", "--docs")
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--frames", default="1:40")
    parser.add_argument("--parts", nargs="*", default=["main", "control", "between"], choices=PARTS)
    parser.add_argument("--rows", nargs="*", default=["13500x4000"], help="PRIMITIVESxSTEPS, of main")
    parser.add_argument("--presets", nargs="*", default=list(PRESETS), choices=list(PRESETS), help="of main")
    parser.add_argument("--edges", nargs="*", type=int, default=[0, 2], help="of equations")
    parser.add_argument("--neurons", nargs="*", type=int, default=[0, 8], help="of equations")
    parser.add_argument("--forms", nargs="*", default=list(FORMS), help="of equations")
    parser.add_argument("--primitives", type=int, default=5400, help="of equations")
    parser.add_argument("--iterations", type=int, default=2500, help="of every run but those of main")
    args = parser.parse_args()
    if args.folder:
        data = ["task=dynamic", "scene=vdb", "scene.look=embergen_fire", "scene.size=96"]
        data += [f"scene.vdb='{args.folder.resolve()}'", f"scene.frames='{args.frames}'"]
        functions = (main_trials, control_trials, between_trials, equation_trials, voxel_trials)
        make = dict(zip(PARTS, functions, strict=True))
        for part in args.parts:
            trials = [trial for seed in range(args.seeds) for trial in make[part](args, data, seed)]
            known = read_record(RECORD).get("machines", {})
            machine = {"control" if part in ("control", "between") else "main": f"one thread of {cpu_name()} a run"}
            wanted = measure_between_frames if part == "between" else KEYS
            run_all(trials, RECORD, wanted, args.jobs, machines=known | machine)
    for name, text in make_tables(read_record(RECORD)).items():
        if args.docs:
            between_markers(RESULT_PAGES / "dynamic.md", name, text)


if __name__ == "__main__":
    main()
