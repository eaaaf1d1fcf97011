"""Choice of rendering quality: full for a still image, as good as time allows while the camera moves.

Quality levels come from the Pareto front that ``neuprim tradeoff RUN_DIR`` measured, if there is one, and from lower
resolutions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from neuprim.core.errors import NeuprimError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.runs.render_config import RenderConfig, parse_run_rendering
from neuprim.search.tradeoff_record import TRADEOFF_FILE, TRADEOFF_FOLDER, read_tradeoff_record

SMOOTH_SECONDS = 0.05  # that an image may take while the camera moves

_HALVINGS = 4
_DECAY = 0.5  # weight of a new measurement

Front = Sequence[tuple[tuple[str, ...], float]]
"""Overrides of render configurations, best quality first, each with its time relative to the full image."""


def read_viewer_front(run_dir: Path, warn: Callable[[str], None] = lambda text: None) -> Front:
    """Read the measured front of time against quality; empty if there is none, or with a warning if it is unusable."""
    try:
        record = read_tradeoff_record(run_dir / TRADEOFF_FOLDER / TRADEOFF_FILE)
    except NeuprimError as error:
        warn(str(error))
        return ()
    if record is None:
        return ()
    points = [record.points[i] for i in record.speed if 0 <= i < len(record.points)]
    return tuple((p.words, p.ratio) for p in points if p.words and 0 < p.ratio < 1)


@dataclass
class QualityLevel:
    """One render configuration.

    Attributes:
        ratio: expected time relative to the full image.
        pace: measured seconds per pixel of the window; None before the first image.
    """

    config: RenderConfig
    ratio: float
    pace: float | None = None


@dataclass
class QualityLadder:
    """Quality levels of one model, the full one first, each cheaper than the one before."""

    levels: list[QualityLevel] = field(default_factory=list)

    @classmethod
    def build(
        cls,
        model: Primitives,
        settings: RenderSettings,
        front: Front,
        warn: Callable[[str], None] = lambda text: None,
        overrides: Sequence[str] = (),
    ) -> QualityLadder:
        """Full quality by the settings and overrides, then the front, then lower resolutions of its last level.

        Raises:
            ConfigError: the overrides do not fit the model.
        """
        levels = [QualityLevel(parse_run_rendering(overrides, settings, model), 1.0)]
        for words, ratio in front:
            try:
                config = parse_run_rendering(words, settings, model)
            except NeuprimError as error:  # the front is that of an older model in this directory
                warn(f"{' '.join(words)}: {error}")
                continue
            if ratio < levels[-1].ratio:
                levels.append(QualityLevel(config, ratio))
        last = levels[-1]
        for i in range(1, _HALVINGS + 1):
            config = replace(last.config, resolution=last.config.resolution / 2**i)
            levels.append(QualityLevel(config, last.ratio / 4**i))
        return cls(levels)

    @property
    def full(self) -> QualityLevel:
        return self.levels[0]

    def expected_seconds(self, level: QualityLevel, pixels: int) -> float | None:
        """Predict the time of an image; None before anything was measured.

        Uses the level's own pace. Otherwise the smallest prediction from other levels counts, because the fixed cost
        of an image would be scaled up with the rest.
        """
        known = [level] if level.pace is not None else self.levels
        times = [x.pace * pixels * level.ratio / x.ratio for x in known if x.pace is not None]
        return min(times, default=None)

    def best_within(self, seconds: float, pixels: int) -> QualityLevel:
        """Return the best level that stays within the time for a window of so many pixels, else the cheapest."""
        for level in self.levels:
            expected = self.expected_seconds(level, pixels)
            if expected is not None and expected <= seconds:
                return level
        return self.levels[-1]

    def add_timing(self, level: QualityLevel, seconds: float, pixels: int) -> None:
        """Record how long an image took."""
        pace = seconds / max(pixels, 1)
        level.pace = pace if level.pace is None else (1 - _DECAY) * level.pace + _DECAY * pace
