"""Cost of a frame against primitives, pixels and overlap; peak memory of a million primitives.

    python benchmarks/scaling.py [--most 1000000] [--threads 0] [--record]
    python benchmarks/scaling.py --print [--docs]

Random scenes whose primitives shrink as they multiply, so that a ray meets about the same number of them ("overlap":
how many times they would cover the unit cube's face). Every point is the fastest of a few frames. Times are of this
machine; the shape of the curves is what travels. --record writes benchmarks/results/scaling.json and
docs/results/performance.md, --print makes the tables from the record; both, with --docs, draw
docs/pictures/scaling.png.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from shared.arguments import make_parser
from shared.scenes import fastest, lower, random_scene, view
from shared.tables import DOCS, RESULTS, Record, Run, Table, make_table, publish

from neuprim.core.compute.threads import core_count, cpu_name
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import RenderOutput, RenderSettings, render_lowered
from neuprim.report.charts import LARGE, Chart, ChartPoints, write_png_charts

RECORD = RESULTS / "scaling.json"
PICTURE = DOCS / "pictures" / "scaling.png"
MEMORY_BOUND = 4e9
SERIES = {
    "primitives": [(n, 400, 30.0) for n in (1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000)],
    "pixels": [(20_000, size, 30.0) for size in (100, 200, 400, 800)],
    "overlap": [(20_000, 400, overlap) for overlap in (3.0, 10.0, 30.0, 100.0)],
}
"""Primitives, side of the image and overlap."""


def render_frame(lowered: LoweredPrimitives, size: int, threads: int, backward: bool) -> RenderOutput:
    with torch.set_grad_enabled(backward):
        out = render_lowered(lowered, view(size), RenderSettings(backend="cpu", threads=threads), torch.zeros(3))
    if backward:
        out.rgb.sum().backward()
    return out


def measure(series: str, args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row per point, with the fastest of three frames."""
    for count, size, overlap in SERIES[series]:
        if count <= args.most:
            lowered = lower(random_scene(count, overlap=overlap))
            row: dict[str, Any] = {"series": series, "primitives": count, "size": size, "overlap": overlap}
            for key, backward in (("forward_ms", False), ("both_ms", True)):
                (seconds,) = fastest([lambda b=backward: render_frame(lowered, size, args.threads, b)], 3)  # noqa: B023
                row[key] = seconds * 1e3
            yield row | {"pairs": render_frame(lowered, size, args.threads, False).stats.pairs}


def peak_memory(count: int, backward: bool, threads: int) -> int:
    """Peak resident bytes of a fresh process that draws one such frame."""
    words = [sys.executable, __file__, "--one", str(count), str(int(backward)), "--threads", str(threads)]
    return int(subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()[-1])


def own_peak() -> int:
    """Peak resident bytes of this process. Linux's ru_maxrss starts at the parent's peak, so the kernel's own mark is
    read there."""
    status = Path("/proc/self/status")
    if status.exists():
        (kilobytes,) = (line.split()[1] for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(kilobytes) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def make_chart(series: str, rows: list[Run]) -> Chart:
    own = [row for row in rows if row["series"] == series]
    x = [row["size"] ** 2 if series == "pixels" else row[series] for row in own]
    lines = [
        ChartPoints(x, [row[key] for row in own], colour, name=name)
        for key, colour, name in (("forward_ms", "C0", "forward"), ("both_ms", "C1", "forward and backward"))
    ]
    texts = {"primitives": f"{own[0]['primitives']} primitives", "pixels": f"{own[0]['size']}×{own[0]['size']}"}
    texts["overlap"] = f"overlap {own[0]['overlap']:g}"
    title = ", ".join(text for name, text in texts.items() if name != series)
    return Chart(title, lines, series, "ms a frame", LARGE, log_x=True, log_y=True)


COLUMNS = {
    "series": lambda row: row["series"],
    "primitives": lambda row: row["primitives"],
    "image": lambda row: f"{row['size']}x{row['size']}",
    "overlap": lambda row: f"{row['overlap']:g}",
    "pairs": lambda row: row["pairs"],
    "forward ms": lambda row: f"{row['forward_ms']:.1f}",
    "forward + backward ms": lambda row: f"{row['both_ms']:.1f}",
}


def measure_all(args: argparse.Namespace) -> Record:
    """Every point, and the peak memory of small and large scenes."""
    rows = [row for series in SERIES for row in measure(series, args)]
    peaks = {
        f"{count} primitives at 800x800, {'forward and backward' if b else 'forward'}": peak_memory(
            count, b, args.threads
        )
        for count in (1000, args.most)
        for b in (False, True)
    }
    return {"cpu": cpu_name(), "threads": core_count(), "rows": rows, "peak_bytes": peaks}


def document(record: Record) -> str:
    """The text between the markers."""
    memories = Table("peak memory of a process that draws", "GB")
    for name, peak in record["peak_bytes"].items():
        memories.row(name, f"{peak / 1e9:.2f}")
    where = f"Times on {record['threads']} threads of {record['cpu']}."
    return f"{memories}\n\n{where}\n\n{make_table(COLUMNS, record['rows'])}"


def main() -> None:
    parser = make_parser(__doc__, "--threads", "--record", "--docs", "--print")
    parser.add_argument("--most", type=int, default=1_000_000, help="largest number of primitives")
    parser.add_argument("--one", nargs=2, type=int, metavar=("COUNT", "BACKWARD"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.one:
        render_frame(lower(random_scene(args.one[0])), 800, args.threads, bool(args.one[1]))
        print(own_peak())
        return
    record = publish(args, RECORD, "performance.md", "scaling", lambda: measure_all(args), document)
    if args.record or args.docs:
        write_png_charts(PICTURE, [make_chart(series, record["rows"]) for series in SERIES])
    worst = max(record["peak_bytes"].values())
    if worst > MEMORY_BOUND:
        raise SystemExit(f"peak memory {worst / 1e9:.2f} GB exceeds {MEMORY_BOUND / 1e9:g} GB")


if __name__ == "__main__":
    main()
