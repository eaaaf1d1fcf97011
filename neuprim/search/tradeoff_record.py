"""Points of a trade-off, their Pareto fronts, combinations of single changes, and the record ``tradeoff.json``."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

from neuprim.core.io.files import read_json_record, write_json
from neuprim.core.metrics import metric_from_json, metric_to_json
from neuprim.core.validation import Range, validate_settings, validate_value

_FORMAT = 1

TRADEOFF_FILE, TRADEOFF_FOLDER = "tradeoff.json", "tradeoff"
"""Name of the record, and its folder in the directory of a finished run."""

REFERENCE, COMBINED = "reference", "combined"
"""Values of ``knob``: the point that others are compared with, and points that change several settings."""

_DIGITS = 2  # decimals of PSNR that count on a front

_DRAWN = ("knob", "words", "bytes", "ms", "ratios")
_TRAINED = (
    *("turned", "length", "primitives", "parameters_per_primitive", "steps", "seconds"),
    *("centre_ms", "run_dir"),
)
"""Fields of every point in the file, and additional fields of trained models."""

_Positive = Annotated[float, Range(above=0)]
T = TypeVar("T")


# ---------------------------------------------------------------- Pareto fronts


class Objectives(NamedTuple):
    """Cost of a point (less is better), quality (more is better), and the uncertainty of the cost."""

    cost: float
    quality: float
    doubt: float = 0.0


def pareto_front(points: Sequence[T], objectives: Callable[[T], Objectives]) -> list[T]:
    """Return the points on the Pareto front of cost and quality, best quality first.

    Measured costs of equal points differ by chance. A point must therefore be cheaper than the next better one by more
    than the sum of both uncertainties. A point of equal quality replaces an earlier point on the same condition.
    """
    known = [(o, p) for p in points if not math.isnan((o := objectives(p)).cost) and not math.isnan(o.quality)]
    front: list[tuple[Objectives, T]] = []
    for here, point in sorted(known, key=lambda pair: -pair[0].quality):
        if front:
            last = front[-1][0]
            if here.cost >= last.cost - (here.doubt + last.doubt):
                continue
            if here.quality == last.quality:
                front.pop()
        front.append((here, point))
    return [point for _, point in front]


class ParetoStep(NamedTuple):
    """A change of a single setting (``knob``): its override, its gain, and its loss.

    The gain is usually the log of the factor by which the cost (time or bytes) drops, and the loss is PSNR in dB.
    """

    knob: str
    override: str
    gain: float
    loss: float


def chain_pareto_steps(steps: Sequence[ParetoStep], min_gain: float = 0.01) -> list[tuple[str, ...]]:
    """Return combinations of overrides that are expected on the Pareto front: two or more settings, one override each.

    Gains and losses are assumed to add up; the combinations are measured later. Each combination extends the previous
    one by the step with the least loss per gain, among the steps that gain more than ``min_gain``. A step changes one
    more setting, or changes a setting further.
    """
    state: dict[str, ParetoStep] = {}
    chain: list[tuple[str, ...]] = []
    while True:
        options = []
        for step in steps:
            now = state.get(step.knob, ParetoStep(step.knob, "", 0.0, 0.0))
            if (gain := step.gain - now.gain) > min_gain:
                options.append((max(step.loss - now.loss, 0.0) / gain, -gain, step.override, step))
        if not options:
            return chain
        best = min(options)[3]
        state[best.knob] = best
        if len(state) > 1:
            chain.append(tuple(step.override for step in state.values()))


def combine_pareto_steps(
    directions: Sequence[Sequence[ParetoStep]], known: Sequence[Sequence[str]], most: int
) -> list[tuple[str, ...]]:
    """Return at most ``most`` new combinations of overrides, i.e. none of ``known``.

    A direction is a list of steps with one goal, e.g. fewer bytes. For each direction, :func:`chain_pareto_steps` makes
    a chain of combinations. The returned combinations are evenly spread along all chains.
    """
    taken = {frozenset(overrides) for overrides in known}
    chains = [[way for way in chain_pareto_steps(steps) if frozenset(way) not in taken] for steps in directions]
    chosen: dict[frozenset[str], tuple[str, ...]] = {}
    for rung in zip_longest(*(thin_pareto_chain(chain, most) for chain in chains)):
        for way in filter(None, rung):
            chosen.setdefault(frozenset(way), way)
    return list(chosen.values())[: max(most, 0)]


def thin_pareto_chain(items: Sequence[T], most: int) -> list[T]:
    """Return at most ``most`` items, evenly spread."""
    if len(items) <= most or most < 1:
        return list(items[: max(most, 0)])
    if most == 1:
        return [items[len(items) // 2]]
    return [items[round(i * (len(items) - 1) / (most - 1))] for i in range(most)]


# ---------------------------------------------------------------- points


@dataclass
class TradeoffPoint:
    """A measured point of a trade-off: a render configuration of a finished model, or a trained model.

    Attributes:
        knob: the setting that the point changes, or :data:`REFERENCE` or :data:`COMBINED`.
        words: overrides that reproduce the point.
        quality: psnr, ssim, ssim_3dgs; lpips and lpips_3dgs if there are weights.
        bytes: size of the model file.
        ms: mean milliseconds per frame in each round.
        ratios: frame time divided by the reference's in each round.
        turned, length: for a trained model, overrides added to the centre's overrides (the centre has the user's
            settings), and fraction of the full training length.
        centre_ms: median milliseconds per frame of the centre over all rounds.
        run_dir: run directory, relative to the record's folder; empty unless trained.
    """

    knob: str
    words: tuple[str, ...]
    quality: dict[str, float]
    bytes: int
    ms: list[_Positive] = field(default_factory=list)
    ratios: list[_Positive] = field(default_factory=list)
    turned: tuple[str, ...] = ()
    length: float = 1.0
    primitives: int = 0
    parameters_per_primitive: int = 0
    steps: int = 0
    seconds: float = 0.0
    centre_ms: float = 0.0
    run_dir: str = ""

    @property
    def name(self) -> str:
        if self.run_dir:
            return name_variant(self.turned, self.length)
        return " ".join(word.removeprefix("renderer.") for word in self.words) or "as the run draws"

    @property
    def ratio(self) -> float:
        """Median over rounds of the frame time divided by the reference's frame time."""
        return statistics.median(self.ratios) if self.ratios else float("nan")

    @property
    def time(self) -> float:
        """Milliseconds per frame. For trained models: ``ratio * centre_ms``, because the load varies between rounds."""
        if self.centre_ms:
            return self.ratio * self.centre_ms
        return statistics.median(self.ms) if self.ms else float("nan")

    @property
    def ms_per_step(self) -> float:
        return 1e3 * self.seconds / max(self.steps, 1)

    @property
    def spread(self) -> float | None:
        """Half of the interquartile range of the ratios over rounds; None for fewer than three rounds."""
        if len(self.ratios) < 3:
            return None
        low, _, high = statistics.quantiles(self.ratios, n=4, method="inclusive")
        return (high - low) / 2

    @property
    def doubt(self) -> float:
        """Uncertainty of :attr:`ratio`, by McGill's notched box plots; the ratio itself for fewer than three rounds."""
        if self.spread is None:
            return self.ratio if self.ratios else 0.0
        return 3.14 * self.spread / len(self.ratios) ** 0.5

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values, with derived times for readers of the file."""
        fields = asdict(self)
        quality = {
            key: entry for name, value in self.quality.items() for key, entry in metric_to_json(name, value).items()
        }
        data = {"name": self.name, "quality": quality, **{name: fields[name] for name in _DRAWN}}
        if self.run_dir:
            data |= {name: fields[name] for name in _TRAINED} | {"ms_per_step": self.ms_per_step}
        if self.ms:
            data |= {"ms_per_frame": self.time, "frames_per_second": 1e3 / self.time, "time_ratio": self.ratio}
            data |= {"time_ratio_spread": self.spread, "time_ratio_doubt": self.doubt}
        return data

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> TradeoffPoint:
        """Invert :meth:`to_dict`; raises KeyError, TypeError, ValueError or ConfigError for invalid values."""
        names = [name.removesuffix("_infinite") for name in data["quality"]]
        quality = {name: value for name in names if (value := metric_from_json(data["quality"], name)) is not None}
        own = {name: data[name] for name in (*_DRAWN, *(_TRAINED if data.get("run_dir") else ()))}
        return replace(validate_settings(cls, {**own, "quality": {}}, "points"), quality=quality)


def name_variant(turned: Sequence[str], length: float) -> str:
    """Return a readable name of a trained model, made of its changed settings and training length."""
    words = [word.removeprefix("model.") for word in turned]
    return " ".join([*words, *([f"{length:g} of the length"] if length != 1.0 else [])]) or "centre"


@dataclass(frozen=True)
class LeftOutPoint:
    """A point of a trade-off that was not measured, and the reason."""

    knob: str
    words: tuple[str, ...]
    reason: str


@dataclass
class TradeoffRecord:
    """Content of ``tradeoff.json``.

    Attributes:
        same: facts that must be equal to reuse points: model or configuration, settings, views, versions, machine.
        facts: further facts for readers: the run, its data.
        points: measured points, the reference first.
        speed, size: indices of the points on the Pareto fronts of PSNR against time and against bytes, best quality
            first.
    """

    same: dict[str, Any]
    facts: dict[str, Any] = field(default_factory=dict)
    points: list[TradeoffPoint] = field(default_factory=list)
    left_out: list[LeftOutPoint] = field(default_factory=list)
    speed: list[int] = field(default_factory=list)
    size: list[int] = field(default_factory=list)

    def changes(self, same: Mapping[str, Any]) -> list[str]:
        """Return the names of facts in the record that differ from those in ``same``."""
        return [name for name in same if self.same.get(name) != same[name]]

    def leave_out(self, knob: str, words: Sequence[str], reason: str) -> None:
        """Note why the setting ``knob`` with the overrides ``words`` is not measured, in place of an earlier note."""
        words = tuple(words)
        others = [one for one in self.left_out if (one.knob, one.words) != (knob, words)]
        self.left_out = [*others, LeftOutPoint(knob, words, reason)]

    def find_fronts(self, in_size: Callable[[TradeoffPoint], bool] = lambda point: True) -> None:
        """Set :attr:`speed` and :attr:`size`, the Pareto fronts of PSNR against frame time and against bytes.

        The front of bytes only uses points for which ``in_size`` is true.
        """
        costs = [
            (Objectives(p.ratio, psnr := round(p.quality["psnr"], _DIGITS), p.doubt), Objectives(float(p.bytes), psnr))
            for p in self.points
        ]
        timed = [i for i, point in enumerate(self.points) if point.ratios]
        self.speed = pareto_front(timed, lambda i: costs[i][0])
        self.size = pareto_front([i for i, p in enumerate(self.points) if in_size(p)], lambda i: costs[i][1])

    def to_dict(self) -> dict[str, Any]:
        """Return JSON-ready values."""
        return {
            "format": _FORMAT,
            "same": self.same,
            **self.facts,
            "points": [point.to_dict() for point in self.points],
            "left_out": [asdict(one) for one in self.left_out],
            "front": {"speed": self.speed, "size": self.size},
        }

    def write(self, path: Path) -> None:
        write_json(path, self.to_dict())


def read_tradeoff_record(path: Path) -> TradeoffRecord | None:
    """Read ``tradeoff.json``; None if it does not exist.

    Raises:
        DataError: the file is damaged.
    """

    def parse(data: Mapping[str, Any]) -> TradeoffRecord:
        points = [TradeoffPoint.from_dict(entry) for entry in data["points"]]
        left_out = [validate_settings(LeftOutPoint, entry, "left_out") for entry in data["left_out"]]
        speed, size = (validate_value(data["front"][name], list[int], f"front.{name}") for name in ("speed", "size"))
        if not points or not all(0 <= number < len(points) for number in (*speed, *size)):
            raise ValueError(f"front: expected point numbers below {len(points)}")
        known = ("format", "same", "points", "left_out", "front")
        facts = {key: value for key, value in data.items() if key not in known}
        return TradeoffRecord(dict(data["same"]), facts, points, left_out, speed, size)

    return read_json_record(path, "a record of `neuprim tradeoff`", "delete it to measure anew", _FORMAT, parse)
