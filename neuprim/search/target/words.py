"""Lines that say what was tried, and by how much a target was missed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from neuprim.config.target import Target
from neuprim.search.target.prediction import decibels, undecibels
from neuprim.search.target.record import Attempt

__all__ = ["described", "promised", "shortfall"]


def described(attempt: Attempt, predicted: Mapping[str, Sequence[float]]) -> str:
    """A training in a line."""
    turned = "".join(f" {key.rpartition('.')[2]}={value}" for key, value in sorted(attempt.words.items()))
    ends = "; a full run: " + ", ".join(promised(name, *pair) for name, pair in predicted.items()) if predicted else ""
    found = f"{attempt.quality('psnr'):.2f} dB, ssim {attempt.quality('ssim'):.4f}"
    return f"{attempt.count:,} primitives{turned}, {attempt.steps:,} steps, {attempt.packed / 1e3:.1f} kB: held out {found}{ends} ({attempt.seconds:.1f} s)"


def promised(name: str, value: float, doubt: float) -> str:
    """A measure that is expected, with its doubt, dB, in its own unit."""
    if name == "psnr":
        return f"{name} {value:.2f} ± {doubt:.2g} dB"
    low, high = (undecibels(name, decibels(name, value) + sign * doubt) for sign in (-1, 1))
    return f"{name} {value:.4f} ± {(high - low) / 2:.2g}"


def shortfall(target: Target, attempt: Attempt, packed: int | None = None) -> str | None:
    """Which of a target's limits, megabytes and frames per second, a training's model breaks; None if none."""
    size = attempt.packed if packed is None else packed
    if target.megabytes is not None and size > 1e6 * target.megabytes:
        return f"{size / 1e6:.3f} MB are more than target.megabytes={target.megabytes:g}"
    speed = 1e3 / attempt.quality("ms_per_frame")
    if target.fps is not None and speed < 0.9 * target.fps:
        return f"{speed:.1f} frames per second are fewer than target.fps={target.fps:g}"
    return None
