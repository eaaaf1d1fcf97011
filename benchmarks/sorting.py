"""What the order of compositing costs and gains: sort=entry and samples=2 against sort=center, and both orders against
the joint volume.

    python benchmarks/sorting.py [--scene 2000x400] [--run RUN_DIR] [--view 0] [--size 128] [--steps 64] [--rounds 7]
    [--threads 0] [--record]

Draws a random scene of overlapping primitives (benchmarks/render.py) and, with --run, the model of a finished run from
one of its test views. Errors are those of an image ``size`` pixels wide against the marched sum of densities
(benchmarks/shared/unsorted_volume.py): "order" keeps every primitive's opacity, so that only the order differs; "field" is the sum
of the densities as they are, clamped at zero, so that it also counts the renderer's clamps and cuts. Times are ratios
to sort=center at the full size, the fastest of
``rounds``, taken in turns in one process; the backward column is the backward pass alone. --record writes the table to
benchmarks/results/sorting.json and docs/performance.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from shared.scenes import lower, random_scene, view
from shared.tables import PERFORMANCE, Table, between_markers
from shared.timing import fastest
from shared.unsorted_volume import measure_sorting_errors
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import RenderSettings, render_lowered

RESULTS = Path(__file__).parent / "results" / "sorting.json"
VARIANTS: dict[str, dict[str, Any]] = {
    "sort=center": {},
    "sort=entry": {"sort": "entry"},
    "sort=center samples=2": {"samples": 2},
    "sort=entry samples=2": {"sort": "entry", "samples": 2},
}


def from_run(folder: Path, index: int) -> tuple[str, tuple[Lowered, Camera, Tensor]]:
    """The model of a finished run, as leaves that take gradients, one of its test cameras, and its background;
    named."""
    from neuprim.runs.open import load_dataset, load_run

    config, task, model, _ = load_run(folder)
    dataset = load_dataset(config, task)
    shot = dataset.test.view(index)
    for value in model.params.values():
        value.requires_grad_()
    name = f"{dataset.name}, {model.count} primitives, view {index}"
    return name, (model.lower(shot.camera, shot.conditions), shot.camera, dataset.background)


def ratios(
    lowered: Lowered, camera: Camera, background: Tensor, settings: RenderSettings, rounds: int
) -> dict[str, list[float]]:
    """Seconds of the forward pass and of the backward pass of every variant, in the order of VARIANTS."""
    forward: list[Callable[[], Any]] = []
    backward: list[Callable[[], Any]] = []
    leaves = [x for x in (lowered.geometry.means, lowered.geometry.log_scales, lowered.density.W1) if x.requires_grad]  # type: ignore[union-attr]
    for knobs in VARIANTS.values():
        chosen = replace(settings, **knobs)
        kept = render_lowered(lowered, camera, chosen, background)

        def draw(chosen: RenderSettings = chosen) -> None:
            with torch.no_grad():
                render_lowered(lowered, camera, chosen, background)

        def differentiate(rgb: Tensor = kept.rgb) -> None:
            torch.autograd.grad(rgb, leaves, torch.ones_like(rgb), retain_graph=True)

        forward.append(draw)
        backward.append(differentiate)
    return {"forward": fastest(forward, rounds), "backward": fastest(backward, rounds)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--scene", default="2000x400", help="PRIMITIVESxSIZE of the random scene")
    parser.add_argument("--run", type=Path, help="a finished run's directory")
    parser.add_argument("--view", type=int, default=0, help="which of the run's test views")
    parser.add_argument("--size", type=int, default=128, help="width of the images whose errors are measured")
    parser.add_argument(
        "--steps",
        type=int,
        default=64,
        help="even divisions per ray of the joint volume, beside the ends of all chords",
    )
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--record", action="store_true")
    args = parser.parse_args()
    count, size = (int(x) for x in args.scene.split("x"))
    settings = RenderSettings(threads=args.threads)
    scenes = {f"random {args.scene}": (lower(random_scene(count)), view(size), torch.zeros(3))}
    if args.run:
        name, scene = from_run(args.run, args.view)
        scenes[name] = scene
    rows = []
    table = Table("scene", "drawn with", "order: PSNR, mean abs", "field: PSNR, mean abs", "forward", "backward")
    for name, (lowered, camera, background) in scenes.items():
        small = camera.resized(args.size, max(1, round(camera.height * args.size / camera.width)))
        order, field = (
            measure_sorting_errors(lowered, small, settings, background, args.steps, keep)
            for keep in ("opacity", "density")
        )
        times = ratios(lowered, camera, background, settings, args.rounds)
        for i, (variant, knobs) in enumerate(VARIANTS.items()):
            row: dict[str, Any] = {"scene": name, "variant": variant, **{k: v[i] / v[0] for k, v in times.items()}}
            cells = ["", ""]
            if "samples" not in knobs:
                found = [e[settings.sort if "sort" not in knobs else knobs["sort"]] for e in (order, field)]
                cells = [f"{e.psnr:.2f} dB, {e.mean_abs:.5f}" for e in found]
                row |= {
                    k: {"psnr": e.psnr, "mean_abs": e.mean_abs} for k, e in zip(("order", "field"), found, strict=True)
                }
            table.row(name, variant, *cells, f"{row['forward']:.2f}", f"{row['backward']:.2f}")
            rows.append(row)
    if args.record:
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps({"size": args.size, "steps": args.steps, "rows": rows}, indent=1) + "\n")
        between_markers(PERFORMANCE, "sorting", str(table))


if __name__ == "__main__":
    main()
