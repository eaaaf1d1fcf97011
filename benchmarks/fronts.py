"""How far the fronts of models reach, in time of a frame and in bytes: one scene of each task, models of very different
size trained equally long.

    python benchmarks/fronts.py [--scenes chair fire lit_solids] [--chair DIR] [--fire DIR] [--out DIR] [--docs]
    [--print]

It is `neuprim tradeoff task=… scene=…` with the words below: every model trains for the same time, on one thread, and
times of frames are taken in rounds that take turns between all of them. What is trained is kept in --out and gone on
with. Results go to benchmarks/results/fronts.json; --docs puts the tables between the markers of
docs/results/tradeoffs.md and draws docs/pictures/fronts.png; --print runs nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared.arguments import make_parser, require_folders
from shared.tables import DOCS, RESULT_PAGES, RESULTS, ROOT, between_markers, make_table, read_record, update_record

from neuprim.config.command_settings import parse_duration_setting
from neuprim.core.compute.threads import cpu_name
from neuprim.report.charts import Chart, Dot, front_chart, write_png_charts
from neuprim.search.ablation import run_ablation
from neuprim.search.tradeoff_measuring import TradeoffRequest

VIEWS = 25  # held-out views, evenly spread: as many as the chair has

RECORD = RESULTS / "fronts.json"
PICTURE = DOCS / "pictures" / "fronts.png"


@dataclass(frozen=True)
class Scene:
    """What is trained: words, knobs and budget of `neuprim tradeoff`; ``data`` is the word that gets the folder, if it
    wants one."""

    title: str
    words: tuple[str, ...]
    knobs: tuple[str, ...]
    budget: str
    data: str = ""


SCENES = {
    "chair": Scene(
        "static: NeRF-synthetic chair, 200×200",
        ("task=static", "scene=blender", "model.primitives=5600", "train.iterations=16000"),
        ("model.primitives",),
        "55m",
        "scene.path",
    ),
    "fire": Scene(
        "dynamic: EmberGen fire, 64×64",
        ("task=dynamic", "scene=vdb", "scene.size=64", "train.iterations=44000"),
        ("model.primitives",),
        "110m",
        "scene.vdb",
    ),
    "lit_solids": Scene(
        "relight: lit_solids (generated), 128×128",
        ("task=relight", "scene=lit_solids", "scene.size=128", "train.iterations=6000", "model.colour.form=additive"),
        ("model.primitives", "model.colour.visibility"),
        "40m",
    ),
}


KEYS = ("name", "primitives", "steps", "bytes", "time_ratio", "time_ratio_spread", "ms_per_frame", "ms_per_step")


def measure(name: str, data: Path | None, out: Path) -> dict[str, Any]:
    scene = SCENES[name]
    where = [] if data is None else [f"{scene.data}={data.resolve()}"]
    words = [*scene.words, *where, "renderer.threads=1", f"output_dir={(out / name).resolve()}"]
    _, record = run_ablation(
        TradeoffRequest(words, parse_duration_setting(scene.budget, scene.budget), VIEWS, knobs=scene.knobs), tell=print
    )
    whole = record.to_dict()
    models = [
        {key: point[key] for key in KEYS} | {key: point["quality"][key] for key in ("psnr", "ssim")}
        for point in whole["points"]
    ]
    return {
        "words": scene.words,
        "length": whole["length"],
        "models": models,
        **{front: whole["front"][front] for front in ("speed", "size")},
        "left_out": [one["knob"] + " " + " ".join(one["words"]) for one in whole["left_out"]],
        "views": VIEWS,
        "cpu": cpu_name(),
    }


def reach(result: Mapping[str, Any], front: str, cost: str) -> float:
    """Times that the dearest of a front costs of what its cheapest does."""
    costs = [result["models"][i][cost] for i in result[front]]
    return float(max(costs) / min(costs))


def report(name: str, result: Mapping[str, Any]) -> str:
    """Prints the table of a scene; returns it with what is said about it."""
    title = (
        f"**{SCENES[name].title}** (`{' '.join(result['words'])}`): the slowest model of its front needs "
        f"{reach(result, 'speed', 'time_ratio'):.1f} times as long for a frame as the fastest, the largest has "
        f"{reach(result, 'size', 'bytes'):.0f} times as many bytes as the smallest. {result['length']}"
    )
    print(f"\n{title}\n")
    models = result["models"]
    fronts = {"speed": "time", "size": "bytes"}
    columns = {
        "model": lambda i: (
            models[i]["name"] + (f", {models[i]['primitives']:,} primitives" if models[i]["name"] == "centre" else "")
        ),
        "front of": lambda i: ", ".join(text for front, text in fronts.items() if i in result[front]),
        "PSNR, dB": lambda i: f"{models[i]['psnr']:.2f}",
        "SSIM": lambda i: f"{models[i]['ssim']:.4f}",
        "time": lambda i: f"{models[i]['time_ratio']:.3f} ± {models[i]['time_ratio_spread']:.3f}",
        "ms": lambda i: f"{models[i]['ms_per_frame']:.2f}",
        "bytes": lambda i: f"{models[i]['bytes']:,}",
        "steps": lambda i: f"{models[i]['steps']:,}",
        "ms/step": lambda i: f"{models[i]['ms_per_step']:.1f}",
    }
    table = make_table(columns, sorted(range(len(models)), key=lambda i: -float(models[i]["psnr"])))
    return f"{title}\n\n{table}\n\n{result['cpu']}, one thread, one training each, {result['views']} held-out views."


def make_chart(name: str, result: Mapping[str, Any], front: str) -> Chart:
    """The front of a scene; its points are marked with their primitives."""
    cost, unit, label = {"speed": ("ms_per_frame", 1.0, "ms a frame, one thread"), "size": ("bytes", 1e-6, "MB")}[front]
    dots = []
    for i, model in enumerate(result["models"]):
        mark = f"{model['primitives']:,}" + (", no shadows" if "visibility=none" in model["name"] else "")
        dots.append(Dot(unit * model[cost], model["psnr"], mark=mark if i in result[front] else None))
    return front_chart(SCENES[name].title, label, "PSNR, dB", dots)


def main() -> None:
    parser = make_parser(__doc__, "--chair", "--fire", "--docs", "--print", scenes=SCENES)
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "fronts")
    args = parser.parse_args()
    if not args.only_print:
        require_folders(parser, args, args.scenes)
        for name in args.scenes:
            update_record(RECORD, **{name: measure(name, getattr(args, name, None), args.out)})
    found = read_record(RECORD)
    names = [name for name in SCENES if name in found]
    text = "\n\n".join(report(name, found[name]) for name in names)
    if args.docs:
        between_markers(RESULT_PAGES / "tradeoffs.md", "fronts", text)
        charts = [make_chart(name, found[name], front) for front in ("speed", "size") for name in names]
        write_png_charts(PICTURE, charts, rows=2)


if __name__ == "__main__":
    main()
