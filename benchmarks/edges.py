"""What a soft edge costs: nanoseconds a lane of edge = 1 and 2 over those of edge = 0, forward and backward, in one
run.

    python benchmarks/edges.py [--scenes 5000x400 ...] [--rounds N] [--record]

The scene of benchmarks/render.py, each edge with weights scaled so that a central chord is as opaque. All take turns;
best of N rounds. --record writes the table to docs/performance.md and the rows to benchmarks/results/edges.json.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from render import make_passes
from shared.scenes import lower, random_scene, view
from shared.tables import PERFORMANCE, Table, between_markers
from shared.timing import fastest

from neuprim.core.compute.threads import cpu_name
from neuprim.core.model.edge import EDGES, NORMS
from neuprim.core.model.fields import Cosine

RESULTS = Path(__file__).parent / "results" / "edges.json"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=["5000x400", "20000x400"], help="PRIMITIVESxSIZE")
    parser.add_argument(
        "--rates", nargs="*", type=float, default=[4.0, 10.0], help="largest phase rates per axis, radians per m"
    )
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--record", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    table = Table("scene", "largest rate", "pass", "edge 0, ns/lane", "edge 1", "edge 2")
    for text in args.scenes:
        count, size = (int(x) for x in text.split("x"))
        for rate in args.rates:
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
        RESULTS.write_text(json.dumps({"cpu": cpu_name(), "rows": rows}, indent=1) + "\n")
        between_markers(PERFORMANCE, "edges", f"{table}\n\n{cpu_name()}, one thread.")


if __name__ == "__main__":
    main()
