"""What silhouettes of what can be seen are worth (neuprim/core/render/cpu/seen.py): runs drawn with them and with whole
ones, in turns.

    python benchmarks/seen.py RUN_DIR... [--views 8] [--rounds 7] [--record]

Forward is a training view without gradients, step one with them and its backward pass; the colours' lowering is inside,
the optimiser is not. Times are the fastest rounds of all views, on one thread. *pairs* of tiles and primitives and
*lanes*, rays against primitives, are shares of those of whole silhouettes; *backward* are the lanes that the backward
pass evaluates, of those drawn. *image*, *gradient*: the largest difference, of a gradient relative to its parameter's
largest.
--record writes benchmarks/results/seen.json and the table in docs/performance.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from shared.tables import PERFORMANCE, Table, between_markers
from shared.timing import fastest
from torch import Tensor

from neuprim.core.compute.machine import cpu_name
from neuprim.core.data import Dataset, View
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.core.render.cpu import backend
from neuprim.runs.open import load_dataset, load_run

RESULTS = Path(__file__).parent / "results" / "seen.json"


@contextmanager
def whole() -> Iterator[None]:
    """Silhouettes of all that has a density: no depth is too little."""
    genuine = backend.depth_that_counts
    backend.depth_that_counts = lambda alpha_min: -1.0
    try:
        yield
    finally:
        backend.depth_that_counts = genuine


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN_DIR")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--record", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = [measured(run, args.views, args.rounds) for run in args.runs]
    shares = ("pairs", "lanes", "backward", "forward", "step")
    table = Table(
        "run", "primitives", "pairs", "lanes", "backward", "time forward", "time of a step", "image", "gradient"
    )
    for r in rows:
        table.row(
            r["run"],
            f"{r['primitives']:,}",
            *(f"{r[name]:.2f}" for name in shares),
            f"{r['image']:.0e}",
            f"{r['gradient']:.0e}",
        )
    if args.record:
        RESULTS.write_text(json.dumps({"cpu": cpu_name(), "rows": rows}, indent=1) + "\n")
        between_markers(PERFORMANCE, "seen", f"{table}\n\n{cpu_name()}, one thread.")


def measured(folder: Path, count: int, rounds: int) -> dict[str, Any]:
    config, task, model, _ = load_run(folder)
    dataset = load_dataset(config, task, run_dir=folder)
    settings = RenderSettings(backend="cpu", threads=1, alpha_min=config.renderer.alpha_min)
    every = max(len(dataset.train) // count, 1)
    views = [dataset.train.view(i) for i in range(0, every * count, every)]
    for value in model.params.values():
        value.requires_grad_(True)
    own = drawn(model, dataset, views, settings)
    with whole():
        other = drawn(model, dataset, views, settings)

    def forward() -> None:
        with torch.no_grad():
            for view in views:
                render(model, view.camera, view.conditions, settings, dataset.background)

    def step() -> None:
        drawn(model, dataset, views, settings)

    def with_whole(work: Any) -> Any:
        def run() -> None:
            with whole():
                work()

        return run

    times = {work.__name__: fastest([work, with_whole(work)], rounds) for work in (forward, step)}
    gradients = (
        float((a - b).abs().max() / b.abs().max().clamp_min(1e-30))
        for a, b in zip(own["gradients"], other["gradients"], strict=True)
        if b.numel()
    )
    return {
        "run": dataset.name,
        "primitives": model.count,
        "pairs": own["pairs"] / other["pairs"],
        "lanes": own["forward_lanes"] / other["forward_lanes"],
        "backward": own["backward_lanes"] / own["forward_lanes"],
        **{name: mine / theirs for name, (mine, theirs) in times.items()},
        "image": max(float((a - b).abs().max()) for a, b in zip(own["images"], other["images"], strict=True)),
        "gradient": max(gradients),
    }


def drawn(model: Primitives, dataset: Dataset, views: list[View], settings: RenderSettings) -> dict[str, Any]:
    """Images, counts and gradients of all views together."""
    images: list[Tensor] = []
    found: dict[str, Any] = {"images": images, "pairs": 0, "forward_lanes": 0, "backward_lanes": 0}
    for value in model.params.values():
        value.grad = None
    for view in views:
        output = render(model, view.camera, view.conditions, settings, dataset.background)
        output.rgb.square().sum().backward()
        images.append(output.rgb.detach())
        found["pairs"] += output.stats.pairs
        for way in ("forward_lanes", "backward_lanes"):
            found[way] += output.stats.extra[way]
    found["gradients"] = [
        torch.zeros(0) if value.grad is None else value.grad.clone() for value in model.params.values()
    ]
    return found


if __name__ == "__main__":
    main()
