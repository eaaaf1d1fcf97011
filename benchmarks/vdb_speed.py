"""How fast OpenVDB files decode: MB of float32 leaves per second over a folder, on one core.

    python benchmarks/vdb_speed.py DIR [--against DIR_OF_ANOTHER_READER] [--rounds N]

``--against`` names a folder with a module ``purevdb`` whose ``read(path)`` returns ``({name: {"values": …}}, …)``; both
readers then take turns in the same process, over the same files and grids, and the ratio of their best rounds is
printed.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from collections.abc import Callable
from pathlib import Path

from neuprim.core.io.vdb import read_grids, read_header


def leaves(path: Path, names: list[str]) -> int:
    """Decodes the named grids; bytes of float32 values."""
    return sum(grid.values.nbytes for grid in read_grids(path, names, level_sets=True))


def timed(work: Callable[[], int]) -> tuple[float, int]:
    start = time.perf_counter()
    size = work()
    return time.perf_counter() - start, size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    files = [
        (p, [g.name for g in read_header(p).grids if g.undecodable() is None])
        for p in sorted(args.folder.glob("*.vdb"))
    ]
    readers: dict[str, Callable[[], int]] = {"neuprim": lambda: sum(leaves(path, names) for path, names in files)}
    if args.against:
        sys.path.insert(0, str(args.against))
        other = importlib.import_module("purevdb")

        def compare() -> int:
            return sum(
                grid["values"].nbytes for path, names in files for grid in other.read(str(path), names)[0].values()
            )

        readers["other"] = compare
    best: dict[str, float] = {}
    sizes: dict[str, int] = {}
    for _ in range(args.rounds):
        for name, work in readers.items():
            seconds, sizes[name] = timed(work)
            best[name] = min(seconds, best.get(name, seconds))
    if len(set(sizes.values())) != 1:
        raise SystemExit(f"the readers decoded different amounts: {sizes}")
    stored = sum(path.stat().st_size for path, _ in files)
    print(
        f"{len(files)} files, {stored / 1e6:.1f} MB on disk, {sizes['neuprim'] / 1e6:.1f} MB of float32 leaves, best of {args.rounds}"
    )
    for name, seconds in best.items():
        print(f"{name:8} {sizes[name] / 1e6 / seconds:7.0f} MB/s")
    if args.against:
        print(f"ratio    {best['other'] / best['neuprim']:7.1f}")


if __name__ == "__main__":
    main()
