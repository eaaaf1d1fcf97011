"""What one primitive can express: neural, Gaussian and constant-density primitives at equal count and at equal bytes.

    python benchmarks/expressivity.py [DIR] [--seeds 3] [--primitives 100] [--iterations 400] [--keep] [--docs]

Trains on the embedded scene `solids` and, if DIR is given, on that NeRF-synthetic folder. Every run is the static task
with the preset `quick`, cut to a fixed number of iterations rather than seconds: the Gaussian does not lower to a form that the
fast kernels know and runs on the reference backend, so equal seconds would compare backends. For the same reason the images are
small. Equal bytes means that the forms with fewer parameters get more primitives. Numbers are means over seeds +- half the
spread, on the test views, of the last checkpoint.

Results go to benchmarks/results/expressivity.json after every run (--keep goes on from there), models to outputs/expressivity, and
from the models of seed 0 the picture docs/pictures/expressivity.png is drawn (Figure 9 of the paper). --docs puts the table between
the markers in docs/expressivity.md; --print runs nothing and prints the recorded table.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import torch
from shared.machine import cpu_name
from shared.tables import between_markers, spread

from neuprim.config import compose
from neuprim.core.checkpoint import save_model
from neuprim.runs.fit import fit

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "expressivity.json"
DOCS = HERE.parent / "docs" / "expressivity.md"
PICTURE = HERE.parent / "docs" / "pictures" / "expressivity.png"
KEYS = ("psnr", "psnr_worst", "ssim", "iterations", "parameters", "parameters_per_primitive", "primitives", "backend", "seed")


@dataclass(frozen=True)
class Form:
    """One kind of primitive: its name in the table, its overrides, and its parameters besides the 48 of the colour."""

    label: str
    words: tuple[str, ...]
    size: int


# Each form's amplitudes learn at the best of the rates tried at 150 primitives and 400 iterations of solids: the preset's own were found
# for runs ten times as long. Tried were, in dB of seed 0: neural, (b2, w2) = (0.01, 0.01) 24.68, (0.03, 0.01) 24.91, (0.1, 0.01) 24.45,
# (0.01, 0.03) 24.73, (0.03, 0.03) 25.25, (0.05, 0.06) 24.72, (0.1, 0.03) 25.15, (0.1, 0.1) 24.87, (0.2, 0.1) 23.87; Gaussian, 0.02 23.63,
# 0.1 25.18, 0.2 25.37; constant, 0.01 22.73, 0.03 22.93, 0.1 22.32, 0.3 20.39.
FORMS = {
    "neural": Form("neural, K = 8", ("model.neurons=8", "train.rates.b2=0.03", "train.rates.w2=0.03"), 51),
    "gaussian": Form("Gaussian", ("model.density.form=gaussian", "train.rates.log_amplitude=0.2"), 11),
    "constant": Form("constant density, K = 0", ("model.neurons=0", "train.rates.b2=0.03"), 11),
}
COLOUR = 48


@dataclass(frozen=True)
class Job:
    scene: str
    form: str
    primitives: int
    seed: int

    @property
    def name(self) -> str:
        return f"{self.scene}-{self.form}-{self.primitives}-{self.seed}"


def equal_bytes(form: str, primitives: int) -> int:
    """As many primitives of ``form`` as have the parameters of ``primitives`` neural ones."""
    return round(primitives * (FORMS["neural"].size + COLOUR) / (FORMS[form].size + COLOUR))


def plan(scenes: list[str], forms: list[str], primitives: int, seeds: int) -> list[Job]:
    """Every run; seed 0 of everything first, so that an early end leaves whole rows."""
    jobs = []
    for seed in range(seeds):
        for scene in scenes:
            for form in forms:
                for count in dict.fromkeys((primitives, equal_bytes(form, primitives))):
                    jobs.append(Job(scene, form, count, seed))
    return jobs


def scene_words(scene: str, folder: Path | None, args: argparse.Namespace) -> list[str]:
    if scene == "solids":
        return ["scene=solids", f"scene.size={args.size}"]
    assert folder is not None
    return ["scene=blender", f"scene.path='{folder.resolve()}'", f"scene.downsample={args.downsample}"]


def train(job: Job, words: list[str], iterations: int, backend: str, target: Path) -> dict[str, Any]:
    """One run of one thread: what `neuprim run` does, less its pictures and report. Leaves configuration and model in ``target``."""
    torch.set_num_threads(1)
    config = compose([
        "task=static", *words, *FORMS[job.form].words, f"model.primitives={job.primitives}", f"seed={job.seed}", "train.background=white",
        f"train.iterations={iterations}", "train.max_seconds=null", f"train.population.every={max(iterations // 20, 1)}",
        f"renderer.backend={backend}", "renderer.threads=1", f"output_dir='{target.resolve()}'",
    ], check_output=False)  # fmt: skip
    fitted = fit(config)
    dataset = fitted.dataset
    target.mkdir(parents=True, exist_ok=True)
    (target / "config.yaml").write_text(config.to_yaml())
    save_model(target / "model.safetensors", fitted.model, config.task, {"color_space": dataset.color_space})
    metrics = fitted.metrics()
    return {"scene": dataset.name, "form": job.form, "job": job.name, **{k: metrics[k] for k in KEYS}, "versions": metrics["versions"]}


# ---------------------------------------------------------------- the table


def table(results: dict[str, Any]) -> str:
    """Markdown; the note below states everything that was reduced."""
    lines = [
        "| scene | primitive | primitives | parameters | PSNR | worst view | SSIM | backend |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    groups: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for run in results["runs"]:
        groups.setdefault((run["scene"], run["form"], run["primitives"]), []).append(run)
    settings = results["settings"]
    order = list(FORMS)
    for scene, form, count in sorted(groups, key=lambda k: (k[0] != "solids", k[0], k[2] != settings["primitives"], order.index(k[1]))):
        runs = groups[scene, form, count]
        same = "" if count == settings["primitives"] else " (equal bytes)"
        lines.append(
            f"| {scene} | {FORMS[form].label} | {count}{same} | {runs[0]['parameters']} | {spread([r['psnr'] for r in runs], 2)} dB "
            f"| {spread([r['psnr_worst'] for r in runs], 1)} dB | {spread([r['ssim'] for r in runs], 4)} | {runs[0]['backend']} |"
        )
    seeds = sorted({len(runs) for runs in groups.values()})
    count = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
    data = f"solids at {settings['size']}×{settings['size']}"
    if settings["folder"]:
        data += f", {settings['folder']} averaged down {settings['downsample']} times"
    note = (
        f"{data}; {settings['iterations']} iterations of the preset `quick`, white background, {count} seed(s); mean ± half the spread over "
        "the test views of the last checkpoint. Reduced sizes: the Gaussian has no fast kernel and runs on the reference backend, which is why "
        f"the budget counts iterations. {results['cpu']}."
    )
    return "\n".join(lines) + "\n\n" + note


# ---------------------------------------------------------------- the whole


def fit_all(args: argparse.Namespace) -> None:
    """Train what is missing, ``args.jobs`` runs at a time, and record each as it ends."""
    scenes = ["solids"] + ([args.folder.name] if args.folder else [])
    names = ("size", "downsample", "primitives", "iterations", "backend")
    settings = {**{k: getattr(args, k) for k in names}, "folder": args.folder.name if args.folder else None}
    results: dict[str, Any] = {"cpu": cpu_name(), "settings": settings, "runs": []}
    if args.keep and RESULTS.exists():
        recorded = json.loads(RESULTS.read_text())
        differing = [k for k in names if recorded["settings"][k] != settings[k]]
        if differing:
            raise SystemExit(f"--keep: {RESULTS} was recorded with another {', '.join(differing)}")
        results["runs"] = recorded["runs"]
        settings["folder"] = settings["folder"] or recorded["settings"]["folder"]
    known = {run["job"] for run in results["runs"]}
    jobs = [job for job in plan(scenes, args.forms, args.primitives, args.seeds) if job.name not in known]
    for scene in scenes if jobs else []:  # drawn images and compiled kernels are kept for the runs side by side
        train(Job(scene, "neural", 8, 0), scene_words(scene, args.folder, args), 2, "auto", args.models / "warm-up")
    with ProcessPoolExecutor(args.jobs, multiprocessing.get_context("spawn")) as pool:
        waiting = {
            pool.submit(train, job, scene_words(job.scene, args.folder, args), args.iterations, args.backend, args.models / job.name): job
            for job in jobs
        }
        for future in as_completed(waiting):
            row = future.result()
            results["runs"] = sorted([*results["runs"], row], key=lambda r: r["job"])
            RESULTS.parent.mkdir(exist_ok=True)
            RESULTS.write_text(json.dumps(results, indent=1) + "\n")  # after every run: a long benchmark may be cut short
            print(f"{waiting[future].name}: {row['psnr']:.2f} dB, {row['backend']} backend", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="a NeRF-synthetic scene beside solids")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--forms", nargs="*", choices=tuple(FORMS), default=list(FORMS))
    parser.add_argument("--primitives", type=int, default=100, help="of the neural model; the others get as many, and as many bytes")
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--size", type=int, default=64, help="pixels on a side of the images of solids")
    parser.add_argument("--downsample", type=int, default=4, help="factor by which the images of DIR are averaged down")
    parser.add_argument("--backend", default="auto", choices=("auto", "reference"), help="reference: the same for all three")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time, one thread each")
    parser.add_argument("--models", type=Path, default=Path("outputs") / "expressivity", help="folder for the fitted models")
    parser.add_argument("--keep", action="store_true", help="keep the recorded runs, train only what is missing")
    parser.add_argument("--print", action="store_true", help="train nothing")
    parser.add_argument("--docs", action="store_true", help="write the recorded table into docs/expressivity.md")
    args = parser.parse_args()
    if not args.print:
        fit_all(args)
        models = [
            args.models / Job(scene, form, args.primitives, 0).name
            for scene in ("solids", *([args.folder.name] if args.folder else []))
            for form in FORMS
        ]
        if all((folder / "model.safetensors").exists() for folder in models):
            from expressivity_picture import draw_figure

            draw_figure(models, PICTURE)
    results = json.loads(RESULTS.read_text())
    print(table(results))
    if args.docs:
        between_markers(DOCS, "expressivity", table(results))


if __name__ == "__main__":
    main()
