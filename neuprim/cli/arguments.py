"""Values of command-line flags, from their text."""

from __future__ import annotations

import argparse
import math
import re

__all__ = ["count", "numbers", "rate", "row", "size"]


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
