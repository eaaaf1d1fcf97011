"""Single scattering, octaves of scattering, and path tracing of smoke, side by side.

    pip install -e '.[path-tracing]'
    python benchmarks/multiple_scattering.py [--scenes smoke_fire fire --fire DIR] [--steps 4000] [--samples 512]
    [--jobs 1] [--docs] [--print]

Mitsuba 3 (`volpath`) traces the middle frame for every held-out camera, under a light that no training view had. The
smoke scatters nine tenths of what it absorbs, and does not glow. Compared with these images are those of the ray caster
with 1 to 4 octaves (`scene.optics.octaves`), and of models that were trained by it with 1 to 3 octaves and four lights
a frame. Values are PSNR of the pixels that show matter, in linear light over the brightest path-traced pixel; *again*
is path tracing with another seed, so it is what the noise allows. `fire` is a folder of EmberGen's files, of which
frames 20 to 40 are used. A second table has the ray caster's images of smoke that its flames light, with few lights for
the flames (`scene.optics.fire_lights`), against 256, over the brightest light that flames add. Results go to
benchmarks/results/multiple_scattering.json after every run, and only what is missing is run; --docs puts the tables
between the markers of docs/results/dynamic.md, --print runs nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from shared.arguments import make_parser, require_folders
from shared.tables import RESULT_PAGES, RESULTS, Record, Run, Table, between_markers, group_runs, read_record
from shared.trials import Trial, run_all
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.io.vdb import VdbFrame
from neuprim.core.render import render
from neuprim.runs.fit import Fitted
from neuprim.tasks.dynamic import vdb_recording_of
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.capture_dataset import light_conditions
from neuprim.tasks.dynamic.volume.lit_medium import light_medium
from neuprim.tasks.dynamic.volume.medium import Medium
from neuprim.tasks.dynamic.volume.optics import Light
from neuprim.tasks.dynamic.volume.raymarch import render_medium

RECORD = RESULTS / "multiple_scattering.json"
LIGHTS, OCTAVES, TRAINED = 4, (1, 2, 3, 4), (1, 2, 3)
FIRE_LIGHTS, ALL_FIRE_LIGHTS, _GLOW = (0, 1, 4, 16, 64), 256, 1.5
_DEPTH = 128  # most segments of a path
_LOOK = (
    "scene.look=smoke_fire",
    "scene.optics.albedo=[0.9,0.9,0.9]",
    "scene.optics.ambient=[0,0,0]",
    "scene.optics.emission=0",
    f"scene.lights={LIGHTS}",
)


def trace_medium(
    medium: Medium, light: Light, camera: Camera, samples: int, seed: int, anisotropy: float = 0.0, depth: int = _DEPTH
) -> Tensor:
    """Path trace a medium under a light at infinity, at most ``depth`` path segments: (H, W, 3) linear radiance."""
    import mitsuba  # only where it is needed: tables are made without it

    mitsuba.set_variant("scalar_rgb")
    assert medium.scattered is not None and medium.bricks.dense
    sigma, scattered = medium.values[0, ..., :1], medium.scattered[0]
    albedo = np.where(sigma > 0, scattered / np.where(sigma > 0, sigma, 1), 0)
    place = np.diag([*map(float, sigma.shape[:3]), 1.0])
    place[:3, 3] = -0.5  # the unit cube of a grid ends at the faces of its voxels
    place = medium.scene_from_index @ place

    def grid(values: np.ndarray) -> dict[str, Any]:
        turned = np.ascontiguousarray(np.transpose(values, (2, 1, 0, 3)), np.float32)
        world = mitsuba.ScalarTransform4f(place.tolist())
        return {"type": "gridvolume", "grid": mitsuba.VolumeGrid(turned), "to_world": world, "raw": True}

    middle = np.eye(4)  # a cube of Mitsuba goes from -1 to 1
    middle[:3, :] = [[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5]]
    pose = torch.linalg.inv(camera.viewmat.double()).numpy() @ np.diag([-1.0, -1.0, 1.0, 1.0])
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    scene = mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": depth, "rr_depth": 32},
            "camera": {
                "type": "perspective",
                "fov": math.degrees(2 * math.atan(camera.width / 2 / float(camera.fx))),
                "to_world": mitsuba.ScalarTransform4f(pose.tolist()),
                "near_clip": 1e-3,
                "film": film,
                "sampler": {"type": "independent", "sample_count": samples},
            },
            "light": {
                "type": "directional",
                "direction": [-x for x in light.direction],
                "irradiance": {"type": "rgb", "value": list(light.irradiance)},
            },
            "smoke": {
                "type": "cube",
                "to_world": mitsuba.ScalarTransform4f((place @ middle).tolist()),
                "bsdf": {"type": "null"},
                "interior": {
                    "type": "heterogeneous",
                    "sigma_t": grid(sigma),
                    "albedo": grid(albedo),
                    "phase": {"type": "hg", "g": anisotropy},
                },
            },
        }
    )
    return torch.from_numpy(np.array(mitsuba.render(scene, seed=seed), np.float32)[..., :3])


def measure(samples: int, fitted: Fitted, metrics: dict[str, Any]) -> dict[str, Any]:
    """Mean squared errors of radiance against path tracing, the brightest traced radiance, and those of the flames."""
    dataset, model, settings = fitted.dataset, fitted.model, fitted.config.renderer
    recording = vdb_recording_of(dataset)
    assert recording is not None
    capture, count = recording.capture, len(recording.capture.frames)
    t = count // 2
    medium, lights = capture.medium(capture.frames[t]), capture.frame_lights(capture.frames[t])
    errors: dict[str, list[Tensor]] = {}
    brightest = 0.0
    for c in range(capture.held_out):
        view, light = dataset.test.view(c * count + t), lights[c - capture.held_out]
        assert light is not None
        truth, again = (trace_medium(medium, light, view.camera, samples, seed) for seed in (0, 1))
        with torch.no_grad():
            conditions = {**view.conditions, **light_conditions(capture, light)}
            images = {"model": render(model, view.camera, conditions, settings).rgb * dataset.exposure, "again": again}
        for octaves in OCTAVES:
            lit = light_medium(medium, light, replace(capture.optics, octaves=octaves))
            cast = render_medium(lit, view.camera, 2)
            images[f"cast_{octaves}"], mask = cast[..., :3], cast[..., 3] > 0.01
        brightest = max(brightest, float(truth.max()))
        for name, image in images.items():
            errors.setdefault(f"mse_{name}", []).append((image - truth).square()[mask])
    found = {name: float(torch.cat(parts).double().mean()) for name, parts in errors.items()}
    fire = light_by_flames(capture, capture.frames[t]) if capture.optics.octaves == 1 else {}
    return {"model_bytes": metrics["model_bytes"], "brightest": brightest, **found, **fire}


def light_by_flames(capture: Capture, frame: VdbFrame) -> dict[str, float]:
    """Mean squared errors of radiance with few fire lights, by their number, and the brightest light of the flames."""

    def images(lights: int) -> list[Tensor]:
        optics = replace(capture.optics, emission=_GLOW, fire_lights=lights)
        medium = replace(capture, optics=optics).medium(frame)
        return [render_medium(medium, camera, 2) for camera in capture.cameras[-capture.held_out :]]

    truth = torch.stack(images(ALL_FIRE_LIGHTS))
    seen, dark = truth[..., 3] > 0.01, torch.stack(images(0))
    found = {"brightest_fire": float((truth - dark)[..., :3].max())}
    for lights in FIRE_LIGHTS:
        wrong = torch.stack(images(lights))[seen][..., :3] - truth[seen][..., :3]
        found[f"mse_fire_{lights}"] = float(wrong.double().square().mean())
    return found


def plan(scenes: Sequence[str], steps: int, fire: Path | None) -> list[Trial]:
    trials = []
    for scene in scenes:
        words = [f"task=dynamic scene={scene}"]
        if scene == "fire":
            words = ["task=dynamic scene=vdb scene.frames=20:40", f"scene.vdb='{fire}'"]
        for octaves in TRAINED:
            own = (*words[0].split(), *words[1:], *_LOOK, f"scene.optics.octaves={octaves}")
            facts = (("scene", scene), ("octaves", octaves))
            trials.append(Trial(f"{scene}-{octaves}-{steps}", own, steps, 0, 0, facts, interventions=None))
    return trials


def table(record: Record) -> str:
    made = Table("scene", "image", *(f"{n} octave{'s' * (n > 1)}" for n in OCTAVES), "again")
    for (scene,), runs in group_runs(record["trials"], "scene").items():
        peak = max(run["brightest"] for run in runs)
        trained = {run["octaves"]: run for run in runs}
        first = runs[0]

        def cell(run: Run, name: str, peak: float = peak) -> str:
            return f"{-10 * math.log10(run[f'mse_{name}'] / peak**2):.2f} dB"

        made.row(scene, "ray caster", *(cell(first, f"cast_{n}") for n in OCTAVES), cell(first, "again"))
        made.row(scene, "model", *(cell(trained[n], "model") if n in trained else "–" for n in OCTAVES), "–")
    fire = Table("scene", *(f"{n} light{'s' * (n != 1)}" for n in FIRE_LIGHTS))
    for run in record["trials"]:
        if "brightest_fire" in run:
            errors = (run[f"mse_fire_{n}"] / run["brightest_fire"] ** 2 for n in FIRE_LIGHTS)
            fire.row(run["scene"], *(f"{-10 * math.log10(error):.1f} dB" for error in errors))
    return f"{made}\n\n{fire}"


def main() -> None:
    parser = make_parser(__doc__, "--fire", "--jobs", "--docs", "--print", scenes=("smoke_fire", "fire"))
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--samples", type=int, default=512, help="paths per pixel")
    args = parser.parse_args()
    if not args.only_print:
        require_folders(parser, args, args.scenes)
        run_all(plan(args.scenes, args.steps, args.fire), RECORD, partial(measure, args.samples), args.jobs)
    text = table(read_record(RECORD))
    if args.docs:
        between_markers(RESULT_PAGES / "dynamic.md", "multiple scattering", text)


if __name__ == "__main__":
    main()
