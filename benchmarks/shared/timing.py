"""Times that can be compared."""

from __future__ import annotations

import math
import time
from collections.abc import Callable


def fastest(pairs: list[Callable[[], None]], rounds: int) -> list[float]:
    """Fastest of ``rounds`` runs of each, taken in turns so that all meet the same noise; one run each beforehand."""
    for run in pairs:
        run()
    times = [math.inf] * len(pairs)
    for _ in range(rounds):
        for i, run in enumerate(pairs):
            start = time.perf_counter()
            run()
            times[i] = min(times[i], time.perf_counter() - start)
    return times
