"""How far the fronts of models reach, in time of a frame and in bytes: one scene of each task, models of very different
size trained equally long.

    python benchmarks/fronts.py [--scenes chair fire lit_solids] [--chair DIR] [--fire DIR] [--out DIR] [--docs]
    [--print]

It is `neuprim tradeoff task=… scene=…` with the words below: every model trains for the same time, on one thread, and
times of frames are taken in rounds that take turns between all of them. What is trained is kept in --out and gone on
with. Results go to benchmarks/results/fronts.json; --docs puts the tables between the markers of docs/tradeoffs.md and
draws docs/pictures/fronts.png; --print runs nothing.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared.tables import ROOT, Table, between_markers

from neuprim.core.compute.threads import cpu_name
from neuprim.core.io.files import write_json
from neuprim.search.ablation import run_ablation
from neuprim.search.ablation_folder import AblationRequest
from neuprim.search.render_tradeoff import parse_budget

VIEWS = 25
"""Held-out views, evenly spread: as many as the chair has."""

RESULTS = Path(__file__).parent / "results" / "fronts.json"
PICTURE = ROOT / "docs" / "pictures" / "fronts.png"


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
        ("task=relight", "scene=lit_solids", "scene.size=128", "train.iterations=6000"),
        ("model.primitives", "model.colour.visibility"),
        "40m",
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--fire", type=Path, help="a folder of OpenVDB files")
    parser.add_argument("--out", type=Path, default=ROOT / "outputs" / "fronts")
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    if not args.only_print:
        for name in args.scenes:
            data = getattr(args, name, None)
            if SCENES[name].data and data is None:
                parser.error(f"--{name}: wants the folder of its data; or leave it out of --scenes")
            measured = measure(name, data, args.out)
            found = json.loads(RESULTS.read_text(encoding="utf-8")) if RESULTS.exists() else {}
            write_json(RESULTS, {**found, name: measured})
    found = json.loads(RESULTS.read_text(encoding="utf-8"))
    texts = [report(name, found[name]) for name in SCENES if name in found]
    if args.docs:
        between_markers(ROOT / "docs" / "tradeoffs.md", "fronts", "\n\n".join(texts))
        draw(found)


def measure(name: str, data: Path | None, out: Path) -> dict[str, Any]:
    scene = SCENES[name]
    where = [] if data is None else [f"{scene.data}={data.resolve()}"]
    words = [*scene.words, *where, "renderer.threads=1", f"output_dir={(out / name).resolve()}"]
    _, record = run_ablation(AblationRequest(words, parse_budget(scene.budget), VIEWS, knobs=scene.knobs), print)
    whole = record.to_dict()
    shown = [
        {key: point[key] for key in KEYS} | {"psnr": point["quality"]["psnr"], "ssim": point["quality"]["ssim"]}
        for point in whole["points"]
    ]
    return {
        "words": scene.words,
        "length": whole["length"],
        "models": shown,
        "speed": whole["front"]["speed"],
        "size": whole["front"]["size"],
        "left_out": [one["knob"] + " " + " ".join(one["words"]) for one in whole["left_out"]],
        "views": VIEWS,
        "cpu": cpu_name(),
    }


KEYS = ("name", "primitives", "steps", "bytes", "time_ratio", "time_ratio_spread", "ms_per_frame", "ms_per_step")


def reach(result: Mapping[str, Any], front: str, cost: str) -> float:
    """Times that the dearest of a front costs of what its cheapest does."""
    costs = [result["models"][i][cost] for i in result[front]]
    return float(max(costs) / min(costs))


def report(name: str, result: Mapping[str, Any]) -> str:
    """Prints the table of a scene; returns it with what is said about it."""
    speed, size = reach(result, "speed", "time_ratio"), reach(result, "size", "bytes")
    title = (
        f"**{SCENES[name].title}** (`{' '.join(result['words'])}`): {speed:.1f} times in the time of a frame, "
        f"{size:.0f} times in bytes. {result['length']}"
    )
    print(f"\n{title}\n")
    table = Table("model", "front of", "PSNR, dB", "SSIM", "time", "ms", "bytes", "steps", "ms/step")
    models: Sequence[Mapping[str, Any]] = result["models"]
    for i in sorted(range(len(models)), key=lambda i: -float(models[i]["psnr"])):
        model = models[i]
        fronts = [text for front, text in (("speed", "time"), ("size", "bytes")) if i in result[front]]
        table.row(
            model["name"] + ("" if model["name"] != "centre" else f", {model['primitives']:,} primitives"),
            ", ".join(fronts),
            f"{model['psnr']:.2f}",
            f"{model['ssim']:.4f}",
            f"{model['time_ratio']:.3f} ± {model['time_ratio_spread']:.3f}",
            f"{model['ms_per_frame']:.2f}",
            f"{model['bytes']:,}",
            f"{model['steps']:,}",
            f"{model['ms_per_step']:.1f}",
        )
    return f"{title}\n\n{table}\n\n{result['cpu']}, one thread, one training each, {result['views']} held-out views."


def draw(found: Mapping[str, Any]) -> None:
    """The fronts of each task: time above, bytes below."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    names = [name for name in SCENES if name in found]
    figure, axes = pyplot.subplots(
        2, len(names), figsize=(4.2 * len(names), 5.6), constrained_layout=True, squeeze=False
    )
    for column, name in enumerate(names):
        models = found[name]["models"]
        kinds = (("speed", "ms_per_frame", 1.0, "ms a frame, one thread"), ("size", "bytes", 1e-6, "MB"))
        for axis, (front, cost, unit, label) in zip(axes[:, column], kinds, strict=True):
            line = sorted(found[name][front], key=lambda i: models[i][cost])
            others = [i for i in range(len(models)) if i not in line]
            axis.plot(
                [unit * models[i][cost] for i in line],
                [models[i]["psnr"] for i in line],
                marker="o",
                markersize=4.5,
                label="front",
            )
            axis.plot(
                [unit * models[i][cost] for i in others],
                [models[i]["psnr"] for i in others],
                ".",
                color="0.65",
                label="behind it",
            )
            for i in line:
                axis.annotate(
                    f"{models[i]['primitives']:,}" + (", no shadows" if "visibility=none" in models[i]["name"] else ""),
                    (unit * models[i][cost], models[i]["psnr"]),
                    textcoords="offset points",
                    xytext=(4, -9),
                    fontsize=7,
                )
            axis.set_xscale("log")
            axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.set_xlabel(label)
            axis.grid(alpha=0.25)
            axis.margins(x=0.13, y=0.1)  # room for the labels
            if others:
                axis.legend(fontsize=7, loc="lower right")
        axes[0, column].set_title(SCENES[name].title, fontsize=9)
    for axis in axes[:, 0]:
        axis.set_ylabel("PSNR, dB")
    figure.savefig(PICTURE, dpi=110)
    pyplot.close(figure)


if __name__ == "__main__":
    main()
