"""How well Gaussians reproduce trained primitives, for each edge and each rule of the ``gaussian-ply`` export, and
after the rounding of ``gaussian-spz``.

    python benchmarks/gaussians.py [RUN_DIR ...] [--edges 0 1 2] [--neurons 8 0] [--iterations 600] [--record]
    python benchmarks/gaussians.py --print [--docs]

Without run directories it trains the static task's `solids`. PSNR in dB over all pixels of the test views, on the
scene's background. --record writes the table to benchmarks/results/gaussians.json and docs/results/static.md; --print
makes it from the record.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch
from shared.arguments import make_parser
from shared.tables import RESULTS, Record, Table, publish

from neuprim.config import compose
from neuprim.core.model.edge import EDGES
from neuprim.export.gaussian_ply import SIZES
from neuprim.runs.export import export_run
from neuprim.runs.run import run

RECORD = RESULTS / "gaussians.json"


def train(folder: Path, neurons: int, edge: int, iterations: int) -> Path:
    words = ["task=static", "scene=solids", "scene.size=128", "model.primitives=500", f"model.neurons={neurons}"]
    words += [f"model.density.edge={edge}", f"model.density.gain={'true' if edge else 'false'}"]
    words += [f"train.iterations={iterations}", "train.max_seconds=null", "train.eval_every=0"]
    words += [f"train.population.every={max(iterations // 15, 1)}", f"output_dir='{folder}'"]
    words += ["train.rates.b2=0.03", "train.rates.w2=0.03", "train.rates.log_scales=0.04"]
    return run(compose(words))


def measure(runs: Sequence[tuple[str, Path]]) -> Record:
    """PSNR of every run and rule, dB, and that of the best rule as SPZ; bytes of both files."""
    rows = []
    for name, folder in runs:
        with tempfile.TemporaryDirectory() as target:
            reports = {
                size: export_run(folder, "gaussian-ply", Path(target) / f"{size}.ply", [f"size={size}"])
                for size in SIZES
            }
            spz = export_run(folder, "gaussian-spz", Path(target) / "auto.spz")
            sizes = {"ply_bytes": reports[SIZES[0]].files[0].stat().st_size, "spz_bytes": spz.files[0].stat().st_size}
        errors = {size: report.errors["psnr"] for size, report in reports.items()}
        rows.append({"model": name, **errors, "spz": spz.errors["psnr"], **sizes})
    return {"rows": rows}


def document(record: Record) -> str:
    """The text between the markers."""
    table = Table("model", *(f"size={size}" for size in SIZES), "best, as SPZ", "bytes, PLY", "SPZ")
    for row in record["rows"]:
        sizes = (f"{row[f'{kind}_bytes']:,}" for kind in ("ply", "spz"))
        table.row(row["model"], *(f"{row[size]:.2f} dB" for size in (*SIZES, "spz")), *sizes)
    return str(table)


def main() -> None:
    parser = make_parser(__doc__, "--record", "--docs", "--print")
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--edges", nargs="*", type=int, choices=EDGES, default=EDGES)
    parser.add_argument("--neurons", nargs="*", type=int, default=[8, 0])
    parser.add_argument("--iterations", type=int, default=600)
    args = parser.parse_args()
    torch.set_num_threads(1)

    def train_and_measure() -> Record:
        with tempfile.TemporaryDirectory() as folder:
            runs = [(str(path), path) for path in args.runs] or [
                (f"`solids`, K = {K}, edge {edge}", train(Path(folder) / f"{K}_{edge}", K, edge, args.iterations))
                for K in args.neurons
                for edge in args.edges
            ]
            return measure(runs)

    publish(args, RECORD, "static.md", "gaussians-export", train_and_measure, document)


if __name__ == "__main__":
    main()
