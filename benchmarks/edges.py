"""What a soft edge costs: nanoseconds a lane of edge = 1 and 2 over those of edge = 0, forward and backward, in one
run.

    python benchmarks/edges.py [--scenes 5000x400 ...] [--rounds N] [--record]

The scene of benchmarks/render.py, each edge with weights scaled so that a central chord is as opaque. All take turns;
best of N rounds. --record writes the table to docs/performance.md and the rows to benchmarks/results/edges.json.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import torch
from render import make_passes
from shared.arguments import make_parser
from shared.scenes import fastest, lower, random_scene, view
from shared.tables import PERFORMANCE, RESULTS, Table, between_markers, update_record

from neuprim.core.compute.threads import cpu_name
from neuprim.core.model.edge import EDGES, NORMS
from neuprim.core.model.fields import Cosine


def main() -> None:
    parser = make_parser(__doc__, "--rounds", "--record")
    parser.add_argument("--scenes", nargs="*", default=["5000x400", "20000x400"], help="PRIMITIVESxSIZE")
    parser.add_argument(
        "--rates", nargs="*", type=float, default=[4.0, 10.0], help="largest phase rates, radians per m"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    table = Table("scene", "largest rate", "pass", "edge 0, ns/lane", "edge 1", "edge 2")
    for text, rate in product(args.scenes, args.rates):
        count, size = (int(x) for x in text.split("x"))
        scene, made = random_scene(count, rate=rate), []
        for edge in EDGES:
            factor = NORMS[0] / NORMS[edge]
            lowered = lower(scene | {"w2": scene["w2"] * factor, "b2": scene["b2"] * factor})
            assert isinstance(lowered.density, Cosine)
            made.append(make_passes(replace(lowered, density=replace(lowered.density, edge=edge)), view(size), 1))
        for i, name in enumerate(("forward", "backward")):
            times = fastest([passes[i] for passes, _ in made], args.rounds)
            lanes = [t / counts[name] * 1e9 for t, (_, counts) in zip(times, made, strict=True)]
            ratios = [lane / lanes[0] for lane in lanes]
            table.row(text, f"{rate:g}", name, f"{lanes[0]:.1f}", *(f"{r:.2f} times that" for r in ratios[1:]))
            rows.append({"scene": text, "rate": rate, "pass": name, "ns_per_lane": lanes, "ratios": ratios})
    if args.record:
        update_record(RESULTS / "edges.json", cpu=cpu_name(), rows=rows)
        between_markers(PERFORMANCE, "edges", f"{table}\n\n{cpu_name()}, one thread.")


if __name__ == "__main__":
    main()
