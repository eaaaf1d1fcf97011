"""``neuprim compress``, and what it prints when it is done."""

from __future__ import annotations

import argparse
from pathlib import Path

from neuprim.cli.console import plain_console
from neuprim.cli.progress import LineProgress
from neuprim.search.compress import Compression, compress_run

__all__ = ["compress", "print_compression"]


def compress(args: argparse.Namespace, run_dir: Path) -> int:
    """Writes the file and prints what became of the model."""
    progress = LineProgress(plain_console(stderr=True))
    print_compression(
        compress_run(
            run_dir, args.level, args.bits, args.out, args.force, progress, args.seconds, args.steps, args.tolerance
        )
    )
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
