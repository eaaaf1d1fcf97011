"""Predict quality and size of full runs of every size, from the record of a target search."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from neuprim.config.command_settings import Target
from neuprim.search.size_curve import (
    FIRST_GAIN,
    STEP_RATIO,
    Curve,
    Forecast,
    fit_line,
    forecast_quality,
    from_decibels,
    to_decibels,
)
from neuprim.search.target_record import Attempt, Purpose, SettingChange, TargetRecord

ALLOWANCE, MIN_MARGIN = 0.1, 0.05
"""dB above the target that full runs aim at, and need at least: the cost of quantization."""

_FULL_FILE = 0.97
"""Share of the allowed bytes to plan with."""


@dataclass(frozen=True)
class SizePredictor:
    """Predict the margin of every size from the record.

    Attributes:
        steps: primitives -> steps of a full run.
    """

    target: Target
    record: TargetRecord
    steps: Callable[[int], float]

    @property
    def measures(self) -> tuple[str, ...]:
        """The target's measures of quality, else PSNR."""
        return tuple(self.target.quality) or ("psnr",)

    def margin(self, values: Mapping[str, float]) -> float:
        """Return the least dB above the target; without measures of quality the PSNR itself."""
        wanted = self.target.quality
        if not wanted:
            return values["psnr"]
        return min(to_decibels(name, values[name]) - to_decibels(name, goal) for name, goal in wanted.items())

    def margin_of(self, attempt: Attempt) -> float:
        return self.margin({name: attempt.measured(name) for name in self.measures})

    def forecasts(self) -> dict[int, dict[str, Forecast]]:
        """Return primitives -> measure -> forecast of a full run with the current settings."""
        by_name = {name: self._forecast(name) for name in self.measures}
        counts = next(iter(by_name.values())).keys()
        return {count: {name: by_name[name][count] for name in self.measures} for count in sorted(counts)}

    def _forecast(self, name: str) -> dict[int, Forecast]:
        lengths: dict[int, dict[int, float]] = {}
        for attempt in self._relevant("size", "knob"):
            steps = int(attempt.measured("steps"))
            lengths.setdefault(attempt.count, {})[steps] = self._with_current_settings(name, attempt)
        gains = []
        for values in lengths.values():
            if len(values) > 1:
                a, b = sorted(values)[-2:]
                gains.append((values[b] - values[a]) / math.log2(b / a))
        mean = sum(gains) / len(gains) if gains else FIRST_GAIN
        forecasts = {}
        for n, values in lengths.items():
            doublings = max(math.log2(max(values) / max(self.record.length, 1)), 0.0)
            forecasts[n] = forecast_quality(values, self.steps(n), mean * STEP_RATIO**doublings)
        full = {a.count: self._with_current_settings(name, a) for a in self._relevant("full")}
        if full and forecasts:  # full runs show how much all forecasts are off
            curve = Curve.fit([(n, f.value) for n, f in forecasts.items()])
            miss = sum(value - curve.at(n) for n, value in full.items()) / len(full)
            forecasts = {n: Forecast(f.value + miss, 2 * ALLOWANCE) for n, f in forecasts.items()}
        return forecasts | {n: Forecast(value, ALLOWANCE) for n, value in full.items()}

    def _relevant(self, *purposes: Purpose) -> list[Attempt]:
        """Return trainings with the current settings, or with earlier values of the settings changed since."""
        history = self.record.history
        finished = self.record.finished(*purposes)
        return [a for a in finished if all(value in history(key) for key, value in a.words.items())]

    def _changes_since(self, attempt: Attempt) -> list[SettingChange]:
        changes = []
        for turn in self.record.turns:
            values = self.record.history(turn.key)
            if turn.adopted and values.index(attempt.words.get(turn.key, values[0])) < values.index(turn.after):
                changes.append(turn)
        return changes

    def _with_current_settings(self, name: str, attempt: Attempt) -> float:
        loss = sum(turn.loss.get(name, 0.0) for turn in self._changes_since(attempt))
        return to_decibels(name, attempt.measured(name)) - loss

    def margins(self) -> list[tuple[int, float]]:
        """Return (primitives, margin) of every size.

        A size that is only forecast is no worse than a smaller full run and no better than a larger one. Between a full
        run that is too small and one that is large enough, only full runs count.
        """
        known = {a.count for a in self._relevant("full")}
        margins = {n: self._margin(values) for n, values in self.forecasts().items()}
        full = {n: margin for n, margin in margins.items() if n in known}
        for n in margins.keys() - full.keys():
            least = max((m for count, m in full.items() if count < n), default=margins[n])
            most = min((m for count, m in full.items() if count > n), default=max(margins[n], least))
            margins[n] = min(max(margins[n], least), max(most, least))
        too_small = max((n for n, margin in full.items() if margin < ALLOWANCE), default=None)
        enough = min((n for n, margin in full.items() if margin >= ALLOWANCE), default=None)
        if too_small is None or enough is None:
            return sorted(margins.items())
        low, high = sorted((too_small, enough))
        return [(n, margin) for n, margin in sorted(margins.items()) if n in full or not low < n < high]

    def _margin(self, values: Mapping[str, Forecast]) -> float:
        return self.margin({name: from_decibels(name, f.value) for name, f in values.items()})

    @property
    def doubt(self) -> float:
        """dB by which a margin may be wrong, at the size that is known best."""
        return min((max(f.doubt for f in values.values()) for values in self.forecasts().values()), default=1.0)

    def predict(self, primitives: int) -> dict[str, list[float]]:
        """Return measure -> [value, doubt in dB] of a full run."""
        forecasts = self.forecasts()
        nearest = min(forecasts, key=lambda n: abs(math.log2(n / primitives)))
        predicted = {}
        for name in self.measures:
            curve = Curve.fit([(n, values[name].value) for n, values in forecasts.items()])
            predicted[name] = [from_decibels(name, curve.at(primitives)), forecasts[nearest][name].doubt]
        return predicted

    def limit(self) -> int | None:
        """Return the primitives that the limits of bytes and speed allow; None without limits or trials."""
        trials = [a for a in self._relevant("size", "full") if a.packed]
        limits = []
        if self.target.megabytes is not None and trials:
            sizes = [(a.count, a.packed * math.prod(t.size for t in self._changes_since(a))) for a in trials]
            limits.append(_largest_count(sizes, _FULL_FILE * 1e6 * self.target.megabytes))
        if self.target.fps is not None and trials:
            times = [(a.count, a.measured("ms_per_frame")) for a in trials]
            limits.append(_largest_count(times, 1e3 / self.target.fps))
        return max(int(min(limits)), 1) if limits else None


def _largest_count(known: Sequence[tuple[int, float]], allowed: float) -> float:
    """Return the largest number of primitives whose bytes, or time, are allowed."""
    low, high = 1.0, 1e8
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if fit_line(known, middle) <= allowed else (low, middle)
    return low


def format_forecast(name: str, value: float, doubt: float) -> str:
    """Format a predicted measure, with its doubt (dB) in the measure's unit."""
    if name == "psnr":
        return f"{name} {value:.2f} ± {doubt:.2g} dB"
    low, high = (from_decibels(name, to_decibels(name, value) + sign * doubt) for sign in (-1, 1))
    return f"{name} {value:.4f} ± {(high - low) / 2:.2g}"


def exceeded_limit(target: Target, attempt: Attempt, packed: int | None = None) -> str | None:
    """Return which limit of a target a model exceeds; None if none."""
    size = attempt.packed if packed is None else packed
    if target.megabytes is not None and size > 1e6 * target.megabytes:
        return f"{size / 1e6:.3f} MB are more than target.megabytes={target.megabytes:g}"
    speed = 1e3 / attempt.measured("ms_per_frame")
    if target.fps is not None and speed < 0.9 * target.fps:
        return f"{speed:.1f} frames per second are fewer than target.fps={target.fps:g}"
    return None
