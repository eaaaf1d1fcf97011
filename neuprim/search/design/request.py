"""What to train and measure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from neuprim.config.launcher import LauncherSettings

__all__ = ["DesignRequest", "Progress", "Tell"]

Progress = Callable[[str, float], None]
"""Called with (text, fraction 0..1 of what the text names)."""

Tell = Callable[[str], None]
"""Called with lines for the user."""


@dataclass(frozen=True)
class DesignRequest:
    """What to train and measure.

    Attributes:
        words: those of ``neuprim run``; they name the centre of the set, and with ``output_dir`` its folder.
        budget: seconds for everything, about; what does not fit is left out.
        views: held-out views, evenly spread.
        repeats: rounds of timing.
        knobs: names of those to turn; empty for all.
        seeds: trainings of every variant.
        lpips: weights for LPIPS; without, those that the words name.
        launcher: where models are trained; they are measured here.
    """

    words: Sequence[str]
    budget: float = 1200.0
    views: int = 5
    repeats: int = 15
    knobs: Sequence[str] = ()
    seeds: int = 1
    lpips: Path | None = None
    launcher: LauncherSettings = LauncherSettings()  # noqa: RUF009 (frozen)
