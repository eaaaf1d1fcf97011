"""Predict quality, bytes and time of full runs from short trials, and propose the number of primitives to try next.

Each doubling of the training steps is assumed to gain a fixed fraction of the gain by the previous doubling. The same
holds for doublings of the number of primitives beyond the numbers tried. Predictions are off by about 0.6 dB over two
doublings, so full runs check them. A *margin* is the predicted quality minus the target, in dB.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

from neuprim.config.command_settings import SearchTarget
from neuprim.search.target_record import Attempt, Purpose, SettingChange, TargetRecord, forecast_time

ALLOWANCE, MIN_MARGIN = 0.1, 0.05
"""``ALLOWANCE``: margin that full runs aim at, dB. ``MIN_MARGIN``: least margin of a full run that is good enough, dB.
A margin is needed because quantization loses quality later."""

_FULL_FILE = 0.97  # share of the allowed bytes to plan with

_STEP_RATIO, _MIN_RATIO, _MAX_RATIO = 0.75, 0.5, 1.0
"""Gain in dB by a doubling of the training steps, divided by the gain of the previous doubling: usual, least and
largest value."""

_SIZE_RATIO = 0.65  # gain of a doubling of primitives over that of the doubling before, beyond the sizes tried
_FIRST_GAIN, _FIRST_SLOPE = 1.3, 1.0  # dB that a doubling of steps, and of primitives, gains where nothing is known
_SEED_NOISE = 0.1  # dB between two seeds of one configuration

_FURTHEST, _APART, _CLOSE = 3.0, 0.5, 0.3
"""Distances between numbers of primitives, in doublings. ``_FURTHEST``: largest distance from a tried number to the
next. ``_APART``: least distance of two numbers that give a slope. ``_CLOSE``: numbers this close count as equal."""


class Forecast(NamedTuple):
    """Predicted quality in dB (:func:`to_forecast_decibels`), and half the width of its uncertainty interval."""

    value: float
    doubt: float


def to_forecast_decibels(name: str, value: float) -> float:
    """Convert a quality measure to dB: PSNR is unchanged, SSIM becomes -10 log10(1 - ssim).

    On this scale, equal gains need about equal effort.
    """
    return value if name == "psnr" else -10 * math.log10(max(1.0 - value, 1e-6))


def from_forecast_decibels(name: str, value: float) -> float:
    """Convert decibels to the measure ``name``, PSNR or SSIM; inverse of :func:`to_forecast_decibels`."""
    return value if name == "psnr" else 1.0 - 10 ** (-value / 10)


def forecast_quality(lengths: Mapping[int, float], steps: float, gain: float = _FIRST_GAIN) -> Forecast:
    """Predict the quality after ``steps`` from trials of one configuration.

    Args:
        lengths: training steps of a trial -> quality of this trial, dB.
        gain: assumed gain of the last doubling of steps, dB; used if there is only one trial.
    """
    tried = sorted(lengths)
    gains = [(lengths[b] - lengths[a]) / math.log2(b / a) for a, b in pairwise(tried)]
    last, longest = max(gains[-1] if gains else gain, 0.0), tried[-1]
    doublings = math.log2(max(steps / longest, 1e-6))
    if doublings <= 0:
        return Forecast(lengths[longest] + last * max(doublings, -1.0), _SEED_NOISE)
    ratio = _STEP_RATIO
    if len(gains) > 1 and gains[-2] > _SEED_NOISE:
        ratio = min(max((_STEP_RATIO + gains[-1] / gains[-2]) / 2, _MIN_RATIO), _MAX_RATIO)
    low, middle, high = (_sum_forecast_gains(last, r, doublings) for r in (_MIN_RATIO, ratio, _MAX_RATIO))
    return Forecast(lengths[longest] + middle, _SEED_NOISE + (high - low) / 2)


def _sum_forecast_gains(gain: float, ratio: float, doublings: float) -> float:
    """Return the gain of the next ``doublings``, if each gains ``ratio`` times as much as the previous one.

    ``gain`` is the gain of the last doubling. The result is gain * (ratio + ratio^2 + ...) with ``doublings`` terms.
    The closed form of the sum also allows a fractional number.
    """
    return gain * doublings if ratio == 1 else gain * ratio * (1 - ratio**doublings) / (1 - ratio)


def _bisect_count(low: float, high: float, is_low: Callable[[float], bool]) -> tuple[float, float]:
    """Return two close numbers of primitives: ``is_low`` is true for the first and false for the second.

    The numbers are found by bisection between ``low`` and ``high`` on a logarithmic scale.
    """
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if is_low(middle) else (low, middle)
    return low, high


@dataclass(frozen=True)
class SizeCurve:
    """Non-decreasing curve of the margin (predicted quality minus target, dB) over log2 of the number of primitives.

    ``nodes`` are the curve's points (log2 of the number, margin), in ascending order.
    """

    nodes: tuple[tuple[float, float], ...]

    @classmethod
    def fit(cls, tried: Sequence[tuple[int, float]]) -> SizeCurve:
        """Fit a curve to (primitives, margin) pairs. Neighbours get their mean margin where margins would fall."""
        blocks: list[tuple[list[float], float]] = []
        for count, margin in sorted(tried):
            blocks.append(([math.log2(count)], margin))
            while len(blocks) > 1 and blocks[-2][1] >= blocks[-1][1]:
                (before, low), (after, high) = blocks[-2:]
                mean = (len(before) * low + len(after) * high) / (len(before) + len(after))
                blocks[-2:] = [(before + after, mean)]
        return cls(tuple((place, value) for places, value in blocks for place in places))

    def _end_slope(self, end: int) -> float:
        """Return the slope, dB per doubling of the primitives, at the first (0) or last (-1) node."""
        place, value = self.nodes[end]
        apart = [node for node in self.nodes if abs(node[0] - place) >= _APART / 2]
        if not apart:
            return _FIRST_SLOPE
        return max((value - apart[end][1]) / (place - apart[end][0]), 0.0)

    @property
    def slope(self) -> float:
        """Slope at the largest size, dB per doubling of the primitives."""
        return self._end_slope(-1)

    def at(self, primitives: float) -> float:
        """Return the margin for a number of primitives, dB."""
        place = math.log2(primitives)
        (first, low), (last, high) = self.nodes[0], self.nodes[-1]
        if place <= first:
            return low - self._end_slope(0) * (first - place)
        if place >= last:
            return high + _sum_forecast_gains(self.slope, _SIZE_RATIO, place - last)
        (a, at_a), (b, at_b) = next(pair for pair in pairwise(self.nodes) if place <= pair[1][0])
        return at_b if b == a else at_a + (at_b - at_a) * (place - a) / (b - a)

    def slope_at(self, primitives: float) -> float:
        """Return the slope around a number of primitives, dB per doubling."""
        return self.at(primitives * 2**_APART) - self.at(primitives / 2**_APART)

    def find_count(self, wanted: float, highest: int) -> int | None:
        """Return the least number of primitives with the margin ``wanted``; None if it would exceed ``highest``."""
        if self.at(1) >= wanted:
            return 1
        if self.at(max(highest, 1)) < wanted:
            return None
        return math.ceil(_bisect_count(1.0, highest, lambda count: self.at(count) < wanted)[1])


class SizeProposal(NamedTuple):
    """Next step of a search for the number of primitives.

    ``kind`` "try" asks for trials with ``primitives``. "take" means that ``primitives`` is the result. "unreachable"
    means that no number reaches the target; ``primitives`` comes closest.
    """

    kind: Literal["try", "take", "unreachable"]
    primitives: int


def propose_size(tried: Sequence[tuple[int, float]], highest: int, wanted: float, doubt: float) -> SizeProposal:
    """Return the next step of a search for the least number of primitives with the margin ``wanted``.

    Args:
        tried: a pair (primitives, margin) for each number tried, one or more.
        highest: limit on the number of primitives.
        doubt: uncertainty of margins, dB. A target is only unreachable if it is missed by more than ``doubt``.
    """
    curve, counts = SizeCurve.fit(tried), sorted({count for count, _ in tried})
    found = curve.find_count(wanted, highest)
    if found is None and len(counts) > 1:
        best = curve.at(highest)
        final = math.log2(highest / counts[-1]) <= _CLOSE or best + 2 * doubt + _FIRST_SLOPE < wanted
        if final and best + doubt < wanted:
            return SizeProposal("unreachable", min(counts[-1], highest))
        if final:
            return SizeProposal("take", highest)
    found = highest if found is None else found
    found = round(min(max(found, counts[0] / 2.0**_FURTHEST, 1), highest, 2.0**_FURTHEST * counts[-1]))
    if len(counts) == 1:
        return SizeProposal("try" if highest > 1 else "take", _move_from_tried_size(counts[0], found, highest))
    near = any(abs(math.log2(found / count)) <= _CLOSE for count in counts)
    return SizeProposal("take" if near else "try", found)


def _move_from_tried_size(tried: int, found: int, highest: int) -> int:
    """Return ``found``, moved away from the only tried number ``tried`` if both are too close to measure a slope."""
    step = math.log2(found / tried)
    if abs(step) < _APART:
        up, down = round(tried * 2**_APART), round(tried / 2**_APART)
        found = up if (step > 0 and up <= highest) or down < 1 else down
    return min(max(found, 1), highest)


def propose_best_size(tried: Sequence[tuple[int, float]], highest: int, worth: float = 0.1) -> SizeProposal:
    """Return the next step of a search for the best quality with at most ``highest`` primitives.

    Args:
        tried: a pair (primitives, margin) for each number tried, one or more.
        worth: least gain, in dB per doubling, that justifies more primitives.
    """
    curve, counts = SizeCurve.fit(tried), sorted({count for count, _ in tried})
    if highest < counts[0] / 2**_CLOSE:  # all sizes tried are above the limit
        return SizeProposal("try", max(highest, round(counts[0] / 2**_FURTHEST), 1))
    at_limit = counts[-1] >= highest / 2**_CLOSE
    further = min(highest, round(counts[-1] * 2**_FURTHEST / 2))
    if len(counts) == 1 and highest > 1:
        return SizeProposal("try", max(1, round(highest / 2)) if at_limit else further)
    if at_limit or curve.slope < worth:
        enough = None if curve.slope >= worth else curve.find_count(curve.nodes[-1][1] - worth, highest)
        return SizeProposal("take", highest if enough is None else enough)
    return SizeProposal("try", further)


# ---------------------------------------------------------------- from the record of a search


@dataclass(frozen=True)
class SizePredictor:
    """Predict margins (quality minus target, dB) of full runs from the record of a target search.

    Attributes:
        steps: function (number of primitives) -> training steps of a full run.
    """

    target: SearchTarget
    record: TargetRecord
    steps: Callable[[int], float]

    @property
    def measures(self) -> tuple[str, ...]:
        """Names of the quality measures that the target sets; ("psnr",) if it sets none."""
        return tuple(self.target.quality) or ("psnr",)

    def margin(self, values: Mapping[str, float]) -> float:
        """Return by how many dB the measured ``values`` exceed the target: the least over all quality measures.

        If the target sets no quality, return the PSNR.
        """
        wanted = self.target.quality
        if not wanted:
            return values["psnr"]
        return min(
            to_forecast_decibels(name, values[name]) - to_forecast_decibels(name, goal) for name, goal in wanted.items()
        )

    def margin_of(self, attempt: Attempt) -> float:
        """Return by how many dB a finished training exceeds the target."""
        return self.margin({name: attempt.measured(name) for name in self.measures})

    def forecasts(self) -> dict[int, dict[str, Forecast]]:
        """Return {number of primitives: {quality measure: prediction}}, for full runs with the current settings."""
        by_name = {name: self._forecast(name) for name in self.measures}
        return {
            count: {name: own[count] for name, own in by_name.items()} for count in sorted(by_name[self.measures[0]])
        }

    def _forecast(self, name: str) -> dict[int, Forecast]:
        """Return number of primitives -> predicted measure ``name``, dB, of a full run with the current settings."""
        lengths: dict[int, dict[int, float]] = {}
        for attempt in self._relevant("size", "knob"):
            steps = int(attempt.measured("steps"))
            lengths.setdefault(attempt.count, {})[steps] = self._with_current_settings(name, attempt)
        gains = []
        for values in lengths.values():
            if len(values) > 1:
                a, b = sorted(values)[-2:]
                gains.append((values[b] - values[a]) / math.log2(b / a))
        mean = sum(gains) / len(gains) if gains else _FIRST_GAIN
        forecasts = {}
        for n, values in lengths.items():
            doublings = max(math.log2(max(values) / max(self.record.length, 1)), 0.0)
            forecasts[n] = forecast_quality(values, self.steps(n), mean * _STEP_RATIO**doublings)
        full = {a.count: self._with_current_settings(name, a) for a in self._relevant("full")}
        if full and forecasts:  # full runs show how much all forecasts are off
            curve = SizeCurve.fit([(n, f.value) for n, f in forecasts.items()])
            miss = sum(value - curve.at(n) for n, value in full.items()) / len(full)
            forecasts = {n: Forecast(f.value + miss, 2 * ALLOWANCE) for n, f in forecasts.items()}
        return forecasts | {n: Forecast(value, ALLOWANCE) for n, value in full.items()}

    def _relevant(self, *purposes: Purpose) -> list[Attempt]:
        """Return the finished trainings of ``purposes``, except those with settings that the search never adopted."""
        history = self.record.history
        finished = self.record.finished(*purposes)
        return [a for a in finished if all(value in history(key) for key, value in a.words.items())]

    def _changes_since(self, attempt: Attempt) -> list[SettingChange]:
        """Return the changes of settings that the search has adopted, but that a training does not have."""
        changes = []
        for turn in self.record.turns:
            values = self.record.history(turn.key)
            if turn.adopted and values.index(attempt.words.get(turn.key, values[0])) < values.index(turn.after):
                changes.append(turn)
        return changes

    def _with_current_settings(self, name: str, attempt: Attempt) -> float:
        """Return a training's measure ``name``, dB, minus the losses by changes of settings that it does not have."""
        loss = sum(turn.loss.get(name, 0.0) for turn in self._changes_since(attempt))
        return to_forecast_decibels(name, attempt.measured(name)) - loss

    def margins(self) -> list[tuple[int, float]]:
        """Return a pair (primitives, margin in dB) for every number of primitives that was trained.

        The margin is the quality minus the target. Full runs (trainings of full length) have measured margins; shorter
        trials have forecasts. A forecast is clamped between the margins of the next smaller and larger full runs.
        Between a full run that misses the target and one that meets it, forecasts are left out.
        """
        margins = {
            n: self.margin({name: from_forecast_decibels(name, f.value) for name, f in values.items()})
            for n, values in self.forecasts().items()
        }
        known = {a.count for a in self._relevant("full")}
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

    @property
    def doubt(self) -> float:
        """Uncertainty of the predicted quality, dB, for the number of primitives with the most certain prediction."""
        return min((max(f.doubt for f in values.values()) for values in self.forecasts().values()), default=1.0)

    def predict(self, primitives: int) -> dict[str, list[float]]:
        """Predict a full run with this number of primitives: quality measure -> [value, uncertainty in dB]."""
        forecasts = self.forecasts()
        nearest = min(forecasts, key=lambda n: abs(math.log2(n / primitives)))
        predicted = {}
        for name in self.measures:
            curve = SizeCurve.fit([(n, values[name].value) for n, values in forecasts.items()])
            predicted[name] = [from_forecast_decibels(name, curve.at(primitives)), forecasts[nearest][name].doubt]
        return predicted

    def limit(self) -> int | None:
        """Return the most primitives within the limits of bytes and speed; None if there are no limits or trials."""
        trials = [a for a in self._relevant("size", "full") if a.packed]
        limits: list[tuple[list[tuple[int, float]], float]] = []
        if self.target.megabytes is not None:
            sizes = [(a.count, a.packed * math.prod(t.size for t in self._changes_since(a))) for a in trials]
            limits.append((sizes, _FULL_FILE * 1e6 * self.target.megabytes))
        if self.target.fps is not None:
            limits.append(([(a.count, a.measured("ms_per_frame")) for a in trials], 1e3 / self.target.fps))
        if not limits or not trials:
            return None
        most = [
            _bisect_count(1.0, 1e8, lambda n, known=known, allowed=allowed: forecast_time(known, n) <= allowed)[0]  # type: ignore[misc]
            for known, allowed in limits
        ]
        return max(int(min(most)), 1)


def format_target_forecast(name: str, value: float, doubt: float) -> str:
    """Format a predicted measure with its uncertainty, which is given in dB and printed in the measure's unit."""
    if name == "psnr":
        return f"{name} {value:.2f} ± {doubt:.2g} dB"
    low, high = (from_forecast_decibels(name, to_forecast_decibels(name, value) + sign * doubt) for sign in (-1, 1))
    return f"{name} {value:.4f} ± {(high - low) / 2:.2g}"


def exceeded_limit(target: SearchTarget, attempt: Attempt, packed: int | None = None) -> str | None:
    """Return a message that says which limit of a target a trained model exceeds; None if it exceeds none."""
    size = attempt.packed if packed is None else packed
    if target.megabytes is not None and size > 1e6 * target.megabytes:
        return f"{size / 1e6:.3f} MB are more than target.megabytes={target.megabytes:g}"
    speed = 1e3 / attempt.measured("ms_per_frame")
    if target.fps is not None and speed < 0.9 * target.fps:
        return f"{speed:.1f} frames per second are fewer than target.fps={target.fps:g}"
    return None
