"""What the trials of a search say together: the margin of every size that was tried, had it a full run."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from neuprim.config.target import Target
from neuprim.search.target.pace import linear
from neuprim.search.target.prediction import FIRST_GAIN, RATIO, Forecast, decibels, forecast, undecibels
from neuprim.search.target.record import Attempt, Purpose, Record, Turn
from neuprim.search.target.search import Curve

__all__ = ["Judge"]

ALLOWANCE = 0.1
"""dB above the target that a full run aims at: what storing the model in few bits costs."""

ROOM = ALLOWANCE / 2
"""dB above the target without which a full run leaves no room for few bits."""

_ALIKE = 0.7
"""For each doubling of the primitives between two sizes, the share of what one turned out otherwise by that is expected
of the other."""

_FULL_FILE = 0.97
"""Of the bytes allowed, those that are planned with."""


@dataclass(frozen=True)
class Judge:
    """The record, read with a target in mind.

    Attributes:
        steps: primitives -> steps of a full run with so many.
    """

    target: Target
    record: Record
    steps: Callable[[int], float]

    @property
    def measures(self) -> tuple[str, ...]:
        """What is forecast: the target's measures of quality, else PSNR."""
        return tuple(self.target.quality) or ("psnr",)

    def margin(self, values: Mapping[str, float]) -> float:
        """dB by which the least of the measures is above the target; without measures of quality the PSNR itself."""
        wanted = self.target.quality
        if not wanted:
            return values["psnr"]
        return min(decibels(name, values[name]) - decibels(name, goal) for name, goal in wanted.items())

    def forecasts(self) -> dict[int, dict[str, Forecast]]:
        """Primitives -> measure -> what a full run would have, with the settings that were turned, on the scale of
        decibels.

        Counts that were tried longer are known better; by how much these turned out otherwise than their short trials
        had promised, all others are moved.
        """
        found = {name: self._of(name) for name in self.measures}
        counts = next(iter(found.values())).keys()
        return {count: {name: found[name][count] for name in self.measures} for count in sorted(counts)}

    def _of(self, name: str) -> dict[int, Forecast]:
        lengths = self._lengths(name)
        full = {a.count: a for a in self._done("full")}
        gains = [f for values in lengths.values() if (f := _gain(values)) is not None]
        mean = sum(gains) / len(gains) if gains else FIRST_GAIN

        def gain(steps: int) -> float:
            return mean * RATIO ** max(math.log2(steps / max(self.record.length, 1)), 0.0)

        def told(n: int, values: Mapping[int, float]) -> Forecast:
            return forecast(values, self.steps(n), gain(max(values)))

        length = self.record.length
        best = {n: told(n, values) for n, values in lengths.items()}
        short = {
            n: told(n, {s: v for s, v in values.items() if s <= length} or values) for n, values in lengths.items()
        }
        moved = {
            n: best[n].value - short[n].value for n, values in lengths.items() if min(values) <= length < max(values)
        }
        made = {}
        for n, values in lengths.items():
            longer = max(values) > self.record.length
            doubt = (
                best[n].doubt if longer or not moved else max(short[n].doubt / 2, min(f.doubt for f in best.values()))
            )
            made[n] = best[n] if longer else Forecast(short[n].value + _shift(moved, n), doubt)
        curve = Curve.through([(n, f.value) for n, f in made.items()]) if made else None
        misses = [self._now(name, a) - curve.at(a.count) for a in full.values()] if curve is not None else []
        if misses:  # full runs tell what the trials' forecasts are worth
            made = {n: Forecast(f.value + sum(misses) / len(misses), 2 * ALLOWANCE) for n, f in made.items()}
        return made | {n: Forecast(self._now(name, a), ALLOWANCE) for n, a in full.items()}

    def _lengths(self, name: str) -> dict[int, dict[int, float]]:
        """Primitives -> steps -> quality of the trials."""
        found: dict[int, dict[int, float]] = {}
        for attempt in self._done("size", "knob", "longer"):
            found.setdefault(attempt.count, {})[int(attempt.outcome["steps"])] = self._now(name, attempt)  # type: ignore[index]
        return found

    def _done(self, *purposes: Purpose) -> list[Attempt]:
        """Trainings that tell something about the settings of now: made with these, or with others that were turned to
        them since."""
        return [
            a
            for a in self.record.done(*purposes)
            if all(value in self.record.way(key) for key, value in a.words.items())
        ]

    def _now(self, name: str, attempt: Attempt) -> float:
        """What a training would have had with the settings of now."""
        return decibels(name, attempt.quality(name)) - sum(
            turn.loss.get(name, 0.0) for turn in self._turned_since(attempt)
        )

    def _turned_since(self, attempt: Attempt) -> list[Turn]:
        def own(turn: Turn) -> bool:
            way = self.record.way(turn.key)
            return way.index(attempt.words.get(turn.key, way[0])) >= way.index(turn.after)

        return [turn for turn in self.record.turns if turn.adopted and not own(turn)]

    def curve(self) -> Curve:
        """Margins over sizes."""
        return Curve.through(self.tried())

    def tried(self) -> list[tuple[int, float]]:
        """(primitives, margin) of every size; of those between two full runs, one too small and one large enough, these
        two alone. A size that is only forecast is no worse than a full run of a smaller one, and no better than one of
        a larger."""
        found = [(n, self._margin(values)) for n, values in self.forecasts().items()]
        full = {a.count for a in self._done("full")}
        known = [(n, margin) for n, margin in found if n in full]

        def held(n: int, margin: float) -> float:
            least = max((m for count, m in known if count < n), default=margin)
            most = min((m for count, m in known if count > n), default=max(margin, least))
            return margin if n in full else min(max(margin, least), max(most, least))

        found = [(n, held(n, margin)) for n, margin in found]
        low = max((n for n, margin in found if n in full and margin < ALLOWANCE), default=None)
        high = min((n for n, margin in found if n in full and margin >= ALLOWANCE), default=None)
        if low is None or high is None:
            return found
        return [(n, margin) for n, margin in found if n in full or not min(low, high) < n < max(low, high)]

    def _margin(self, values: Mapping[str, Forecast]) -> float:
        return self.margin({name: undecibels(name, f.value) for name, f in values.items()})

    @property
    def doubt(self) -> float:
        """dB by which a margin may be wrong, at the size that is known best."""
        found = [max(f.doubt for f in values.values()) for values in self.forecasts().values()]
        return min(found, default=1.0)

    def predicted(self, primitives: int) -> dict[str, list[float]]:
        """Measure -> [value, doubt] of a full run; values as measured, doubts in dB of :func:`decibels`."""
        known = self.forecasts()
        made = {}
        for name in self.measures:
            curve = Curve.through([(n, values[name].value) for n, values in known.items()])
            near = min(known, key=lambda n: abs(math.log2(n / primitives)))
            made[name] = [undecibels(name, curve.at(primitives)), known[near][name].doubt]
        return made

    # ------------------------------------------------------------ limits

    def most(self) -> int | None:
        """Primitives that the target's limits allow; None without limits, or before a trial."""
        limits = []
        tried = [a for a in self._done("size", "longer", "full") if a.packed]
        if self.target.megabytes is not None and tried:
            limits.append(_largest(self._sizes(tried), _FULL_FILE * 1e6 * self.target.megabytes))
        if self.target.fps is not None and tried:
            limits.append(_largest([(a.count, a.quality("ms_per_frame")) for a in tried], 1e3 / self.target.fps))
        return max(int(min(limits)), 1) if limits else None

    def _sizes(self, tried: Sequence[Attempt]) -> list[tuple[int, float]]:
        """(primitives, bytes of the compressed model), with the settings of now."""
        found = []
        for attempt in tried:
            size = float(attempt.packed)
            for turn in self._turned_since(attempt):
                size *= turn.size
            found.append((attempt.count, size))
        return found


def _shift(moved: Mapping[int, float], primitives: int) -> float:
    """What longer trials say of a size's forecast, the nearest of them: less of a size far from it, as few primitives
    are sooner as good as they can be."""
    if not moved:
        return 0.0
    near = min(moved, key=lambda n: abs(math.log2(n / primitives)))
    return moved[near] * _ALIKE ** abs(math.log2(near / primitives))


def _largest(known: Sequence[tuple[int, float]], allowed: float) -> float:
    """The largest number of primitives whose bytes, or time, are allowed."""
    low, high = 1.0, 1e8
    for _ in range(60):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if linear(known, middle) <= allowed else (low, middle)
    return low


def _gain(values: Mapping[int, float]) -> float | None:
    tried = sorted(values)
    return None if len(tried) < 2 else (values[tried[-1]] - values[tried[-2]]) / math.log2(tried[-1] / tried[-2])
