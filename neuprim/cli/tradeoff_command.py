"""``neuprim tradeoff``: measure what speed and size cost in accuracy, of a finished run or of trained models."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from neuprim.cli.command import (
    RENDER_OVERRIDES_HELP,
    Command,
    add_trust_flag,
    check_run_directory,
    parse_count,
    plain_console,
    take_render_overrides,
)
from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from neuprim.search.points import Point, Record

_USAGE = """\
neuprim tradeoff RUN_DIR | KEY=VALUE ... [KEY=VALUE ...] [--views N] [--repeats N] [--knobs NAME ...] [--budget TIME]
                       [--seeds N] [--lpips FILE]"""
_FORMS = """\
neuprim tradeoff RUN_DIR measures the settings of rendering on a finished run.
neuprim tradeoff task=NAME scene=NAME budget=20m [KEY=VALUE ...] [output_dir=DIR]
  trains a designed set of models around the one of these overrides of `neuprim run`, and measures them together.

After RUN_DIR, """

_FILES = ("tradeoff.json", "tradeoff.csv", "tradeoff.html", "front.png")


def is_override(first: str) -> bool:
    """Return whether the first argument is an override of ``neuprim run`` and not a run directory."""
    return "=" in first and not Path(first).exists()


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.usage = _USAGE
    add_trust_flag(parser)
    parser.add_argument("run_dir", metavar="RUN_DIR|KEY=VALUE", help="a finished run, or overrides of `neuprim run`")
    views = "test views, evenly spread (default: 5)"
    parser.add_argument("--views", type=parse_count, default=5, metavar="N", help=views)
    parser.add_argument("--repeats", type=parse_count, default=15, metavar="N", help="rounds of timing (default: 15)")
    knobs = "some of them, e.g. alpha_min sort (default: all)"
    parser.add_argument("--knobs", nargs="+", default=[], metavar="NAME", help=knobs)
    budget = "about how long, e.g. 90s or 10m; what does not fit is left out (default: 5m, 20m of trainings)"
    parser.add_argument("--budget", metavar="TIME", help=budget)
    parser.add_argument("--seeds", type=parse_count, metavar="N", help="trainings of every model (default: 1)")
    lpips = "measure LPIPS with these weights of your own, a file or a folder"
    parser.add_argument("--lpips", type=Path, metavar="FILE", help=lpips)


def _take_rest(arguments: argparse.Namespace, rest: list[str], parser: argparse.ArgumentParser) -> list[str]:
    if is_override(arguments.run_dir):
        arguments.words = [word for word in rest if not word.startswith("-")]
        return [word for word in rest if word.startswith("-") and word != "--"]
    return take_render_overrides(arguments, rest, parser)


def _tradeoff(args: argparse.Namespace) -> int:
    args.words += [word for word in args.knobs if "=" in word]  # overrides after --knobs look like names
    args.knobs = [word for word in args.knobs if "=" not in word]
    return _compare_models(args) if is_override(args.run_dir) else _compare_rendering(args)


def _compare_rendering(args: argparse.Namespace) -> int:
    from neuprim.cli.progress import DrawProgress
    from neuprim.config.command_settings import parse_duration
    from neuprim.search.points import TRADEOFF_FOLDER
    from neuprim.search.render_tradeoff import TradeoffRequest, format_render_command, measure_tradeoff

    run_dir, views, repeats = Path(args.run_dir), args.views, args.repeats
    check_run_directory(run_dir)
    if args.seeds is not None:
        raise ConfigError("--seeds: of models that are trained (neuprim tradeoff task=NAME ...); a run has one")
    budget = parse_duration(args.budget or "5m", f"--budget {args.budget}")
    request = TradeoffRequest(run_dir, views, repeats, args.knobs, budget, args.words, args.lpips)
    folder = run_dir / TRADEOFF_FOLDER
    try:
        with DrawProgress() as progress:
            record = measure_tradeoff(request, progress.note, progress.show)
    except KeyboardInterrupt:
        if not (folder / "tradeoff.json").exists():
            raise
        kept = f"; {folder / 'tradeoff.json'} has the points up to here; the same command goes on"
        raise KeyboardInterrupt(kept) from None
    commands = [format_render_command(str(run_dir), point.words) for point in record.points]
    _print_fronts(folder, record, commands)
    return 0


def _compare_models(args: argparse.Namespace) -> int:
    from neuprim.cli.progress import DrawProgress
    from neuprim.config.command_settings import parse_duration, take_launcher
    from neuprim.config.overrides import parse
    from neuprim.search.ablation import AblationRequest, format_run_command, run_ablation

    launcher, words = take_launcher([args.run_dir, *args.words])
    said = [str(a.value) for a in parse(words) if a.key == "budget"]
    if said and args.budget is not None:
        raise ConfigError(f"budget={said[-1]} and --budget {args.budget}: expected one of them")
    asked = f"budget={said[-1]}" if said else f"--budget {args.budget}"
    budget = parse_duration(said[-1] if said else args.budget or "20m", asked)
    seeds = args.seeds or 1
    request = AblationRequest(words, budget, args.views, args.repeats, args.knobs, seeds, args.lpips, launcher)
    try:
        with DrawProgress() as progress:
            folder, record = run_ablation(request, progress.note, progress.show)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("; what is trained is kept, and the same command goes on") from None
    _print_fronts(folder, record, [format_run_command(point.words) for point in record.points])
    return 0


def _print_fronts(folder: Path, record: Record, commands: Sequence[str]) -> None:
    console = plain_console()
    if "length" in record.facts:
        console.print(record.facts["length"])
    for title, numbers in (("front of speed", record.speed), ("front of size", record.size)):
        console.print(_build_table(title, record, numbers))
        for place, number in enumerate(numbers, 1):
            console.print(f"{commands[number]}  # {place}")
        console.print()
    if record.points[0].run_dir:
        for one in record.left_out:
            console.print(f"left out: {' '.join(one.words) or one.knob}: {one.reason}")
    for name in _FILES:
        console.print(folder / name)


def _build_table(title: str, record: Record, numbers: Sequence[int]) -> Table:
    """Build the table of the reference and a front; the numbers are those of the commands."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    trained = bool(record.points[0].run_dir)
    table = Table(title=title, title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0))
    names = ["#", "time", "ms", "frames/s", "PSNR", "SSIM", "exact", "bytes", *(["ms/step"] if trained else [])]
    for name in names:
        table.add_column(name, justify="right", no_wrap=True)
    first = "centre" if trained else "ref."
    for place, number in ((first, 0), *((str(k), number) for k, number in enumerate(numbers, 1))):
        table.add_row(*(Text(cell) for cell in (place, *_format_cells(record.points[number]))))
    return table


def _format_cells(point: Point) -> tuple[str, ...]:
    q = point.quality
    about = "" if point.spread is None else f" ± {point.spread:.3f}"
    seeds = "" if point.seed_spread is None else f" ± {point.seed_spread:.2f}"
    times = ("–", "–", "–")
    if point.ms:
        times = (f"{point.ratio:.3f}{about}", f"{point.time:.2f}", f"{1e3 / point.time:.1f}")
    quality = (f"{q['psnr']:.2f}{seeds}", f"{q['ssim']:.4f}", f"{q['psnr_exact']:.1f}")
    return (*times, *quality, f"{point.bytes:,}", *([f"{point.ms_per_step:.1f}"] if point.run_dir else []))


COMMAND = Command(
    "tradeoff",
    "measure what speed and size cost in accuracy: how a run is drawn, or what is trained",
    _tradeoff,
    _add_arguments,
    _FORMS + RENDER_OVERRIDES_HELP,
    _take_rest,
)
