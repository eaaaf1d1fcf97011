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

__all__ = ["COMMAND", "parse_table_numbers"]

_RULES = """\
PSNR of floats; SSIM and LPIPS by the rule of 3DGS's tools (ssim_3dgs, lpips_3dgs; metrics.lpips=FILE has your weights
of VGG)"""


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
        print(*_listing(chosen), sep="\n")
        return 0
    scenes = dict(_named(word) for word in args.scenes.split(",")) if args.scenes else {}
    rows = args.rows.split(",") if args.rows else []
    planned = plan(args.data, chosen, scenes, rows, args.budget, args.seeds, args.out, args.overrides)
    print(*_estimate(planned), sep="\n", flush=True)
    if args.estimate:
        return 0
    results = []
    for number, one in enumerate(planned, 1):
        print(f"[{number}/{len(planned)}] {one.config.output_dir}", flush=True)
        results.append((one, read_metrics(run_one(one.config, CommandLine(one.config.overrides)))))
        print(*_result(*results[-1]), sep="\n", flush=True)
    print(*_means(results), _RULES, sep="\n")
    return 0


def parse_table_numbers(words: str) -> set[int]:
    """Return the numbers of the tables that ``3-5,7`` names.

    Raises:
        ConfigError: it names something else than tables 3 to 7.
    """
    found: set[int] = set()
    for word in words.split(","):
        match = re.fullmatch(r"([3-7])(?:-([3-7]))?", word.strip())
        if match is None:
            raise ConfigError(f"--tables {words}: expected numbers from 3 to 7, such as 3-5 or 6,7")
        found |= set(range(int(match[1]), int(match[2] or match[1]) + 1))
    if not found:
        raise ConfigError(f"--tables {words}: no table; expected numbers from 3 to 7, such as 3-5 or 6,7")
    return found


def _named(word: str) -> tuple[str, str]:
    """(scene, its folder) of NAME or NAME=FOLDER."""
    name, _, folder = word.partition("=")
    return name.strip().lower(), (folder or name).strip()


def _number(value: float | None, kind: str) -> str:
    return (
        "–" if value is None else f"{value:,.0f}" if kind == "primitives" else f"{value:.{2 if kind == 'PSNR' else 4}f}"
    )


def _listing(chosen: Sequence[Table]) -> Iterator[str]:
    for table in chosen:
        yield (
            f"table{'s' if len(table.numbers) > 1 else ''} {', '.join(map(str, table.numbers))}: "
            f"{table.title} (task=static scene={table.loader})"
        )
        for row in table.rows:
            yield f"  {row.name}: preset={row.preset}{f'; beside {row.beside[0]}' if row.beside[0] else ''}"
            for scene, found in row.figures.items():
                numbers = (("PSNR", found.psnr), ("SSIM", found.ssim), ("LPIPS", found.lpips))
                line = "  ".join(f"{kind} {_number(value, kind):>7}" for kind, value in numbers)
                yield f"    {scene:10} {line}{f'  {found.primitives:,} primitives' if found.primitives else ''}"
    yield "neuprim bench paper --data DIR runs those whose data are folders of DIR; --estimate says first for how long"


def _estimate(planned: Sequence[Planned]) -> Iterator[str]:
    """What would run, and for how long: seconds of a budget, else steps at the pace of the first ones in the first
    scene of each row."""
    from neuprim.runs.paper import pace

    total, paces, grows = 0.0, dict[tuple[str, str], float](), False
    for one in planned:
        train, key = one.config.train, (one.table.title, one.row.name)
        if train.max_seconds is None:
            if key not in paces:
                paces[key] = pace(one)
                yield (
                    f"{one.row.name}, {one.scene}: {1e3 * paces[key]:.0f} ms a step at the start, "
                    f"{train.iterations:,} steps"
                )
            assert train.iterations is not None, "a run without seconds has steps"
            total += paces[key] * train.iterations
            grows = grows or train.population.strategy == "gradient"
        else:
            total += train.max_seconds
    longer = "; longer where the population grows" if grows else ""
    yield f"{len(planned)} runs, about {_duration(total)} of training on this machine{longer}, and measuring"


def _duration(seconds: float) -> str:
    for unit, length in (("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.0f} s"


def _result(one: Planned, metrics: Mapping[str, Any]) -> Iterator[str]:
    from neuprim.runs.paper import compared

    steps, seconds = metrics["iterations"], _duration(metrics["train_seconds"])
    width, height = metrics["image_size"]
    yield (
        f"{one.scene}, {one.row.name}: preset={one.row.preset}, seed {one.config.seed}, "
        f"{metrics['checkpoint']} checkpoint after {steps:,} steps in {seconds}"
    )
    yield f"  images of {width}x{height}, down-sampling {metrics['downsampling']}{_others(one)}"
    for kind, ours, theirs, other in compared(one, metrics):
        beside = f"   {one.row.beside[0]} {_number(other, kind)}" if one.row.beside[0] and kind != "primitives" else ""
        yield f"  {kind:10} {_number(ours, kind):>9}   paper {_number(theirs, kind)}{beside}"


def _others(one: Planned) -> str:
    """Settings that the user has over the protocol's."""
    own = ("scene=", "scene.path=", "preset=", "seed=", "output_dir=", "task=")
    words = [word for word in one.config.overrides if not word.startswith(own)]
    return f", {' '.join(words)}" if words else ""


def _means(results: Sequence[tuple[Planned, Mapping[str, Any]]]) -> Iterator[str]:
    """Per row, over scenes and seeds that have both numbers; the paper's are of its best checkpoint on the test views,
    ours of the last."""
    from neuprim.runs.paper import compared

    rows = dict.fromkeys((one.table.title, one.row.name) for one, _ in results)
    for title, name in rows:
        own = [(one, metrics) for one, metrics in results if (one.table.title, one.row.name) == (title, name)]
        seeds = len({one.config.seed for one, _ in own})
        yield (
            f"{title}, {name}: means over {len({one.scene for one, _ in own})} scenes, {seeds} "
            f"seed{'s' * (seeds > 1)}; ours of the last checkpoint, the paper's of the best"
        )
        pairs = [pair for one, metrics in own for pair in compared(one, metrics) if pair[0] != "primitives"]
        for kind in ("PSNR", "SSIM", "LPIPS"):
            both = [
                (ours, theirs)
                for what, ours, theirs, _ in pairs
                if what == kind and ours is not None and theirs is not None
            ]
            if both:
                ours, theirs = (statistics.mean(column) for column in zip(*both, strict=True))
                yield f"  {kind:10} {_number(ours, kind):>9}   paper {_number(theirs, kind)}"


COMMAND = Command(
    "bench",
    "the paper's tables, and runs of their protocol on data that you have",
    _add_arguments,
    _bench,
    take_rest=take_overrides,
)
