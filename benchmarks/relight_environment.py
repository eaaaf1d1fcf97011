"""How well a relighting run of lit_solids shows light from all around, against the ray caster under the same and under
more lights.

    python benchmarks/relight_environment.py RUN_DIR [--lights 16 64 256] [--views N] [--record] [--picture FILE.png]
    [--keep DIR]

- same lights: the model's image against the ray-cast sum over the very point lights that stand for the environment, so
  that only the
  model is wrong;
- seen lights: both without the lights more than 15 degrees off every training light;
- distant: against 1024 lights at 1e4 units, so that the lights' number and finite distance count too;
- lights alone: the ray caster under the few lights against the distant ones, what a perfect model would score there.

PSNR of linear light clamped to 0..1, means over views of the test split. --record writes the table to
docs/relighting.md, --keep the environments as OpenEXR files.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from shared.tables import ROOT, Table, between_markers
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.channels import Channels
from neuprim.core.data import View
from neuprim.core.environment import Environment
from neuprim.core.io.exr import write_exr
from neuprim.core.io.images import write_png
from neuprim.core.metrics import psnr
from neuprim.runs.measure import render_light_sum
from neuprim.runs.open import load_dataset, load_run
from neuprim.scenes.lit import INTENSITY, build_lit_solids, draw_lit_solids
from neuprim.scenes.raycast import Scene
from neuprim.tasks.relight.lighting import illuminate

PAGE = ROOT / "docs" / "relighting.md"
MANY, DISTANT = 1024, 1e4
PIXELS = 176  # of one image in the picture


def directions(height: int) -> Tensor:
    """(height, 2 height, 3) unit directions of an environment's texels, up = z."""
    polar = (torch.arange(height) + 0.5) * (math.pi / height)
    azimuth = 2 * math.pi * (0.5 - (torch.arange(2 * height) + 0.5) / (2 * height))
    polar, azimuth = torch.meshgrid(polar, azimuth, indexing="ij")
    return torch.stack([polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()], -1)


def lobe(d: Tensor, toward: tuple[float, float, float], degrees: float, soft: float = 2.0) -> Tensor:
    """(H, W, 1) 1 within ``degrees`` of a direction, fading over ``soft`` degrees."""
    axis = torch.tensor(toward) / torch.tensor(toward).norm()
    angle = torch.rad2deg((d @ axis).clamp(-1, 1).acos())
    return ((degrees + soft - angle) / soft).clamp(0, 1)[..., None]


def environments(height: int = 128) -> dict[str, Tensor]:
    """Radiance over the exposure: a sky with a sun, a dark studio with two coloured softboxes, and plain white."""
    d = directions(height)
    z = d[..., 2:].clamp_min(0)
    blue = torch.tensor([0.22, 0.36, 0.62]) * z + torch.tensor([0.45, 0.45, 0.42]) * (1 - z)
    ground = torch.tensor([0.10, 0.08, 0.06]).expand_as(blue)
    sky = torch.where(d[..., 2:] > 0, blue, ground) + torch.tensor([150.0, 130.0, 100.0]) * lobe(
        d, (1.0, 0.6, 1.3), 2.0
    )
    warm = torch.tensor([8.0, 4.4, 1.6]) * lobe(d, (1.0, -0.8, 1.0), 14.0)
    cold = torch.tensor([0.9, 2.6, 6.0]) * lobe(d, (-1.0, 0.2, 0.9), 18.0)
    return {"sky and sun": sky, "two softboxes": 0.02 + warm + cold, "white": torch.ones_like(sky)}


def truth(scene: Scene, camera: Camera, lights: list[dict[str, Tensor]], supersampling: int = 2) -> Tensor:
    """(H, W, 3) sum of ray-cast images, float64."""
    pose = torch.linalg.inv(camera.viewmat.double()) @ torch.diag(
        torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
    )
    total = np.zeros((camera.height, camera.width, 3))
    for light in lights:
        shot = draw_lit_solids(scene, pose.numpy(), light["light"].double().numpy(), camera.width, supersampling)
        total += shot.rgba[..., :3].astype(np.float64) * (light["light_intensity"].double().numpy() / INTENSITY)
    return torch.from_numpy(total)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--lights", type=int, nargs="*", default=[16, 64, 256])
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--record", action="store_true", help="write the table to docs/relighting.md")
    parser.add_argument(
        "--picture", type=Path, help="environment; truth and model under those of 64 lights that are near trained ones"
    )
    parser.add_argument("--keep", type=Path, help="write the environments here")
    args = parser.parse_args()
    torch.set_num_threads(1)
    config, task, model, header = load_run(args.run_dir)
    facts, dataset, scene = header["data"], load_dataset(config, task), Scene(build_lit_solids())
    far = {**facts, "lights": {**facts["lights"], "distance": DISTANT}}
    step = max(len(dataset.test) // args.views, 1)
    views = [dataset.test.view(i) for i in range(0, len(dataset.test), step)][: args.views]
    table = Table("environment", "lights", "same lights", "seen lights", "distant", "lights alone")
    columns = []
    for name, radiance in environments().items():
        if args.keep:
            args.keep.mkdir(parents=True, exist_ok=True)
            write_exr(args.keep / f"{name.replace(' ', '_')}.exr", radiance, half=False)
        environment = Environment(radiance)
        distant = [truth(scene, v.camera, list(illuminate(environment, MANY, far).conditions), 1) for v in views]
        for count in args.lights:
            around = illuminate(environment, count, facts)
            lights = list(around.conditions)
            scores = []
            for view, reference in zip(views, distant, strict=True):
                drawn = render_light_sum(model, view, lights, config.renderer, torch.zeros(3)).double()
                cast = truth(scene, view.camera, lights, 2)
                seen = list(around.frames(False))
                fair = (
                    render_light_sum(model, view, seen, config.renderer, torch.zeros(3)).double(),
                    truth(scene, view.camera, seen, 2),
                )
                pairs = ((drawn, cast), fair, (drawn, reference), (cast, reference))
                scores.append([psnr(a.clamp(0, 1), b.clamp(0, 1)) for a, b in pairs])
            means = [f"{x:.2f} dB" for x in np.mean(scores, axis=0)]
            table.row(name, len(lights), *means)
            for note in around.notes:
                print(f"  {note}")
        if args.picture:
            camera = views[-1].camera.resized(PIXELS, PIXELS)
            around = illuminate(environment, 64, facts)
            lights = list(around.frames(False))
            drawn = render_light_sum(model, View("picture", camera), lights, config.renderer, torch.zeros(3))
            planes = radiance.clamp(0, 1).movedim(-1, 0)[None]
            small = torch.nn.functional.interpolate(
                planes, size=(PIXELS // 2, PIXELS), mode="bilinear", antialias=True
            )[0].movedim(0, -1)
            images = [small, truth(scene, camera, lights, 3).float(), drawn]
            columns.append(torch.cat([Channels(color_space="linear").display(x).clamp(0, 1) for x in images]))
    if args.picture:
        write_png(args.picture, torch.cat(columns, 1))
    if args.record:
        rate = (
            f"{len(views)} test views of {views[0].camera.width}x{views[0].camera.height}, {model.count} primitives, "
        )
        between_markers(PAGE, "relight-environment", f"{table}\n\n{rate}{header['train_seconds']:.0f} s of training.")


if __name__ == "__main__":
    main()
