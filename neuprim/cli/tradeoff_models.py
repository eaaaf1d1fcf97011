"""``neuprim tradeoff task=…``: what the knobs of a model cost, by a designed set of trainings."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from neuprim.search.design.record import Model

__all__ = ["tradeoff_models"]

_BUDGET = "20m"


def tradeoff_models(args: argparse.Namespace) -> int:
    """Trains, measures, writes the set's folder and prints the fronts."""
    from neuprim.cli.console import plain_console
    from neuprim.cli.progress import DrawProgress
    from neuprim.config.launcher import take_launcher
    from neuprim.config.overrides import parse
    from neuprim.search.design.record import Model, command
    from neuprim.search.design.run import DesignRequest, design_run
    from neuprim.search.tradeoff.run import seconds_of

    words = [
        args.run_dir,
        *args.words,
        *(word for word in args.knobs if "=" in word),
    ]  # after --knobs they look like names
    knobs = [word for word in args.knobs if "=" not in word]
    launcher, words = take_launcher(words)
    said = [str(a.value) for a in parse(words) if a.key == "budget"]
    if said and args.budget is not None:
        raise ConfigError(f"budget={said[-1]} and --budget {args.budget}: expected one of them")
    budget = seconds_of(said[-1], "budget=") if said else seconds_of(args.budget or _BUDGET)
    request = DesignRequest(words, budget, args.views, args.repeats, knobs, args.seeds or 1, args.lpips, launcher)
    try:
        with DrawProgress(plain_console(stderr=True)) as progress:
            folder, record = design_run(request, progress.note, progress.show)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("; what is trained is kept, and the same command goes on") from None
    models = [point for point in record.points if isinstance(point, Model)]
    console = plain_console()
    console.print(record.facts["length"], markup=False)
    for title, numbers in (("front of speed", record.speed), ("front of size", record.size)):
        console.print(_table(title, models, numbers))
        for place, number in enumerate(numbers, 1):
            console.print(f"{command(models[number].words)}  # {place}", markup=False)
        console.print()
    for one in record.left_out:
        console.print(f"left out: {' '.join(one.words) or one.knob}: {one.reason}", markup=False)
    for name in ("tradeoff.json", "tradeoff.csv", "tradeoff.html", "front.png"):
        console.print(folder / name)
    return 0


def _table(title: str, models: Sequence[Model], numbers: Sequence[int]) -> Table:
    """The centre, and the models of a front under the numbers that their commands have."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left", box=box.SIMPLE, padding=(0, 1, 0, 0))
    table.add_column("#", justify="right", no_wrap=True)
    for name in ("PSNR", "SSIM", "exact", "time", "fps", "ms/step", "bytes", "MB"):
        table.add_column(name, justify="right", no_wrap=True)
    for place, number in (("centre", 0), *((str(k), number) for k, number in enumerate(numbers, 1))):
        table.add_row(*(Text(cell) for cell in (place, *_cells(models[number]))))
    return table


def _cells(model: Model) -> tuple[str, ...]:
    q = model.quality
    about = "" if model.spread is None else f" ± {model.spread:.3f}"
    seeds = "" if model.seed_spread is None else f" ± {model.seed_spread:.2f}"
    return (
        *(f"{q['psnr']:.2f}{seeds}", f"{q['ssim']:.4f}", f"{q['psnr_exact']:.0f}"),
        *((f"{model.ratio:.3f}{about}", f"{1e3 / model.time:.1f}") if model.ms else ("–", "–")),
        *(
            f"{model.ms_per_step:.1f}",
            f"{model.bytes:,}",
            "–" if model.peak_bytes is None else f"{model.peak_bytes / 1e6:.1f}",
        ),
    )
