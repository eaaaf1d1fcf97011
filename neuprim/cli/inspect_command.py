"""``neuprim inspect``: look inside a run's density."""

from __future__ import annotations

import argparse
from pathlib import Path

from neuprim.cli.command import Command, parse_count, parse_numbers, parse_size, parse_whole, take_conditions

_CONDITIONS = """\
Each condition of the run's task is a flag, given after RUN_DIR: --time 0.5, or several frames: --time 0:1:20,
--time 0.2,0.8."""


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    shown = "volume, isosurface, slices, primitives, primitive, difference, ..."
    parser.add_argument("--show", default="", metavar="NAME,...", help=shown)
    ellipsoids = "the ellipsoids in their own colours; as --show primitives"
    parser.add_argument("--primitives", action="store_true", help=ellipsoids)
    one = "look into this one; as --show primitive"
    parser.add_argument("--primitive", type=parse_whole, metavar="INDEX", help=one)
    parser.add_argument("--against", metavar="FILE.vdb|DIR|scene", help="ground truth to compare with")
    grid = "points along the box's longest side (default: 128)"
    parser.add_argument("--grid", type=parse_count, default=128, metavar="N", help=grid)
    box = "two corners, in the coordinates of the run's data, as --box=-1,-1,-1,1,1,1 (default: around all matter)"
    parser.add_argument("--box", type=parse_numbers, metavar="X,Y,Z,X,Y,Z", help=box)
    levels = "extinctions of isosurfaces, 1/scene unit"
    parser.add_argument("--level", type=parse_numbers, default=[], metavar="S,...", help=levels)
    parser.add_argument("--up", choices=("x", "y", "z"), help="the upward axis (default: the scene's, or z)")
    parser.add_argument("--size", type=parse_size, metavar="WxH", help="pixels of the picture or window")
    out = ".png, .webp, .gif, .mp4, .html or .vdb (default: a window)"
    parser.add_argument("--out", type=Path, metavar="FILE", help=out)
    parser.add_argument("--force", action="store_true", help="replace files that exist")


def _inspect(arguments: argparse.Namespace) -> int:
    from neuprim.cli.progress import print_notes
    from neuprim.inspect import ViewOptions, parse_box
    from neuprim.runs.inspect import Request, inspect_run

    names = [name.strip() for name in arguments.show.split(",") if name.strip()]
    names += ["primitives"] * arguments.primitives + ["primitive"] * (arguments.primitive is not None)
    request = Request(
        arguments.run,
        names or ["volume"],
        arguments.conditions,
        arguments.grid,
        None if arguments.box is None else parse_box(arguments.box),
        options=ViewOptions(tuple(arguments.level), arguments.primitive),
        against=arguments.against,
        out=arguments.out,
        size=arguments.size,
        up=arguments.up,
        overwrite=arguments.force,
    )
    print(*inspect_run(request, print_notes), sep="\n")
    return 0


COMMAND = Command(
    "inspect",
    "look inside a run's density",
    _inspect,
    _add_arguments,
    _CONDITIONS,
    take_conditions,
    opens_run=True,
)
