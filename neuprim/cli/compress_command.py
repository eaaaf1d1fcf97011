"""``neuprim compress``: write a run's model as a quantised file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from neuprim.cli.command import Command, parse_count, parse_decibels, parse_seconds, parse_whole

if TYPE_CHECKING:
    from neuprim.search.compress import Compression

__all__ = ["COMMAND", "print_compression"]


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
    from neuprim.cli.console import plain_console
    from neuprim.cli.progress import LineProgress
    from neuprim.search.compress import CompressRequest, compress_run

    progress = LineProgress(plain_console(stderr=True))
    request = CompressRequest(
        args.run_dir, args.level, args.bits, args.out, args.force, args.seconds, args.steps, args.tolerance
    )
    made = compress_run(request, progress)
    print_compression(made)
    return 0


def print_compression(made: Compression) -> None:
    """File, bytes of every parameter, and what was lost, on standard output."""
    print(made.file)
    cells = [("", "bits", "bytes before", "after", "times")]
    cells += [(p.name, p.bits, f"{p.before:,}", f"{p.after:,}", _times(p.before, p.after)) for p in made.parameters]
    cells += [("all, and the header", "", f"{made.before:,}", f"{made.after:,}", _times(made.before, made.after))]
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]))]
    for name, *numbers in cells:
        print(
            "  ".join(
                [f"{name:{widths[0]}}", *(f"{n:>{w}}" for n, w in zip(numbers, widths[1:], strict=True))]
            ).rstrip()
        )
    for name, (before, after) in made.measured.items():
        unit, digits = (" dB", 3) if name == "psnr" else ("", 4)
        print(
            f"{name:5} {before:.{digits}f} -> {after:.{digits}f}{unit} ({after - before:+.{digits}f}), mean of the held-out views"
        )
    for note in made.notes:
        print(f"note: {note}")
    trained = f", with {made.steps:,} steps of training" if made.steps else ""
    print(f"compressed in {made.seconds:.2f} s{trained}")


def _times(before: int, after: int) -> str:
    return f"{before / after:.2f}" if before and after else "-"


COMMAND = Command(
    "compress",
    "write a run's model in few bits, as one file that every command reads",
    _add_arguments,
    _compress,
    opens_run=True,
)
