"""Smoke and fire under lights that no training view had, beside colours that have one light baked in.

    python benchmarks/lit_volumes.py [--scenes smoke_fire ...] [--steps 8000] [--seeds 3] [--jobs 1] [--docs] [--print]
    python benchmarks/lit_volumes.py --scenes fire --fire DIR --frames 20:40

trains the preset of every scene twice: with four lights a frame (`scene.lights=4`), and with the look's own alone,
whose colours are baked. Both are judged by the held-out cameras in every 7th frame, by the pixels that show matter in
some frame: under a light that no training view had, under the look's own, and under another light of the training.
Values are PSNR of all those pixels together, in linear light over the brightest radiance of the data with four lights.
A frame is timed on one thread. `fire` is a folder of EmberGen's files, under the light of `smoke_fire`. Results go to
benchmarks/results/lit_volumes.json after every run, and only what is missing is run; --docs puts the table between the
markers of docs/results/dynamic.md, --print runs nothing.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from shared.arguments import make_parser, require_folders
from shared.tables import RESULT_PAGES, RESULTS, Record, Table, between_markers, group_runs, read_record, spread
from shared.trials import Trial, run_all

from neuprim.core.render import render
from neuprim.runs.fit import Fitted
from neuprim.tasks.dynamic import vdb_recording_of
from neuprim.tasks.dynamic.volume.capture_dataset import light_conditions
from neuprim.tasks.dynamic.volume.lit_medium import light_medium
from neuprim.tasks.dynamic.volume.optics import Light
from neuprim.tasks.dynamic.volume.raymarch import render_medium

RECORD = RESULTS / "lit_volumes.json"
SIMULATED = ("smoke_fire", "colorful_smoke", "ground_explosion", "dust_tornado")
LIGHTS, EVERY, ROUNDS = 4, 7, 3
_SUN = "scene.optics.light={direction: [-0.6, -0.35, 0.7], irradiance: [5.0, 5.0, 5.2]}"
LIT = {"new": "a new light", "own": "the look's light", "trained": "a light of the training"}


def measure(fitted: Fitted, metrics: dict[str, Any]) -> dict[str, Any]:
    """Mean squared errors in radiance, by light, and milliseconds a frame."""
    dataset, model, settings = fitted.dataset, fitted.model, fitted.config.renderer
    recording = vdb_recording_of(dataset)
    assert recording is not None
    lit = replace(recording.capture, lights=LIGHTS)
    errors: dict[str, list[torch.Tensor]] = {name: [] for name in LIT}
    times, frames = [], len(lit.frames)
    for t in range(0, frames, EVERY):
        medium, lights = lit.medium(lit.frames[t]), lit.frame_lights(lit.frames[t])
        for c in range(lit.held_out):
            view, mask = dataset.test.view(c * frames + t), recording.matter_mask(c * frames + t)
            shown: dict[str, Light | None] = {"new": lights[c - lit.held_out], "own": lights[0], "trained": lights[1]}
            for name, light in shown.items():
                known = light_conditions(lit, light) if "light" in view.conditions else {}
                truth = render_medium(light_medium(medium, light, lit.optics), view.camera, lit.samples)[..., :3]
                took = []
                for _ in range(ROUNDS):
                    start = time.thread_time()
                    with torch.no_grad():
                        found = render(model, view.camera, {**view.conditions, **known}, settings).rgb
                    took.append(time.thread_time() - start)
                times.append(min(took))
                errors[name].append((found * dataset.exposure - truth).square()[mask])
    found_errors = {f"mse_{name}": float(torch.cat(parts).double().mean()) for name, parts in errors.items()}
    kept = {key: metrics[key] for key in ("primitives", "model_bytes")}
    return {**kept, "exposure": dataset.exposure, **found_errors, "frame_ms": 1e3 * statistics.mean(times)}


def plan(scenes: Sequence[str], steps: int, seeds: int, fire: Path | None, frames: str) -> list[Trial]:
    trials = []
    for scene in scenes:
        words = ["task=dynamic", f"scene={scene}"]
        if scene == "fire":
            words = ["task=dynamic", "scene=vdb", f"scene.vdb='{fire}'", f"scene.frames={frames}", _SUN]
        for lights in (LIGHTS, 1):
            for seed in range(seeds):
                name, facts = f"{scene}-{lights}-{steps}-{seed}", (("scene", scene), ("lights", lights))
                own = (*words, f"scene.lights={lights}")
                trials.append(Trial(name, own, steps, seed, 0, facts, interventions=None))
    return trials


def decibel(name: str, runs: Sequence[Record], peaks: Mapping[tuple[str, int], float]) -> str:
    values = [-10 * math.log10(run[f"mse_{name}"] / peaks[run["scene"], run["seed"]] ** 2) for run in runs]
    return f"{spread(values, 2)} dB"


def table(record: Record) -> str:
    made = Table(
        "scene", "steps", "model", "bytes", *(f"under {name}" for name in LIT.values()), "ms a frame", "CPU seconds"
    )
    peaks = {(run["scene"], run["seed"]): run["exposure"] for run in record["trials"] if run["lights"] > 1}
    for (scene, steps, lights), runs in group_runs(record["trials"], "scene", "iterations", "lights").items():
        kind = "lit" if lights > 1 else "baked"
        took, spent = (statistics.mean(run[key] for run in runs) for key in ("frame_ms", "cpu_seconds"))
        made.row(
            scene,
            f"{steps:,}",
            kind,
            f"{runs[0]['model_bytes']:,}",
            *(decibel(name, runs, peaks) for name in LIT),
            f"{took:.1f}",
            f"{spent:.0f}",
        )
    return "\n".join([*made.lines, "", f"One thread of {record['cpu']}."])


def main() -> None:
    parser = make_parser(__doc__, "--fire", "--seeds", "--jobs", "--docs", "--print", scenes=(*SIMULATED, "fire"))
    parser.add_argument("--steps", type=int, default=8000)
    parser.add_argument("--frames", default="20:40", help="of --fire")
    args = parser.parse_args()
    if not args.only_print:
        require_folders(parser, args, args.scenes)
        run_all(plan(args.scenes, args.steps, args.seeds, args.fire, args.frames), RECORD, measure, args.jobs)
    text = table(read_record(RECORD))
    if args.docs:
        between_markers(RESULT_PAGES / "dynamic.md", "lit volumes", text)


if __name__ == "__main__":
    main()
