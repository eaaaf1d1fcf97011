"""Training that knows in how few bits its numbers will be stored (quantisation-aware fine-tuning), and how few of them
images allow."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

from torch import Tensor

from neuprim.config import RunConfig
from neuprim.core.compression import (
    BitTable,
    Quantizers,
    canonicalize,
    fake_quantize,
    fit_quantizers,
    fit_quantizers_to_error,
)
from neuprim.core.data import Dataset
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import TaskSpec
from neuprim.core.train.sensitivity import inner_sensitivity, sensitivity
from neuprim.runs.finetune import fine_tuner, steps_in
from neuprim.runs.fit import use_one_torch_thread
from neuprim.search.prune.cut import zeros_of
from neuprim.search.prune.judge import Judge, judge_of

__all__ = ["Fewer", "Rounding", "read_back", "train_for", "train_within"]

Progress = Callable[[str, float], None]

_LOOKED_AT = 48
"""Training views that tell how much each number matters: sums over all primitives are known by a few."""

_AHEAD = 2.0
"""Times the tolerance that may be lost at once where training follows, to begin with."""

_ROUND, _ROUNDS = 500, 3
"""Steps of a round of training, at least, and rounds, at most: after one it is known how much training brings back.
What was trained for some steps between numbers is best stored in these: of a fire finer ones are worse, since only what
is read back was trained."""

_SLOPE, _AIM = 0.7, 0.95
"""dB that a trained model loses more, for one more at once; and the share of the tolerance that the next round aims
at."""

_LOOKS = 16
"""At how coarse numbers may be, at most."""

_LEAST, _MOST = 1e-4, 30.0
"""Share of the error that there is, which rounding may add, within these."""


@dataclass(frozen=True)
class Fewer:
    """A folded model, how it is to be coded, the steps that it was trained for, and what there is to say about it."""

    model: Primitives
    made: Quantizers
    steps: int
    notes: tuple[str, ...] = ()


class Rounding:
    """How coarsely a model's numbers can be stored, by one number: the squared error that rounding all of them may add,
    as a share of what there is.

    Attributes:
        model: folded.
    """

    def __init__(self, model: Primitives, dataset: Dataset, judge: Judge) -> None:
        self.model = canonicalize(model)
        views = sensitivity(self.model, dataset, judge.others[:_LOOKED_AT], judge.settings)
        if judge.draws:
            views = views.beside(
                inner_sensitivity(self.model, judge.draws, threads=judge.settings.threads), judge.apart(self.model)
            )
        columns = sum(spec.size for spec in self.model.specs)
        self._effects, self._error = views.columns, 10 ** (-judge.images(self.model) / 10) / max(columns, 1)

    def of(self, trained: Primitives) -> Rounding:
        """The same of what became of the model in training."""
        other = copy(self)
        other.model = trained
        return other

    def fit_quantizers(self, share: float) -> Quantizers:
        """How the model is coded."""
        return fit_quantizers_to_error(self.model, self._effects, share * self._error)

    def coarsest(self, enough: Callable[[Quantizers], bool], start: float) -> tuple[Quantizers, float]:
        """The coarsest schemes that are ``enough``, and their share of the error; or the finest that there are.

        Args:
            start: the share that is tried first.
        """
        fine, _ = self._between(enough, start)
        return self.fit_quantizers(fine), fine

    def finest(self, enough: Callable[[Quantizers], bool], start: float) -> tuple[Quantizers, float]:
        """The finest schemes that are ``enough``, and their share of the error; or the coarsest that there are."""
        _, coarse = self._between(lambda made: not enough(made), start)
        return self.fit_quantizers(coarse), coarse

    def read_back(self, made: Quantizers) -> Primitives:
        """The model as it would come back."""
        return read_back(self.model, made)

    def _between(self, fine_enough: Callable[[Quantizers], bool], start: float) -> tuple[float, float]:
        """Two shares that lie close together, of which the first is fine enough and the second is not; or both an end
        of what is tried."""
        fine, coarse, share = 0.0, 0.0, start
        for _ in range(_LOOKS):
            if fine_enough(self.fit_quantizers(share)):
                fine = share
            else:
                coarse = share
            if coarse == _LEAST or fine == _MOST or (fine and coarse and coarse < 1.08 * fine):
                break
            share = (
                math.sqrt(fine * coarse)
                if fine and coarse
                else min(2.0 * fine, _MOST)
                if fine
                else max(share / 2.0, _LEAST)
            )
        return fine or _LEAST, coarse or _MOST


def train_for(
    config: RunConfig,
    task: TaskSpec,
    dataset: Dataset,
    model: Primitives,
    table: BitTable,
    seconds: float,
    steps: int | None,
    progress: Progress,
) -> Fewer:
    """The model trained for the bits of a table.

    Args:
        seconds: about, where there are no ``steps``.
    """
    with use_one_torch_thread():
        if steps is None:
            steps = steps_in(seconds, config, task, dataset, model)
        whole = canonicalize(model)
        made, judge = fit_quantizers(whole, table), judge_of(config, dataset)
        before = judge(read_back(whole, made))
        trained = _trained(
            config, task, dataset, whole, made, steps, lambda share: progress("training for few bits", share)
        )
        after = judge(read_back(trained, made))
    if after <= before:
        note = f"{steps:,} steps for few bits brought nothing ({after - before:+.3f} dB on training views); stored as it was"
        return Fewer(whole, made, steps, (note,))
    return Fewer(trained, made, steps)


def train_within(
    config: RunConfig,
    task: TaskSpec,
    dataset: Dataset,
    model: Primitives,
    tolerance: float,
    seconds: float,
    steps: int | None,
    progress: Progress,
) -> Fewer:
    """The model in the fewest bits with which judged training views are at most ``tolerance`` dB worse, trained for
    them.

    Args:
        seconds: about, where there are no ``steps``; 0 for no training.
    """
    with use_one_torch_thread():
        if steps is None:
            steps = steps_in(seconds, config, task, dataset, model)
        judge = judge_of(config, dataset)
        base = judge(model)
        progress("looking for what numbers are worth", 0.0)
        plain = Rounding(model, dataset, judge)
        rounding, at_once, best = plain, _AHEAD * tolerance, None
        rounds = min(max(steps // _ROUND, 1), _ROUNDS) if steps else 0
        for number in range(rounds):

            def show(part: float, before: int = number) -> None:
                progress("training for few bits", (before + part) / rounds)

            share = _share(at_once)
            made = rounding.fit_quantizers(share)
            own = steps * (number + 1) // rounds - steps * number // rounds
            rounding = rounding.of(_trained(config, task, dataset, rounding.model, made, own, show))
            lost = base - judge(rounding.read_back(made))
            if lost <= tolerance and (best is None or share > best[2]):
                best = rounding.model, made, share
            at_once = max(at_once + (_AIM * tolerance - lost) / _SLOPE, 0.25 * at_once)
        if (
            best is None
        ):  # of what was trained between coarser numbers, and of what was not trained, what can be stored more coarsely
            progress("looking for the coarsest numbers", 1.0)
            tried = [plain, rounding] if rounds else [plain]

            def found(one: Rounding) -> tuple[Primitives, Quantizers, float]:
                return one.model, *one.coarsest(
                    lambda made: base - judge(one.read_back(made)) <= tolerance, _share(tolerance)
                )

            best = max(map(found, tried), key=lambda each: each[2])
    whole, made, share = best
    return Fewer(
        whole,
        made,
        steps,
        (f"rounding may add {share:.1%} to the squared error; every number's last bit is worth as much",),
    )


def _share(decibels: float) -> float:
    """Of the error that there is, what makes it so many dB larger."""
    return float(min(max(10 ** (decibels / 10) - 1, _LEAST), _MOST))


def _trained(
    config: RunConfig,
    task: TaskSpec,
    dataset: Dataset,
    whole: Primitives,
    made: Quantizers,
    steps: int,
    progress: Callable[[float], None],
) -> Primitives:
    """A folded model after so many steps in which every image is drawn of what will be read back."""
    trainer = fine_tuner(config, task, dataset, whole, steps)
    trainer.zero_masks = zeros_of(trainer.model)
    there = {name: scheme.to(trainer.device) for name, scheme in made.items()}

    def stored(params: dict[str, Tensor]) -> dict[str, Tensor]:
        return fake_quantize(params, there)

    trainer.fake_quantize = stored
    for done in range(steps):
        trainer.train_step()
        if done % 20 == 0:
            progress(done / steps)
    return Primitives(
        whole.density, whole.colour, {name: value.detach().cpu() for name, value in trainer.model.params.items()}
    )


def read_back(model: Primitives, made: Quantizers) -> Primitives:
    """A folded model as it would come back."""
    return Primitives(
        model.density, model.colour, {name: value.detach() for name, value in fake_quantize(model.params, made).items()}
    )
