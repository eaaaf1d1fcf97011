"""Speed of the CPU backend: time per evaluated lane, lanes per true hit, arithmetic rate and memory.

    python benchmarks/render.py [--scenes 5000x400 20000x400 20000x800] [--threads 1 2] [--rounds 9] [--record]
    python benchmarks/render.py --print [--docs]
    python benchmarks/render.py --against CHECKOUT [--scenes 20000x400] [--threads 1] [--rounds 9] [--turns 5]

Draws random scenes, with preparation and binning. A step is forward, backward and Adam on all parameters; three
colours, no depth. Flops are counted by one rule: 420 per evaluated lane forward, 1,100 backward (K = 8). --record
writes the result to benchmarks/results/render.json and docs/results/performance.md; --print makes the table from the
record.

--against compares with another commit (`git worktree add CHECKOUT COMMIT`): processes of both checkouts run their own
copy of this script in turns, and the ratio of the fastest times is printed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numba import njit
from shared.arguments import make_parser
from shared.scenes import fastest, lower, random_scene, view
from shared.tables import RESULTS, ROOT, Record, Table, make_table, publish

from neuprim.core.cameras import Camera
from neuprim.core.compute.threads import cpu_name
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.model.schema import ParameterSpec
from neuprim.core.render import RenderSettings, layout, render_lowered
from neuprim.core.render.cpu.layout import gradient_width, row_width
from neuprim.core.train.optimizer import RowAdam

RECORD = RESULTS / "render.json"
FLOPS = {"forward": 420, "backward": 1100}
MEMORY = (
    f"Per primitive {4 * row_width(8) + 4 * layout.SPAN_WIDTH} bytes of rows and spans and per pair 8 bytes of lists; "
    f"a "
    f"backward pass takes {4 * gradient_width(8, 3)} bytes more for each (K = 8, three colours), and what the forward "
    f"pass keeps for it: 6 bytes a pair and 4 a lane."
)
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


def count_true_hits(lowered: LoweredPrimitives, camera: Camera) -> int:
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


def make_passes(lowered: LoweredPrimitives, camera: Camera, threads: int) -> tuple[Passes, dict[str, int]]:
    """The forward pass, the backward pass and a whole step; lanes of the first two, and pairs."""
    settings, background = RenderSettings(backend="cpu", threads=threads), torch.zeros(3)
    g_rgb = torch.ones(camera.height, camera.width, 3)
    saved = render_lowered(lowered, camera, settings, background)
    g, d, c = lowered.geometry, lowered.density, lowered.colour
    assert isinstance(d, Cosine) and isinstance(c, Constant)
    params = {"means": g.means, "log_scales": g.log_scales, "quats": g.quats, "rgb": c.rgb}
    params |= {"W1": d.W1, "b1": d.b1, "w2": d.w2, "b2": d.b2}
    specs = [ParameterSpec(n, tuple(v.shape[1:]), 0.0, lambda context: torch.empty(0)) for n, v in params.items()]
    adam = RowAdam(specs, params)

    def forward() -> None:
        with torch.no_grad():
            render_lowered(lowered, camera, settings, background)

    def backward() -> None:
        torch.autograd.grad(saved.rgb, list(params.values()), g_rgb, retain_graph=True)

    def step() -> None:
        for value in params.values():
            value.grad = None
        render_lowered(lowered, camera, settings, background).rgb.backward(g_rgb)
        adam.step(params, dict.fromkeys(params, 0.0))  # the scene stays as it is

    backward()
    lanes = {k: int(saved.stats.extra[f"{k}_lanes"]) for k in ("forward", "backward")}
    return (forward, backward, step), {**lanes, "pairs": saved.stats.pairs}


def measure(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row per scene, number of threads and pass."""
    for text in args.scenes:
        count, size = (int(x) for x in text.split("x"))
        camera, lowered = view(size), lower(random_scene(count, rate=args.rate))
        hits = count_true_hits(lowered, camera)
        for threads in args.threads:
            passes, counts = make_passes(lowered, camera, threads)
            for run, name in zip(passes, (*FLOPS, "step"), strict=True):
                (seconds,) = fastest([run], args.rounds)
                parts = [name] if name in FLOPS else list(FLOPS)
                lanes = sum(counts[part] for part in parts)
                flops = sum(counts[part] * FLOPS[part] for part in parts)
                yield {
                    "scene": text,
                    "rate": args.rate,
                    "threads": threads,
                    "pass": name,
                    "ms": seconds * 1e3,
                    "ns_per_lane": seconds / lanes * 1e9 * threads,
                    "lanes_per_hit": counts["forward"] / hits,
                    "gflops": flops / seconds / 1e9,
                }


COLUMNS: dict[str, Callable[[dict[str, Any]], object]] = {
    "scene": lambda row: row["scene"],
    "largest rate": lambda row: f"{row['rate']:g}",
    "threads": lambda row: row["threads"],
    "pass": lambda row: row["pass"],
    "ms": lambda row: f"{row['ms']:.1f}",
    "ns/lane": lambda row: f"{row['ns_per_lane']:.1f}",
    "lanes/hit": lambda row: f"{row['lanes_per_hit']:.2f}",
    "GFLOP/s": lambda row: f"{row['gflops']:.0f}",
}


def document(record: Record) -> str:
    """The text between the markers."""
    return f"{make_table(COLUMNS, record['rows'])}\n\n{record['cpu']}. {MEMORY}"


def times_of(checkout: Path, args: argparse.Namespace) -> dict[tuple[str, ...], float]:
    """Milliseconds by scene, threads and pass, as a checkout's own script prints them."""
    options = ["--rate", args.rate, "--rounds", args.rounds, "--scenes", *args.scenes, "--threads", *args.threads]
    command = [sys.executable, "benchmarks/render.py", *map(str, options)]
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    done = subprocess.run(command, env=environment, cwd=checkout, stdout=subprocess.PIPE, text=True, check=True)
    lines = [line.strip("| \n").split(" | ") for line in done.stdout.splitlines() if line.startswith("|")]
    rows = [dict(zip(lines[0], cells, strict=False)) for cells in lines[2:]]
    return {(row["scene"], row["threads"], row["pass"]): float(row["ms"]) for row in rows}


def compare(args: argparse.Namespace) -> None:
    """Print how long frames and steps of this checkout take, over those of another one."""
    best: dict[Path, dict[tuple[str, ...], float]] = {args.against.resolve(): {}, ROOT: {}}
    for turn in range(args.turns):
        for checkout in list(best)[:: 1 if turn % 2 else -1]:
            for key, ms in times_of(checkout, args).items():
                best[checkout][key] = min(ms, best[checkout].get(key, ms))
    other, own = best.values()
    table = Table("scene", "threads", "pass", f"ms, {args.against.name}", "ms, here", "here / there")
    for key in own:
        table.row(*key, f"{other[key]:.1f}", f"{own[key]:.1f}", f"{own[key] / other[key]:.3f}")


def main() -> None:
    parser = make_parser(__doc__, "--rounds", "--record", "--docs", "--print")
    parser.add_argument("--scenes", nargs="*", default=["5000x400", "20000x400", "20000x800"], help="PRIMITIVESxSIZE")
    parser.add_argument("--threads", nargs="*", type=int, default=[1, 2])
    parser.add_argument("--rate", type=float, default=4.0, help="largest phase rate per axis, radians per m")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT", help="another checkout")
    parser.add_argument("--turns", type=int, default=5, help="of --against")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.against:
        compare(args)
        return
    print(MEMORY)
    publish(
        args,
        RECORD,
        "performance.md",
        "render",
        lambda: {"cpu": cpu_name(), "rows": list(measure(args))},
        document,
    )


if __name__ == "__main__":
    main()
