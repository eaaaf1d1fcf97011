"""Memory and quality of sequences whose box is large and almost empty.

    python benchmarks/sparse_volumes.py [--scenes trail plume] [--frames 3] [--steps 1000] [--record] [--print [--docs]]

makes two sequences of .vdb files (half floats, Blosc), trains the preset quick on each in a process of its own, and
measures the peak memory of that process. Both are generated here:

    trail   1.1 million active voxels along the diagonal of a box of 2026 x 1526 x 1172 voxels; one file has 2.5 MB
    plume   21 million active voxels (2 %) of 1024 x 1024 x 1024: a winding tube

The errors of the extinction are those of metrics.json: on every third voxel along each axis of the trail, and on every
second of the plume. --record writes benchmarks/results/sparse_volumes.json and the table of docs/results/dynamic.md.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from shared.arguments import make_parser
from shared.tables import RESULTS, Record, Table, publish, read_record

from neuprim.core.compute.threads import cpu_name
from neuprim.core.io.vdb import VdbGrid, VdbTiles, vdb_scale_transform, write_vdb

RECORD = RESULTS / "sparse_volumes.json"
_LEAF = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3)
_CHUNK = 4096  # leaves computed together
_ERRORS = ("sigma_correlation_early", "sigma_correlation_middle", "sigma_correlation_late")
_RUN = """
import resource, sys
from pathlib import Path
from neuprim.cli import main
status = main(["run", *sys.argv[1:]])
(Path(sys.argv[-1]) / "peak.txt").write_text(str(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss))
sys.exit(status)
"""


def trail(part: float) -> tuple[np.ndarray, np.ndarray]:
    """Points of a curve and its radius at each, in voxels: what a fast object leaves behind; ``part`` is the time."""
    along = np.linspace(0, 1, 6000)[:, None]
    points = 14 + along * (np.array([2026, 1526, 1172]) - 28)
    points[:, 2] += 2 * np.sin(40 * along[:, 0] + 6 * part)
    return points, 10.5 + 2.0 * np.sin(9 * along[:, 0] - 4 * part)


def plume(part: float) -> tuple[np.ndarray, np.ndarray]:
    """A tube that winds around the vertical axis and turns with the time."""
    along = np.linspace(0, 1, 12000)[:, None]
    angle = 6 * math.pi * along[:, 0] + part
    points = 512 + 400 * np.stack([np.cos(angle), np.sin(angle), 2 * along[:, 0] - 1], -1)
    return points, 29.5 + 3 * np.sin(11 * along[:, 0] + 3 * part)


CURVES = {"trail": trail, "plume": plume}


def make_frame(path: Path, points: np.ndarray, radii: np.ndarray) -> int:
    """Write smoke around a curve; return the number of active voxels. Memory follows the leaves, not the box."""
    reach = math.ceil(float(radii.max()) / 8) + 1
    near = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    coarse = np.unique((points // 8).astype(np.int64), axis=0)
    origins = np.unique((coarse[:, None] + near).reshape(-1, 3), axis=0) * 8
    tree = cKDTree(points)
    origins = origins[tree.query(origins + 3.5)[0] < radii.max() + 3.5 * math.sqrt(3)]
    kept, values = [], []
    for first in range(0, len(origins), _CHUNK):
        some = origins[first : first + _CHUNK]
        places = (some[:, None] + _LEAF).reshape(-1, 3)
        distance, nearest = tree.query(places, distance_upper_bound=float(radii.max()))
        inside = np.isfinite(distance)
        depth = np.zeros(len(places))
        depth[inside] = 1 - distance[inside] / radii[nearest[inside]]
        waves = 0.6 + 0.4 * np.prod(np.sin(places / np.array([5.1, 6.3, 7.7])), -1)
        sigma = (np.clip(2 * depth, 0, 1) * waves).astype(np.float16).astype(np.float32).reshape(-1, 8, 8, 8)
        used = sigma.any((1, 2, 3))
        kept.append(some[used])
        values.append(sigma[used])
    leaves = np.concatenate(values)
    transform = vdb_scale_transform(0.02)
    grid = VdbGrid(
        "density", transform, np.zeros((), np.float32), np.concatenate(kept).astype(np.int32), leaves, leaves > 0,
        VdbTiles.none(), half=True,
    )  # fmt: skip
    write_vdb(path, [grid])
    return grid.active_voxels


def measure_sequence(name: str, frames: int, steps: int) -> Record:
    """Make a sequence, train on it, and read its metrics and the peak memory of the training process."""
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / "vdb", Path(folder) / "run"
        source.mkdir()
        files = [source / f"{name}.{n:04d}.vdb" for n in range(frames)]
        active = [make_frame(file, *CURVES[name](n / frames)) for n, file in enumerate(files)]
        words = ["task=dynamic", "scene=vdb", f"scene.vdb={source}", f"train.iterations={steps}", "--out", str(out)]
        environment = {**os.environ, "NEUPRIM_CACHE_DIR": f"{folder}/cache"}
        subprocess.run([sys.executable, "-c", _RUN, *words], check=True, env=environment)
        metrics = json.loads((out / "metrics.json").read_text())
        kept = {key: metrics[key] for key in ("psnr", "psnr_mask", "model_bytes", *_ERRORS)}
        peak = 1024 * int((out / "peak.txt").read_text())
        size = max(file.stat().st_size for file in files)
    return {"scene": name, "active": max(active), "file_bytes": size, "peak_bytes": peak, "steps": steps, **kept}


def measure(args: argparse.Namespace) -> Record:
    rows = {row["scene"]: row for row in read_record(RECORD).get("rows", [])}
    rows |= {name: measure_sequence(name, args.frames, args.steps) for name in args.scenes}
    return {"cpu": cpu_name(), "rows": list(rows.values())}


def document(record: Record) -> str:
    table = Table(
        "sequence (generated)",
        "active voxels",
        "one file",
        "peak memory",
        "steps",
        "inside the mask",
        "correlation of σ",
    )
    for row in record["rows"]:
        table.row(
            row["scene"], f"{row['active'] / 1e6:.1f} million", f"{row['file_bytes'] / 1e6:.1f} MB",
            f"{row['peak_bytes'] / 1e9:.1f} GB", f"{row['steps']:,}", f"{row['psnr_mask']:.1f} dB",
            " / ".join(f"{row[name]:.2f}" for name in _ERRORS),
        )  # fmt: skip
    return str(table)


def main() -> None:
    parser = make_parser(__doc__, "--record", "--docs", "--print", scenes=CURVES)
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--steps", type=int, default=1000)
    args = parser.parse_args()
    publish(args, RECORD, "dynamic.md", "sparse volumes", partial(measure, args), document)


if __name__ == "__main__":
    main()
