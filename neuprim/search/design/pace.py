"""How long a training step of a model takes, as a multiple of the centre's: a few of each in turns, so that both meet
the same noise."""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from neuprim.config import RunConfig
from neuprim.core.data import Dataset
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import prepare_training, use_one_torch_thread
from neuprim.runs.training import compile_for_run

__all__ = ["Pace", "Paces"]

_TURN, _ROUNDS, _MOST_ROUNDS = 4, 4, 20
"""Steps of a turn, and turns at least: together as many as the presets have between two looks at voxels; and at
most."""

_SECONDS = 0.4
"""Turns go on until steps of the centre have taken as long."""


@dataclass(frozen=True)
class Pace:
    """Of a variant.

    Attributes:
        ratios: seconds per step over the centre's beside it, of each round.
        ratio: of all rounds together.
        starting: seconds until the first step.
        like: what its fields and primitives are; equal ones are the same model.
    """

    ratios: tuple[float, ...]
    ratio: float
    starting: float
    like: tuple[Any, ...]


class Paces:
    """Measures variants against the centre.

    Steps are taken in the middle of the budget, where every band of colour is in use and images have their full size.

    Attributes:
        seconds: per step of the centre, the median of all its turns so far: what else the machine did for a moment does
        not shorten trainings. centre: its own pace.
        compiling: seconds that compiling kernels took, or finding them on disk.
    """

    def __init__(self, centre: RunConfig, dataset: Dataset) -> None:
        self._dataset, self.compiling = dataset, 0.0
        self._trainer, starting, like = self._ready(centre)
        self._turns: list[float] = []
        with use_one_torch_thread():
            _turn(self._trainer)
            while self._short(self._turns):
                self._turns.append(_turn(self._trainer))
        self.centre = Pace((1.0,) * len(self._turns), 1.0, starting, like)

    @property
    def seconds(self) -> float:
        return statistics.median(self._turns) / _TURN

    def of(self, config: RunConfig) -> Pace:
        """Raises what starting a training raises."""
        trainer, starting, like = self._ready(config)
        own, beside = list[float](), list[float]()
        with use_one_torch_thread():
            _turn(trainer)
            while self._short(beside):
                beside.append(_turn(self._trainer))
                own.append(_turn(trainer))
        self._turns += beside
        ratios = tuple(a / b for a, b in zip(own, beside, strict=True))
        return Pace(ratios, sum(own) / sum(beside), starting, like)

    @staticmethod
    def _short(turns: Sequence[float]) -> bool:
        """Whether more turns are needed."""
        return len(turns) < _ROUNDS or (sum(turns) < _SECONDS and len(turns) < _MOST_ROUNDS)

    def _ready(self, config: RunConfig) -> tuple[Trainer, float, tuple[Any, ...]]:
        begun = time.perf_counter()
        population = replace(config.train.population, grow_from=1.0)  # by the middle all have been born
        trainer = prepare_training(
            replace(config, train=replace(config.train, population=population)), dataset=self._dataset
        ).trainer
        started = time.perf_counter()
        compile_for_run(trainer)
        self.compiling += time.perf_counter() - started
        model, settings = trainer.model, trainer.settings
        trainer.step, trainer.elapsed = (settings.iterations or 0) // 2, (settings.max_seconds or 0.0) / 2
        like = (
            model.count,
            settings.population.grow_to,
            *(type(f).__name__ + repr(f.settings()) for f in (model.density, model.colour)),
        )
        return trainer, started - begun, like


def _turn(trainer: Trainer) -> float:
    begun = time.perf_counter()
    for _ in range(_TURN):
        trainer.train_step()
    return time.perf_counter() - begun
