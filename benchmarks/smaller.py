"""What a scene requires: models of the presets, pruned, in few bits, and both.

    python benchmarks/smaller.py --orders RUN_DIR
    python benchmarks/smaller.py [--chair DIR] [--fire DIR] [--scenes chair chair_5000 fire fire_half lit_solids
    smoke_fire] [--seeds 3] [--jobs 2] [--docs] [--print]

Every model is its preset's own (`quick`, the preset's number of views), but for `fire_half`, half as large as the
preset's and with the 4,000 views of docs/dynamic.md, and `chair_5000`, two and a half times as large. Then, as `neuprim
prune` and `neuprim compress` do it:

    trained as long   the whole model, fine-tuned for the steps that pruning has: what they bring without pruning
    pruned            `neuprim prune --tolerance 0.1dB --steps 4000`
    level 3           `neuprim compress --level 3 --steps 1000`: as many bits for a parameter in every model
    few bits, T dB    `neuprim compress --tolerance T --steps 1000` of the whole and of the pruned model

PSNR and SSIM are means over all held-out views, which decide nothing; bytes are those of the files, of a whole model
its numbers in float32.
Rows go to benchmarks/results/smaller.json as they come, and only what is missing is run; runs stay in outputs/smaller.
--docs puts the table between the markers of docs/tradeoffs.md; --print runs nothing. --orders RUN_DIR prints what the
held-back training views of a run lose without the 5 % of its primitives that are worth least, by several ways to say
so.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from shared.tables import ROOT, Table, between_markers, spread

from neuprim.config import compose
from neuprim.core.compute.machine import cpu_name
from neuprim.core.data import Dataset
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import render
from neuprim.core.train.sensitivity import sensitivity
from neuprim.runs.finetune import fine_tuner
from neuprim.runs.measure import quality
from neuprim.runs.open import load_dataset, load_run, read_metrics
from neuprim.runs.run import run
from neuprim.search.compress import compress_run
from neuprim.search.prune.judge import Judge
from neuprim.search.prune.run import Request, prune_run

RESULTS = Path(__file__).parent / "results" / "smaller.json"
RUNS = ROOT / "outputs" / "smaller"
SCENES = {
    "chair": ("task=static", "scene=blender"),
    "chair_5000": ("task=static", "scene=blender", "model.primitives=7000"),
    "fire": ("task=dynamic", "scene=vdb", "scene.size=64"),
    "fire_half": (
        "task=dynamic",
        "scene=vdb",
        "scene.frames='1:40'",
        "scene.look=embergen_fire",
        "scene.size=96",
        "model.primitives=6750",
        "train.iterations=4000",
    ),
    "lit_solids": ("task=relight", "scene=lit_solids", "scene.size=128"),
    "smoke_fire": ("task=dynamic", "scene=smoke_fire", "scene.size=64"),
}
PRUNED, FEW_BITS, TOLERANCE = 4000, 1000, 0.1
TOLERANCES = (0.1, 0.3)
ROWS = [
    "as trained",
    "trained as long",
    "pruned",
    "level 3",
    *(f"{p}few bits, {allowed} dB" for p in ("", "pruned, ") for allowed in TOLERANCES),
]
SHOWN = {
    "chair": "chair, 200×200",
    "chair_5000": "chair, 200×200, as large as 5,000 of the paper's",
    "fire": "real fire, 64×64",
    "fire_half": "real fire, 96×96, half as many",
    "lit_solids": "lit_solids, 128×128",
    "smoke_fire": "smoke_fire, 64×64",
}


def words(scene: str, data: Path | None, seed: int) -> list[str]:
    where = [] if data is None else [f"scene.{'vdb' if scene.startswith('fire') else 'path'}='{data.resolve()}'"]
    return [
        *SCENES[scene],
        *where,
        f"seed={seed}",
        "renderer.threads=1",
        "train.eval_every=0",
        f"output_dir='{RUNS / f'{scene}-{seed}'}'",
    ]


def scene_of(scene: str, data: Path | None, seed: int, known: list[str], send: Any) -> None:
    """All rows of one run, each handed to ``send`` as it comes."""
    torch.set_num_threads(1)
    folder = RUNS / f"{scene}-{seed}"

    def tell(what: str, size: int, psnr: float, ssim: float, begun: float, **more: Any) -> None:
        row = {
            "scene": scene,
            "seed": seed,
            "what": what,
            "bytes": size,
            "psnr": psnr,
            "ssim": ssim,
            "cpu_seconds": time.process_time() - begun,
        }
        send({**row, **more})

    if not (folder / "metrics.json").exists():
        run(compose(words(scene, data, seed), check_output=False))
    begun, metrics = time.process_time(), read_metrics(folder)
    if "as trained" not in known:
        whole = 4 * metrics["parameters"]
        tell(
            "as trained",
            whole,
            metrics["psnr"],
            metrics["ssim"],
            begun,
            primitives=metrics["primitives"],
            steps=metrics["iterations"],
        )
    small = folder.with_name(f"{folder.name}-pruned")
    if "pruned" not in known or not (small / "metrics.json").exists():
        begun = time.process_time()
        made = prune_run(Request(folder, TOLERANCE, steps=PRUNED, out=small, overwrite=True))
        after = made.after
        tell(
            "pruned",
            int(after["bytes"]),
            after["psnr"],
            after["ssim"],
            begun,
            primitives=after["primitives"],
            numbers=after["numbers"],
            reduced=list(made.words),
            kept=made.kept,
        )
        if made.run_dir is None:
            small = folder
    asked: list[tuple[str, Path, dict[str, Any]]] = [("level 3", folder, {"level": 3})]
    for where, which in ((folder, ""), (small, "pruned, ")):
        asked += [(f"{which}few bits, {allowed} dB", where, {"tolerance": allowed}) for allowed in TOLERANCES]
    for name, where, how in asked:
        if name not in known:
            begun = time.process_time()
            stored = compress_run(where, out=where / "small.neuprim", overwrite=True, steps=FEW_BITS, **how)
            (psnr, ssim) = (stored.measured[key][1] for key in ("psnr", "ssim"))
            tell(name, stored.after, psnr, ssim, begun)
    if "trained as long" not in known:
        begun = time.process_time()
        config, task, model, _ = load_run(folder)
        dataset = load_dataset(config, task, run_dir=folder)
        trainer = fine_tuner(config, task, dataset, model, PRUNED)
        for _ in range(PRUNED):
            trainer.train_step()
        psnr, ssim = quality(trainer.model, task, dataset, config.renderer)
        tell("trained as long", 4 * model.count * model.parameters_per_primitive, psnr, ssim, begun)


def orders(folder: Path, share: float = 0.05) -> None:
    """What a run's judged training views lose without a share of its primitives, least first, by three measures of what
    they are worth."""
    torch.set_num_threads(1)
    config, task, model, _ = load_run(folder)
    dataset = load_dataset(config, task, run_dir=folder)
    judge = Judge(dataset, config.renderer)
    weights = torch.stack([weight_in(model, dataset, view, config.renderer) for view in judge.others])
    squares = sensitivity(model, dataset, judge.others, config.renderer).whole
    made = Table("order", f"without the first {share:.0%}")
    for name, worth in (
        ("sum of squared weights", squares),
        ("sum of weights", weights.sum(0)),
        ("largest weight in a view", weights.amax(0)),
    ):
        kept = worth.argsort(stable=True)[int(share * model.count) :].sort().values
        made.row(name, f"{judge(Primitives(model.density, model.colour, model.rows(kept))) - judge(model):+.3f} dB")


def weight_in(model: Primitives, dataset: Dataset, index: int, settings: Any) -> torch.Tensor:
    """(N,) sums of weights in a training view."""
    view = dataset.train.view(index)
    params = {name: value.detach().requires_grad_() for name, value in model.params.items()}
    output = render(
        Primitives(model.density, model.colour, params), view.camera, view.conditions, settings, dataset.background
    )
    tally = output.watch(torch.ones(output.rgb.shape[:2]))
    output.rgb.sum().backward()
    return tally.of_all(model.count)[0]


def table(rows: list[dict[str, Any]], cpu: str) -> str:
    made = Table("model", "bytes", "times smaller", "PSNR", "against as trained", "SSIM")
    for scene in SCENES:
        mine = [r for r in rows if r["scene"] == scene]
        base = {r["seed"]: r for r in mine if r["what"] == "as trained"}
        for what in ROWS:
            own = [r for r in mine if r["what"] == what]
            if not own:
                continue
            first = base[own[0]["seed"]]
            named = (
                f"**{SHOWN[scene]}**, {first['primitives']:,} primitives, {first['steps']:,} views"
                if what == "as trained"
                else what
            )
            made.row(
                named,
                f"{np.mean([r['bytes'] for r in own]):,.0f}",
                ""
                if what in ("as trained", "trained as long")
                else spread([base[r["seed"]]["bytes"] / r["bytes"] for r in own], 2),
                f"{spread([r['psnr'] for r in own], 2)} dB",
                ""
                if what == "as trained"
                else f"{np.mean([r['psnr'] - base[r['seed']]['psnr'] for r in own]):+.3f} dB",
                spread([r["ssim"] for r in own], 4),
            )
    seeds = {scene: len({r["seed"] for r in rows if r["scene"] == scene}) for scene in SCENES}
    said = ", ".join(f"{scene} {count}" for scene, count in seeds.items() if count)
    return (
        f"{made}\n\nSeeds: {said}; mean ± half the spread. Pruned with a tolerance of {TOLERANCE} dB on training views and {PRUNED:,} steps of fine-tuning; "
        f"{FEW_BITS:,} steps for few bits; {cpu}, one thread."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--fire", type=Path, help="a folder of EmberGen's .vdb files")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time, one thread each")
    parser.add_argument("--print", action="store_true", help="train nothing")
    parser.add_argument("--docs", action="store_true", help="write the table into docs/tradeoffs.md")
    parser.add_argument("--orders", type=Path, metavar="RUN_DIR", help="only this, of a finished run")
    args = parser.parse_args()
    if args.orders is not None:
        orders(args.orders)
        return
    record = json.loads(RESULTS.read_text()) if RESULTS.exists() else {"cpu": "", "rows": []}
    rows: list[dict[str, Any]] = record["rows"]
    cpu = record["cpu"]
    data = {"chair": args.chair, "chair_5000": args.chair, "fire": args.fire, "fire_half": args.fire}
    if not args.print:
        context = multiprocessing.get_context("spawn")
        queue = context.Manager().Queue()
        with ProcessPoolExecutor(args.jobs, context) as pool:
            asked = [
                (scene, seed)
                for seed in range(args.seeds)
                for scene in args.scenes
                if scene not in data or data[scene] is not None
            ]
            waiting = set()
            for scene, seed in asked:
                known = [r["what"] for r in rows if (r["scene"], r["seed"]) == (scene, seed)]
                if set(known) == set(ROWS):
                    continue  # the runs themselves may be gone: what is recorded needs them no more
                waiting.add(pool.submit(scene_of, scene, data.get(scene), seed, known, queue.put))
            while waiting or not queue.empty():
                while not queue.empty():
                    rows.append(queue.get())
                    cpu = (
                        cpu if cpu_name() in cpu.split("; ") else "; ".join(filter(None, (cpu, cpu_name())))
                    )  # rows may be of several
                    RESULTS.write_text(
                        json.dumps(
                            {"cpu": cpu, "rows": sorted(rows, key=lambda r: (r["scene"], r["seed"], r["what"]))},
                            indent=1,
                        )
                        + "\n"
                    )
                    print({k: v for k, v in rows[-1].items() if k != "kept"}, flush=True)
                done = {future for future in waiting if future.done()}
                for future in done:
                    future.result()
                waiting -= done
                time.sleep(1.0)
    text = table(rows, cpu)
    if args.docs:
        between_markers(ROOT / "docs" / "tradeoffs.md", "smaller", text)


if __name__ == "__main__":
    main()
