"""How long what lies ahead will take: seconds of a step, and of a frame, over the number of primitives."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from neuprim.runs.events import Event, Events, Preparing, Step
from neuprim.runs.training import COMPILING

__all__ = ["Stopwatch", "linear"]

_FEW = 64
"""Steps of which a single slow one would spoil the mean."""

_FIXED = 0.5
"""Share of a step's time that does not depend on the number of primitives, where only one number was tried."""


def linear(known: Sequence[tuple[int, float]], primitives: float) -> float:
    """A time at a number of primitives, from (primitives, time) pairs: a least-squares line that neither falls nor
    starts below nothing.

    Of one number alone half is taken to be the same for all.
    """
    counts, times = [float(n) for n, _ in known], [t for _, t in known]
    mean_n, mean_t = sum(counts) / len(counts), sum(times) / len(times)
    spread = sum((n - mean_n) ** 2 for n in counts)
    slope = (
        sum((n - mean_n) * (t - mean_t) for n, t in zip(counts, times, strict=True)) / spread
        if spread > 0
        else (1 - _FIXED) * mean_t / mean_n
    )
    slope = min(max(slope, 0.0), mean_t / mean_n)
    return mean_t + slope * (primitives - mean_n)


@dataclass
class Stopwatch:
    """Passes events on and measures, by a clock, how long a step takes.

    Attributes:
        clock: seconds; monotonic.
        compiling: seconds that kernels were compiled for, which happens once per installation.
    """

    clock: Callable[[], float]
    events: Events
    compiling: float = 0.0
    _steps: list[float] = field(default_factory=list)
    _last: float | None = None
    _compiling: float | None = None

    def __call__(self, event: Event) -> None:
        self.events(event)
        now = self.clock()
        if isinstance(event, Preparing) and event.text == COMPILING and self._compiling is None:
            self._compiling = now
        if isinstance(event, Step):
            if self._compiling is not None:
                self.compiling, self._compiling = self.compiling + now - self._compiling, None
            if self._last is not None:
                self._steps.append(now - self._last)
            self._last = now

    @property
    def pace(self) -> float | None:
        """Seconds of a step, the mean; of few steps the median. None of fewer than two."""
        if not self._steps:
            return None
        return max((statistics.median if len(self._steps) < _FEW else statistics.mean)(self._steps), 1e-9)
