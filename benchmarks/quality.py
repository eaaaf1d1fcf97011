"""Static scenes and relighting: quality, size and speed by training time, beside published results.

    python benchmarks/quality.py SCENE ... [--seconds 240 1200] [--steps 2500] [--seeds 3] [--set KEY=VALUE ...]
    [--tune] [--lpips FILE] [--jobs 1] [--out DIR] [--record FILE] [--docs]

SCENE is the folder of a data set or the name of a built-in scene, all of one task; `SCENE,KEY=VALUE,...` has settings
of its own, as in `solids`, `room,scene.size=400` or `DIR/cup,scene.downsample=2`. A row is a run in a directory below
--out, one thread, all as the preset has it but --set, and then `neuprim compress`. A budget is seconds that this thread
computes while the model learns, or steps. --tune judges by training views that are held out instead of the test views,
in a record of its own.

Rows go to benchmarks/results/TASK.json one by one, and the table to TASK.md beside it. Only what is missing is run; a
row that was interrupted goes on from its checkpoint. --docs puts the table between the markers of
docs/results/static.md or docs/results/relighting.md.
Without SCENE nothing is run, and the static table is made, or that of --record. The picture of mic:

    python docs/make_pictures.py outputs/quality/mic_800-240s-0 docs/pictures/static.png 3 400

Published figures are those of neuprim/runs/paper_tables.yaml and benchmarks/results/published.json, which name their
sources. Values are means over seeds +- half the spread, of the last checkpoint. SSIM and LPIPS of static scenes are
counted as the tools of 3D Gaussian splatting do (`ssim_3dgs`, `lpips_3dgs`). Scores of relighting are those of linear
light clamped to 0..1 and of display values, and of pixel classes where the scene knows them.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import torch
from shared.arguments import make_parser
from shared.tables import (
    RESULT_PAGES,
    RESULTS,
    Record,
    Run,
    Table,
    between_markers,
    group_runs,
    read_record,
    spread_of,
)
from shared.trials import Trial, run_all

from neuprim.config import compose
from neuprim.core.train import trainer as trainer_module
from neuprim.runs.evaluate import evaluate_fitted
from neuprim.runs.fit import Events, Fitted
from neuprim.runs.measure import render_image
from neuprim.runs.paper import find_paper_figure, load_paper_run_tables
from neuprim.runs.training import train_in_directory
from neuprim.search.compress import CompressRequest, compress_run

PUBLISHED = RESULTS / "published.json"
PAPER_SIZE = "800×800"
HOLD_OUT = 8
COMPRESS_SECONDS = 30.0  # as `neuprim compress` fine-tunes unless told otherwise
COLUMNS = ("scene", "method", "training", "primitives", "bytes", "compressed")
CLASSES = {"lit": "lit", "cast_shadow": "cast shadow", "attached_shadow": "attached shadow", "highlight": "highlight"}
SCORES: dict[str, dict[str, tuple[str, int]]] = {
    "static": {
        "psnr": ("PSNR", 2),
        "psnr_gain": ("a gain away", 2),
        "ssim": ("SSIM", 4),
        "ssim_3dgs": ("SSIM (3DGS)", 4),
        "lpips_3dgs": ("LPIPS (3DGS)", 4),
    },
    "relight": {
        "psnr_linear_clamped": ("PSNR, linear", 2),
        "psnr_display": ("PSNR, display", 2),
        "ssim_display": ("SSIM, display", 4),
        **{f"psnr_pooled_{key}": (name, 1) for key, name in CLASSES.items()},
    },
}
"""Columns of each task, of metrics, with digits."""
KEYS = (*(key for scores in SCORES.values() for key in scores), "psnr_worst", "primitives", "model_bytes")
PAGES = {"static": RESULT_PAGES / "static.md", "relight": RESULT_PAGES / "relighting.md"}


def scene_words(text: str) -> tuple[str, str, list[str]]:
    """Task, name and settings of SCENE."""
    place, *settings = text.split(",")
    folder = Path(place)
    if not folder.is_dir():
        return ("relight" if place == "lit_solids" else "static"), text, [f"scene={place}", *settings]
    name, transforms = ",".join([folder.resolve().name, *settings]), folder / "transforms_train.json"
    layout = "nerfstudio" if (folder / "transforms.json").exists() else "colmap"
    if transforms.exists():
        layout = "olat" if '"pl_pos"' in transforms.read_text(encoding="utf-8") else "blender"
    return (
        ("relight" if layout == "olat" else "static"),
        name,
        [f"scene={layout}", f"scene.path='{folder.resolve()}'", *settings],
    )


def plan(args: argparse.Namespace) -> list[Trial]:
    """All rows of the first seed, short budgets first; then those of the next."""
    budgets = [(f"{steps:,} steps", steps, f"train.iterations={steps}", "null") for steps in args.steps]
    budgets += [(f"{seconds:g} s", 0, "train.iterations=null", f"{seconds:g}") for seconds in args.seconds]
    shared = [*args.set, *([f"metrics.lpips='{args.lpips.resolve()}'"] if args.lpips else [])]
    trials = []
    for seed in range(args.seeds):
        for budget, steps, iterations, seconds in budgets:
            for task, name, words in map(scene_words, args.scenes):
                own = (f"task={task}", *words, *shared, iterations, f"train.max_seconds={seconds}")
                facts = (("task", task), ("scene", name), ("settings", " ".join(args.set)), ("budget", budget))
                trial = "-".join([name, budget.replace(" ", "").replace(",", ""), *args.set, str(seed)])
                trials.append(Trial(trial, own, steps, seed, HOLD_OUT if args.tune else 0, facts))
    return trials


def measure_row(data: tuple[Trial, Path], attempt: int, events: Events) -> Record:
    """Train, evaluate and, unless held-out views judge, compress; the function of a job."""
    trial, out = data[0], data[1] / data[0].name
    torch.set_num_threads(1)
    own = [f"seed={trial.seed}", "renderer.threads=1", f"output_dir='{out}'", "resume=true"]
    # the budget counts what this thread computes, and not what others on the machine do meanwhile
    with patch.object(trainer_module, "time", SimpleNamespace(perf_counter=time.process_time)):
        fitted, interrupted = train_in_directory(compose([*trial.words, *own]), events, hold_out=trial.hold_out)
        if interrupted:
            raise KeyboardInterrupt
        start = time.process_time()
        metrics = evaluate_fitted(fitted, out)
        evaluated = time.process_time() - start
        compress = CompressRequest(out, overwrite=True, seconds=COMPRESS_SECONDS)
        compressed = None if trial.hold_out else compress_run(compress)
    row = {"trial": trial.name, "seed": trial.seed, "iterations": fitted.trainer.step, **dict(trial.facts)}
    row |= {"cpu_seconds": fitted.trainer.elapsed, "evaluation_cpu_seconds": evaluated}
    row |= {"size": "×".join(map(str, metrics["image_size"])), "frame_ms": time_frames(fitted)}
    if compressed is not None:
        row |= {"compressed_bytes": compressed.after, "psnr_compressed": compressed.measured["psnr"][1]}
    return row | {key: metrics[key] for key in KEYS if metrics.get(key) is not None}


def time_frames(fitted: Fitted) -> float:
    """Milliseconds of one thread in which a held-out view is rendered: the mean over views of the fastest of three."""
    test, took = fitted.dataset.test, []
    for number in range(len(test)):
        view, times = test.view(number), []
        for _ in range(3):
            start = time.process_time()
            render_image(fitted.model, view, fitted.config.renderer, fitted.dataset.background)
            times.append(time.process_time() - start)
        took.append(min(times))
    return 1e3 * statistics.mean(took)


def published_rows(scene: str, size: str) -> Iterator[Record]:
    """What others report of a scene at this image size."""
    name = scene.partition(",")[0].partition("_")[0].lower()
    (paper,) = (found for found in load_paper_run_tables() if found["loader"] == "blender")
    if size == PAPER_SIZE and name in paper["scenes"]:
        for row in paper["rows"]:
            for method, figures in ((f"the paper, {row['name']}", row), (row["beside"]["name"], row["beside"])):
                kinds = (("psnr", "psnr"), ("ssim_3dgs", "ssim"), ("lpips_3dgs", "lpips"))
                yield {"method": method} | {key: find_paper_figure(paper, figures, name, kind) for key, kind in kinds}
    for row in read_record(PUBLISHED)["rows"]:
        if (row["scene"], row["size"]) == (name, size):
            yield row


def group_rows(runs: Sequence[Run]) -> Iterator[tuple[str, str, list[list[Run]]]]:
    """Scene, image size, and its rows by training time; runs of a row differ by their seed alone."""

    def time_of(row: Sequence[Run]) -> float:
        return statistics.mean(run["cpu_seconds"] for run in row)

    for (scene, size), own in group_runs(runs, "scene", "size").items():
        yield scene, size, sorted(group_runs(own, "settings", "budget").values(), key=time_of)


def row_cells(runs: Sequence[Run], task: str = "static") -> list[str]:
    """Cells from the budget on of runs that differ by their seed alone, or of one published row."""

    def known(key: str) -> list[Run]:
        return [run for run in runs if run.get(key) is not None]

    def mean(key: str, form: str) -> str:
        return form.format(statistics.mean(run[key] for run in known(key))) if known(key) else "–"

    sizes = [mean(key, "{:,.0f}") for key in ("primitives", "model_bytes", "compressed_bytes")]
    scores = [spread_of(known(key), key, digits) for key, (_, digits) in SCORES[task].items()]
    budget = runs[0].get("budget", "–")
    if budget.endswith("steps"):
        budget += mean("cpu_seconds", " ({:.0f} s)")
    return [budget, *sizes, *scores, mean("frame_ms", "{:.1f}")]


def method_cell(settings: str, task: str) -> str:
    """Of own rows: the settings; of relighting those of the model, as a network trains with many of its own."""
    own = [word for word in settings.split() if word.startswith("model.")] if task == "relight" else []
    return f"neuprim, `{' '.join(own) or settings}`" if settings else "neuprim"


def table(record: Record) -> str:
    """All rows of a record, each scene's own and then the published ones."""
    task = record["trials"][0].get("task", "static")
    made = Table(*COLUMNS, *(title for title, _ in SCORES[task].values()), "ms a frame")
    for scene, size, rows in group_rows(record["trials"]):
        for runs in rows:
            made.row(f"{scene}, {size}", method_cell(runs[0]["settings"], task), *row_cells(runs, task))
        for row in published_rows(scene, size):
            made.row(f"{scene}, {size}", row["method"], *row_cells([row], task))
    if task == "relight":
        return f"{made}\n\nOne thread of {record['cpu']}."
    sources = "\n".join(f"* {name}: {source}" for name, source in read_record(PUBLISHED)["sources"].items())
    return f"{made}\n\nOwn rows: one thread of {record['cpu']}.\n\n{sources}"


def main() -> None:
    parser = make_parser(__doc__, "--seeds", "--jobs", "--docs")
    parser.set_defaults(jobs=1)
    parser.add_argument("scenes", nargs="*", metavar="SCENE")
    parser.add_argument("--seconds", nargs="*", type=float, default=[], help="budgets in seconds of the CPU")
    parser.add_argument("--steps", nargs="*", type=int, default=[], help="budgets in steps")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="further settings of every run")
    parser.add_argument("--tune", action="store_true", help="judge by training views that are held out")
    parser.add_argument("--lpips", type=Path, help="weights, as metrics.lpips takes them")
    parser.add_argument("--out", type=Path, default=Path("outputs/quality"), help="folder of the runs")
    parser.add_argument("--record", type=Path, help="another record than benchmarks/results/TASK.json")
    args = parser.parse_args()
    tasks = {scene_words(scene)[0] for scene in args.scenes} or {"static"}
    if len(tasks) > 1:
        parser.error("found scenes of two tasks; expected those of one")
    (task,) = tasks
    path = args.record or RESULTS / f"{task}{'_tune' if args.tune else ''}.json"
    run_all(plan(args), path, args.out.absolute(), args.jobs, call="quality:measure_row")
    record = read_record(path)
    text = table(record)
    path.with_suffix(".md").write_text(f"{text}\n", encoding="utf-8")
    if args.docs:
        task = record["trials"][0].get("task", "static")
        between_markers(PAGES[task], task, text)


if __name__ == "__main__":
    main()
