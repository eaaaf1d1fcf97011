"""What few bits cost: bytes and held-out views of finished runs at every level of ``neuprim compress``.

    python benchmarks/compress.py RUN_DIR ... [--levels 1 2 3 4 5] [--bits NAME=BITS ...] [--each] [--record]

Each run's model is compressed, read again and measured on all of the run's own held-out views, as `neuprim compress`
does it. A row is a run at a level: bytes of its numbers in float32 and of the file, their ratio, PSNR and SSIM before
and after. ``--each`` adds a row per parameter: what the level's bits cost if this parameter alone has them and the
others 16. ``--record`` writes all of it to benchmarks/results/compress.json, run by run; runs that differ in their seed
alone are one row of the table, mean and half the spread.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from shared.tables import Table, spread

from neuprim.config import RunConfig
from neuprim.core.checkpoint import load_model, save_compressed
from neuprim.core.compression import LEVELS, bit_table
from neuprim.core.compute.machine import cpu_name
from neuprim.core.model.primitives import Primitives
from neuprim.runs.measure import quality
from neuprim.runs.open import load_dataset, load_run

RESULTS = Path(__file__).parent / "results" / "compress.json"


class Run:
    """A finished run with its data, measured once as it is."""

    def __init__(self, folder: Path) -> None:
        self.config, self.task, self.model, _ = load_run(folder)
        self.dataset = load_dataset(self.config, self.task, run_dir=folder)
        self.text = (folder / "config.yaml").read_text(encoding="utf-8")
        self.before = self.measured(self.model)

    def measured(self, model: Primitives) -> dict[str, float]:
        """PSNR and SSIM, means over the held-out views."""
        return dict(zip(("psnr", "ssim"), quality(model, self.task, self.dataset, self.config.renderer), strict=True))

    def compressed(self, level: int, words: Sequence[str], alone: str | None = None) -> dict[str, Any]:
        """What becomes of it at a level, under words NAME=BITS."""
        with tempfile.TemporaryDirectory() as scratch:
            path = Path(scratch) / "model.neuprim"
            begin = time.process_time()
            stored = save_compressed(
                path, self.model, self.task.name, {}, bit_table(level, words, self.model.specs), self.text
            )
            seconds = time.process_time() - begin
            again, size = load_model(path, self.task)[0], path.stat().st_size
        after, numbers = self.measured(again), 4 * self.model.count
        return {
            **named(self.config),
            "seed": self.config.seed,
            "level": level,
            "bits": list(words),
            "alone": alone,
            "float32_bytes": numbers * self.model.parameters_per_primitive,
            "bytes": size,
            "cpu_seconds": seconds,
            **{name: [self.before[name], after[name]] for name in after},
            "parameters": {
                s.name: {"bits": stored[s.name].bits, "float32_bytes": numbers * s.size, "bytes": stored[s.name].size}
                for s in self.model.specs
            },
        }

    def alone(self, level: int) -> list[tuple[str, list[str]]]:
        """Parameter -> words that give it this level's bits and all others 16."""
        table, found = LEVELS[level], []
        for spec in self.model.specs:
            if spec.size:
                own = ",".join(map(str, table.named.get(spec.name, (table.others,))))
                found.append(
                    (
                        spec.name,
                        [f"{spec.name}={own}", *(f"{s.name}=16" for s in self.model.specs if s.name != spec.name)],
                    )
                )
        return found


def named(config: RunConfig) -> dict[str, Any]:
    """What a run fitted, but for its seed."""
    return {
        "scene": config.scene_name,
        "preset": config.preset,
        "primitives": config.model.primitives,
        "iterations": config.train.iterations,
    }


def key(row: dict[str, Any]) -> tuple[Any, ...]:
    return (*(row[k] for k in ("scene", "preset", "primitives", "iterations", "level", "alone")), tuple(row["bits"]))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A row per scene, size and level."""
    made = Table("run", "level", "kB, float32 / file", "times", "PSNR", "after", "SSIM after", "seconds of a core")
    for one in dict.fromkeys(map(key, rows)):
        own = [r for r in rows if key(r) == one]
        first = own[0]
        made.row(
            f"{first['scene']}, {first['primitives']:,} primitives",
            f"{first['level']}"
            + (f", {first['alone']} alone" if first["alone"] else "".join(f" {w}" for w in first["bits"])),
            " / ".join(f"{sum(r[k] for r in own) / len(own) / 1000:,.0f}" for k in ("float32_bytes", "bytes")),
            spread([r["float32_bytes"] / r["bytes"] for r in own], 2),
            f"{spread([r['psnr'][0] for r in own], 2)} dB",
            f"{spread([r['psnr'][1] - r['psnr'][0] for r in own], 3)} dB",
            spread([r["ssim"][1] - r["ssim"][0] for r in own], 4),
            spread([r["cpu_seconds"] for r in own], 2),
        )
    return str(made)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN_DIR")
    parser.add_argument("--levels", type=int, nargs="*", default=list(LEVELS), choices=list(LEVELS))
    parser.add_argument("--bits", nargs="*", default=[], metavar="NAME=BITS")
    parser.add_argument("--each", action="store_true")
    parser.add_argument("--record", action="store_true")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for folder in args.runs:
        run = Run(folder)
        for level in args.levels:
            rows.append(run.compressed(level, args.bits))
            if args.each:
                rows += [run.compressed(level, words, name) for name, words in run.alone(level)]
            if args.record:
                recorded: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {"rows": []}
                new = {(key(r), r["seed"]) for r in rows}
                kept = [r for r in recorded["rows"] if (key(r), r["seed"]) not in new]
                RESULTS.write_text(json.dumps({"cpu": cpu_name(), "rows": kept + rows}, indent=1) + "\n")
    table(rows)


if __name__ == "__main__":
    main()
