"""Whether a change made an earlier number worse: the same runs by this checkout and by an earlier one, in one go.

    git worktree add ../before COMMIT
    python benchmarks/before.py ../before [--runs chair_2000 chair_5000 fire lit_solids] [--chair DIR] [--fire DIR]
    [--seeds 1] [--record FILE]

Every run is its preset `quick` at a budget that the documentation has quoted, in steps, on one thread; both checkouts
train it one after the other from the same seed, in processes of their own, and test views judge. Where nothing was
meant to change the numbers are the same to the last digit. Seconds are those that the thread computed while the model
learned. Results go to --record (default benchmarks/results/before.json) after every run, with both commits; only what
is missing is run.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from shared.tables import ROOT, Table

from neuprim.core.compute.threads import cpu_name

RESULTS = Path(__file__).parent / "results" / "before.json"
CHAIR = ("task=static", "scene=blender", "train.background=white")
RUNS: dict[str, tuple[tuple[str, ...], int, str, tuple[str, ...]]] = {
    "chair_2000": ((*CHAIR, "model.primitives=2800"), 2500, "chair", ("psnr", "psnr_worst")),
    "chair_5000": ((*CHAIR, "model.primitives=7000"), 4000, "chair", ("psnr", "psnr_worst")),
    "fire": (
        ("task=dynamic", "scene=vdb", "scene.frames='1:40'", "scene.look=embergen_fire", "scene.size=96"),
        4000,
        "fire",
        ("psnr_mask", "sigma_relative_l2_early", "sigma_relative_l2_late"),
    ),
    "lit_solids": (
        ("task=relight", "scene=lit_solids", "scene.size=128"),
        2600,
        "",
        ("psnr_linear_clamped", "psnr_pooled_cast_shadow", "psnr_pooled_highlight"),
    ),
}
"""Words, steps, the data, and the measures. As many primitives as have the bytes of 2,000 or 5,000 of the paper's in
`chair_*`."""

FOLDERS = {"chair": "scene.path", "fire": "scene.vdb"}

CHILD = """
import json, sys, time
import torch
from neuprim.config import compose
from neuprim.runs.fit import compile_kernels, complete, start
torch.set_num_threads(1)
fitted = start(compose(sys.argv[1:], check_output=False))
compile_kernels(fitted.trainer)
begin = time.thread_time()
complete(fitted)
seconds = time.thread_time() - begin
numbers = {k: v for k, v in fitted.metrics().items() if isinstance(v, float)}
print(json.dumps({"cpu_seconds": seconds, "primitives": fitted.model.count, **numbers}))
"""
"""What both checkouts run: only what both of them have."""


def commit(folder: Path) -> str:
    """Of a checkout, with a plus where files differ from it."""
    done = subprocess.run(
        ["git", "-C", folder, "describe", "--always", "--dirty=+"], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def one(folder: Path, words: list[str]) -> dict[str, Any]:
    environment = {**os.environ, "PYTHONPATH": str(folder.resolve())}
    done = subprocess.run(
        [sys.executable, "-c", CHILD, *words],
        env=environment,
        cwd=folder,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="another checkout")
    parser.add_argument("--runs", nargs="*", default=list(RUNS), choices=list(RUNS))
    parser.add_argument("--chair", type=Path, help="a NeRF-synthetic folder")
    parser.add_argument("--fire", type=Path, help="a folder of EmberGen's .vdb files")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--record", type=Path, default=RESULTS)
    args = parser.parse_args()
    both = {"before": args.before, "now": ROOT}
    commits = {which: commit(folder) for which, folder in both.items()}
    whole: dict[str, Any] = {"cpu": cpu_name(), "commits": commits, "runs": []}
    if args.record.exists():
        earlier = json.loads(args.record.read_text())
        if earlier["commits"] == commits:
            whole = earlier
    for name in args.runs:
        words, steps, data, measures = RUNS[name]
        if data and not getattr(args, data):
            parser.error(f"--{data}: wants the folder of its data; or leave {name} out of --runs")
        for seed in range(args.seeds):
            if any((run["run"], run["seed"]) == (name, seed) for run in whole["runs"]):
                continue
            every = [
                *words,
                f"seed={seed}",
                f"train.iterations={steps}",
                "train.max_seconds=null",
                "train.eval_every=0",
                "renderer.threads=1",
            ]
            if data:
                every.append(f"{FOLDERS[data]}='{getattr(args, data).resolve()}'")
            kept = ("cpu_seconds", "primitives", *measures)
            found = {
                which: {key: value for key, value in one(folder, every).items() if key in kept}
                for which, folder in both.items()
            }
            whole["runs"].append({"run": name, "seed": seed, "steps": steps, **found})
            args.record.write_text(json.dumps(whole, indent=1) + "\n")
    made = Table(
        "run", "steps", "seed", "measure", commits["before"], commits["now"], "difference", "time, now / before"
    )
    for run in whole["runs"]:
        pace = run["now"]["cpu_seconds"] / run["before"]["cpu_seconds"]
        for place, measure in enumerate(RUNS[run["run"]][3]):
            before, now = run["before"][measure], run["now"][measure]
            made.row(
                run["run"],
                run["steps"],
                run["seed"],
                measure,
                f"{before:.3f}",
                f"{now:.3f}",
                f"{now - before:+.3f}",
                "" if place else f"{pace:.2f}",
            )


if __name__ == "__main__":
    main()
