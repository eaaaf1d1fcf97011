"""How long a training step of a model takes, as a multiple of the centre's: a few of each in turns, so that both meet the same noise."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from neuprim.config import RunConfig
from neuprim.core.data import Dataset
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import one_torch_thread, start
from neuprim.runs.training import make_ready

__all__ = ["Pace", "Paces"]

_ROUNDS, _TURN = 4, 4
"""Turns of so many steps: together as many as the presets have between two looks at voxels."""


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
        seconds: per step of the centre, the mean of all its steps so far.
        centre: its own pace.
        compiling: seconds that compiling kernels took, or finding them on disk.
    """

    def __init__(self, centre: RunConfig, dataset: Dataset) -> None:
        self._dataset, self.compiling = dataset, 0.0
        self._trainer, starting, like = self._ready(centre)
        self._took, self._steps = 0.0, 0
        with one_torch_thread():
            _turn(self._trainer)
            for _ in range(_ROUNDS):
                self._count(_turn(self._trainer))
        self.centre = Pace((1.0,) * _ROUNDS, 1.0, starting, like)

    @property
    def seconds(self) -> float:
        return self._took / self._steps

    def of(self, config: RunConfig) -> Pace:
        """Raises what starting a training raises."""
        trainer, starting, like = self._ready(config)
        own, beside = [], []
        with one_torch_thread():
            _turn(trainer)
            for _ in range(_ROUNDS):
                beside.append(_turn(self._trainer))
                own.append(_turn(trainer))
        for seconds in beside:
            self._count(seconds)
        ratios = tuple(a / b for a, b in zip(own, beside, strict=True))
        return Pace(ratios, sum(own) / sum(beside), starting, like)

    def _count(self, seconds: float) -> None:
        self._took, self._steps = self._took + seconds, self._steps + _TURN

    def _ready(self, config: RunConfig) -> tuple[Trainer, float, tuple[Any, ...]]:
        begun = time.perf_counter()
        trainer = start(config, dataset=self._dataset).trainer
        started = time.perf_counter()
        make_ready(trainer)
        self.compiling += time.perf_counter() - started
        model, settings = trainer.model, trainer.settings
        trainer.step, trainer.elapsed = (settings.iterations or 0) // 2, (settings.max_seconds or 0.0) / 2
        like = (model.count, settings.population.grow_to, *(type(f).__name__ + repr(f.settings()) for f in (model.density, model.colour)))
        return trainer, started - begun, like


def _turn(trainer: Trainer) -> float:
    begun = time.perf_counter()
    for _ in range(_TURN):
        trainer.train_step()
    return time.perf_counter() - begun
