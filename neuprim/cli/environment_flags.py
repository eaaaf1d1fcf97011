"""The flags ``--environment...`` of ``neuprim render``."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from neuprim.core.environment import EnvironmentFile

__all__ = ["add_environment_flags", "environment_of"]


def add_environment_flags(parser: argparse.ArgumentParser) -> None:
    """Adds them as a group of their own."""
    group = parser.add_argument_group("light from all around, for tasks with a light")
    group.add_argument(
        "--environment", type=Path, metavar="FILE.exr", help="radiance by latitude and longitude, twice as wide as high"
    )
    group.add_argument("--environment-samples", type=_count, metavar="N", help="lights that stand for it (default: 64)")
    group.add_argument(
        "--environment-rotation",
        type=_degrees,
        metavar="DEG",
        help="anticlockwise about up, seen from above (default: 0)",
    )
    group.add_argument("--environment-scale", type=_factor, metavar="X", help="multiplies its radiance (default: 1)")
    unseen = "light from where the model never saw any: draw what it guesses, or leave it out (default: keep)"
    group.add_argument("--environment-unseen", choices=("keep", "drop"), help=unseen)


def environment_of(args: argparse.Namespace) -> EnvironmentFile | None:
    """What they ask for; None without ``--environment``.

    Raises:
        ConfigError: one of the others without it.
    """
    settings = {name: getattr(args, f"environment_{name}") for name in ("samples", "rotation", "scale", "unseen")}
    settings = {name: value for name, value in settings.items() if value is not None}
    if args.environment is None:
        if settings:
            raise ConfigError(f"--environment-{next(iter(settings))} is given without --environment FILE.exr")
        return None
    from neuprim.core.environment import EnvironmentFile

    guesses = settings.pop("unseen", "keep") == "keep"
    return EnvironmentFile(args.environment, **settings, guesses=guesses)


def _count(text: str) -> int:
    value = _number(text, 1.0, 4096.0, "a whole number from 1 to 4096")
    if value != int(value):
        raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number from 1 to 4096")
    return int(value)


def _degrees(text: str) -> float:
    return _number(text, -1e6, 1e6, "an angle in degrees")


def _factor(text: str) -> float:
    return _number(text, 0.0, 1e6, "a factor from 0 to 1e6")


def _number(text: str, low: float, high: float, expected: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"{text!r}: expected {expected}")
    return value
