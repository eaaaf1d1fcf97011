"""Target searches of simulated trainings: quality and bytes from a grid of measured full runs, time from a formula."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import pytest

from neuprim.config.command_settings import SearchTarget
from neuprim.core.train.settings import ModelSettings
from neuprim.search import size_search
from neuprim.search.size_forecast import SizePredictor
from neuprim.search.size_search import SizeSearch
from neuprim.search.target import choose_full_run
from neuprim.search.target_record import Attempt, TargetRecord, TrialRunner

__all__ = ["Curves", "SimulatedRunner", "attempt", "from_grid", "interpolate", "simulate_search"]


def attempt(count: int, steps: int, psnr: float, purpose: Any = "size", **more: Any) -> Attempt:
    """Return a finished training that nobody made."""
    outcome = {
        "psnr": psnr,
        "ssim": 0.9,
        "primitives": count,
        "steps": steps,
        "bytes": 1,
        "pace": 0.01,
        "ms_per_frame": 10.0,
    }
    words = more.pop("words", {})
    return Attempt(purpose, words, count, steps, outcome={**outcome, **more}, packed=1000 + 20 * count)


def interpolate(known: Sequence[tuple[float, float]], x: float) -> float:
    """Interpolate linearly between sorted points, and extrapolate beyond them."""
    i = min(max(sum(place <= x for place, _ in known), 1), len(known) - 1)
    (a, at_a), (b, at_b) = known[i - 1], known[i]
    return at_a + (at_b - at_a) * (x - a) / (b - a)


@dataclass(frozen=True)
class Curves:
    """PSNR and log bytes over log2 of the primitives, of full runs with one set of settings."""

    psnr: list[tuple[float, float]]
    log_bytes: list[tuple[float, float]]


def from_grid(grid: Sequence[Mapping[str, Any]]) -> dict[str, Curves]:
    """Return setting override ("" for none) -> its curves."""
    curves = {}
    for less in dict.fromkeys(one["less"] for one in grid):
        own = sorted((one for one in grid if one["less"] == less), key=lambda one: one["primitives"])
        places = [math.log2(one["primitives"]) for one in own]
        sizes = [math.log(one["bytes"]) for one in own]
        curves[less] = Curves(
            list(zip(places, (one["psnr"] for one in own), strict=True)), list(zip(places, sizes, strict=True))
        )
    return curves


@dataclass
class SimulatedRunner(TrialRunner):
    """Trainings that take no time: the clock moves by their steps.

    Attributes:
        curves: of full runs.
        full: steps of a full run.
        gain: dB of the last doubling of the steps; every doubling before gained a third more.
        seed: of the noise between trainings, 0.1 dB.
    """

    curves: dict[str, Curves] = field(default_factory=dict)
    full: int = 3000
    gain: float = 0.7
    seed: int = 0
    now: float = 0.0
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clock = lambda: self.now

    def write_record(self) -> None:
        self.record.spent = self.seconds_spent

    def notify(self, text: str) -> None:
        self.notes.append(text)

    def _train(self, attempt: Attempt) -> None:
        place, steps = math.log2(attempt.primitives), max(attempt.steps, 1)
        words = "".join(f"{key}={value}" for key, value in attempt.words.items())
        curves = self.curves[words]
        missing, doublings, gain = 0.0, math.log2(self.full / steps), self.gain
        while doublings > 0:
            missing, doublings, gain = missing + gain * min(doublings, 1.0), doublings - 1, gain / 0.75
        noise = 0.1 * math.sin(12.9898 * attempt.primitives + 78.233 * (self.seed + 1) + steps)
        psnr = interpolate(curves.psnr, place) - missing + noise
        pace = 1e-3 + 1e-6 * attempt.primitives
        attempt.seconds = pace * steps + 0.1
        self.now += attempt.seconds
        counts = {"primitives": attempt.primitives, "steps": steps, "bytes": 1, "ms_per_frame": 1.0}
        attempt.outcome = {"psnr": psnr, "ssim": 0.9, "pace": pace, **counts}
        attempt.packed = round(math.exp(interpolate(curves.log_bytes, place)))


def simulate_search(
    curves: dict[str, Curves], target: SearchTarget, start: int, seed: int = 0, more: Callable[..., Any] | None = None
) -> tuple[Attempt, SimulatedRunner]:
    """Search with simulated trainings; returns the chosen full run."""
    train = SimpleNamespace(iterations=3000)
    config: Any = SimpleNamespace(model=ModelSettings(primitives=start), train=train, task="static")
    dataset: Any = SimpleNamespace(train=range(64), test=range(16))
    record = TargetRecord({**target.given_settings(), "budget": 60.0}, {}, hold_out=8)
    runner = SimulatedRunner(config, dataset, record, lambda event: None, curves=curves, seed=seed)
    ladder = {}
    for word in curves:
        if word:
            key, _, value = word.partition("=")
            ladder[key] = (int(value) if value.isdigit() else value, "usual")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(size_search, "load_config_task", lambda config: None)
        patch.setattr(size_search, "list_smaller_settings", lambda *args: ladder)
        search = SizeSearch(config, target, dataset, record, runner)
        search.run()
    predictor: SizePredictor = search.predictor
    return choose_full_run(predictor), runner
