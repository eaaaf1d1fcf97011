"""The search for what a scene does not require: cut, train a little, look, and go back where it was too much."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

from neuprim.config import RunConfig
from neuprim.core.data import Dataset
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.reduction import reduce_model
from neuprim.core.task import TaskSpec
from neuprim.core.train.sensitivity import inner_sensitivity, sensitivity
from neuprim.runs.finetune import fine_tuner
from neuprim.search.prune.cut import cut_to, numbers, priced, steps_down, zeros_of
from neuprim.search.prune.judge import judge_of

__all__ = ["ROUNDS", "Search", "Stage"]

ROUNDS = 3
"""Of training, at most (but see :data:`_MORE`), each with its share of the steps, and nearly each after a cut. Every
one goes down to the rates of the run's end, so that what is judged is as well trained as it was."""

_MORE = 1300
"""Steps of a round where there are so many that :data:`ROUNDS` would be longer: what a scene does not require at all
goes a doubled cut at a time."""

_LEAST = 600
"""Steps of a round, at least: few of them leave a model worse than they found it."""

_PATIENCE = 2.0
"""Times the tolerance: what has lost no more after a round is trained for another one before it is taken back."""

_BITE = 6.5
"""dB that the first cut loses at once, over the tolerance: what training brings back most of."""

_GROWTH = 1.5
"""Times the last bite that the next one may be."""

_LEFT = 0.3
"""Share of a bite that is still lost after a round of enough steps, but for what the round would have brought without a
cut."""

_AGAIN = 0.35
"""Share of what a round would have brought without a cut that the next one is expected to bring."""

_LARGEST_BITE = 10.0
"""dB: a bite smaller than this that takes nothing is doubled."""

_ENOUGH = 0.1
"""Share of the tolerance below which there is nothing to cut for: what is left is trained for a round instead, which
wins a little back."""

_FREE = 0.02
"""Share of the tolerance that counts as nothing."""


@dataclass(frozen=True)
class Stage:
    """One round.

    Attributes:
        words: what fields do with less of; primitives, numbers: that there are.
        cut, trained: dB of the judged views after the last cut, and after the round's steps.
        kept: whether this is within the tolerance.
    """

    words: tuple[str, ...]
    primitives: int
    numbers: int
    cut: float
    trained: float
    kept: bool


@dataclass(frozen=True)
class _State:
    """A model on the way.

    Attributes:
        words: of its fields, all that were reduced.
        bite, cut: dB that its last cut was to lose at once, and of the judged views after it.
        lost: dB of the judged views since the beginning; rounds: of training since the cut.
        alone: whether the cut was of whole fields' parts alone.
    """

    model: Primitives
    words: tuple[str, ...] = ()
    bite: float = 0.0
    cut: float = 0.0
    lost: float = 0.0
    rounds: int = 0
    alone: bool = False

    def stage(self, base: float, stays: bool) -> Stage:
        return Stage(self.words, self.model.count, numbers(self.model), self.cut, base - self.lost, stays)


def _saved(model: Primitives, less: Primitives, size: int) -> float:
    """Share that is saved: of a file's numbers, or of those that every frame works through, where single ones of them
    are zero already."""
    return max(1 - numbers(less) / size, 1 - less.parameters_per_primitive / model.parameters_per_primitive)


@dataclass
class Search:
    """One pruning.

    Attributes:
        tolerance: dB; steps: of fine-tuning in all, 0 for none; progress: called with (text, fraction 0..1).
        base: dB of the model on the judged views, once there is one.
        stages: what was tried, in order.
    """

    config: RunConfig
    task: TaskSpec
    dataset: Dataset
    tolerance: float
    steps: int
    progress: Callable[[str, float], None] = lambda text, fraction: None
    stages: list[Stage] = field(default_factory=list)
    base: float = 0.0

    def __post_init__(self) -> None:
        self.judge, self._looks = judge_of(self.config, self.dataset), 0

    def __call__(self, model: Primitives) -> tuple[Primitives, tuple[str, ...]]:
        """The smallest model found whose judged views are at most the tolerance worse, and the words for what its
        fields have less of."""
        self.base = self.judge(model)
        best, tried = _State(model), None
        apart: tuple[str, ...] = ()
        rounds = min(max(self.steps // _LEAST, 1), max(ROUNDS, self.steps // _MORE))
        enough = min(self.steps / rounds / _LEAST, 1.0) ** 2  # what a few steps bring back is next to nothing
        bite = self.tolerance * (1.0 + (_BITE - 1.0) * enough)
        remains = 1.0 - (1.0 - _LEFT) * enough
        for number in range(rounds):
            left = self.tolerance - max(best.lost, 0.0)
            if not best.model.count:
                break
            if tried is None:  # else what the last cut left is trained for longer
                if apart:  # what failed together with others is tried by itself
                    tried, apart = self._without(best, apart, bite), ()
                elif left < _ENOUGH * self.tolerance:
                    tried = replace(best, cut=self.base - best.lost)
                else:
                    tried = self._cut(best, bite if self.steps else left, number / rounds)
                    while (
                        numbers(tried.model) >= numbers(best.model) and 0.0 < tried.bite < _LARGEST_BITE and self.steps
                    ):
                        tried = self._cut(
                            best, 2.0 * tried.bite, number / rounds
                        )  # of a few large parts each is worth more than the bite
                    if numbers(tried.model) >= numbers(best.model):
                        break
                bite = tried.bite
            before, smaller = tried, numbers(tried.model) < numbers(best.model)
            tried = self._trained(tried, number, rounds)
            spent, stays = tried.lost - best.lost, tried.lost <= self.tolerance + 1e-9
            self.stages.append(tried.stage(self.base, stays))
            if not smaller:
                best, tried = min(best, tried, key=lambda state: state.lost), None
            elif stays:
                brought = max(remains * bite - spent, 0.0)
                room = self.tolerance - tried.lost
                bite = min(max((room + _AGAIN * brought) / remains, bite / _BITE), _GROWTH * bite)
                best, tried = replace(tried, bite=bite), None
            elif tried.lost > self._hopeless(before, tried, best):
                apart = () if tried.alone else tried.words[len(best.words) :]
                bite *= (
                    1.0 if tried.alone else min(max(0.7 * (self.tolerance - best.lost) / max(spent, 1e-9), 0.2), 0.7)
                )
                tried = None
        last = {word.partition("=")[0]: word for word in best.words}  # degree 0 after degree 2 is degree 0
        return best.model, tuple(last.values())

    def _hopeless(self, before: _State, now: _State, best: _State) -> float:
        """dB from which on what was lost after a round is taken back: more than another round like it would win, or
        anything where the model before the cut has room left, as a smaller cut of that is sure to save something."""
        if best.rounds and best.lost < 0:
            return self.tolerance
        return self.tolerance * _PATIENCE if now.rounds == 1 else self.tolerance + before.lost - now.lost

    # ------------------------------------------------------------ one stage

    def _cut(self, state: _State, bite: float, progress: float) -> _State:
        """A model that is ``bite`` dB worse before training, and what its fields do with less of."""

        def quick(m: Primitives) -> float:
            return self.judge(m, quick=bool(self.steps))

        self.progress("looking for what is worth least", progress)
        model = state.model
        start, size = quick(model), numbers(model)
        by_price = self._by_price(model, quick, bite)
        price = bite / max(1 - numbers(by_price) / size, 1e-9)
        smaller, words, lost = model, list(state.words), 0.0
        again = True
        while again:
            again = False
            for kind, name, value in steps_down(smaller):
                less = reduce_model(smaller, kind, name, value)
                drop = start - quick(less)
                if drop <= min(bite, price * _saved(model, less, size)) or drop - lost <= _FREE * self.tolerance:
                    smaller, lost, again = less, max(drop, lost), True
                    words.append(f"{kind}.{name}={value}")
                    break
        found = by_price if smaller is model else self._by_price(smaller, quick, bite - lost)
        return _State(found, tuple(words), bite=bite, cut=self.judge(found))

    def _without(self, state: _State, words: tuple[str, ...], bite: float) -> _State:
        """A model whose fields do with less as the words say, and nothing else."""
        model = state.model
        for word in words:
            place, _, value = word.partition("=")
            kind, _, name = place.partition(".")
            model = reduce_model(model, kind, name, int(value))
        return _State(model, (*state.words, *words), bite=bite, cut=self.judge(model), alone=True)

    def _by_price(self, model: Primitives, quality: Callable[[Primitives], float], loss: float) -> Primitives:
        if loss <= 0:
            return model
        self._looks += 1
        settings, draws = self.config.renderer, self.judge.draws
        views = sensitivity(model, self.dataset, self.judge.others, settings, seed=self._looks)
        inside = inner_sensitivity(model, draws, seed=self._looks, threads=settings.threads) if draws else None
        return cut_to(model, priced(model, views, inside, self.judge), quality, loss)

    def _trained(self, state: _State, number: int, rounds: int) -> _State:
        """The state after the round's steps."""
        model, steps = state.model, self.steps * (number + 1) // rounds - self.steps * number // rounds
        if steps and model.count:
            trainer = fine_tuner(self.config, self.task, self.dataset, model, steps)
            trainer.zero_masks, left = zeros_of(trainer.model), numbers(model)
            for done in range(steps):
                trainer.train_step()
                if done % 20 == 0:
                    self.progress(f"training what is left, {left:,} numbers", (number + done / steps) / rounds)
            model = Primitives(
                model.density, model.colour, {name: value.detach() for name, value in trainer.model.params.items()}
            )
        found = self.judge(model) if steps else state.cut
        return replace(state, model=model, lost=self.base - found, rounds=state.rounds + 1)
