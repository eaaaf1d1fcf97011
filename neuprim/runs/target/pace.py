"""How long what lies ahead will take: seconds of a step, and of a frame, over the number of primitives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from neuprim.runs.events import Event, Events, Step

__all__ = ["Stopwatch", "linear"]

_FIXED = 0.5
"""Share of a step's time that does not depend on the number of primitives, where only one number was tried."""


def linear(known: Sequence[tuple[int, float]], primitives: float) -> float:
    """A time at a number of primitives, from (primitives, time) pairs: a least-squares line that neither falls nor is ever below its times' least half.

    Later pairs count as much as earlier ones, so a machine that became slower is noticed with the next trial.
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
    return max(mean_t + slope * (primitives - mean_n), min(times) / 2 if primitives < mean_n else 0.0)


@dataclass
class Stopwatch:
    """Passes events on and measures, by a clock, how long a step takes.

    Attributes:
        clock: seconds; monotonic.
    """

    clock: Callable[[], float]
    events: Events
    _first: float | None = field(default=None)
    _last: float = field(default=0.0)
    _steps: int = field(default=0)

    def __call__(self, event: Event) -> None:
        self.events(event)
        if isinstance(event, Step):
            self._last = self.clock()
            if self._first is None:
                self._first = self._last
            else:
                self._steps += 1

    @property
    def pace(self) -> float | None:
        """Seconds of a step; None of fewer than two."""
        return None if self._first is None or not self._steps else max((self._last - self._first) / self._steps, 1e-9)
