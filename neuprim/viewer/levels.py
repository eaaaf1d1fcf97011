"""How accurately a picture is drawn: fully when nothing moves, and as well as there is time for while something does.

Levels come from the front of ``neuprim tradeoff RUN_DIR`` where there is one, which knows what is cheap for this model;
else from lower resolutions alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from neuprim.core.errors import NeuprimError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.runs.render_config import RenderConfig, parse_render_config
from neuprim.search.tradeoff.record import read_record
from neuprim.search.tradeoff.run import FOLDER

__all__ = ["SMOOTH", "Front", "Level", "Levels", "read_front"]

SMOOTH = 0.05
"""Seconds that a picture may take while the camera moves."""

_HALVINGS = 4
_FORGET = 0.5  # of what was measured, by one more picture


@dataclass(frozen=True)
class Front:
    """Words of operating points, best quality first, each with its time over that of the full picture."""

    points: tuple[tuple[tuple[str, ...], float], ...] = ()


def read_front(run_dir: Path, tell: Callable[[str], None] = lambda text: None) -> Front:
    """The front of time against quality that was measured of a run; empty where none was.

    Args:
        tell: told why a record that is there is of no use.
    """
    try:
        record = read_record(run_dir / FOLDER / "tradeoff.json")
    except NeuprimError as error:
        tell(str(error))
        return Front()
    if record is None:
        return Front()
    found = [record.points[i] for i in record.speed if 0 <= i < len(record.points)]
    return Front(tuple((p.words, p.ratio) for p in found if p.words and 0 < p.ratio < 1))


@dataclass
class Level:
    """One way of drawing.

    Attributes:
        ratio: of its time over the full picture's, as long as it was not measured here.
        pace: seconds per pixel of the window, measured; None before.
    """

    point: RenderConfig
    ratio: float
    pace: float | None = None


@dataclass
class Levels:
    """Ways of drawing one model, the full one first, each cheaper than the one before."""

    all: list[Level] = field(default_factory=list)

    @classmethod
    def of(
        cls,
        model: Primitives,
        settings: RenderSettings,
        front: Front,
        tell: Callable[[str], None] = lambda text: None,
        words: Sequence[str] = (),
    ) -> Levels:
        """The full picture with these settings and words over them, the points of the front, and lower resolutions of
        the last of these.

        Raises:
            ConfigError: the words do not fit the model.
        """
        levels = [Level(parse_render_config(words, settings, model), 1.0)]
        for words, ratio in front.points:
            try:
                point = parse_render_config(words, settings, model)
            except NeuprimError as error:  # measured of another model in this directory
                tell(f"{' '.join(words)}: {error}")
                continue
            if ratio < levels[-1].ratio:
                levels.append(Level(point, ratio))
        last = levels[-1]
        for i in range(1, _HALVINGS + 1):
            levels.append(Level(replace(last.point, resolution=last.point.resolution / 2**i), last.ratio / 4**i))
        return cls(levels)

    @property
    def full(self) -> Level:
        return self.all[0]

    def seconds(self, level: Level, pixels: int) -> float | None:
        """What a picture will take: by its own pace where that is known, else the least that other levels' paces
        promise, as what a picture takes whatever its level would count several times; None where nothing was drawn
        yet."""
        known = [level] if level.pace is not None else [other for other in self.all if other.pace is not None]
        return min(
            (other.pace * pixels * level.ratio / other.ratio for other in known if other.pace is not None), default=None
        )

    def within(self, seconds: float, pixels: int) -> Level:
        """The best level whose picture of a window of so many pixels takes no longer, else the cheapest one."""
        for level in self.all:
            expected = self.seconds(level, pixels)
            if expected is not None and expected <= seconds:
                return level
        return self.all[-1]

    def took(self, level: Level, seconds: float, pixels: int) -> None:
        """Remember what a picture took."""
        pace = seconds / max(pixels, 1)
        level.pace = pace if level.pace is None else (1 - _FORGET) * level.pace + _FORGET * pace
