"""Plan an ablation, i.e. trainings that each change one setting of the user's model (the *centre*).

The plan says which variants to train, how long to train each, and which changes to combine.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

from neuprim.config import RunConfig
from neuprim.config.overrides import parse_overrides, quote_override
from neuprim.core.data import Dataset
from neuprim.core.task import TaskSpec
from neuprim.core.train.settings import build_settings
from neuprim.core.train.trainer import Trainer
from neuprim.core.validation import Range
from neuprim.plugins.attribution import call_task_tunable_settings
from neuprim.runs.fit import compile_run_kernels, prepare_training, use_one_torch_thread_for_run
from neuprim.search.tradeoff_record import COMBINED, ParetoStep, TradeoffPoint, combine_pareto_steps, name_variant
from neuprim.search.trials import get_trial_setting

CENTRE = "centre"  # name of the model that others are compared with
LENGTH = "train.iterations"  # the knob whose values are shares of the full length

_COUNTS, _LENGTHS = (0.5, 2.0, 0.25, 4.0, 1 / 8, 1 / 16, 1 / 32, 1 / 64), (0.5, 0.25)
"""Factors by which variants change the number of primitives, and the training length, of the user's model."""

_MIN_LENGTH, _MIN_STEPS = 1 / 20, 100
"""Shortest training of the user's model in an ablation: a fraction of the configured steps, or a number of steps if the
configured budget is in seconds."""

_STEPS_PER_TURN, _TURNS = 4, 6  # step times: variant and centre alternate, so that load of the machine affects both


@dataclass(frozen=True)
class Variant:
    """A model to train in an ablation. ``knob`` is the name of the changed setting. ``turned`` has the overrides
    (``key=value``) that are added to the user's overrides. ``length`` is the training length as a fraction of the full
    length.
    """

    knob: str
    turned: tuple[str, ...] = ()
    length: float = 1.0

    @property
    def name(self) -> str:
        return name_variant(self.turned, self.length)

    @property
    def folder(self) -> str:
        text = re.sub(r"[^A-Za-z0-9._+-]+", "-", "_".join(self.name.split(" "))).strip("._-")
        return text[:80]

    @property
    def label(self) -> tuple[str, ...]:
        """Overrides and training length as texts. The record names variants that were not measured by these texts."""
        return (*self.turned, *((f"{self.length:g} of the length",) if self.length != 1.0 else ()))


def list_variants(centre: RunConfig, task: TaskSpec) -> dict[str, list[Variant]]:
    """Return a dict: setting name -> variants that change only this setting.

    The variants with values close to the value in ``centre`` come first.
    """
    counts = dict.fromkeys(max(1, round(part * centre.model.count)) for part in _COUNTS)
    knob = "model.primitives"
    variants = {knob: [Variant(knob, (quote_override(knob, n),)) for n in counts if n != centre.model.count]}
    for knob, values in call_task_tunable_settings(task, build_settings(task, centre.model, centre.options)).items():
        now = get_trial_setting(centre, knob)
        others = [value for value in values if value != now]
        if now in values:
            others.sort(key=lambda value: abs(values.index(value) - values.index(now)))
        variants[knob] = [Variant(knob, (quote_override(knob, value),)) for value in others]
    variants[LENGTH] = [Variant(LENGTH, length=part) for part in _LENGTHS]
    return variants


def merge_variant_overrides(words: Sequence[str], over: Sequence[str]) -> list[str]:
    """Return the overrides ``words``, without keys that ``over`` sets, followed by the overrides ``over``."""
    again = {assignment.key for assignment in parse_overrides(over)}
    return [*(a.text for a in parse_overrides(words) if a.key not in again), *over]


@dataclass
class AblationPlan:
    """Training lengths of the models of an ablation. A continued ablation uses the same plan.

    Attributes:
        steps: training steps of the centre (the model with the user's settings) in this ablation.
        seconds: approximate time of a training of full length.
        whole: training steps in the centre's configuration; 0 if the configured budget is in seconds.
        paces: name of a variant -> seconds per training step, divided by the centre's seconds per step.
    """

    steps: Annotated[int, Range(at_least=1)]
    seconds: float
    whole: int
    paces: dict[str, Annotated[float, Range(above=0)]] = field(default_factory=lambda: {CENTRE: 1.0})

    def overrides(self, variant: Variant, words: Sequence[str], centre: RunConfig) -> list[str]:
        """Return the overrides that train a variant for its planned length.

        Population control (which adds and moves primitives) runs as many times as in a full run of ``centre``,
        unless ``words`` set its interval.
        """
        steps = max(1, round(self.steps * variant.length / self.paces[variant.name]))
        budget = [quote_override(LENGTH, steps)] + ["train.max_seconds=null"] * (centre.train.max_seconds is not None)
        every, key = centre.train.population.every, "train.population.every"
        scaled = max(1, round(every * steps / self.whole)) if self.whole else every
        if scaled != every and key not in {assignment.key for assignment in parse_overrides(words)}:
            budget.append(quote_override(key, scaled))
        return merge_variant_overrides(words, [*variant.turned, *budget])

    def describe(self) -> str:
        text = f"Every model trains for the same time, about {self.seconds:.3g} s: {self.steps:,} steps of the centre"
        if self.whole and self.steps < self.whole:
            return f"{text}, of {self.whole:,} of its configuration. Fronts of longer trainings may differ."
        return f"{text}, all of its configuration."


def plan_training_lengths(centre: RunConfig, pace: float, available: float, lengths: Sequence[float]) -> AblationPlan:
    """Return a plan with which all trainings together take at most ``available`` seconds.

    If this would make the trainings too short, the plan takes longer.

    Args:
        pace: seconds per training step of the centre (the model with the user's settings).
        lengths: length of each training, as a fraction of the full length.
    """
    if centre.train.iterations is None:
        assert centre.train.max_seconds is not None, "a configuration has a budget"
        most, least, whole = centre.train.max_seconds / pace, float(_MIN_STEPS), 0
    else:
        most = whole = centre.train.iterations
        least = max(1.0, whole * _MIN_LENGTH)
    steps = max(1, int(min(most, max(available / sum(lengths) / pace, least))))
    return AblationPlan(steps, steps * pace, whole)


class AblationStepTimes:
    """Timer of the training steps of variants, relative to the centre (the model with the user's settings).

    The timed steps are halfway through the training, because all bands of spherical harmonics are in use there.

    Attributes:
        seconds: seconds per training step of the centre.
        compiling: seconds that kernels took to compile.
    """

    def __init__(self, centre: RunConfig, dataset: Dataset) -> None:
        self.dataset, self.compiling = dataset, 0.0
        self._centre = self._prepare(centre)
        self._identity = _ablation_model_identity(self._centre)
        self.seconds = self._run_turns(self._centre)[1] / (_STEPS_PER_TURN * _TURNS)

    def measure(self, config: RunConfig) -> float | None:
        """Return the time per step of ``config`` divided by the centre's; None if both build the same model."""
        trainer = self._prepare(config)
        if _ablation_model_identity(trainer) == self._identity:
            return None
        own, base = self._run_turns(trainer)
        return own / base

    def _prepare(self, config: RunConfig) -> Trainer:
        population = replace(config.train.population, grow_from=1.0)  # all primitives exist by half of the training
        config = replace(config, train=replace(config.train, population=population))
        trainer = prepare_training(config, dataset=self.dataset).trainer
        begun = time.perf_counter()
        compile_run_kernels(trainer)
        self.compiling += time.perf_counter() - begun
        settings = trainer.settings
        trainer.step, trainer.elapsed = (settings.iterations or 0) // 2, (settings.max_seconds or 0.0) / 2
        return trainer

    def _run_turns(self, trainer: Trainer) -> tuple[float, float]:
        """Run equally many training steps of ``trainer`` and the centre, alternately; return both times in seconds."""
        total = [0.0, 0.0]
        with use_one_torch_thread_for_run():
            for turn in range(_TURNS + 1):
                for i, one in enumerate((trainer, self._centre)):
                    begun = time.perf_counter()
                    for _ in range(_STEPS_PER_TURN):
                        one.train_step()
                    total[i] += (time.perf_counter() - begun) * (turn > 0)  # the first turn warms up
        return total[0], total[1]


def _ablation_model_identity(trainer: Trainer) -> tuple[Any, ...]:
    model = trainer.model
    fields = [type(f).__name__ + repr(f.settings()) for f in (model.density, model.colour)]
    return (model.count, trainer.settings.population.grow_to, *fields)


def combine_ablation_changes(points: Sequence[TradeoffPoint], most: int) -> list[tuple[str, ...]]:
    """Return at most ``most`` combinations of changes of single settings, each combination as a tuple of overrides.

    Only changes that save bytes, save time or improve quality, as measured in ``points``, are combined.
    """
    centre = points[0]
    smaller, faster, better = [], [], []
    for point in points[1:]:
        if point.knob == COMBINED or point.length != 1.0 or len(point.turned) != 1:
            continue
        loss, bytes_gain = centre.quality["psnr"] - point.quality["psnr"], math.log(centre.bytes / point.bytes)
        step = ParetoStep(point.knob, point.turned[0], bytes_gain, loss)
        if bytes_gain > 0:
            smaller.append(step)
        if point.ratios and 0 < point.ratio < 1.0 - point.doubt:
            faster.append(step._replace(gain=-math.log(point.ratio)))
        if loss < -0.02:
            better.append(step._replace(gain=-loss, loss=-bytes_gain))
    known = [point.turned for point in points]
    return combine_pareto_steps((smaller, faster, better), known, most)
