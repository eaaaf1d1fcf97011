"""Smoke and fire under lights that no training view had, beside colours that have one light baked in.

    python benchmarks/lit_volumes.py [--scenes smoke_fire ...] [--steps 8000] [--seeds 3] [--jobs 1] [--docs] [--print]
    python benchmarks/lit_volumes.py --scenes fire --fire DIR --frames 20:40

trains the preset of every scene twice: with four lights a frame (`scene.lights=4`), and with the look's own alone,
whose colours are baked. Lit models have fewer primitives, so that both have equally many bytes. Both are judged by the
held-out cameras in every 7th frame, by the pixels that show matter in some frame: under three lights that no training
view had, under the look's own, and under another light of the training. Values are PSNR of all those pixels together,
in linear light over the brightest radiance of the data with four lights. The time of a frame of a lit model is divided
by that of the same primitives without scattered light, on one thread, at the size of the data and at 640 x 640 pixels.
`fire` is a folder of EmberGen's files, under the light of `smoke_fire`. Results go to
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

from neuprim.core.cameras import Camera
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.runs.fit import Fitted
from neuprim.tasks.dynamic import vdb_recording_of
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.scattering import ScatteringHarmonics
from neuprim.tasks.dynamic.volume.capture_dataset import light_conditions
from neuprim.tasks.dynamic.volume.lit_medium import draw_lights, light_medium
from neuprim.tasks.dynamic.volume.raymarch import render_medium

RECORD = RESULTS / "lit_volumes.json"
SIMULATED = ("smoke_fire", "colorful_smoke", "ground_explosion", "dust_tornado")
LIGHTS, NEW_LIGHTS, EVERY, ROUNDS, LARGE = 4, 3, 7, 3, 640
LIT_PRIMITIVES = 11_940  # as many bytes as 13,500 primitives without scattered light
_SUN = "scene.optics.light={direction: [-0.6, -0.35, 0.7], irradiance: [5.0, 5.0, 5.2]}"
LIT = {"new": "new lights", "own": "the look's light", "trained": "a light of the training"}


def measure(fitted: Fitted, metrics: dict[str, Any]) -> dict[str, Any]:
    """Mean squared errors in radiance, by light, and of lit models the time of a frame over that without a light."""
    dataset, model, settings = fitted.dataset, fitted.model, fitted.config.renderer
    recording = vdb_recording_of(dataset)
    assert recording is not None
    lit = replace(recording.capture, lights=LIGHTS)
    errors: dict[str, list[torch.Tensor]] = {name: [] for name in LIT}
    times: dict[int, list[tuple[float, float]]] = {lit.cameras[0].width: [], LARGE: []}
    frames, new_lights = len(lit.frames), [("new", light) for light in draw_lights(lit.optics, NEW_LIGHTS)]
    for t in range(0, frames, EVERY):
        medium, lights = lit.medium(lit.frames[t]), lit.frame_lights(lit.frames[t])
        for c in range(lit.held_out):
            view, mask = dataset.test.view(c * frames + t), recording.matter_mask(c * frames + t)
            for name, light in (*new_lights, ("own", lights[0]), ("trained", lights[1])):
                known = light_conditions(lit, light) if "light" in view.conditions else {}
                truth = render_medium(light_medium(medium, light, lit.optics), view.camera, lit.samples)[..., :3]
                with torch.no_grad():
                    found = render(model, view.camera, {**view.conditions, **known}, settings).rgb
                errors[name].append((found * dataset.exposure - truth).square()[mask])
            if "light" in view.conditions:
                for size, took in times.items():
                    took.append(time_frame(model, view.camera.resized(size, size), view.conditions, settings))
    found_errors = {f"mse_{name}": float(torch.cat(parts).double().mean()) for name, parts in errors.items()}
    kept = {key: metrics[key] for key in ("primitives", "model_bytes")}
    ratios = {
        f"frame_{size}": sum(a for a, _ in took) / sum(b for _, b in took) for size, took in times.items() if took
    }
    return {**kept, "exposure": dataset.exposure, **found_errors, **ratios}


def time_frame(
    model: Primitives, camera: Camera, conditions: Mapping[str, torch.Tensor], settings: RenderSettings
) -> tuple[float, float]:
    """Seconds of a frame of a lit model, and of its primitives without scattered light: the best of some rounds."""
    colour = model.colour
    assert isinstance(colour, ScatteringHarmonics)
    names = ("degree", "channels", "powers", "waves", "frequencies")
    own = TimeHarmonics(**{name: getattr(colour, name) for name in names})
    params = {name: value for name, value in model.params.items() if name != "scattered"}
    best = [math.inf, math.inf]
    for _ in range(ROUNDS):
        for i, one in enumerate((model, Primitives(model.density, own, params))):
            start = time.thread_time()
            with torch.no_grad():
                render(one, camera, conditions, settings)
            best[i] = min(best[i], time.thread_time() - start)
    return best[0], best[1]


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
                own += (f"model.primitives={LIT_PRIMITIVES}",) if lights > 1 else ()
                trials.append(Trial(name, own, steps, seed, 0, facts, interventions=None))
    return trials


def decibel(name: str, runs: Sequence[Record], peaks: Mapping[tuple[str, int], float]) -> str:
    values = [-10 * math.log10(run[f"mse_{name}"] / peaks[run["scene"], run["seed"]] ** 2) for run in runs]
    return f"{spread(values, 2)} dB"


def table(record: Record) -> str:
    made = Table(
        *("scene", "steps", "seeds", "model", "bytes"),
        *(f"under {name}" for name in LIT.values()),
        *("frame time", "CPU seconds"),
    )
    peaks = {(run["scene"], run["seed"]): run["exposure"] for run in record["trials"] if run["lights"] > 1}
    for (scene, steps, lights), runs in group_runs(record["trials"], "scene", "iterations", "lights").items():
        kind = "lit" if lights > 1 else "baked"
        spent = statistics.mean(run["cpu_seconds"] for run in runs)
        sizes = [int(key[6:]) for key in runs[0] if key.startswith("frame_")]
        took = [f"{statistics.mean(run[f'frame_{size}'] for run in runs):.2f} at {size}" for size in sizes]
        made.row(
            scene,
            f"{steps:,}",
            len(runs),
            kind,
            f"{runs[0]['model_bytes']:,}",
            *(decibel(name, runs, peaks) for name in LIT),
            ", ".join(took) or "1",
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
