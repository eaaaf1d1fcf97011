"""What one primitive can express, and what its bytes are worth: the forms of the family, the paper's and a Gaussian, at
equal bytes and equal seconds.

    python benchmarks/expressivity.py [--scenes solids chair fire smoke_fire lit_solids] [--chair DIR] [--fire DIR]
        [--parts forms slope gaussian] [--sizes 100 400 2000] [--seeds 3] [--docs] [--print]

Each run is its task's preset `quick`, cut to a number of steps, with all primitives from the start and rates without a
cool-down. A size is the bytes of so many of the paper's primitives; every form gets as many primitives as these bytes
hold. Parts:

    forms     every form at every size, for as many steps as fit into the seconds that the paper's form takes for its
    own: the forms take turns
              on this machine first, over a whole run, and each has its pace in seconds that its thread computes
    slope     the same with half the steps, first seed: what the last doubling of the budget still brought
    gaussian  a true Gaussian has no fast kernel and runs on the reference backend: small images of the static scenes
    and few steps, equal count
              and equal bytes, beside the other forms in the same conditions

Numbers are means over seeds +- half the spread, of the last checkpoint, on the test views. Results go to
benchmarks/results/expressivity.json after every run, and only what is missing is run. --docs puts the tables between
the markers in docs/expressivity.md; --print runs nothing.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import torch
from shared.forms import AS_RECORDED, PAPER, SCENES, Form
from shared.tables import between_markers, spread
from shared.trials import Trial, begin, paces_of, run_all

from neuprim.core.compute.threads import cpu_name

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "expressivity.json"
DOCS = HERE.parent / "docs" / "expressivity.md"
KEYS = (
    "psnr",
    "psnr_worst",
    "ssim",
    "psnr_mask",
    "psnr_linear_clamped",
    "psnr_pooled_cast_shadow",
    "psnr_pooled_highlight",
    "sigma_relative_l2_early",
    "sigma_relative_l2_middle",
    "sigma_relative_l2_late",
    "parameters",
    "parameters_per_primitive",
    "primitives",
    "backend",
)

FORMS = {
    "static": ("8:0", "0:2", "2:2", "4:2"),
    "dynamic": ("8:0@images", "0:2@images", "0:2", "2:2"),
    "relight": ("8:0", "0:2", "2:2"),
}
REFERENCE = {"static": str(PAPER), "dynamic": f"{PAPER}@images", "relight": str(PAPER)}
"""Whose seconds all others get."""
STEPS = {
    "solids": {100: 2000, 400: 2000, 2000: 3000},
    "chair": {100: 2000, 400: 2000, 2000: 3000},
    "fire": {2000: 5000},
    "smoke_fire": {1000: 5000},
    "lit_solids": {2000: 2000},
}
"""Of the reference; the others train as long in seconds."""
SMALL = {"iterations": 400, "primitives": 100, "size": 64, "downsample": 4}
"""What the part ``gaussian`` is reduced to."""


def reduced(scene: str) -> tuple[str, ...]:
    """The small images of the part ``gaussian``."""
    return (f"scene.size={SMALL['size']}",) if scene == "solids" else (f"scene.downsample={SMALL['downsample']}",)


def words_of(form: str, scene: str, args: argparse.Namespace, count: int) -> tuple[str, ...]:
    own = SCENES[scene]
    return (*own.all_words(vars(args), scene), *AS_RECORDED, *Form.named(form).words, f"model.primitives={count}")


def measure_paces(scene: str, size: int, forms: Sequence[str], args: argparse.Namespace) -> dict[str, float]:
    """Seconds a step of each over a whole run as long as the reference's."""
    torch.set_num_threads(1)
    steps, trainers = STEPS[scene][size], {}
    for form in forms:
        count = Form.named(form).equal_bytes(size, SCENES[scene].task)
        trainers[form] = begin(Trial(form, words_of(form, scene, args, count), steps)).trainer
    return paces_of(trainers, steps)


def measured_paces(args: argparse.Namespace) -> dict[str, float]:
    """Time of a step over that of the paper's form, by "scene size form"; what is recorded stays."""
    whole: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    found: dict[str, float] = whole.setdefault("paces", {})
    wanted = []
    for scene in args.scenes:
        for size in sizes(scene, args):
            missing = [f for f in forms_of(scene, args) if f"{scene} {size} {f}" not in found]
            if missing:  # ratios travel, seconds do not: the reference takes part every time
                wanted.append((scene, size, list(dict.fromkeys([REFERENCE[SCENES[scene].task], *missing]))))
    with ProcessPoolExecutor(args.jobs, multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(measure_paces, scene, size, forms, args) for scene, size, forms in wanted]
        for (scene, size, forms), future in zip(wanted, futures, strict=True):
            took = future.result()
            ratios = {form: took[form] / took[forms[0]] for form in forms}
            found |= {f"{scene} {size} {form}": ratio for form, ratio in ratios.items()}
            RESULTS.write_text(json.dumps(whole, indent=1) + "\n")
            print(f"paces of {scene}, {size}:", {form: round(ratio, 3) for form, ratio in ratios.items()}, flush=True)
    return found


def forms_of(scene: str, args: argparse.Namespace) -> list[str]:
    return args.forms or list(FORMS[SCENES[scene].task])


def sizes(scene: str, args: argparse.Namespace) -> list[int]:
    return [size for size in STEPS[scene] if not args.sizes or size in args.sizes]


def plan(args: argparse.Namespace, paces: dict[str, float]) -> list[Trial]:
    """Every run; the first seed of everything first, so that an early end leaves whole rows."""
    trials = []

    def add(
        part: str, scene: str, size: int, form: str, count: int, steps: int, seed: int, further: tuple[str, ...] = ()
    ) -> None:
        facts = (("part", part), ("scene", scene), ("form", form), ("size", size))
        name = f"{part}-{scene}-{size}-{form}-{count}-{steps}-{seed}"
        trials.append(Trial(name, (*words_of(form, scene, args, count), *further), steps, seed, 0, facts))

    for seed in range(args.seeds):
        for scene in args.scenes:
            task = SCENES[scene].task
            for size in sizes(scene, args) if paces else []:
                for form in forms_of(scene, args):
                    count, steps = (
                        Form.named(form).equal_bytes(size, task),
                        round(STEPS[scene][size] / paces[f"{scene} {size} {form}"]),
                    )
                    if "forms" in args.parts:
                        add("forms", scene, size, form, count, steps, seed)
                    if "slope" in args.parts and seed == 0:
                        add("slope", scene, size, form, count, steps // 2, seed)
            if "gaussian" in args.parts and task == "static":
                for form in [*forms_of(scene, args), "gaussian"]:
                    size = SMALL["primitives"]
                    for count in dict.fromkeys((size, Form.named(form).equal_bytes(size, task))):
                        add("gaussian", scene, size, form, count, SMALL["iterations"], seed, reduced(scene))
    return trials


# ---------------------------------------------------------------- the tables


def forms_table(found: dict[str, Any]) -> str:
    """One row per form, scene and size; the best in bold, and all whose mean lies within its half spread."""
    trials = found["trials"]
    lines = [
        "| scene | bytes of | primitive | primitives | numbers each | steps | PSNR | worst view | SSIM | last "
        "doubling | error of σ |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    groups: dict[tuple[str, int, str], list[dict[str, Any]]] = {}
    for run in trials:
        if run["part"] == "forms":
            groups.setdefault((run["scene"], run["size"], run["form"]), []).append(run)
    order = list(SCENES)
    for (scene, size, form), runs in sorted(
        groups.items(), key=lambda g: (order.index(g[0][0]), g[0][1], -_mean(g[1]))
    ):
        judged = SCENES[scene].judged
        top = max((own for key, own in groups.items() if key[:2] == (scene, size)), key=_mean)
        values = [r[judged] for r in top]
        text = f"{spread([r[judged] for r in runs], 2)} dB"
        half = [
            r[judged]
            for r in trials
            if r["part"] == "slope" and (r["scene"], r["size"], r["form"]) == (scene, size, form)
        ]
        first = next(r[judged] for r in runs if r["seed"] == 0)
        lines.append(
            f"| {scene} | {size} | {Form.named(form).label} | {runs[0]['primitives']} | "
            f"{runs[0]['parameters_per_primitive']} | {runs[0]['iterations']} "
            f"| {f'**{text}**' if _mean(runs) >= _mean(top) - (max(values) - min(values)) / 2 else text} | "
            f"{spread([r['psnr_worst'] for r in runs], 1)} dB "
            f"| {spread([r['ssim'] for r in runs], 4)} | {f'{first - half[0]:+.2f} dB' if half else ''} | "
            f"{_sigma(runs)} |"
        )
    seeds = sorted({len(runs) for runs in groups.values()})
    lines.append(
        f"\nPreset `quick` with all primitives from the start and without a cool-down, "
        f"{' to '.join(str(n) for n in dict.fromkeys((seeds[0], seeds[-1])))} seed(s), mean ± half the spread; "
        f"*bytes of* so many of the paper's primitives; steps: as many as fit into "
        "the seconds of the paper's form, at paces measured in turns over whole runs; *error of σ*: relative L2 "
        "over the files' voxels, early / middle / late; *last doubling*: what the second half of the budget "
        "brought, first seed. PSNR is of "
        f"the whole image (solids, chair at 200×200 on white), inside the mask (fire, smoke_fire), clamped linear "
        f"(lit_solids). {found['cpu']}, one thread."
    )
    return "\n".join(lines)


def gaussian_table(trials: list[dict[str, Any]]) -> str:
    """Equal count and equal bytes in the conditions that a Gaussian can be trained in."""
    lines = [
        "| scene | primitive | primitives | parameters | PSNR | worst view | backend |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    groups: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for run in trials:
        if run["part"] == "gaussian":
            groups.setdefault((run["scene"], run["form"], run["primitives"]), []).append(run)
    size = SMALL["primitives"]
    for (scene, form, count), runs in sorted(
        groups.items(), key=lambda g: (g[0][0] != "solids", g[0][0], g[0][2] != size, -_mean(g[1]))
    ):
        same = "" if count == size and form != str(PAPER) else " (equal bytes)" if count != size else " (both)"
        lines.append(
            f"| {scene} | {Form.named(form).label} | {count}{same} | {runs[0]['parameters']} | "
            f"{spread([r['psnr'] for r in runs], 2)} dB "
            f"| {spread([r['psnr_worst'] for r in runs], 1)} dB | {runs[0]['backend']} |"
        )
    lines.append(
        f"\nReduced: solids at {SMALL['size']}×{SMALL['size']}, the folder's images averaged down "
        f"{SMALL['downsample']} times, {SMALL['iterations']} steps of every form "
        "(not equal seconds: the backends differ)."
    )
    return "\n".join(lines)


def _mean(runs: list[dict[str, Any]]) -> float:
    return sum(float(r[SCENES[r["scene"]].judged]) for r in runs) / len(runs)


def _sigma(runs: list[dict[str, Any]]) -> str:
    keys = [f"sigma_relative_l2_{third}" for third in ("early", "middle", "late")]
    return " / ".join(spread([r[k] for r in runs], 2) for k in keys) if all(k in runs[0] for k in keys) else ""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--fire", type=Path, help="a folder of EmberGen's .vdb files")
    parser.add_argument(
        "--parts", nargs="*", default=["forms", "slope", "gaussian"], choices=("forms", "slope", "gaussian")
    )
    parser.add_argument("--forms", nargs="*", default=[], metavar="K:EDGE", help="instead of the task's")
    parser.add_argument("--sizes", nargs="*", type=int, default=[], help="some of the scenes' sizes")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time, one thread each")
    parser.add_argument("--print", action="store_true", help="train nothing")
    parser.add_argument("--docs", action="store_true", help="write the tables into docs")
    args = parser.parse_args()
    if not args.print:
        paces = measured_paces(args) if {"forms", "slope"} & set(args.parts) else {}
        run_all(
            plan(args, paces),
            RESULTS,
            KEYS,
            args.jobs,
            lambda row: f"{row[SCENES[row['scene']].judged]:.2f} dB",
            {"cpu": cpu_name(), **({"paces": paces} if paces else {})},
        )
    found = json.loads(RESULTS.read_text())
    trials = found["trials"]
    tables = {"expressivity": forms_table(found), "expressivity-gaussian": gaussian_table(trials)}
    for name, text in tables.items():
        print(f"\n{text}")
        if args.docs:
            between_markers(DOCS, name, text)


if __name__ == "__main__":
    main()
