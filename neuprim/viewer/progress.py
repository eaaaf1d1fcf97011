"""How a training goes, in numbers that a page shows; cheap enough for every step."""

from __future__ import annotations

import math

import numpy as np

from neuprim.runs.events import Evaluated, Event, Finishing, Preparing, Step

__all__ = ["Series", "TrainingProgress"]

_SMOOTH = 0.98


class Series:
    """Points of a curve, at most ``most`` of them: when there are more, every other one goes and half as many come."""

    def __init__(self, most: int = 1000) -> None:
        self._most, self._every, self._count = most, 1, 0
        self.x: list[float] = []
        self.y: list[float] = []

    def add(self, x: float, y: float) -> None:
        """Values that are not finite are left out."""
        if not math.isfinite(y):
            return
        if self._count % self._every == 0:
            self.x.append(x)
            self.y.append(y)
            if len(self.x) >= self._most:
                self.x, self.y, self._every = self.x[::2], self.y[::2], 2 * self._every
        self._count += 1

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """(P,) each, float64; a copy."""
        count = min(len(self.x), len(self.y))
        return np.array(self.x[:count]), np.array(self.y[:count])


class TrainingProgress:
    """Listens to a run's events.

    Attributes:
        step, fraction: steps done, and the used part of the budget, 0..1.
        text: what the run does now.
        seen: PSNR of the training views, smoothed; held_out: of the held-out views; dB over steps.
    """

    def __init__(self) -> None:
        self.step, self.fraction, self.text = 0, 0.0, ""
        self.seen, self.held_out = Series(), Series()
        self._smooth: float | None = None

    def __call__(self, event: Event) -> None:
        match event:
            case Step():
                report = event.report
                self.step, self.fraction = report.step, event.progress
                if math.isfinite(report.psnr):
                    self._smooth = (
                        report.psnr if self._smooth is None else _SMOOTH * self._smooth + (1 - _SMOOTH) * report.psnr
                    )
                    self.seen.add(report.step, self._smooth)
                self.text = f"step {report.step}, {report.primitives:,} primitives, {report.seconds:.0f} s of training"
            case Evaluated():
                self.held_out.add(self.step, event.psnr)
            case Preparing() | Finishing() as work:
                self.text = work.text
