"""Cost of a frame against primitives, pixels and overlap; peak memory of a million primitives.

    python benchmarks/scaling.py [--most 1000000] [--threads 0] [--record]

Random scenes whose primitives shrink as they multiply, so that a ray meets about the same number of them ("overlap":
how many times they would cover the unit cube's face). Every point is the fastest of a few frames. Times are of this
machine; the shape of the curves is what travels. --record writes benchmarks/results/scaling.json, docs/performance.md
and docs/pictures/scaling.png.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch
from shared.scenes import lower, random_scene, view
from shared.tables import PERFORMANCE, Table, between_markers

from neuprim.core.compute.threads import core_count, cpu_name
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import RenderSettings, render_lowered

HERE = Path(__file__).parent
RESULTS, PICTURE = HERE / "results" / "scaling.json", HERE.parent / "docs" / "pictures" / "scaling.png"
MEMORY_BOUND = 4e9


def milliseconds(lowered: Lowered, size: int, threads: int, backward: bool) -> tuple[float, int]:
    """Fastest of 3 frames (forward, or forward and backward), and the pairs it listed."""
    settings, best, pairs = RenderSettings(backend="cpu", threads=threads), math.inf, 0
    for _ in range(4):
        start = time.perf_counter()
        with torch.set_grad_enabled(backward):
            out = render_lowered(lowered, view(size), settings, torch.zeros(3))
        if backward:
            out.rgb.sum().backward()
        best, pairs = min(best, time.perf_counter() - start), out.stats.pairs
    return best * 1e3, pairs


def memory(count: int, size: int, backward: bool, threads: int) -> int:
    """Peak resident bytes of a fresh process that draws one such frame."""
    words = [sys.executable, __file__, "--one", str(count), str(size), str(int(backward)), "--threads", str(threads)]
    return int(subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()[-1])


def one_frame(count: int, size: int, backward: bool, threads: int) -> None:
    lowered = lower(random_scene(count))
    with torch.set_grad_enabled(backward):
        out = render_lowered(lowered, view(size), RenderSettings(backend="cpu", threads=threads), torch.zeros(3))
    if backward:
        out.rgb.sum().backward()
    print(_peak())


def _peak() -> int:
    """Peak resident bytes of this process. Linux's ru_maxrss starts at the parent's peak, so the kernel's own mark is
    read there."""
    status = Path("/proc/self/status")
    if status.exists():
        (kilobytes,) = (line.split()[1] for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return int(kilobytes) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def series(points: list[tuple[int, int, float]], label: str, threads: int, table: Table) -> list[dict[str, Any]]:
    rows = []
    for count, size, overlap in points:
        lowered = lower(random_scene(count, overlap=overlap))
        row: dict[str, Any] = {"series": label, "primitives": count, "size": size, "overlap": overlap}
        row["forward_ms"], row["pairs"] = milliseconds(lowered, size, threads, backward=False)
        row["both_ms"], _ = milliseconds(lowered, size, threads, backward=True)
        rows.append(row)
        table.row(
            label,
            count,
            f"{size}x{size}",
            f"{overlap:g}",
            row["pairs"],
            f"{row['forward_ms']:.1f}",
            f"{row['both_ms']:.1f}",
        )
    return rows


def draw(rows: list[dict[str, Any]]) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 3, figsize=(12, 3.6), constrained_layout=True)
    for axis, label, key in zip(
        axes, ("primitives", "pixels", "overlap"), ("primitives", "size", "overlap"), strict=True
    ):
        mine = [r for r in rows if r["series"] == label]
        x = [r[key] ** 2 if key == "size" else r[key] for r in mine]
        for name, text in (("forward_ms", "forward"), ("both_ms", "forward and backward")):
            axis.loglog(x, [r[name] for r in mine], marker="o", label=text)
        fixed = {k: mine[0][k] for k in ("primitives", "size", "overlap") if k != key}
        words = {"primitives": "{} primitives", "size": "{0}x{0}", "overlap": "overlap {:g}"}
        axis.set_title(", ".join(words[k].format(v) for k, v in fixed.items()), fontsize=10)
        axis.set_xlabel(label)
        axis.grid(True, which="major", alpha=0.3)
    axes[0].set_ylabel("ms per frame")
    axes[0].legend(frameon=False)
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--most", type=int, default=1_000_000, help="largest number of primitives")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--one", nargs=3, type=int, metavar=("COUNT", "SIZE", "BACKWARD"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.one:
        one_frame(args.one[0], args.one[1], bool(args.one[2]), args.threads)
        return
    table = Table("series", "primitives", "image", "overlap", "pairs", "forward ms", "forward + backward ms")
    counts = [n for n in (1000, 3000, 10_000, 30_000, 100_000, 300_000, 1_000_000) if n <= args.most]
    rows = series([(n, 400, 30.0) for n in counts], "primitives", args.threads, table)
    rows += series([(20_000, s, 30.0) for s in (100, 200, 400, 800)], "pixels", args.threads, table)
    rows += series([(20_000, 400, o) for o in (3.0, 10.0, 30.0, 100.0)], "overlap", args.threads, table)
    peaks = {
        f"{n} primitives at 800x800, {'forward and backward' if b else 'forward'}": memory(n, 800, b, args.threads)
        for n in (1000, args.most)
        for b in (False, True)
    }
    memories = Table("peak memory of a process that draws", "GB")
    for name, peak in peaks.items():
        memories.row(name, f"{peak / 1e9:.2f}")
    if args.record:
        RESULTS.parent.mkdir(exist_ok=True)
        RESULTS.write_text(json.dumps({"rows": rows, "peak_bytes": peaks}, indent=1) + "\n")
        draw(rows)
        between_markers(
            PERFORMANCE, "scaling", f"{memories}\n\nTimes on {core_count()} threads of {cpu_name()}.\n\n{table}"
        )
    worst = max(peaks.values())
    if worst > MEMORY_BOUND:
        raise SystemExit(f"peak memory {worst / 1e9:.2f} GB exceeds {MEMORY_BOUND / 1e9:g} GB")


if __name__ == "__main__":
    main()
