"""What few bits cost: bytes and held-out views of finished runs at every level of ``neuprim compress``.

    python benchmarks/compress.py RUN_DIR ... [--levels 1 2 3 4 5] [--bits NAME=BITS ...] [--each] [--record]

Each run's model is compressed, read again and measured on the run's own held-out views, as `neuprim compress` does it. A row is a run at a
level: bytes of its numbers in float32 and of the file, their ratio, PSNR and SSIM before and after. ``--each`` adds a row per parameter:
what the level's bits cost if this parameter alone has them and the others 16. ``--record`` writes all of it to
benchmarks/results/compress.json, run by run; runs that differ in their seed alone are one row of the table, mean and half the spread.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from shared.machine import cpu_name
from shared.tables import Table, spread

from neuprim.config import RunConfig
from neuprim.core.compressed import LEVELS, bit_table
from neuprim.runs.compress import Compression, compress_run
from neuprim.runs.open import load_run

RESULTS = Path(__file__).parent / "results" / "compress.json"


def measured(folder: Path, level: int, words: Sequence[str], alone: str | None = None) -> dict[str, Any]:
    """One run at one level."""
    with tempfile.TemporaryDirectory() as scratch:
        made = compress_run(folder, level, words, Path(scratch) / "model.neuprim")
    if not made.measured:
        raise SystemExit(f"{folder}: {made.notes[-1]}")
    config = RunConfig.from_yaml(folder / "config.yaml")
    return {
        **named(config),
        "seed": config.seed,
        "level": level,
        "bits": list(words),
        "alone": alone,
        "float32_bytes": made.before,
        "bytes": made.after,
        "seconds": made.seconds,
        "psnr": list(made.measured["psnr"]),
        "ssim": list(made.measured["ssim"]),
        "parameters": parameters(made),
    }


def named(config: RunConfig) -> dict[str, Any]:
    """What a run fitted, but for its seed."""
    return {
        "scene": config.scene_name,
        "preset": config.preset,
        "primitives": config.model.primitives,
        "iterations": config.train.iterations,
    }


def parameters(made: Compression) -> dict[str, dict[str, Any]]:
    """Bits and bytes by parameter."""
    return {p.name: {"bits": p.bits, "float32_bytes": p.before, "bytes": p.after} for p in made.parameters}


def alone(folder: Path, level: int) -> list[tuple[str, list[str]]]:
    """Parameter -> words that give it this level's bits and all others 16."""
    specs = load_run(folder)[2].specs
    table, found = bit_table(level, [], specs), []
    for spec in specs:
        if spec.size:
            own = ",".join(map(str, table.named.get(spec.name, (table.others,))))
            rest = [f"{other.name}=16" for other in specs if other.name != spec.name]
            found.append((spec.name, [f"{spec.name}={own}", *rest]))
    return found


def key(row: dict[str, Any]) -> tuple[Any, ...]:
    return (*(row[k] for k in ("scene", "preset", "primitives", "iterations", "level", "alone")), tuple(row["bits"]))


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A row per scene, size and level."""
    made = Table("run", "level", "kB, float32 / file", "times", "PSNR", "after", "SSIM after", "seconds")
    for one in dict.fromkeys(map(key, rows)):
        own = [r for r in rows if key(r) == one]
        first = own[0]
        made.row(
            f"{first['scene']}, {first['primitives']:,} primitives",
            f"{first['level']}" + (f", {first['alone']} alone" if first["alone"] else "".join(f" {w}" for w in first["bits"])),
            " / ".join(f"{sum(r[k] for r in own) / len(own) / 1000:,.0f}" for k in ("float32_bytes", "bytes")),
            spread([r["float32_bytes"] / r["bytes"] for r in own], 2),
            f"{spread([r['psnr'][0] for r in own], 2)} dB",
            f"{spread([r['psnr'][1] - r['psnr'][0] for r in own], 3)} dB",
            spread([r["ssim"][1] - r["ssim"][0] for r in own], 4),
            spread([r["seconds"] for r in own], 2),
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
        for level in args.levels:
            rows.append(measured(folder, level, args.bits))
            if args.each:
                rows += [measured(folder, level, words, name) for name, words in alone(folder, level)]
            if args.record:
                recorded: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {"rows": []}
                new = {(key(r), r["seed"]) for r in rows}
                kept = [r for r in recorded["rows"] if ((*key(r)[:-1], tuple(r["bits"])), r["seed"]) not in new]
                RESULTS.write_text(json.dumps({"cpu": cpu_name(), "rows": kept + rows}, indent=1) + "\n")
    table(rows)


if __name__ == "__main__":
    main()
