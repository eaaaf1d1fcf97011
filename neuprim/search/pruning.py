"""``neuprim prune``: make the model of a finished run smaller, in rounds.

A round removes parameters (a *cut*), fine-tunes and evaluates the model. Cuts that lose too much quality are undone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from neuprim.config import Job, RunConfig
from neuprim.core.channels import find_channels
from neuprim.core.data import Dataset
from neuprim.core.data.dataset import hold_out_views
from neuprim.core.data.dataset_check import check_dataset_views
from neuprim.core.errors import ConfigError
from neuprim.core.io.files import refuse_existing, write_json, write_text
from neuprim.core.model.primitives import Primitives, reduce_model
from neuprim.core.task import TaskSpec
from neuprim.core.train.sensitivity import inner_sensitivity, sensitivity
from neuprim.core.train.trainer import Trainer
from neuprim.runs.evaluate import evaluate_fitted
from neuprim.runs.fit import Fitted, drop_unused_run_rates, make_run_loss, use_one_torch_thread_for_run
from neuprim.runs.measure import measure_quality
from neuprim.runs.open import PRUNED, kept_shares, load_dataset, load_run, model_file, move_to_render_device
from neuprim.runs.training import count_run_finetune_steps, make_run_finetune_trainer, save_run_training
from neuprim.search.model_quality import SearchQuality, choose_trial_views, measure_trial_views
from neuprim.search.pruning_cuts import (
    count_unpruned_numbers,
    cut_to_loss,
    list_pruning_reductions,
    mask_pruned_numbers,
    price_cuts,
)

MAX_ROUNDS, _LONG_ROUND, _MIN_ROUND = 3, 1300, 600
"""Largest number of rounds; steps of a round above which there are more rounds; least steps of a round. Every round
ends with the final learning rates of the run, so that evaluated models are trained equally well."""

__all__ = ["PruneRequest", "Pruning", "prune_run"]

_PATIENCE = 2.0  # a model that lost at most this many tolerances gets another round before its cut is undone

_FIRST_CUT, _GROWTH, _LARGEST_CUT = 6.5, 1.5, 10.0
"""``_FIRST_CUT``: intended loss of the first cut, divided by the tolerance. ``_GROWTH``: largest factor between the
losses of two successive cuts. ``_LARGEST_CUT``: dB up to which a cut that removes nothing is doubled."""

_REMAINING, _BROUGHT = 0.3, 0.35
"""``_REMAINING``: expected fraction of a cut's loss that remains after fine-tuning. ``_BROUGHT``: if fine-tuning
recovers more than expected, the fraction of this surplus that is also expected of the next round."""

_ENOUGH, _FREE = 0.1, 0.02
"""Fractions of the tolerance. Nothing more is cut when less than ``_ENOUGH`` is left. Losses below ``_FREE`` are
ignored."""

_TIMED_VIEWS = 12

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class PruningStage:
    """Result of one round of pruning. ``words`` has all reductions of fields so far, e.g. "colour.degree=1".

    Attributes:
        primitives, numbers: how many primitives, and how many parameter values, remain.
        cut, trained: quality in dB after the cut (removal of parameters), and after the fine-tuning that follows.
        kept: whether the loss is within the tolerance.
    """

    words: tuple[str, ...]
    primitives: int
    numbers: int
    cut: float
    trained: float
    kept: bool


@dataclass(frozen=True)
class _PruningState:
    """Intermediate model of pruning. ``words`` has all reductions of its fields so far, e.g. "colour.degree=1".

    Attributes:
        bite: loss in dB that the last cut (removal of parameters) was intended to cause, before fine-tuning.
        cut: quality after the last cut, before fine-tuning, dB.
        lost: loss relative to the full model, dB.
        rounds: rounds of fine-tuning since the last cut.
        fields_only: whether the last cut only reduced fields.
    """

    model: Primitives
    words: tuple[str, ...] = ()
    bite: float = 0.0
    cut: float = 0.0
    lost: float = 0.0
    rounds: int = 0
    fields_only: bool = False

    @property
    def numbers(self) -> int:
        return count_unpruned_numbers(self.model)


def _saved_share(model: Primitives, smaller: Primitives, numbers: int) -> float:
    """Return the fraction of parameter values that ``smaller`` saves, compared with ``model``.

    The result is the larger of two fractions: of the values in the file, where ``model`` has ``numbers`` values, and of
    the values per primitive.
    """
    per_primitive = smaller.parameters_per_primitive / model.parameters_per_primitive
    return max(1 - count_unpruned_numbers(smaller) / numbers, 1 - per_primitive)


@dataclass
class ModelShrinker:
    """Search for the smallest model that renders the training views within a tolerance of the full model.

    Attributes:
        tolerance: PSNR that training views may lose, dB.
        steps: total number of fine-tuning steps in all rounds; 0 for none.
        base: quality of the full model, dB; set by :meth:`shrink`.
        stages: the rounds so far, in order.
    """

    config: RunConfig
    task: TaskSpec
    dataset: Dataset
    tolerance: float
    steps: int
    progress: Progress = lambda text, fraction: None
    stages: list[PruningStage] = field(default_factory=list)
    base: float = 0.0

    def __post_init__(self) -> None:
        self.quality, self._sensitivity_seed = SearchQuality.of_run(self.config, self.dataset), 0

    def shrink(self, model: Primitives) -> tuple[Primitives, tuple[str, ...]]:
        """Prune ``model``; return the smallest model found, and the reductions of its fields as overrides."""
        self.base = self.quality(model)
        best, tried = _PruningState(model), None
        untried: tuple[str, ...] = ()
        rounds = min(max(self.steps // _MIN_ROUND, 1), max(MAX_ROUNDS, self.steps // _LONG_ROUND))
        recovery = min(self.steps / rounds / _MIN_ROUND, 1.0) ** 2  # a few steps recover next to nothing
        bite = self.tolerance * (1.0 + (_FIRST_CUT - 1.0) * recovery)
        remains = 1.0 - (1.0 - _REMAINING) * recovery
        for number in range(rounds):
            if not best.model.count:
                break
            if tried is None:
                tried, untried = self._next_state(best, untried, bite, number / rounds), ()
                if tried is None:
                    break
                bite = tried.bite
            before, smaller = tried, tried.numbers < best.numbers
            tried = self._train(tried, number, rounds)
            spent, kept = tried.lost - best.lost, tried.lost <= self.tolerance + 1e-9
            trained = self.base - tried.lost
            self.stages.append(PruningStage(tried.words, tried.model.count, tried.numbers, tried.cut, trained, kept))
            if not smaller:
                best, tried = min(best, tried, key=lambda state: state.lost), None
            elif kept:
                room = self.tolerance - tried.lost + _BROUGHT * max(remains * bite - spent, 0.0)
                bite = min(max(room / remains, bite / _FIRST_CUT), _GROWTH * bite)
                best, tried = replace(tried, bite=bite), None
            elif tried.lost > self._max_loss(before, tried, best):
                untried = () if tried.fields_only else tried.words[len(best.words) :]
                if not tried.fields_only:
                    bite *= min(max(0.7 * (self.tolerance - best.lost) / max(spent, 1e-9), 0.2), 0.7)
                tried = None
        last = {word.partition("=")[0]: word for word in best.words}  # degree 0 after degree 2 is degree 0
        return best.model, tuple(last.values())

    def _next_state(
        self, best: _PruningState, untried: tuple[str, ...], bite: float, progress: float
    ) -> _PruningState | None:
        """Return the model to fine-tune next, usually after removing parameters; None if no more can be removed."""
        if untried:  # reductions that failed together with other cuts are tried alone
            return self._reduce_fields(best, untried, bite)
        left = self.tolerance - max(best.lost, 0.0)
        if left < _ENOUGH * self.tolerance:  # without a cut: a round of training recovers a little
            return replace(best, cut=self.base - best.lost)
        state = self._cut(best, bite if self.steps else left, progress)
        while state.numbers >= best.numbers and 0.0 < state.bite < _LARGEST_CUT and self.steps:
            state = self._cut(best, 2.0 * state.bite, progress)  # each of a few large parts costs more than the bite
        return None if state.numbers >= best.numbers else state

    def _max_loss(self, before: _PruningState, now: _PruningState, best: _PruningState) -> float:
        """Return the loss in dB above which a cut is undone, because another round of fine-tuning would not recover it.

        ``before`` and ``now`` are the states before and after the last round; ``best`` is the best state so far.
        """
        if best.rounds and best.lost < 0:  # the model before has room, so a smaller cut saves something
            return self.tolerance
        return self.tolerance * _PATIENCE if now.rounds == 1 else self.tolerance + before.lost - now.lost

    def _cut(self, state: _PruningState, bite: float, progress: float) -> _PruningState:
        """Return the model after removing parameters (a cut), which loses about ``bite`` dB before fine-tuning."""

        def quick(model: Primitives) -> float:
            return self.quality(model, quick=bool(self.steps))

        self.progress("choosing what to cut", progress)
        model, size, start = state.model, state.numbers, quick(state.model)
        by_price = self._cut_by_price(model, quick, bite)
        price = bite / max(1 - count_unpruned_numbers(by_price) / size, 1e-9)
        smaller, words, lost, again = model, list(state.words), 0.0, True
        while again:  # whole parts of fields, while they cost no more than single numbers
            again = False
            for kind, name, value in list_pruning_reductions(smaller):
                reduced = reduce_model(smaller, kind, name, value)
                drop = start - quick(reduced)
                cheap = drop <= min(bite, price * _saved_share(model, reduced, size))
                if cheap or drop - lost <= _FREE * self.tolerance:
                    smaller, lost, again = reduced, max(drop, lost), True
                    words.append(f"{kind}.{name}={value}")
                    break
        result = by_price if smaller is model else self._cut_by_price(smaller, quick, bite - lost)
        return _PruningState(result, tuple(words), bite=bite, cut=self.quality(result))

    def _reduce_fields(self, state: _PruningState, words: tuple[str, ...], bite: float) -> _PruningState:
        """Return the state after reducing fields only, by ``words`` such as "colour.degree=1"."""
        model = state.model
        for word in words:
            place, _, value = word.partition("=")
            kind, _, name = place.partition(".")
            model = reduce_model(model, kind, name, int(value))
        return _PruningState(model, (*state.words, *words), bite=bite, cut=self.quality(model), fields_only=True)

    def _cut_by_price(self, model: Primitives, quality: Callable[[Primitives], float], loss: float) -> Primitives:
        """Return the model without the primitives and units of least effect per value; at most ``loss`` dB are lost."""
        if loss <= 0:
            return model
        self._sensitivity_seed += 1
        seed, settings, draws = self._sensitivity_seed, self.config.renderer, self.quality.draws
        views = sensitivity(model, self.dataset, self.quality.others, settings, seed=seed)
        inside = inner_sensitivity(model, draws, seed=seed, threads=settings.threads) if draws else None
        return cut_to_loss(model, price_cuts(model, views, inside, self.quality), quality, loss)

    def _train(self, state: _PruningState, number: int, rounds: int) -> _PruningState:
        """Fine-tune the model in round ``number`` of ``rounds``; return the new state with its loss."""
        model, steps = state.model, self.steps * (number + 1) // rounds - self.steps * number // rounds
        if steps and model.count:
            trainer = make_run_finetune_trainer(Job(self.config, self.task), self.dataset, model, steps)
            trainer.zero_masks, left = mask_pruned_numbers(trainer.model), state.numbers
            for done in range(steps):
                trainer.train_step()
                if done % 20 == 0:
                    self.progress(f"fine-tuning {left:,} numbers", (number + done / steps) / rounds)
            params = {name: value.detach() for name, value in trainer.model.params.items()}
            model = Primitives(model.density, model.colour, params)
        after = self.quality(model) if steps else state.cut
        return replace(state, model=model, lost=self.base - after, rounds=state.rounds + 1)


# ---------------------------------------------------------------- a run


@dataclass(frozen=True)
class PruneRequest:
    """Request for :func:`prune_run`, with the arguments of ``neuprim prune``.

    Attributes:
        tolerance: PSNR that training views may lose, dB.
        seconds: approximate time of fine-tuning.
        steps: number of fine-tuning steps, instead of ``seconds``; the result is then the same on every machine.
        out: the new run directory; None for the run's name with "-pruned".
        overwrite: whether existing files may be replaced.
        hold_out: n > 1 keeps every n-th training view out of fine-tuning and of decisions; 0 uses all training views.
    """

    run_dir: Path  # the run directory
    tolerance: float = 0.1
    seconds: float = 60.0
    steps: int | None = None
    out: Path | None = None
    overwrite: bool = False
    hold_out: int = 0


@dataclass(frozen=True)
class Pruning:
    """Result of :func:`prune_run`; ``pruned.json`` has the same content without ``run_dir``.

    Attributes:
        run_dir: the new run directory; None if nothing could be removed, so that nothing was written.
        before: measurements of the original: primitives, numbers (count of parameter values), bytes, psnr and ssim of
            test views, frames_per_second.
        reduced: reductions of fields, as in ``model.reduced``.
        judged_psnr: PSNR of the training views by which cuts are accepted, before and after pruning, dB.
    """

    run_dir: Path | None
    steps: int  # steps of fine-tuning
    seconds: float  # time of pruning
    before: dict[str, float]
    after: dict[str, float]  # the same numbers of the pruned model
    reduced: tuple[str, ...]
    kept: dict[str, float]  # unit -> share of the primitives that have it
    judged_psnr: tuple[float, float]
    stages: tuple[PruningStage, ...]  # the rounds of pruning


def prune_run(request: PruneRequest, progress: Progress = lambda text, fraction: None) -> Pruning:
    """Prune a run's model with fine-tuning, as far as the PSNR of training views allows; write the result as a new run.

    Pruning removes primitives, units such as neurons of single primitives, and parts of fields. Test views are only
    used for measurements.

    Raises:
        NeuprimError: the run does not exist, its data cannot be read, or files exist already.
    """
    final = request.out or request.run_dir.with_name(f"{request.run_dir.resolve().name}-pruned")
    if final.exists() and not final.is_dir():
        raise ConfigError(f"--out {final}: is a file; expected a new folder")
    if final.exists() and final.resolve() == request.run_dir.resolve():
        raise ConfigError(f"--out {final}: is the run itself; expected a new folder")
    refuse_existing(final, request.overwrite)
    run = load_run(request.run_dir)
    config, task, model, header = replace(run.config, output_dir=request.run_dir), run.task, run.model, run.header
    with run.plugins.attribute_errors(), use_one_torch_thread_for_run():
        progress("reading the run's data", 0.0)
        dataset = load_dataset(run)
        check_dataset_views(dataset, task.conditions)
        if request.hold_out:
            dataset = replace(dataset, train=hold_out_views(dataset, request.hold_out).train)
        begun, steps = time.monotonic(), request.steps
        if steps is None:
            steps = count_run_finetune_steps(request.seconds, Job(config, task), dataset, model)
        shrinker = ModelShrinker(config, task, dataset, request.tolerance, steps, progress)
        small, words = shrinker.shrink(model)
        seconds = time.monotonic() - begun
        judged = shrinker.base, shrinker.quality(small)
        progress("measuring test views", 1.0)
        measured = measure_quality(model, task, dataset, config.renderer)
        before = _measure_pruned(model, model_file(request.run_dir), measured, config, dataset)
        kept, stages = kept_shares(small), tuple(shrinker.stages)
        if count_unpruned_numbers(small) >= count_unpruned_numbers(model):
            return Pruning(None, steps, seconds, before, before, (), kept_shares(model), judged, stages)
        progress("pictures and report", 1.0)
        fitted = _fit_pruned(replace(config, output_dir=final), task, dataset, small, words)
        fitted.trainer.step = int(header.get("iterations") or 0) + steps
        fitted.trainer.elapsed = float(header.get("train_seconds") or 0.0) + seconds
        final.mkdir(parents=True, exist_ok=True)
        write_text(final / "config.yaml", fitted.config.to_yaml())
        save_run_training(fitted)
        metrics = evaluate_fitted(fitted, final)
        measured = metrics["psnr"], metrics["ssim"]
        after = _measure_pruned(small, final / "model.safetensors", measured, config, dataset)
    result = Pruning(final, steps, seconds, before, after, words, kept, judged, stages)
    facts = {name: value for name, value in asdict(result).items() if name != "run_dir"}
    origin = {"format": 1, "pruned_from": str(request.run_dir), "tolerance": request.tolerance}
    write_json(final / PRUNED, origin | facts)
    return result


def _measure_pruned(
    model: Primitives, file: Path, measured: tuple[float, float], config: RunConfig, dataset: Dataset
) -> dict[str, float]:
    views = choose_trial_views(dataset, _TIMED_VIEWS)
    moved = move_to_render_device(model, config.renderer, views[0].view)
    ms = measure_trial_views(moved, views, config.renderer, dataset.background).ms_per_frame
    facts = {"primitives": model.count, "numbers": count_unpruned_numbers(model), "bytes": file.stat().st_size}
    return {**facts, "psnr": measured[0], "ssim": measured[1], "frames_per_second": 1e3 / ms}


def _fit_pruned(
    config: RunConfig, task: TaskSpec, dataset: Dataset, model: Primitives, words: tuple[str, ...]
) -> Fitted:
    """Return a pruned model as a finished training that can be saved and evaluated.

    The configuration has overrides that build such a model; ``words`` are the reductions of fields by pruning.
    """
    reduced = [*config.model.reduced, *words]
    own = [f"model.primitives={model.count}"]
    own += [f"model.reduced=[{','.join(map(repr, reduced))}]"] if reduced else []
    replaced = ("model.primitives=", "model.reduced=", "output_dir=", "resume=")
    config = replace(
        config,
        model=replace(config.model, primitives=model.count, reduced=reduced),
        overrides=[*(word for word in config.overrides if not word.startswith(replaced)), *own],
    )
    settings = drop_unused_run_rates(config.train, task, model)
    trainer = Trainer(model, dataset, make_run_loss(Job(config, task)), settings, config.renderer, config.seed)
    trainer.zero_masks = mask_pruned_numbers(trainer.model)
    return Fitted(config, task, dataset, find_channels(task, dataset), trainer)
