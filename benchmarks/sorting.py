"""What the order of compositing costs and gains: sort=entry and samples=2 against sort=center, and both orders against
the joint volume.

    python benchmarks/sorting.py [--scene 2000x400] [--run RUN_DIR] [--view 0] [--size 128] [--steps 64] [--rounds 7]
    [--threads 0] [--record]

Draws a random scene of overlapping primitives (benchmarks/render.py) and, with --run, the model of a finished run from
one of its test views. Errors are those of an image ``size`` pixels wide against the marched sum of densities
(benchmarks/shared/unsorted_volume.py): "order" keeps every primitive's opacity, so that only the order differs; "field"
is the sum of the densities as they are, clamped at zero, so that it also counts the renderer's clamps and cuts. Times
are ratios to sort=center at the full size, the fastest of ``rounds``, taken in turns in one process; the backward
column is the backward pass alone. --record writes the table to benchmarks/results/sorting.json and docs/performance.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from shared.arguments import make_parser
from shared.records import RESULTS, update_record
from shared.scenes import lower, random_scene, view
from shared.tables import PERFORMANCE, between_markers, make_table
from shared.timing import fastest
from shared.unsorted_volume import measure_sorting_errors
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.runs.open import load_dataset, load_run

VARIANTS: dict[str, dict[str, Any]] = {
    "sort=center": {},
    "sort=entry": {"sort": "entry"},
    "sort=center samples=2": {"samples": 2},
    "sort=entry samples=2": {"sort": "entry", "samples": 2},
}
Scene = tuple[LoweredPrimitives, Camera, Tensor]


def open_scene(folder: Path, index: int) -> tuple[str, Scene]:
    """The model of a finished run, as leaves that take gradients, one of its test cameras, and its background;
    named."""
    stored = load_run(folder)
    model = stored.model
    dataset = load_dataset(stored)
    shot = dataset.test.view(index)
    for value in model.params.values():
        value.requires_grad_()
    name = f"{dataset.name}, {model.count} primitives, view {index}"
    return name, (model.lower(shot.camera, shot.conditions), shot.camera, dataset.background)


def measure_times(scene: Scene, settings: RenderSettings, rounds: int) -> dict[str, list[float]]:
    """Seconds of the forward pass and of the backward pass of every variant, in the order of VARIANTS."""
    lowered, camera, background = scene
    leaves = [x for x in (lowered.geometry.means, lowered.geometry.log_scales, lowered.density.W1) if x.requires_grad]  # type: ignore[union-attr]
    forward: list[Callable[[], Any]] = []
    backward: list[Callable[[], Any]] = []
    for words in VARIANTS.values():
        draw = partial(render_lowered, lowered, camera, replace(settings, **words), background)
        rgb = draw().rgb
        forward.append(torch.no_grad()(draw))
        backward.append(partial(torch.autograd.grad, rgb, leaves, torch.ones_like(rgb), retain_graph=True))
    return {"forward": fastest(forward, rounds), "backward": fastest(backward, rounds)}


def error_cell(key: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: f"{row[key]['psnr']:.2f} dB, {row[key]['mean_abs']:.5f}" if key in row else ""


def main() -> None:
    parser = make_parser(__doc__, "--rounds", "--threads", "--record")
    parser.set_defaults(rounds=7)
    parser.add_argument("--scene", default="2000x400", help="PRIMITIVESxSIZE of the random scene")
    parser.add_argument("--run", type=Path, help="a finished run's directory")
    parser.add_argument("--view", type=int, default=0, help="which of the run's test views")
    parser.add_argument("--size", type=int, default=128, help="width of the images whose errors are measured")
    parser.add_argument("--steps", type=int, default=64, help="even divisions per ray, beside the ends of all chords")
    args = parser.parse_args()
    count, size = (int(x) for x in args.scene.split("x"))
    settings = RenderSettings(threads=args.threads)
    scenes: dict[str, Scene] = {f"random {args.scene}": (lower(random_scene(count)), view(size), torch.zeros(3))}
    if args.run:
        scenes |= dict([open_scene(args.run, args.view)])
    rows: list[dict[str, Any]] = []
    for name, scene in scenes.items():
        lowered, camera, background = scene
        small = camera.resized(args.size, max(1, round(camera.height * args.size / camera.width)))
        errors = {
            key: measure_sorting_errors(lowered, small, settings, background, args.steps, what)
            for key, what in (("order", "opacity"), ("field", "density"))
        }
        times = measure_times(scene, settings, args.rounds)
        for i, (variant, words) in enumerate(VARIANTS.items()):
            row: dict[str, Any] = {"scene": name, "variant": variant, **{k: v[i] / v[0] for k, v in times.items()}}
            for key, found in errors.items() if "samples" not in words else ():
                error = found[words.get("sort", settings.sort)]
                row[key] = {"psnr": error.psnr, "mean_abs": error.mean_abs}
            rows.append(row)
    columns = {
        "scene": lambda row: row["scene"],
        "drawn with": lambda row: row["variant"],
        "order: PSNR, mean abs": error_cell("order"),
        "field: PSNR, mean abs": error_cell("field"),
        "forward": lambda row: f"{row['forward']:.2f}",
        "backward": lambda row: f"{row['backward']:.2f}",
    }
    table = make_table(columns, rows)
    if args.record:
        update_record(RESULTS / "sorting.json", size=args.size, steps=args.steps, rows=rows)
        between_markers(PERFORMANCE, "sorting", str(table))


if __name__ == "__main__":
    main()
