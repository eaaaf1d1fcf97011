"""How well Gaussians reproduce trained primitives, for each edge and each rule of the ``gaussian-ply`` export.

    python benchmarks/gaussians.py [RUN_DIR ...] [--edges 0 1 2] [--neurons 8 0] [--iterations 600] [--docs]

Without run directories it trains the static task's `solids`. PSNR in dB over all pixels of the test views, on the
scene's background. --docs puts the table between the markers of docs/export.md.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch
from shared.arguments import make_parser
from shared.tables import DOCS, Table, between_markers

from neuprim.config import compose
from neuprim.core.model.edge import EDGES
from neuprim.export.gaussian_ply import SIZES
from neuprim.runs.export import export_run
from neuprim.runs.run import run


def train(folder: Path, neurons: int, edge: int, iterations: int) -> Path:
    words = ["task=static", "scene=solids", "scene.size=128", "model.primitives=500", f"model.neurons={neurons}"]
    words += [f"model.density.edge={edge}", f"model.density.gain={'true' if edge else 'false'}"]
    words += [f"train.iterations={iterations}", "train.max_seconds=null", "train.eval_every=0"]
    words += [f"train.population.every={max(iterations // 15, 1)}", f"output_dir='{folder}'"]
    words += ["train.rates.b2=0.03", "train.rates.w2=0.03", "train.rates.log_scales=0.04"]
    return run(compose(words))


def export_table(runs: Sequence[tuple[str, Path]]) -> Table:
    table = Table("model", *(f"size={size}" for size in SIZES))
    for name, folder in runs:
        with tempfile.TemporaryDirectory() as target:
            reports = [
                export_run(folder, "gaussian-ply", Path(target) / f"{size}.ply", [f"size={size}"]) for size in SIZES
            ]
        table.row(name, *(f"{report.errors['psnr']:.1f} dB" for report in reports))
    return table


def main() -> None:
    parser = make_parser(__doc__, "--docs")
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--edges", nargs="*", type=int, choices=EDGES, default=EDGES)
    parser.add_argument("--neurons", nargs="*", type=int, default=[8, 0])
    parser.add_argument("--iterations", type=int, default=600)
    args = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        runs = [(str(path), path) for path in args.runs] or [
            (f"`solids`, K = {K}, edge {edge}", train(Path(folder) / f"{K}_{edge}", K, edge, args.iterations))
            for K in args.neurons
            for edge in args.edges
        ]
        table = export_table(runs)
    if args.docs:
        between_markers(DOCS / "export.md", "gaussians-export", str(table))


if __name__ == "__main__":
    main()
