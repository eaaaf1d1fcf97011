"""``neuprim tradeoff``: what speed and size cost in accuracy, of a finished run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from neuprim.cli.command import Command, add_trust_flag, check_run_directory, parse_count
from neuprim.cli.render_overrides import RENDER_OVERRIDES_HELP, split_render_overrides
from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from neuprim.search.tradeoff.record import Measured, Record

__all__ = ["COMMAND", "of_words"]

_USAGE = """\
neuprim tradeoff RUN_DIR | KEY=VALUE ... [KEY=VALUE ...] [--views N] [--repeats N] [--knobs NAME ...] [--budget TIME]
                       [--seeds N] [--lpips FILE]"""
_FORMS = """\
neuprim tradeoff RUN_DIR measures the knobs of drawing on a finished run.
neuprim tradeoff task=NAME scene=NAME budget=20m [KEY=VALUE ...] [output_dir=DIR]
  trains a designed set of models around the one that these words of `neuprim run` name, and measures them side by side.

After RUN_DIR, """


def of_words(first: str) -> bool:
    """Whether the first argument is a word of ``neuprim run`` and not a run's directory."""
    return "=" in first and not Path(first).exists()


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.usage = _USAGE
    add_trust_flag(parser)
    parser.add_argument("run_dir", metavar="RUN_DIR|KEY=VALUE", help="a finished run, or words of `neuprim run`")
    parser.add_argument(
        "--views", type=parse_count, default=5, metavar="N", help="held-out views, evenly spread (default: 5)"
    )
    parser.add_argument("--repeats", type=parse_count, default=15, metavar="N", help="rounds of timing (default: 15)")
    parser.add_argument(
        "--knobs", nargs="+", default=[], metavar="NAME", help="some of them, e.g. alpha_min sort (default: all)"
    )
    parser.add_argument(
        "--budget",
        metavar="TIME",
        help="about how long, e.g. 90s or 10m; what does not fit is left out (default: 5m, 20m of trainings)",
    )
    parser.add_argument("--seeds", type=parse_count, metavar="N", help="trainings of every model (default: 1)")
    parser.add_argument(
        "--lpips", type=Path, metavar="FILE", help="measure LPIPS with these weights of your own, a file or a folder"
    )


def _take_rest(arguments: argparse.Namespace, rest: list[str], parser: argparse.ArgumentParser) -> list[str]:
    if of_words(arguments.run_dir):
        arguments.words = [word for word in rest if not word.startswith("-")]
        return [word for word in rest if word.startswith("-") and word != "--"]
    arguments.words, rest = split_render_overrides(rest)
    return rest


def _tradeoff(args: argparse.Namespace) -> int:
    if of_words(args.run_dir):
        from neuprim.cli.tradeoff_models import tradeoff_models

        return tradeoff_models(args)
    args.run_dir = Path(args.run_dir)
    check_run_directory(args.run_dir)
    return _tradeoff_of_run(args)


def _tradeoff_of_run(args: argparse.Namespace) -> int:
    """Measure, write RUN_DIR/tradeoff and print the fronts."""
    from neuprim.cli.console import plain_console
    from neuprim.cli.progress import DrawProgress
    from neuprim.search.tradeoff.record import command
    from neuprim.search.tradeoff.run import FOLDER, Request, seconds_of, tradeoff_run

    words = [*args.words, *(word for word in args.knobs if "=" in word)]  # after --knobs they look like names
    knobs = [word for word in args.knobs if "=" not in word]
    if args.seeds is not None:
        raise ConfigError(
            "--seeds: of models that are trained (neuprim tradeoff task=NAME ...); a finished run has one"
        )
    request = Request(args.run_dir, args.views, args.repeats, knobs, seconds_of(args.budget or "5m"), words, args.lpips)
    folder = args.run_dir / FOLDER
    try:
        with DrawProgress(plain_console(stderr=True)) as progress:
            record = tradeoff_run(request, progress.note, progress.show)
    except KeyboardInterrupt:
        if not (folder / "tradeoff.json").exists():
            raise
        raise KeyboardInterrupt(
            f"; {folder / 'tradeoff.json'} has the points up to here; the same command goes on"
        ) from None
    console = plain_console()
    for title, numbers in (("front of speed", record.speed), ("front of size", record.size)):
        console.print(_table(title, record, numbers))
        for place, number in enumerate(numbers, 1):
            console.print(f"{command(str(args.run_dir), record.points[number].words)}  # {place}")
        console.print()
    for name in ("tradeoff.json", "tradeoff.csv", "tradeoff.html", "front.png"):
        console.print(folder / name)
    return 0


def _table(title: str, record: Record, numbers: Sequence[int]) -> Table:
    """The reference, and the points of a front under the numbers that their commands have."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0))
    for name in ("#", "time", "ms", "frames/s", "PSNR", "SSIM", "exact", "bytes", "MB"):
        table.add_column(name, justify="right", no_wrap=True)
    for place, number in (("ref.", 0), *((str(k), number) for k, number in enumerate(numbers, 1))):
        table.add_row(*(Text(cell) for cell in (place, *_cells(record.points[number]))))
    return table


def _cells(point: Measured) -> tuple[str, ...]:
    q = point.quality
    about = "" if point.spread is None else f" ± {point.spread:.3f}"
    return (
        *(
            (f"{point.ratio:.3f}{about}", f"{point.time:.2f}", f"{1e3 / point.time:.1f}")
            if point.ms
            else ("–", "–", "–")
        ),
        *(f"{q['psnr']:.2f}", f"{q['ssim']:.4f}", f"{q['psnr_exact']:.1f}", f"{point.bytes:,}"),
        "–" if point.peak_bytes is None else f"{point.peak_bytes / 1e6:.1f}",
    )


COMMAND = Command(
    "tradeoff",
    "measure what speed and size cost in accuracy: how a run is drawn, or what is trained",
    _add_arguments,
    _tradeoff,
    epilog=_FORMS + RENDER_OVERRIDES_HELP,
    take_rest=_take_rest,
)
