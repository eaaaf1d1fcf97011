"""What one primitive can express, and what its bytes are worth: the forms of the family, the paper's and a Gaussian, at
equal bytes and equal seconds.

    python benchmarks/expressivity.py [--scenes solids chair fire smoke_fire lit_solids] [--chair DIR] [--fire DIR]
        [--parts forms slope gaussian] [--sizes 100 400 2000] [--seeds 3] [--docs] [--print]

Each run is its task's preset `quick`, cut to a number of steps, with all primitives from the start and rates without a
cool-down. A size is the bytes of so many of the paper's primitives; every form gets as many primitives as these bytes
hold. Parts:

    forms     every form at every size, for as many steps as fit into the seconds that the paper's form takes for its
              own: the forms take turns on this machine first, over a whole run, and each has its pace in seconds that
              its thread computes
    slope     the same with half the steps, first seed: what the last doubling of the budget still brought
    gaussian  a true Gaussian has no fast kernel and runs on the reference backend: small images of the static scenes
              and few steps, equal count and equal bytes, beside the other forms in the same conditions

Numbers are means over seeds +- half the spread, of the last checkpoint, on the test views. Results go to
benchmarks/results/expressivity.json after every run, and only what is missing is run. --docs puts the tables between
the markers in docs/results/expressivity.md; --print runs nothing.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

from shared.arguments import make_parser, require_folders
from shared.forms import AS_RECORDED, PAPER, SCENES, Form
from shared.tables import (
    RESULT_PAGES,
    RESULTS,
    Run,
    between_markers,
    format_range,
    group_runs,
    make_table,
    read_record,
    spread_of,
)
from shared.trials import Trial, measure_paces, run_all

RECORD = RESULTS / "expressivity.json"
SIGMA = tuple(f"sigma_relative_l2_{third}" for third in ("early", "middle", "late"))
KEYS = (
    *("psnr", "psnr_worst", "ssim", "psnr_mask", "psnr_linear_clamped"),
    *("psnr_pooled_cast_shadow", "psnr_pooled_highlight", *SIGMA),
    *("parameters", "parameters_per_primitive", "primitives", "backend"),
)
FORMS = {
    "static": ("8:0", "0:2", "2:2", "4:2"),
    "dynamic": ("8:0@images", "0:2@images", "0:2", "2:2"),
    "relight": ("8:0", "0:2", "2:2"),
}
"""The first is the paper's, whose seconds all others get."""
STEPS = {
    "solids": {100: 2000, 400: 2000, 2000: 3000},
    "chair": {100: 2000, 400: 2000, 2000: 3000},
    "fire": {2000: 5000},
    "smoke_fire": {1000: 5000},
    "lit_solids": {2000: 2000},
}
"""Of the paper's form; the others train as long in seconds."""
SMALL = 100  # primitives of the part ``gaussian``
SMALL_STEPS = 400
SMALL_IMAGES = {"solids": "scene.size=64", "chair": "scene.downsample=4"}


def words_of(form: str, scene: str, args: argparse.Namespace, count: int) -> tuple[str, ...]:
    own = [
        *SCENES[scene].all_words(vars(args), scene),
        *(["model.colour.form=additive"] if scene == "lit_solids" else []),
    ]
    return (*own, *AS_RECORDED, *Form.named(form).words, f"model.primitives={count}")


def equal_seconds(scene: str, size: int, args: argparse.Namespace) -> dict[str, Trial]:
    """Every form at a size, for as long as the paper's takes for its steps."""
    task, whole = SCENES[scene].task, STEPS[scene][size]

    def trial(form: str, steps: int) -> Trial:
        return Trial("", words_of(form, scene, args, Form.named(form).equal_bytes(size, task)), steps)

    forms = args.forms or FORMS[task]
    named = {f"{scene} {size} {form}": trial(form, whole) for form in forms}
    paces = measure_paces(RECORD, trial(FORMS[task][0], whole), named, whole)
    return {form: trial(form, round(whole / paces[f"{scene} {size} {form}"])) for form in forms}


def plan(args: argparse.Namespace) -> Iterator[Trial]:
    """Every run; the first seed of everything first, so that an early end leaves whole rows."""

    def named(part: str, scene: str, size: int, form: str, words: tuple[str, ...], steps: int, seed: int) -> Trial:
        facts = (("part", part), ("scene", scene), ("form", form), ("size", size))
        count = next(word for word in words if word.startswith("model.primitives=")).partition("=")[2]
        return Trial(f"{part}-{scene}-{size}-{form}-{count}-{steps}-{seed}", words, steps, seed, 0, facts)

    timed = {"forms", "slope"} & set(args.parts)
    sizes = [
        (scene, size) for scene in args.scenes for size in STEPS[scene] if timed and size in (args.sizes or [size])
    ]
    forms = {key: equal_seconds(*key, args) for key in sizes}
    for seed in range(args.seeds):
        for (scene, size), trials in forms.items():
            for form, trial in trials.items():
                if "forms" in args.parts:
                    yield named("forms", scene, size, form, trial.words, trial.iterations, seed)
                if "slope" in args.parts and seed == 0:
                    yield named("slope", scene, size, form, trial.words, trial.iterations // 2, seed)
        if "gaussian" in args.parts:
            for scene in (name for name in args.scenes if name in SMALL_IMAGES):
                for form in (*(args.forms or FORMS["static"]), "gaussian"):
                    for count in dict.fromkeys((SMALL, Form.named(form).equal_bytes(SMALL, "static"))):
                        words = (*words_of(form, scene, args, count), SMALL_IMAGES[scene])
                        yield named("gaussian", scene, SMALL, form, words, SMALL_STEPS, seed)


# ---------------------------------------------------------------- tables


def mean_score(runs: Sequence[Run]) -> float:
    return sum(float(run[SCENES[run["scene"]].judged]) for run in runs) / len(runs)


def forms_table(record: dict[str, Any]) -> str:
    """One row per form, scene and size; the best in bold, and all whose mean lies within its half spread."""
    groups = group_runs([run for run in record["trials"] if run["part"] == "forms"], "scene", "size", "form")
    halved = {(r["scene"], r["size"], r["form"]): r for r in record["trials"] if r["part"] == "slope"}
    order = list(SCENES)

    def score(runs: Sequence[Run]) -> str:
        key, judged = (runs[0]["scene"], runs[0]["size"]), SCENES[runs[0]["scene"]].judged
        best = max((own for found, own in groups.items() if found[:2] == key), key=mean_score)
        values = [run[judged] for run in best]
        text = f"{spread_of(runs, judged)} dB"
        return f"**{text}**" if mean_score(runs) >= mean_score(best) - (max(values) - min(values)) / 2 else text

    def last_doubling(runs: Sequence[Run]) -> str:
        half = halved.get((runs[0]["scene"], runs[0]["size"], runs[0]["form"]))
        judged = SCENES[runs[0]["scene"]].judged
        first = next(run[judged] for run in runs if run["seed"] == 0)
        return f"{first - half[judged]:+.2f} dB" if half else ""

    columns = {
        "scene": lambda runs: runs[0]["scene"],
        "bytes of": lambda runs: runs[0]["size"],
        "primitive": lambda runs: Form.named(runs[0]["form"]).label,
        "primitives": lambda runs: runs[0]["primitives"],
        "numbers each": lambda runs: runs[0]["parameters_per_primitive"],
        "steps": lambda runs: runs[0]["iterations"],
        "PSNR": score,
        "worst view": lambda runs: f"{spread_of(runs, 'psnr_worst', 1)} dB",
        "SSIM": lambda runs: spread_of(runs, "ssim", 4),
        "last doubling": last_doubling,
        "error of σ": lambda runs: " / ".join(spread_of(runs, key) for key in SIGMA if key in runs[0]),
    }
    ordered = sorted(groups.items(), key=lambda item: (order.index(item[0][0]), item[0][1], -mean_score(item[1])))
    table = make_table(columns, [runs for _, runs in ordered])
    seeds = format_range(len(runs) for runs in groups.values())
    return (
        f"{table}\n\nPreset `quick` with all primitives from the start and without a cool-down, {seeds} seed(s), mean "
        f"± "
        "half the spread; *bytes of* so many of the paper's primitives; steps: as many as fit into the seconds of the "
        "paper's form, at paces measured in turns over whole runs; *error of σ*: relative L2 over the files' voxels, "
        "early / middle / late; *last doubling*: what the second half of the budget brought, first seed. PSNR is of "
        "the whole image (solids, chair at 200×200 on white), inside the mask (fire, smoke_fire), clamped linear "
        f"(lit_solids). {record['cpu']}, one thread."
    )


def gaussian_table(trials: Sequence[Run]) -> str:
    """Equal count and equal bytes in the conditions that a Gaussian can be trained in."""
    groups = group_runs([run for run in trials if run["part"] == "gaussian"], "scene", "form", "primitives")

    def count(runs: Sequence[Run]) -> str:
        own, paper = runs[0]["primitives"], runs[0]["form"] == str(PAPER)
        return f"{own}{' (equal bytes)' if own != SMALL else ' (both)' if paper else ''}"

    columns = {
        "scene": lambda runs: runs[0]["scene"],
        "primitive": lambda runs: Form.named(runs[0]["form"]).label,
        "primitives": count,
        "parameters": lambda runs: runs[0]["parameters"],
        "PSNR": lambda runs: f"{spread_of(runs, 'psnr')} dB",
        "worst view": lambda runs: f"{spread_of(runs, 'psnr_worst', 1)} dB",
        "backend": lambda runs: runs[0]["backend"],
    }
    ordered = sorted(
        groups.items(), key=lambda item: (item[0][0] != "solids", item[0][0], item[0][2] != SMALL, -mean_score(item[1]))
    )
    table = make_table(columns, [runs for _, runs in ordered])
    return (
        f"{table}\n\nA small version of the comparison: solids at 64×64, the folder's images reduced by a factor of 4, "
        f"and {SMALL_STEPS} steps of every form, as seconds of different backends cannot be compared."
    )


def main() -> None:
    parser = make_parser(__doc__, "--chair", "--fire", "--seeds", "--jobs", "--docs", "--print", scenes=STEPS)
    parts = ["forms", "slope", "gaussian"]
    parser.add_argument("--parts", nargs="*", default=parts, choices=parts)
    parser.add_argument("--forms", nargs="*", default=[], metavar="K:EDGE", help="instead of the task's")
    parser.add_argument("--sizes", nargs="*", type=int, default=[], help="some of the scenes' sizes")
    args = parser.parse_args()
    if not args.only_print:
        require_folders(parser, args, args.scenes)
        run_all(list(plan(args)), RECORD, KEYS, args.jobs)
    record = read_record(RECORD)
    for name, make in (("expressivity", forms_table), ("expressivity-gaussian", lambda r: gaussian_table(r["trials"]))):
        text = make(record)
        print()
        if args.docs:
            between_markers(RESULT_PAGES / "expressivity.md", name, text)


if __name__ == "__main__":
    main()
