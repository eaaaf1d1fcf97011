"""``neuprim prune``: remove what a run's scene does not require."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from neuprim.cli.command import Command, parse_decibels, parse_seconds, parse_whole, print_columns

if TYPE_CHECKING:
    from neuprim.search.pruning import Pruning


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    tolerance = "how much worse it may get (default: 0.1dB)"
    parser.add_argument("--tolerance", type=parse_decibels, default=0.1, metavar="DB", help=tolerance)
    seconds = "of fine-tuning; 0 for none (default: 60)"
    parser.add_argument("--seconds", type=parse_seconds, default=60.0, metavar="S", help=seconds)
    steps = "of fine-tuning instead, for the same model on every machine"
    parser.add_argument("--steps", type=parse_whole, metavar="N", help=steps)
    parser.add_argument("--out", type=Path, metavar="DIR", help="the new run's directory (default: RUN_DIR-pruned)")
    parser.add_argument("--force", action="store_true", help="replace files that exist")


def _prune(args: argparse.Namespace) -> int:
    from neuprim.cli.progress import DrawProgress
    from neuprim.search.pruning import PruneRequest, prune_run

    request = PruneRequest(args.run_dir, args.tolerance, args.seconds, args.steps, args.out, args.force)
    with DrawProgress() as progress:
        made = prune_run(request, progress.show)
    _report(made, args.tolerance)
    return 0


_ROWS = (
    ("primitives", "primitives", "{:,.0f}"),
    ("numbers", "numbers", "{:,.0f}"),
    ("bytes", "bytes", "{:,.0f}"),
    ("psnr", "PSNR, held-out views", "{:.3f} dB"),
    ("ssim", "SSIM, held-out views", "{:.4f}"),
    ("frames_per_second", "frames/s", "{:.1f}"),
)


def _report(made: Pruning, tolerance: float) -> None:
    from neuprim.runs.open import describe_kept_shares

    for number, stage in enumerate(made.stages, 1):
        less = f", {', '.join(stage.words)}" if stage.words else ""
        what = f"cut {number}: {stage.primitives:,} primitives, {stage.numbers:,} numbers{less}"
        loss = f"{stage.cut - made.judged[0]:+.3f} dB at once, {stage.trained - made.judged[0]:+.3f} dB after training"
        print(f"{what}; training views {loss}; {'kept' if stage.kept else 'taken back'}")
    if made.run_dir is None:
        print(f"nothing can go within {tolerance:g} dB; nothing was written")
        return
    print(made.run_dir)
    rows = [(name, form.format(made.before[key]), form.format(made.after[key])) for key, name, form in _ROWS]
    print_columns([("", "before", "after"), *rows])
    for word in made.words:
        print(f"all primitives: {word}")
    for line in describe_kept_shares(made.kept):
        print(line)
    print(f"fine-tuned for {made.steps:,} steps, {made.seconds:.0f} s in all")


COMMAND = Command(
    "prune",
    "remove what a run's scene does not require, and write the rest as a run",
    _prune,
    _add_arguments,
    opens_run=True,
)
