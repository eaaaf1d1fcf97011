"""What a soft edge costs: nanoseconds a lane of edge = 1 and 2 over those of edge = 0, forward and backward, in one
run.

    python benchmarks/edges.py [--scenes 5000x400 ...] [--rounds N] [--record]
    python benchmarks/edges.py --print [--docs]

The scene of benchmarks/render.py, each edge with weights scaled so that a central chord is as opaque. All take turns;
best of N rounds. --record writes the rows to benchmarks/results/edges.json and the table to
docs/results/performance.md; --print makes the table from the record.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product

import torch
from render import make_passes
from shared.arguments import make_parser
from shared.scenes import fastest, lower, random_scene, view
from shared.tables import RESULTS, Record, make_table, publish

from neuprim.core.compute.threads import cpu_name
from neuprim.core.model.edge import EDGES, NORMS
from neuprim.core.model.fields import Cosine

RECORD = RESULTS / "edges.json"
COLUMNS: dict[str, Callable[[Record], object]] = {
    "scene": lambda row: row["scene"],
    "largest rate": lambda row: f"{row['rate']:g}",
    "pass": lambda row: row["pass"],
    "edge 0, ns/lane": lambda row: f"{row['ns_per_lane'][0]:.1f}",
    "edge 1": lambda row: f"{row['ratios'][1]:.2f} times that",
    "edge 2": lambda row: f"{row['ratios'][2]:.2f} times that",
}


def measure(args: argparse.Namespace) -> Iterator[Record]:
    """A row per scene, rate and pass."""
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
            yield {"scene": text, "rate": rate, "pass": name, "ns_per_lane": lanes, "ratios": ratios}


def document(record: Record) -> str:
    """The text between the markers."""
    return f"{make_table(COLUMNS, record['rows'])}\n\n{record['cpu']}, one thread."


def main() -> None:
    parser = make_parser(__doc__, "--rounds", "--record", "--docs", "--print")
    parser.add_argument("--scenes", nargs="*", default=["5000x400", "20000x400"], help="PRIMITIVESxSIZE")
    parser.add_argument(
        "--rates", nargs="*", type=float, default=[4.0, 10.0], help="largest phase rates, radians per m"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    publish(
        args,
        RECORD,
        "performance.md",
        "edges",
        lambda: {"cpu": cpu_name(), "rows": list(measure(args))},
        document,
    )


if __name__ == "__main__":
    main()
