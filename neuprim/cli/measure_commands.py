"""``neuprim eval``, ``bench`` and ``tradeoff``: measure quality and speed of runs."""

from __future__ import annotations

import argparse
import math
import re
import statistics
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.cli.command import (
    RENDER_SETTINGS_HELP,
    Command,
    add_trust_flag,
    check_run_dir_argument,
    parse_count,
    plain_console,
    print_columns,
)
from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from neuprim.runs.paper import PlannedRun
    from neuprim.search.tradeoff_measuring import TradeoffRequest
    from neuprim.search.tradeoff_record import TradeoffPoint, TradeoffRecord


# ---------------------------------------------------------------- eval


def _add_eval_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--all", action="store_true", help="print every metric, not only the most important ones")
    text = "weights to measure LPIPS with, a file or a folder"
    parser.add_argument("--lpips", type=Path, metavar="FILE", help=text)


_MAIN_METRICS = ("psnr", "ssim", "lpips", "psnr_worst", "model_bytes", "render_fps")


def _eval_command(arguments: argparse.Namespace) -> int:
    from neuprim.core.metrics.image import format_failed_views
    from neuprim.runs.measure import evaluate_run

    metrics = evaluate_run(arguments.run_dir, arguments.lpips, arguments.overrides)
    chosen = {name: number for name in _MAIN_METRICS if (number := _find_metric(metrics, name)) is not None}
    rows = _list_printed_metrics(metrics if arguments.all else chosen)
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        print(f"{name:{width}}  {value}")
    if failed := format_failed_views(metrics):
        print(f"neuprim: warning: {failed}", file=sys.stderr)
    return 0


def _find_metric(metrics: Mapping[str, Any], name: str) -> float | None:
    """Return the metric ``name`` from the content of a run's ``metrics.json``; None if it was not measured.

    JSON has no infinity: an infinite metric is stored as null, with a second entry ``NAME_infinite``.
    """
    value: float | None = math.inf if metrics.get(f"{name}_infinite") else metrics.get(name)
    return value


def _list_printed_metrics(metrics: Mapping[str, Any], where: str = "") -> list[tuple[str, str]]:
    rows: list[tuple[str, str]] = []
    for key, value in metrics.items():
        name = f"{where}{key}"
        if isinstance(value, Mapping):
            rows += _list_printed_metrics(value, f"{name}.")
        elif isinstance(value, list) and value and all(isinstance(entry, Mapping) for entry in value):
            rows.append((name, f"{len(value)} entries, in the run's metrics.json"))
        else:
            rows.append((name, f"{value:.4f}" if isinstance(value, float) else str(value)))
    return rows


EVAL_COMMAND = Command(
    "eval",
    "measure a run on its test views",
    _eval_command,
    _add_eval_arguments,
    settings=RENDER_SETTINGS_HELP,
    opens_run=True,
)


# ---------------------------------------------------------------- bench paper


_PAPER_RULES = """\
PSNR of floats; SSIM and LPIPS by the rule of 3DGS's tools (ssim_3dgs, lpips_3dgs; metrics.lpips=FILE has your weights
of VGG)"""

_PAPER_MEASURES = ("PSNR", "SSIM", "LPIPS")


def _add_bench_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", choices=["paper"], help="print or run the paper's tables")
    numbers = "tables to use, e.g. 3-5 or 6,7 (default: 3-7)"
    parser.add_argument("--tables", default="3-7", metavar="N", help=numbers)
    data = "holds a folder per scene; without --data the tables are printed"
    parser.add_argument("--data", type=Path, metavar="DIR", help=data)
    scenes = "scenes to run, e.g. chair,lego (default: all)"
    parser.add_argument("--scenes", metavar="NAME", help=scenes)
    parser.add_argument("--rows", metavar="NAME", help="rows to run: 200, 5k, nolimit, real (default: all)")
    seeds = "runs of each row, with seeds from 0 (default: 1)"
    parser.add_argument("--seeds", type=parse_count, default=1, metavar="N", help=seeds)
    out = "where to write a directory for each run (default: outputs/paper)"
    parser.add_argument("--out", type=Path, default=Path("outputs/paper"), metavar="DIR", help=out)


def _bench_command(args: argparse.Namespace) -> int:
    """Run the command ``bench paper`` and return the exit status.

    Without ``--data``, print the tables of the paper. With ``--data``, train the runs of the tables, and print our
    values next to the paper's.
    """
    from neuprim.cli.progress import run_command_here
    from neuprim.config.command_settings import take_budget_override
    from neuprim.config.overrides import CommandLine
    from neuprim.runs.open import read_metrics
    from neuprim.runs.paper import load_paper_run_tables, plan_paper_runs

    wanted = parse_table_numbers(args.tables)
    chosen = [table for table in load_paper_run_tables() if wanted & set(table["tables"])]
    if args.data is None:
        print(*_list_paper_tables(chosen), sep="\n")
        return 0
    scenes = args.scenes.lower().split(",") if args.scenes else []
    rows = args.rows.split(",") if args.rows else []
    budget, settings = take_budget_override(args.overrides)
    planned = plan_paper_runs(args.data, chosen, scenes, rows, budget, args.seeds, args.out, settings)
    results = []
    for number, one in enumerate(planned, 1):
        print(f"[{number}/{len(planned)}] {one.config.output_dir}", flush=True)
        results.append((one, read_metrics(run_command_here(one.config, CommandLine(one.config.overrides)))))
        print(*_describe_bench_result(*results[-1]), sep="\n", flush=True)
    print(*_describe_paper_averages(results), _PAPER_RULES, sep="\n")
    return 0


def parse_table_numbers(text: str) -> set[int]:
    """Parse table numbers such as ``3-5,7``; raise ConfigError for tables other than 3 to 7."""
    found: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"([3-7])(?:-([3-7]))?", part.strip())
        numbers = range(int(match[1]), int(match[2] or match[1]) + 1) if match else ()
        if not numbers:
            raise ConfigError(f"--tables {text}: expected table numbers from 3 to 7, such as 3-5 or 6,7")
        found |= set(numbers)
    return found


def _list_paper_tables(chosen: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    from neuprim.runs.paper import find_paper_figure

    for table in chosen:
        numbers, plural = ", ".join(map(str, table["tables"])), "s" * (len(table["tables"]) > 1)
        yield f"table{plural} {numbers}: {table['title']} (task=static scene={table['loader']})"
        for row in table["rows"]:
            beside = f"; beside {row['beside']['name']}" if "beside" in row else ""
            yield f"  {row['name']}: preset={row['preset']}{beside}"
            for scene in table["scenes"]:
                found = {kind: find_paper_figure(table, row, scene, kind.lower()) for kind in _PAPER_MEASURES}
                line = "  ".join(f"{kind} {_format_measure(value, kind):>7}" for kind, value in found.items())
                count = find_paper_figure(table, row, scene, "primitives")
                yield f"    {scene:10} {line}{f'  {count:,} primitives' if count else ''}"
    yield "neuprim bench paper --data DIR runs those whose data are folders of DIR"


def _describe_bench_result(one: PlannedRun, metrics: Mapping[str, Any]) -> Iterator[str]:
    from neuprim.runs.paper import compare_run_with_paper

    steps, seconds = metrics["iterations"], _format_seconds(metrics["train_seconds"])
    yield (
        f"{one.scene}, {one.row['name']}: preset={one.row['preset']}, seed {one.config.seed}, "
        f"{metrics['checkpoint']} checkpoint after {steps:,} steps in {seconds}"
    )
    protocol = ("scene=", "scene.path=", "preset=", "seed=", "output_dir=", "task=")
    own = " ".join(text for text in one.config.overrides if not text.startswith(protocol))
    width, height = metrics["image_size"]
    yield f"  images of {width}x{height}, down-sampling {metrics['downsampling']}{f', {own}' if own else ''}"
    for kind, ours, theirs, other in compare_run_with_paper(one, metrics):
        named = "beside" in one.row and kind in _PAPER_MEASURES
        beside = f"   {one.row['beside']['name']} {_format_measure(other, kind)}" if named else ""
        yield f"  {kind:10} {_format_measure(ours, kind):>9}   paper {_format_measure(theirs, kind)}{beside}"


def _describe_paper_averages(results: Sequence[tuple[PlannedRun, Mapping[str, Any]]]) -> Iterator[str]:
    """Yield text lines that compare, for each row of the paper's tables, our mean of each metric with the paper's mean.

    A mean covers the runs (scenes and seeds) for which both our value and the paper's value exist.
    """
    from neuprim.runs.paper import compare_run_with_paper

    rows: dict[tuple[str, str], list[tuple[PlannedRun, Mapping[str, Any]]]] = {}
    for one, metrics in results:
        rows.setdefault((one.table["title"], one.row["name"]), []).append((one, metrics))
    for (title, name), own in rows.items():
        scenes, seeds = len({one.scene for one, _ in own}), len({one.config.seed for one, _ in own})
        count = f"{scenes} scenes, {seeds} seed{'s' * (seeds > 1)}"
        yield f"{title}, {name}: means over {count}; ours of the last checkpoint, the paper's of the best"
        pairs = [pair for one, metrics in own for pair in compare_run_with_paper(one, metrics)]
        for kind in _PAPER_MEASURES:
            both = [(a, b) for what, a, b, _ in pairs if what == kind and a is not None and b is not None]
            if both:
                ours, theirs = (statistics.mean(column) for column in zip(*both, strict=True))
                yield f"  {kind:10} {_format_measure(ours, kind):>9}   paper {_format_measure(theirs, kind)}"


def _format_measure(value: float | None, kind: str) -> str:
    if value is None:
        return "–"
    return f"{value:,.0f}" if kind == "primitives" else f"{value:.{2 if kind == 'PSNR' else 4}f}"


def _format_seconds(seconds: float) -> str:
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.0f} s"


BENCH_COMMAND = Command(
    "bench",
    "print the paper's tables, and run their protocol on your data",
    _bench_command,
    _add_bench_arguments,
    settings="""\
any setting of `neuprim run`, over the protocol's, e.g. scene.downsample=4
  budget=TIME                training time of each run, e.g. 10m (default: 100,000 steps)""",
)


# ---------------------------------------------------------------- tradeoff


_TRADEOFF_HELP = """\
neuprim tradeoff RUN_DIR measures the settings of rendering on a finished run.
neuprim tradeoff task=NAME scene=NAME [KEY=VALUE ...] trains a designed set of models around the one of these settings
of `neuprim run`, and measures them together."""

_TRADEOFF_FILES = ("tradeoff.json", "tradeoff.html", "front.png")


def _add_tradeoff_arguments(parser: argparse.ArgumentParser) -> None:
    add_trust_flag(parser)
    parser.add_argument("run_dir", nargs="?", type=Path, metavar="RUN_DIR", help="a finished run")
    views = "test views to measure, evenly spaced (default: 5)"
    parser.add_argument("--views", type=parse_count, default=5, metavar="N", help=views)
    parser.add_argument("--repeats", type=parse_count, default=15, metavar="N", help="rounds of timing (default: 15)")
    vary = "settings to vary, e.g. alpha_min,sort (default: all)"
    parser.add_argument("--vary", default="", metavar="NAME,...", help=vary)
    lpips = "weights to measure LPIPS with, a file or a folder"
    parser.add_argument("--lpips", type=Path, metavar="FILE", help=lpips)
    out = "where to write (default: RUN_DIR/tradeoff, outputs/tradeoff-TASK-SCENE)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=out)


def _tradeoff_command(args: argparse.Namespace) -> int:
    from neuprim.config.command_settings import parse_duration_setting, take_budget_override
    from neuprim.search.tradeoff_measuring import TradeoffRequest

    trained = args.run_dir is None
    if trained and not args.overrides:
        raise ConfigError("neuprim tradeoff: expected RUN_DIR, or task=NAME scene=NAME (see neuprim tradeoff --help)")
    if not trained:
        check_run_dir_argument(args.run_dir)
    budget, settings = take_budget_override(args.overrides)
    seconds = parse_duration_setting(budget or ("20m" if trained else "5m"), f"budget={budget}")
    knobs = [name.strip() for name in args.vary.split(",") if name.strip()]
    request = TradeoffRequest(settings, seconds, args.views, args.repeats, knobs, args.lpips, args.out)
    return _train_tradeoff_command(request) if trained else _render_tradeoff_command(args.run_dir, request)


def _render_tradeoff_command(run_dir: Path, request: TradeoffRequest) -> int:
    from neuprim.cli.progress import DrawProgress
    from neuprim.search.render_tradeoff import format_tradeoff_render_command, measure_tradeoff
    from neuprim.search.tradeoff_record import TRADEOFF_FOLDER

    folder = request.out or run_dir / TRADEOFF_FOLDER
    try:
        with DrawProgress() as progress:
            record = measure_tradeoff(run_dir, request, progress.print_note, progress.show)
    except KeyboardInterrupt:
        if not (folder / "tradeoff.json").exists():
            raise
        kept = f"; {folder / 'tradeoff.json'} has the points measured so far; repeat the command to continue"
        raise KeyboardInterrupt(kept) from None
    commands = [format_tradeoff_render_command(str(run_dir), point.words) for point in record.points]
    _print_fronts(folder, record, commands)
    return 0


def _train_tradeoff_command(request: TradeoffRequest) -> int:
    from neuprim.cli.progress import DrawProgress
    from neuprim.config.command_settings import take_launcher_overrides
    from neuprim.search.ablation import format_ablation_run_command, run_ablation

    launcher, settings = take_launcher_overrides(request.words)
    try:
        with DrawProgress() as progress:
            request = replace(request, words=settings)
            folder, record = run_ablation(request, launcher, progress.print_note, progress.show)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("; trained models are kept; repeat the command to continue") from None
    _print_fronts(folder, record, [format_ablation_run_command(point.words) for point in record.points])
    return 0


def _print_fronts(folder: Path, record: TradeoffRecord, commands: Sequence[str]) -> None:
    console = plain_console()
    if "length" in record.facts:
        console.print(record.facts["length"])
    for title, numbers in (("front of speed", record.speed), ("front of size", record.size)):
        console.print(title)
        print_columns(_list_front_rows(record, numbers))
        for place, number in enumerate(numbers, 1):
            console.print(f"{commands[number]}  # {place}")
        console.print()
    if record.points[0].run_dir:
        for one in record.left_out:
            console.print(f"left out: {' '.join(one.words) or one.knob}: {one.reason}")
    for name in _TRADEOFF_FILES:
        console.print(folder / name)


def _list_front_rows(record: TradeoffRecord, numbers: Sequence[int]) -> list[Sequence[str]]:
    """Return rows of a table: titles, the reference (point 0), and the points of a Pareto front.

    ``numbers`` are indices into ``record.points``. The first column counts the points of the front from 1.
    """
    trained = bool(record.points[0].run_dir)
    names = ["#", "time", "ms", "frames/s", "PSNR", "SSIM", "bytes", *(["ms/step"] if trained else [])]
    first = ("centre" if trained else "ref.", *_format_printed_point(record.points[0]))
    return [names, first, *((str(k), *_format_printed_point(record.points[n])) for k, n in enumerate(numbers, 1))]


def _format_printed_point(point: TradeoffPoint) -> tuple[str, ...]:
    q = point.quality
    about = "" if point.spread is None else f" ± {point.spread:.3f}"
    times = ("–", "–", "–")
    if point.ms:
        times = (f"{point.ratio:.3f}{about}", f"{point.time:.2f}", f"{1e3 / point.time:.1f}")
    quality = (f"{q['psnr']:.2f}", f"{q['ssim']:.4f}")
    return (*times, *quality, f"{point.bytes:,}", *([f"{point.ms_per_step:.1f}"] if point.run_dir else []))


TRADEOFF_COMMAND = Command(
    "tradeoff",
    "measure speed and size against accuracy, for settings of rendering or of training",
    _tradeoff_command,
    _add_tradeoff_arguments,
    _TRADEOFF_HELP,
    f"""{RENDER_SETTINGS_HELP}
  budget=TIME                about how long, e.g. 90s or 10m (default: 5m for RUN_DIR, 20m to train models)
without RUN_DIR, any setting of `neuprim run`, and budget=TIME""",
)
