"""``neuprim bench paper``: the paper's tables, and our numbers beside them for the scenes whose data are there."""

from __future__ import annotations

import argparse
import re
import statistics
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.cli.command import Command, parse_count, take_overrides
from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from neuprim.runs.paper import Planned, Table

_RULES = """\
PSNR of floats; SSIM and LPIPS by the rule of 3DGS's tools (ssim_3dgs, lpips_3dgs; metrics.lpips=FILE has your weights
of VGG)"""

_MEASURES = ("PSNR", "SSIM", "LPIPS")


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("what", choices=["paper"], help="which tables")
    settings = "settings over the protocol's, e.g. scene.downsample=4"
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help=settings)
    numbers = "numbers of the paper's tables, e.g. 3-5 or 6,7 (default: 3-7)"
    parser.add_argument("--tables", default="3-7", metavar="N", help=numbers)
    parser.add_argument("--data", type=Path, metavar="DIR", help="a folder per scene; without it the tables are listed")
    scenes = "some of them, e.g. chair,lego; chair=FOLDER where the folder has another name"
    parser.add_argument("--scenes", metavar="NAME", help=scenes)
    parser.add_argument("--rows", metavar="NAME", help="some of the rows: 200, 5k, nolimit, real")
    budget = "training time of a run, e.g. 10m; full: 100,000 steps (default)"
    parser.add_argument("--budget", default="full", metavar="TIME", help=budget)
    seeds = "runs of each, with seeds from 0 (default: 1)"
    parser.add_argument("--seeds", type=parse_count, default=1, metavar="N", help=seeds)
    out = "gets a run directory each"
    parser.add_argument("--out", type=Path, default=Path("outputs/paper"), metavar="DIR", help=out)
    parser.add_argument("--estimate", action="store_true", help="only say what would run, and for how long")


def _bench(args: argparse.Namespace) -> int:
    """List the tables, or run what stands for their rows."""
    from neuprim.cli.run_command import run_one
    from neuprim.config.overrides import CommandLine
    from neuprim.runs.open import read_metrics
    from neuprim.runs.paper import plan, tables

    wanted = parse_table_numbers(args.tables)
    chosen = [table for table in tables() if wanted & set(table.numbers)]
    if args.data is None:
        print(*_list_tables(chosen), sep="\n")
        return 0
    scenes: dict[str, str] = {}
    for text in args.scenes.split(",") if args.scenes else []:
        name, _, folder = text.partition("=")
        scenes[name.strip().lower()] = (folder or name).strip()
    rows = args.rows.split(",") if args.rows else []
    planned = plan(args.data, chosen, scenes, rows, args.budget, args.seeds, args.out, args.overrides)
    print(*_estimate(planned), sep="\n", flush=True)
    if args.estimate:
        return 0
    results = []
    for number, one in enumerate(planned, 1):
        print(f"[{number}/{len(planned)}] {one.config.output_dir}", flush=True)
        results.append((one, read_metrics(run_one(one.config, CommandLine(one.config.overrides)))))
        print(*_describe_result(*results[-1]), sep="\n", flush=True)
    print(*_average(results), _RULES, sep="\n")
    return 0


def parse_table_numbers(text: str) -> set[int]:
    """Return the numbers of the tables that ``3-5,7`` names.

    Raises:
        ConfigError: it names something else than tables 3 to 7.
    """
    found: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"([3-7])(?:-([3-7]))?", part.strip())
        numbers = range(int(match[1]), int(match[2] or match[1]) + 1) if match else ()
        if not numbers:
            raise ConfigError(f"--tables {text}: expected numbers from 3 to 7, such as 3-5 or 6,7")
        found |= set(numbers)
    return found


def _list_tables(chosen: Sequence[Table]) -> Iterator[str]:
    for table in chosen:
        numbers = ", ".join(map(str, table.numbers))
        plural = "s" * (len(table.numbers) > 1)
        yield f"table{plural} {numbers}: {table.title} (task=static scene={table.loader})"
        for row in table.rows:
            yield f"  {row.name}: preset={row.preset}{f'; beside {row.beside[0]}' if row.beside[0] else ''}"
            for scene, found in row.figures.items():
                line = "  ".join(f"{kind} {_format(getattr(found, kind.lower()), kind):>7}" for kind in _MEASURES)
                yield f"    {scene:10} {line}{f'  {found.primitives:,} primitives' if found.primitives else ''}"
    yield "neuprim bench paper --data DIR runs those whose data are folders of DIR; --estimate says first for how long"


def _estimate(planned: Sequence[Planned]) -> Iterator[str]:
    """What would run, and for how long: seconds of a budget, else steps at the pace of the first ones in the first
    scene of each row."""
    from neuprim.runs.paper import pace

    total, paces, longer = 0.0, dict[tuple[str, str], float](), ""
    for one in planned:
        train, key = one.config.train, (one.table.title, one.row.name)
        if train.max_seconds is not None:
            total += train.max_seconds
            continue
        assert train.iterations is not None, "a run without seconds has steps"
        if key not in paces:
            paces[key] = pace(one)
            start = f"{1e3 * paces[key]:.0f} ms a step at the start"
            yield f"{one.row.name}, {one.scene}: {start}, {train.iterations:,} steps"
        total += paces[key] * train.iterations
        if train.population.strategy == "gradient":
            longer = "; longer where the population grows"
    yield f"{len(planned)} runs, about {_format_seconds(total)} of training on this machine{longer}, and measuring"


def _describe_result(one: Planned, metrics: Mapping[str, Any]) -> Iterator[str]:
    from neuprim.runs.paper import compared

    steps, seconds = metrics["iterations"], _format_seconds(metrics["train_seconds"])
    yield (
        f"{one.scene}, {one.row.name}: preset={one.row.preset}, seed {one.config.seed}, "
        f"{metrics['checkpoint']} checkpoint after {steps:,} steps in {seconds}"
    )
    protocol = ("scene=", "scene.path=", "preset=", "seed=", "output_dir=", "task=")
    own = " ".join(text for text in one.config.overrides if not text.startswith(protocol))
    width, height = metrics["image_size"]
    yield f"  images of {width}x{height}, down-sampling {metrics['downsampling']}{f', {own}' if own else ''}"
    for kind, ours, theirs, other in compared(one, metrics):
        beside = f"   {one.row.beside[0]} {_format(other, kind)}" if one.row.beside[0] and kind in _MEASURES else ""
        yield f"  {kind:10} {_format(ours, kind):>9}   paper {_format(theirs, kind)}{beside}"


def _average(results: Sequence[tuple[Planned, Mapping[str, Any]]]) -> Iterator[str]:
    """Per row, over scenes and seeds that have both numbers; the paper's are of its best checkpoint on the test views,
    ours of the last."""
    from neuprim.runs.paper import compared

    rows: dict[tuple[str, str], list[tuple[Planned, Mapping[str, Any]]]] = {}
    for one, metrics in results:
        rows.setdefault((one.table.title, one.row.name), []).append((one, metrics))
    for (title, name), own in rows.items():
        scenes, seeds = len({one.scene for one, _ in own}), len({one.config.seed for one, _ in own})
        count = f"{scenes} scenes, {seeds} seed{'s' * (seeds > 1)}"
        yield f"{title}, {name}: means over {count}; ours of the last checkpoint, the paper's of the best"
        pairs = [pair for one, metrics in own for pair in compared(one, metrics)]
        for kind in _MEASURES:
            both = [(a, b) for what, a, b, _ in pairs if what == kind and a is not None and b is not None]
            if both:
                ours, theirs = (statistics.mean(column) for column in zip(*both, strict=True))
                yield f"  {kind:10} {_format(ours, kind):>9}   paper {_format(theirs, kind)}"


def _format(value: float | None, kind: str) -> str:
    if value is None:
        return "–"
    return f"{value:,.0f}" if kind == "primitives" else f"{value:.{2 if kind == 'PSNR' else 4}f}"


def _format_seconds(seconds: float) -> str:
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.0f} s"


COMMAND = Command(
    "bench",
    "the paper's tables, and runs of their protocol on data that you have",
    _bench,
    _add_arguments,
    take_rest=take_overrides,
)
