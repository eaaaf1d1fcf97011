"""Whether a change made an earlier number worse: the same runs by this checkout and by an earlier one, in one go.

    git worktree add ../before COMMIT
    python benchmarks/before.py ../before [--runs chair_2000 chair_5000 fire lit_solids] [--chair DIR] [--fire DIR]
    [--seeds 1] [--set KEY=VALUE ...]

Every run is `neuprim run` of its preset `quick` at a budget that the documentation has quoted, in steps, on one thread;
both checkouts train it one after the other from the same seed, in processes of their own, and test views judge. Where
nothing was meant to change the numbers are the same to the last digit. Ratios are of training seconds and of the time
of a frame. --set changes every run, for example `train.iterations=100`.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from shared.arguments import make_parser, require_folders
from shared.forms import SCENES
from shared.tables import ROOT, Table

RUNS: dict[str, tuple[str, int, tuple[str, ...], tuple[str, ...]]] = {
    "chair_2000": ("chair", 2500, ("model.primitives=2800",), ("psnr", "psnr_worst")),
    "chair_5000": ("chair", 4000, ("model.primitives=7000",), ("psnr", "psnr_worst")),
    "fire": ("fire", 4000, (), ("psnr_mask", "sigma_relative_l2_early", "sigma_relative_l2_late")),
    "lit_solids": ("lit_solids", 2600, (), ("psnr_linear_clamped", "psnr_pooled_cast_shadow", "psnr_pooled_highlight")),
}
"""Scene, steps, further words and the measures. `chair_*` have the bytes of 2,000 or 5,000 of the paper's
primitives."""


def describe_commit(folder: Path) -> str:
    """The commit of a checkout, with a plus where files differ from it."""
    command = ["git", "-C", folder, "describe", "--always", "--dirty=+"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def run(checkout: Path, words: list[str]) -> dict[str, Any]:
    """The metrics of a run by a checkout's command line."""
    environment = {**os.environ, "PYTHONPATH": str(checkout.resolve())}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "neuprim", "run", *words, f"output_dir='{folder}/run'"]
        done = subprocess.run(command, env=environment, cwd=checkout, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"{checkout}: {done.stderr}")
        metrics: dict[str, Any] = json.loads(Path(folder, "run", "metrics.json").read_text(encoding="utf-8"))
    return metrics


def main() -> None:
    parser = make_parser(__doc__, "--chair", "--fire", "--seeds")
    parser.set_defaults(seeds=1)
    parser.add_argument("before", type=Path, help="another checkout")
    parser.add_argument("--runs", nargs="*", default=list(RUNS), choices=list(RUNS))
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="further settings of every run")
    args = parser.parse_args()
    require_folders(parser, args, [RUNS[name][0] for name in args.runs])
    heads = [describe_commit(args.before), describe_commit(ROOT), "difference", "training time, now / before", "frame"]
    table = Table("run", "seed", "measure", *heads)
    for name in args.runs:
        scene, steps, further, measures = RUNS[name]
        words = [*SCENES[scene].all_words(vars(args), scene), *further, f"train.iterations={steps}"]
        words += ["train.max_seconds=null", "train.eval_every=0", "renderer.threads=1", *args.set]
        for seed in range(args.seeds):
            before, now = (run(folder, [*words, f"seed={seed}"]) for folder in (args.before, ROOT))
            training = f"{now['train_seconds'] / before['train_seconds']:.2f}"
            ratios = (training, f"{before['render_fps'] / now['render_fps']:.2f}")
            for measure in measures:
                found = (before[measure], now[measure], now[measure] - before[measure])
                table.row(name, seed, measure, *(f"{value:.4f}" for value in found), *ratios)


if __name__ == "__main__":
    main()
