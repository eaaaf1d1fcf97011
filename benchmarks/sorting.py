"""What sort=entry and samples=2 cost against sort=center.

    python benchmarks/sorting.py [--scene 2000x400] [--run RUN_DIR] [--view 0] [--rounds 7] [--threads 0] [--record]
    python benchmarks/sorting.py --print [--docs]

Draws a random scene of overlapping primitives (benchmarks/render.py) and, with --run, the model of a finished run from
one of its test views. Times are ratios to sort=center, the fastest of ``rounds``, taken in turns in one process; the
backward column is the backward pass alone. --record writes the table to benchmarks/results/sorting.json and
docs/results/performance.md; --print makes it from the record.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from shared.arguments import make_parser
from shared.scenes import fastest, lower, random_scene, view
from shared.tables import RESULTS, Record, make_table, publish
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.runs.open import load_dataset, load_run

RECORD = RESULTS / "sorting.json"
COLUMNS: dict[str, Callable[[Record], object]] = {
    "scene": lambda row: row["scene"],
    "drawn with": lambda row: row["variant"],
    "forward": lambda row: f"{row['forward']:.2f}",
    "backward": lambda row: f"{row['backward']:.2f}",
}
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


def measure(args: argparse.Namespace) -> Record:
    """A row per scene and variant."""
    count, size = (int(x) for x in args.scene.split("x"))
    settings = RenderSettings(threads=args.threads)
    scenes: dict[str, Scene] = {f"random {args.scene}": (lower(random_scene(count)), view(size), torch.zeros(3))}
    if args.run:
        scenes |= dict([open_scene(args.run, args.view)])
    rows: list[Record] = []
    for name, scene in scenes.items():
        times = measure_times(scene, settings, args.rounds)
        for i, variant in enumerate(VARIANTS):
            rows.append({"scene": name, "variant": variant, **{k: v[i] / v[0] for k, v in times.items()}})
    return {"rows": rows}


def document(record: Record) -> str:
    """The text between the markers."""
    return str(make_table(COLUMNS, record["rows"]))


def main() -> None:
    parser = make_parser(__doc__, "--rounds", "--threads", "--record", "--docs", "--print")
    parser.set_defaults(rounds=7)
    parser.add_argument("--scene", default="2000x400", help="PRIMITIVESxSIZE of the random scene")
    parser.add_argument("--run", type=Path, help="a finished run's directory")
    parser.add_argument("--view", type=int, default=0, help="which of the run's test views")
    args = parser.parse_args()
    publish(args, RECORD, "performance.md", "sorting", lambda: measure(args), document)


if __name__ == "__main__":
    main()
