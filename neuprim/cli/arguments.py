"""Values of command-line flags, from their text; and the flags of commands that have many."""

from __future__ import annotations

import argparse
import math
import re
from pathlib import Path

from neuprim.core.io.trust import FLAG

__all__ = [
    "count",
    "decibels",
    "duration",
    "for_bench",
    "for_compress",
    "for_inspect",
    "for_render",
    "for_stored",
    "numbers",
    "rate",
    "row",
    "size",
    "whole",
]


def for_bench(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of ``neuprim bench``."""
    parser.add_argument("what", choices=["paper"], help="which tables")
    parser.add_argument(
        "overrides", nargs="*", metavar="KEY=VALUE", help="settings over the protocol's, e.g. scene.downsample=4"
    )
    parser.add_argument(
        "--tables", default="3-7", metavar="N", help="numbers of the paper's tables, e.g. 3-5 or 6,7 (default: 3-7)"
    )
    parser.add_argument("--data", type=Path, metavar="DIR", help="a folder per scene; without it the tables are listed")
    parser.add_argument(
        "--scenes", metavar="NAME", help="some of them, e.g. chair,lego; chair=FOLDER where the folder has another name"
    )
    parser.add_argument("--rows", metavar="NAME", help="some of the rows: 200, 5k, nolimit, real")
    parser.add_argument(
        "--budget",
        default="full",
        metavar="TIME",
        help="training time of a run, e.g. 10m; full: 100,000 steps (default)",
    )
    parser.add_argument(
        "--seeds", type=count, default=1, metavar="N", help="runs of each, with seeds from 0 (default: 1)"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/paper"), metavar="DIR", help="gets a run directory each"
    )
    parser.add_argument("--estimate", action="store_true", help="only say what would run, and for how long")


_STORED = ("run", "eval", "render", "tradeoff", "export", "compress", "prune", "inspect", "view")
"""Commands that open a run somebody made."""


def for_stored(parser: argparse.ArgumentParser, name: str) -> None:
    """Adds the user's word for what a stored configuration would reach (:mod:`neuprim.config.trust`), to the commands
    that read one."""
    if name in _STORED:
        parser.add_argument(
            FLAG,
            action="store_true",
            help="use addresses, and write to folders outside of it, that a stored config.yaml names",
        )


def for_render(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of ``neuprim render``, but those of light from all around."""
    parser.add_argument("run_dir", type=Path, metavar="RUN_DIR")
    cameras = "which cameras; a file is JSON (frames, or a path of nerfstudio's viewer), USD (FILE#/PRIM) or a COLMAP model's folder"
    parser.add_argument("--camera", required=True, metavar="orbit|test|FILE", help=cameras)
    space = "coordinates of a file's cameras, of lights, and in .exr files: those of the run's data (default), or of the model (volumes: its unit box)"
    parser.add_argument("--space", choices=("world", "scene"), help=space)
    parser.add_argument("--size", type=size, metavar="WxH", help="pixels (default: the data set's)")
    parser.add_argument(
        "--format", choices=("png", "exr", "npy", "webp", "gif", "mp4"), help="default: png, or webp for an animation"
    )
    layers = "of an .exr: beauty, alpha, depth, density, and what the run's task adds (an unknown name lists them); default: all"
    parser.add_argument("--layers", metavar="NAME,...", help=layers)
    datatype = (
        "light and alpha of an .exr in 16 or 32 bits (default: float); depth and other numbers are float in either"
    )
    parser.add_argument("--datatype", choices=("half", "float"), help=datatype)
    parser.add_argument(
        "--fps", type=rate, metavar="F", help="frames per second of an animation (default: about four seconds in all)"
    )
    parser.add_argument("--out", type=Path, metavar="PATH", help="where to write (default: in RUN_DIR)")
    parser.add_argument("--frames", type=count, default=60, metavar="N", help="frames of an orbit (default: 60)")
    parser.add_argument("--force", action="store_true", help="replace pictures of the run's report")


def for_inspect(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of ``neuprim inspect``."""
    parser.add_argument("run_dir", type=Path, metavar="RUN_DIR")
    parser.add_argument(
        "--show",
        default="",
        metavar="NAME,...",
        help="volume, isosurface, slices, primitives, primitive, difference, ...",
    )
    parser.add_argument(
        "--primitives", action="store_true", help="the ellipsoids in their own colours; as --show primitives"
    )
    parser.add_argument("--primitive", type=row, metavar="INDEX", help="look into this one; as --show primitive")
    parser.add_argument("--against", metavar="FILE.vdb|DIR|scene", help="ground truth to compare with")
    parser.add_argument(
        "--grid", type=count, default=128, metavar="N", help="points along the box's longest side (default: 128)"
    )
    parser.add_argument(
        "--box",
        type=numbers,
        metavar="X,Y,Z,X,Y,Z",
        help="two corners, in the coordinates of the run's data, as --box=-1,-1,-1,1,1,1 (default: around all matter)",
    )
    parser.add_argument(
        "--level", type=numbers, default=[], metavar="S,...", help="extinctions of isosurfaces, 1/scene unit"
    )
    parser.add_argument("--up", choices=("x", "y", "z"), help="the upward axis (default: the scene's, or z)")
    parser.add_argument("--size", type=size, metavar="WxH", help="pixels of the picture or window")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help=".png, .webp, .gif, .mp4, .html or .vdb (default: a window)"
    )
    parser.add_argument("--force", action="store_true", help="replace files that exist")


def for_compress(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of ``neuprim compress``."""
    parser.add_argument("run_dir", type=Path, metavar="RUN_DIR")
    parser.add_argument("--tolerance", type=decibels, metavar="DB", help="how much worse it may get (default: 0.1dB)")
    parser.add_argument(
        "--level",
        type=count,
        metavar="1-5",
        help="so many bits instead, whatever that costs: 1 keeps nearly everything, 5 very little",
    )
    words = "bits of a parameter, or of all others, over a level's (3 unless given): means=16 sh_rest=6,5 others=8"
    parser.add_argument("--bits", nargs="+", default=[], metavar="NAME=BITS", help=words)
    parser.add_argument(
        "--seconds", type=duration, default=30.0, metavar="S", help="of training for few bits; 0 for none (default: 30)"
    )
    parser.add_argument(
        "--steps", type=whole, metavar="N", help="of training instead, for the same file on every machine"
    )
    parser.add_argument(
        "--out", "--output", type=Path, metavar="FILE", help="where to write (default: RUN_DIR/model.neuprim)"
    )
    parser.add_argument("--force", action="store_true", help="replace a file that exists")


def size(text: str) -> tuple[int, int]:
    """640x480 -> (640, 480) pixels."""
    match = re.fullmatch(r"([1-9]\d{0,5})[xX]([1-9]\d{0,5})", text)
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r}: expected WIDTHxHEIGHT, for example 640x480")
    return int(match.group(1)), int(match.group(2))


def count(text: str) -> int:
    """A positive whole number."""
    if not re.fullmatch(r"[1-9]\d{0,6}", text):
        raise argparse.ArgumentTypeError(f"{text!r}: expected a positive count")
    return int(text)


def whole(text: str) -> int:
    """A whole number, from 0."""
    if not re.fullmatch(r"\d{1,7}", text):
        raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number, from 0")
    return int(text)


def decibels(text: str) -> float:
    """0.1 or 0.1dB -> 0.1."""
    match = re.fullmatch(r"(\d+\.?\d*|\.\d+) ?(?:dB)?", text, re.IGNORECASE)
    if match is None or not 0 < float(match[1]) <= 100:
        raise argparse.ArgumentTypeError(f"{text!r}: expected decibels above 0, for example 0.1dB")
    return float(match[1])


def duration(text: str) -> float:
    """Seconds, 0 or more: 30, 90s, 5m."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)(s|m|h|)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r}: expected a time, for example 30s or 5m")
    return float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]]


def row(text: str) -> int:
    """The number of a primitive, from 0."""
    if not re.fullmatch(r"\d{1,9}", text):
        raise argparse.ArgumentTypeError(f"{text!r}: expected the number of a primitive, from 0")
    return int(text)


def numbers(text: str) -> list[float]:
    """Finite numbers separated by commas."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if not values or not all(math.isfinite(v) for v in values):
        raise argparse.ArgumentTypeError(f"{text!r}: expected numbers separated by commas")
    return values


def rate(text: str) -> float:
    """Frames per second."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.1 <= value <= 240.0:
        raise argparse.ArgumentTypeError(f"{text!r}: expected 0.1 to 240 frames per second")
    return value
