"""Speed of the CPU backend: time per evaluated lane, lanes per true hit, arithmetic rate and memory.

    python benchmarks/render.py [--scenes 5000x400 20000x400 20000x800] [--threads 1 2] [--rounds 9] [--record]

Draws random scenes, with preparation and binning. A step is forward, backward and Adam on all parameters; three
colours, no depth. Flops are counted by one rule: 420 per evaluated lane forward, 1,100 backward (K = 8). --record
writes the result to benchmarks/results/render.json and docs/performance.md.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numba import njit
from shared.scenes import lower, random_scene, view
from shared.tables import PERFORMANCE, Table, between_markers
from shared.timing import fastest

from neuprim.core.cameras import Camera
from neuprim.core.compute.threads import cpu_name
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.primitives import Lowered
from neuprim.core.model.schema import ParameterSpec
from neuprim.core.render import RenderSettings, layout, render_lowered
from neuprim.core.render.cpu.layout import gradient_width, row_width
from neuprim.core.train.optimizer import RowAdam

RESULTS = Path(__file__).parent / "results" / "render.json"
FLOPS = {"forward": 420, "backward": 1100}
Passes = tuple[Callable[[], None], Callable[[], None], Callable[[], None]]


@njit(cache=False)
def _count_hits(E0, EX, EY, XA, tc, anchor, boxes):  # type: ignore[no-untyped-def]
    hits = 0
    for i in range(len(tc)):
        for y in range(boxes[i, 1], boxes[i, 3]):
            for x in range(boxes[i, 0], boxes[i, 2]):
                du, dv = x + 0.5 - anchor[i, 0], y + 0.5 - anchor[i, 1]
                ee, me, mm = 0.0, 0.0, 0.0
                for a in range(3):
                    g = du * EX[i, a] + dv * EY[i, a]
                    e, m = E0[i, a] + g, XA[i, a] + tc[i] * g
                    ee, me, mm = ee + e * e, me + m * e, mm + m * m
                hits += mm - me * me / ee < 1.0
    return hits


def true_hits(lowered: Lowered, camera: Camera) -> int:
    """Rays that really meet a primitive within its silhouette, of all (pixel, primitive) pairs; counted in the frame
    that a forward pass keeps."""
    node = render_lowered(lowered, camera, RenderSettings(backend="cpu"), torch.zeros(3)).rgb.grad_fn
    while not hasattr(node, "frame"):
        assert node is not None, "the backend keeps its frame in the graph"
        node = node.next_functions[0][0]
    frame = node.frame
    rows = frame.projected.rows.astype(np.float64)
    parts = [rows[:, c : c + 3] for c in (layout.E0, layout.EX, layout.EY, layout.XA)]
    return int(_count_hits(*parts, rows[:, layout.TC], rows[:, [layout.UX, layout.UY]], frame.projected.boxes))


def make_passes(lowered: Lowered, camera: Camera, threads: int) -> tuple[Passes, dict[str, int]]:
    settings, background = RenderSettings(backend="cpu", threads=threads), torch.zeros(3)
    g_rgb = torch.ones(camera.height, camera.width, 3)
    kept = render_lowered(lowered, camera, settings, background)
    g, d, c = lowered.geometry, lowered.density, lowered.colour
    assert isinstance(d, Cosine) and isinstance(c, Constant)
    params = {
        "means": g.means,
        "log_scales": g.log_scales,
        "quats": g.quats,
        "W1": d.W1,
        "b1": d.b1,
        "w2": d.w2,
        "b2": d.b2,
        "rgb": c.rgb,
    }
    specs = [ParameterSpec(n, tuple(v.shape[1:]), 0.0, lambda context: torch.empty(0)) for n, v in params.items()]
    adam = RowAdam(specs, params)

    def forward() -> None:
        with torch.no_grad():
            render_lowered(lowered, camera, settings, background)

    def backward() -> None:
        torch.autograd.grad(kept.rgb, list(params.values()), g_rgb, retain_graph=True)

    def step() -> None:
        for value in params.values():
            value.grad = None
        render_lowered(lowered, camera, settings, background).rgb.backward(g_rgb)
        adam.step(params, dict.fromkeys(params, 0.0))  # the scene stays as it is

    backward()
    lanes = {k: int(kept.stats.extra[f"{k}_lanes"]) for k in ("forward", "backward")}
    return (forward, backward, step), {**lanes, "pairs": kept.stats.pairs}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--scenes", nargs="*", default=["5000x400", "20000x400", "20000x800"], help="PRIMITIVESxSIZE")
    parser.add_argument("--threads", nargs="*", type=int, default=[1, 2])
    parser.add_argument(
        "--rate", type=float, default=4.0, help="largest phase rate per axis, radians per m (trained models: about 10)"
    )
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--record", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    memory = (
        f"Per primitive {4 * row_width(8) + 4 * layout.SPAN_WIDTH} bytes of rows and spans and per pair 8 bytes of "
        f"lists; a backward pass takes "
        f"{4 * gradient_width(8, 3)} bytes more for each (K = 8, three colours), and what the forward pass keeps "
        f"for it: 6 bytes a pair and 4 a lane."
    )
    print(memory)
    table = Table("scene", "largest rate", "threads", "pass", "ms", "ns/lane", "lanes/hit", "GFLOP/s")
    for text in args.scenes:
        count, size = (int(x) for x in text.split("x"))
        p, camera = random_scene(count, rate=args.rate), view(size)
        lowered = lower(p)
        hits = true_hits(lowered, camera)
        for threads in args.threads:
            passes, counts = make_passes(lowered, camera, threads)
            for i, name in enumerate((*FLOPS, "step")):
                times = fastest([passes[i]], args.rounds)
                row: dict[str, Any] = {
                    "scene": text,
                    "rate": args.rate,
                    "threads": threads,
                    "pass": name,
                    "ms": times[0] * 1e3,
                }
                lanes = counts["forward"] + counts["backward"] if name == "step" else counts[name]
                flops = sum(counts[k] * FLOPS[k] for k in FLOPS) if name == "step" else lanes * FLOPS[name]
                row |= {"ns_per_lane": times[0] / lanes * 1e9 * threads, "lanes_per_hit": counts["forward"] / hits}
                row["gflops"] = flops / times[0] / 1e9
                cells = (
                    f"{row['ms']:.1f}",
                    f"{row['ns_per_lane']:.1f}",
                    f"{row['lanes_per_hit']:.2f}",
                    f"{row['gflops']:.0f}",
                )
                table.row(text, f"{args.rate:g}", threads, name, *cells)
                rows.append(row)
    if args.record:
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps({"cpu": cpu_name(), "rows": rows}, indent=1) + "\n")
        between_markers(PERFORMANCE, "render", f"{table}\n\n{cpu_name()}. {memory}")


if __name__ == "__main__":
    main()
