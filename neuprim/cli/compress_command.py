"""``neuprim compress``: write a run's model as a quantised file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from neuprim.cli.command import Command, parse_count, parse_decibels, parse_seconds, parse_whole, print_columns

if TYPE_CHECKING:
    from neuprim.search.compress import Compression


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    tolerance = "how much worse it may get (default: 0.1dB)"
    parser.add_argument("--tolerance", type=parse_decibels, metavar="DB", help=tolerance)
    level = "so many bits instead, whatever that costs: 1 keeps nearly everything, 5 very little"
    parser.add_argument("--level", type=parse_count, metavar="1-5", help=level)
    bits = "bits of a parameter, or of all others, over a level's (3 unless given): means=16 sh_rest=6,5 others=8"
    parser.add_argument("--bits", nargs="+", default=[], metavar="NAME=BITS", help=bits)
    seconds = "of training for few bits; 0 for none (default: 30)"
    parser.add_argument("--seconds", type=parse_seconds, default=30.0, metavar="S", help=seconds)
    steps = "of training instead, for the same file on every machine"
    parser.add_argument("--steps", type=parse_whole, metavar="N", help=steps)
    out = "where to write (default: RUN_DIR/model.neuprim)"
    parser.add_argument("--out", "--output", type=Path, metavar="FILE", help=out)
    parser.add_argument("--force", action="store_true", help="replace a file that exists")


def _compress(args: argparse.Namespace) -> int:
    from neuprim.cli.progress import LineProgress
    from neuprim.search.compress import CompressRequest, compress_run

    request = CompressRequest(
        args.run_dir, args.level, args.bits, args.out, args.force, args.seconds, args.steps, args.tolerance
    )
    _print_compression(compress_run(request, LineProgress()))
    return 0


def _print_compression(made: Compression) -> None:
    """Print file, bytes of every parameter, and what was lost."""
    print(made.file)
    sizes = [(p.name, p.bits, p.before, p.after) for p in made.parameters]
    sizes.append(("all, and the header", "", made.before, made.after))
    rows = [("", "bits", "bytes before", "after", "times")]
    for name, bits, before, after in sizes:
        rows.append((name, bits, f"{before:,}", f"{after:,}", f"{before / after:.2f}" if before and after else "-"))
    print_columns(rows)
    for name, (loss_before, loss_after) in made.measured.items():
        unit, digits = (" dB", 3) if name == "psnr" else ("", 4)
        change = f"{loss_before:.{digits}f} -> {loss_after:.{digits}f}{unit} ({loss_after - loss_before:+.{digits}f})"
        print(f"{name:5} {change}, mean of the held-out views")
    for note in made.notes:
        print(f"note: {note}")
    trained = f", with {made.steps:,} steps of training" if made.steps else ""
    print(f"compressed in {made.seconds:.2f} s{trained}")


COMMAND = Command(
    "compress",
    "write a run's model in few bits, as one file that every command reads",
    _compress,
    _add_arguments,
    opens_run=True,
)
