"""How well a relighting run of lit_solids shows light from all around, against the ray caster under the same and under
more lights.

    python benchmarks/relight_environment.py RUN_DIR [--lights 16 64 256] [--views N] [--record] [--picture FILE.png]
    python benchmarks/relight_environment.py --print [--docs]

- same lights: the model's image against the ray-cast sum over the very point lights that stand for the environment, so
  that only the model is wrong;
- seen lights: both without the lights more than 15 degrees off every training light;
- distant: against 1024 lights at 1e4 units, so that the lights' number and finite distance count too;
- lights alone: the ray caster under the few lights against the distant ones, what a perfect model would score there.

PSNR of linear light clamped to 0..1, means over views of the test split. --record writes
benchmarks/results/relight_environment.json and the table of docs/results/relighting.md; --print makes it from the
record.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from shared.arguments import make_parser
from shared.tables import RESULTS, Record, Table, publish
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.channels import Channels
from neuprim.core.data import View
from neuprim.core.environment import Environment
from neuprim.core.io.images import write_png
from neuprim.core.light_conditions import lights_from_environment
from neuprim.core.metrics import psnr
from neuprim.runs.measure import render_light_sum
from neuprim.runs.open import load_dataset, load_run
from neuprim.scenes.lit import INTENSITY, build_lit_solids, draw_lit_solids
from neuprim.scenes.raycast import Scene

RECORD = RESULTS / "relight_environment.json"
SCORES = ("same lights", "seen lights", "distant", "lights alone")
MANY, DISTANT = 1024, 1e4
PIXELS = 176  # of one image in the picture
Lights = list[dict[str, Tensor]]


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


def truth(scene: Scene, camera: Camera, lights: Lights, supersampling: int = 2) -> Tensor:
    """(H, W, 3) sum of ray-cast images, float64."""
    pose = torch.linalg.inv(camera.viewmat.double()) @ torch.diag(
        torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)
    )
    total = np.zeros((camera.height, camera.width, 3))
    for light in lights:
        shot = draw_lit_solids(scene, pose.numpy(), light["light"].double().numpy(), camera.width, supersampling)
        total += shot.rgba[..., :3].astype(np.float64) * (light["light_intensity"].double().numpy() / INTENSITY)
    return torch.from_numpy(total)


def measure(args: argparse.Namespace) -> Record:
    """A row per environment and number of lights, and the picture if one is asked for."""
    stored = load_run(args.run_dir)
    config, model, header = stored.config, stored.model, stored.header
    facts, dataset, scene = header["data"], load_dataset(stored), Scene(build_lit_solids())
    far = {**facts, "lights": {**facts["lights"], "distance": DISTANT}}
    step = max(len(dataset.test) // args.views, 1)
    views = [dataset.test.view(i) for i in range(0, len(dataset.test), step)][: args.views]

    def draw(view: View, lights: Lights) -> Tensor:
        return render_light_sum(model, view, lights, config.renderer, torch.zeros(3))

    def picture(radiance: Tensor) -> Tensor:
        """The environment, the truth and the model below each other."""
        camera = views[-1].camera.resized(PIXELS, PIXELS)
        lights = list(lights_from_environment(Environment(radiance), 64, facts).frames(False))
        planes, size = radiance.clamp(0, 1).movedim(-1, 0)[None], (PIXELS // 2, PIXELS)
        small = torch.nn.functional.interpolate(planes, size=size, mode="bilinear", antialias=True)[0].movedim(0, -1)
        images = [small, truth(scene, camera, lights, 3).float(), draw(View("picture", camera), lights)]
        return torch.cat([Channels(color_space="linear").display(image).clamp(0, 1) for image in images])

    rows = []
    for name, radiance in environments().items():
        environment = Environment(radiance)
        distant = [
            truth(scene, v.camera, list(lights_from_environment(environment, MANY, far).conditions), 1) for v in views
        ]
        for count in args.lights:
            around = lights_from_environment(environment, count, facts)
            lights, seen = list(around.conditions), list(around.frames(False))
            scores = []
            for view, reference in zip(views, distant, strict=True):
                drawn, cast = draw(view, lights).double(), truth(scene, view.camera, lights)
                fair = (draw(view, seen).double(), truth(scene, view.camera, seen))
                pairs = ((drawn, cast), fair, (drawn, reference), (cast, reference))
                scores.append([psnr(a.clamp(0, 1), b.clamp(0, 1)) for a, b in pairs])
            means = dict(zip(SCORES, np.mean(scores, axis=0).tolist(), strict=True))
            rows.append({"environment": name, "lights": len(lights), **means})
    if args.picture:
        write_png(args.picture, torch.cat([picture(radiance) for radiance in environments().values()], 1))
    return {
        "views": len(views),
        "size": [views[0].camera.width, views[0].camera.height],
        "primitives": model.count,
        "train_seconds": header["train_seconds"],
        "rows": rows,
    }


def document(record: Record) -> str:
    """The text between the markers."""
    table = Table("environment", "lights", *SCORES)
    for row in record["rows"]:
        table.row(row["environment"], row["lights"], *(f"{row[key]:.2f} dB" for key in SCORES))
    size = "x".join(map(str, record["size"]))
    run = f"{record['primitives']} primitives, {record['train_seconds']:.0f} s of training."
    return f"{table}\n\n{record['views']} test views of {size}, {run}"


def main() -> None:
    parser = make_parser(__doc__, "--record", "--docs", "--print")
    parser.add_argument("run_dir", type=Path, nargs="?")
    parser.add_argument("--lights", type=int, nargs="*", default=[16, 64, 256])
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--picture", type=Path, help="environment; truth and model under 64 lights near trained ones")
    args = parser.parse_args()
    if args.run_dir is None and not args.only_print:
        parser.error("found no RUN_DIR; expected the directory of a run, or --print")
    torch.set_num_threads(1)
    publish(args, RECORD, "relighting.md", "relight-environment", lambda: measure(args), document)


if __name__ == "__main__":
    main()
