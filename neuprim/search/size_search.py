"""Search for the smallest model that meets a target: short trials of several sizes, trials of settings, then full runs.

Every stage derives the next training from the record only, so that a resumed search makes the same decisions again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from neuprim.config import RunConfig, load_config_task
from neuprim.config.command_settings import SearchTarget
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.task import TaskSpec
from neuprim.core.train.settings import build_settings
from neuprim.plugins.attribution import call_task_tunable_settings
from neuprim.search.size_forecast import (
    ALLOWANCE,
    MIN_MARGIN,
    SizeCurve,
    SizePredictor,
    SizeProposal,
    exceeded_limit,
    format_target_forecast,
    propose_best_size,
    propose_size,
    to_forecast_decibels,
)
from neuprim.search.target_record import (
    VIEWS,
    Attempt,
    SettingChange,
    SettingValue,
    TargetRecord,
    TrialRunner,
    forecast_time,
)
from neuprim.search.trials import get_trial_setting

_MAX_MARGIN, _NEAR = 0.3, 1.08
"""Upper limits up to which a full run is good enough: limit of the margin above the target in dB, and limit of the
number of primitives divided by the predicted number."""

_TRIALS, _FULL = 0.33, 0.34  # shares of the budget for trials and for a full run; the rest is for another one

_SHORTER, _PACE_STEPS, _MIN_STEPS = 8, 24, 16
"""Steps of a full run divided by the steps of a trial; steps of the first training, which measures the time per step;
least steps of a trial."""

_MAX_SIZES, _MAX_CHANGES, _MAX_FULL = 6, 4, 5

_MIN_SLOPE = 0.8  # dB that twice as many primitives gain in full runs, at least; short trials may show less
_BEYOND, _BELOW = 2.0, 3.0  # a full run has at most this many times the largest, and 1/this of the smallest size tried

_MIN_STEP, _MORE_STEPS = 1.07, 0.75
"""``_MIN_STEP``: least factor between the numbers of primitives of two full runs. ``_MORE_STEPS``: least number of
steps of a further full run, divided by the steps of the full run before."""

_MORE = 1.25  # factor by which limits must allow more primitives for another full run
_SLOWER = 1.5  # a full run that becomes this many times slower is cut short
_PAYS = 0.97  # largest share of the bytes that a changed setting may leave to be adopted
_MAX_REFUSED = 2  # values of a setting that may fail before the search leaves it


# ---------------------------------------------------------------- settings that save bytes


def list_smaller_settings(config: RunConfig, task: TaskSpec, dataset: Dataset) -> dict[str, tuple[SettingValue, ...]]:
    """Return setting -> values, for settings that can reduce the number of parameters per primitive.

    Values are sorted by the number of parameters; the current value is last. The setting that can save most is first.
    """

    def count_numbers(config: RunConfig) -> int:
        settings = build_settings(task, config.model, config.options)
        task.check(settings)
        return sum(spec.size for field in task.build(settings, dataset) for spec in field.parameters())

    whole, found = count_numbers(config), []
    for key, offered in call_task_tunable_settings(task, build_settings(task, config.model, config.options)).items():
        now = get_trial_setting(config, key)
        if now is None:  # not a setting of this configuration
            continue
        if key in ("model.sh_degree", "model.neurons"):  # any whole number is possible
            offered = tuple(range(min(offered), now))
        sizes: dict[SettingValue, int] = {}
        for value in offered:
            with suppress(ConfigError):  # not with the other settings
                sizes[value] = count_numbers(config.override({key: value}))
        if fewer := sorted((value for value in sizes if sizes[value] < whole), key=lambda value: sizes[value]):
            found.append((sizes[fewer[0]], key, (*fewer, now)))
    return {key: values for _, key, values in sorted(found, key=lambda one: one[0])}


def propose_setting_trial(
    values: Mapping[str, Sequence[SettingValue]], turns: Sequence[SettingChange]
) -> tuple[str, SettingValue, SettingValue] | None:
    """Return (setting, current value, value to try) of the next trial; None if no trial is left.

    The value to try is found by bisection of ``values``, sorted by size (:func:`list_smaller_settings`). It is halfway
    between the current value and a smaller value: the closest value that was tried but not adopted (see ``turns``), or
    else the smallest value.
    """
    for key, ladder in values.items():
        own = [turn for turn in turns if turn.key == key]
        now = min((ladder.index(turn.after) for turn in own if turn.adopted), default=len(ladder) - 1)
        refused = [ladder.index(turn.after) for turn in own if not turn.adopted]
        after = (now + max(refused, default=0)) // 2
        if after < now and after not in refused and len(refused) < _MAX_REFUSED:
            return key, ladder[now], ladder[after]
    return None


def setting_change_pays(loss: float, size: float, slope: float) -> bool:
    """Return whether a changed setting makes a model of equal quality smaller.

    Args:
        loss: loss of quality by the change, at an equal number of primitives, dB.
        size: bytes per primitive after the change, divided by bytes per primitive before.
        slope: gain of quality by twice as many primitives, dB.
    """
    return bool(size * 2 ** (max(loss, 0.0) / slope) < _PAYS)


# ---------------------------------------------------------------- the search


@dataclass
class SizeSearch:
    """Search for the smallest model that meets a target (quality, file size, speed). It can resume from its record."""

    config: RunConfig
    target: SearchTarget
    dataset: Dataset
    record: TargetRecord
    runner: TrialRunner

    @property
    def max_steps(self) -> float:
        return self.config.train.iterations or math.inf

    def full_steps(self, primitives: int) -> float:
        """Return how many training steps fit into a full run's share of the budget, for this number of primitives."""
        return min(self.max_steps, max(_FULL * self.record.asked["budget"] / self.runner.pace(primitives), 1.0))

    @property
    def predictor(self) -> SizePredictor:
        return SizePredictor(self.target, self.record, self.full_steps)

    def run(self) -> None:
        """Run all stages of the search that are not finished according to the record."""
        kept = sum(a.outcome is not None for a in self.record.attempts)
        if kept:
            self.runner.notify(f"{kept} earlier trainings are kept")
        stages = (self._measure_pace, self._try_sizes, self._report_reach, self._change_settings, self._run_full)
        for number, stage in enumerate(stages, 1):
            if self.record.stage < number:
                stage()
                self.record.stage = number

    def _measure_pace(self) -> None:
        """Measure the time per step in a short training, and choose the number of training steps of a trial."""
        if self.record.length:
            return
        (first,) = self.runner.run(Attempt("pace", {}, self.config.model.count, int(min(_PACE_STEPS, self.max_steps))))
        possible, pace = self.full_steps(first.count), self.runner.pace(first.count)
        needed = 2 * _MIN_STEPS * _SHORTER
        if possible < needed:
            enough = "" if self.max_steps < needed else f"a budget of {needed * pace / _FULL:.0f} s, "
            raise ConfigError(
                f"budget={self.record.asked['budget']:g}s: enough for only {possible:.0f} steps of {first.count:,} "
                f"primitives; expected at least {needed} steps. Give {enough}fewer "
                "primitives (model.primitives) or smaller images"
            )
        self.record.length = round(possible / _SHORTER)
        self.runner.notify(
            f"{1e3 * pace:.1f} ms a step with {first.count:,} primitives: full runs of about {possible:,.0f} steps, "
            f"trials of {self.record.length:,}; one of {self.record.hold_out} training views is held out"
        )

    def _highest(self) -> int:
        """Return the largest number of primitives to try.

        The number is within the target's limits, and not above a number at which the model of a trial stopped growing.
        A full run with this number has at least twice as many steps as a trial.
        """
        low = high = self.config.model.count
        while self.full_steps(high) > 2 * self.record.length and high < 2**24:
            low, high = high, 2 * high
        while high - low > max(low // 50, 1):
            middle = (low + high) // 2
            low, high = (middle, high) if self.full_steps(middle) > 2 * self.record.length else (low, middle)
        saturated = [a.count for a in self.record.finished("size") if a.count < 0.95 * a.primitives]
        limit = self.predictor.limit()
        return max(1, min([low, *saturated, *([] if limit is None else [limit])]))

    def _try_size(self, primitives: int) -> None:
        """Run two trials with this number of primitives. One is twice as long, to measure the gain by more steps."""
        length, words = self.record.length, self.record.words
        attempts = [Attempt("size", words, primitives, steps) for steps in (length // 2, length)]
        for several in [attempts] if self.runner.parallel else [[attempt] for attempt in attempts]:
            known = [self.runner.is_finished(attempt) for attempt in several]
            for before, done in zip(known, self.runner.run(*several), strict=True):
                if not before:
                    self.runner.notify(_describe_attempt(done, self.predictor.predict(done.count)))

    def _try_sizes(self) -> None:
        """Run trials with different numbers of primitives, until the best number is known or time is up."""
        first = min(self.config.model.count, self._highest())
        self._try_size(first)
        lengthened = False
        while not self.record.turns and self.full_steps(first) >= 1.9 * _SHORTER * self.record.length:
            self.record.length, lengthened = 2 * self.record.length, True  # steps are faster than the first ones
        if lengthened:
            self._try_size(first)
        own = [a.primitives for a in self.record.attempts if a.purpose == "size" and a.words == self.record.words]
        begun = list(dict.fromkeys(own))
        for count in begun:  # sizes of an interrupted search
            self._try_size(count)
        for _ in range(_MAX_SIZES - len(begun)):
            proposal = self._propose()
            if proposal.kind != "try" or proposal.primitives in begun:
                return
            if not self.runner.fits(proposal.primitives, 1.5 * self.record.length, _TRIALS):
                self.record.add_reason("no time for more sizes")
                return
            begun.append(proposal.primitives)
            self._try_size(proposal.primitives)

    def _propose(self) -> SizeProposal:
        """Return the next step of the search for the number of primitives, from the trainings so far."""
        predictor, highest = self.predictor, self._highest()
        if not self.target.quality:
            return propose_best_size(predictor.margins(), highest)
        return propose_size(predictor.margins(), highest, ALLOWANCE, predictor.doubt)

    def _wanted(self) -> int:
        """Return the number of primitives for the next full run, from the trainings so far."""
        predictor, highest = self.predictor, self._highest()
        margins = predictor.margins()
        if not self.target.quality:
            proposal = propose_best_size(margins, highest)
            return proposal.primitives if proposal.kind == "take" else highest
        counts = [n for n, _ in margins]
        best = max(margins, key=lambda pair: pair[1])[0]
        found = SizeCurve.fit(margins).find_count(ALLOWANCE, highest)
        if found is None and not self.record.finished("full") and max(counts) > best:
            found = best  # a full run of it tells more than trials of larger ones
        more = min(highest, round(_BEYOND * max(counts)))
        if found is not None and found <= _BEYOND * max(counts):
            found = max(found, min(round(min(counts) / _BELOW), highest), self._least_useful())
        elif found is None and (
            best < max(counts) or self.full_steps(more) < _MORE_STEPS * self.full_steps(max(counts))
        ):
            return min(best, highest)  # more primitives would have fewer steps
        else:
            found = more
        for attempt in self.record.finished("full"):  # another full run must differ
            margin = predictor.margin_of(attempt)
            if margin < MIN_MARGIN:
                found = max(found, math.ceil(attempt.count * _MIN_STEP))
            elif margin > _MAX_MARGIN and attempt.count > 1:
                found = min(found, math.floor(attempt.count / _MIN_STEP))
        return max(found, 1)

    def _least_useful(self) -> int:
        """Return the least number of primitives for the next full run; 1 unless all full runs so far exceed the target.

        Trials alone would propose too few: short trials of different sizes often have similar quality.
        """
        full = [(a.count, self.predictor.margin_of(a)) for a in self.record.finished("full")]
        if not full or min(margin for _, margin in full) < MIN_MARGIN:
            return 1
        count, margin = min(full)
        return round(count / 2 ** ((margin - MIN_MARGIN) / _MIN_SLOPE))

    def _report_reach(self) -> None:
        """If the trials show that the target cannot be reached, tell the user and store the message in the record."""
        if not self.target.quality:
            return
        predictor, best = self.predictor, self._wanted()
        margins = predictor.margins()
        if max(SizeCurve.fit(margins).at(best), *(m for _, m in margins)) + predictor.doubt >= ALLOWANCE:
            return
        expected = ", ".join(format_target_forecast(name, *pair) for name, pair in predictor.predict(best).items())
        limited = predictor.limit() is not None and self._highest() == predictor.limit()
        self.record.out_of_reach = (
            f"{self.target} is out of reach: {expected} is the best that "
            f"{'the limits allow' if limited else 'the budget can train'}, of {best:,} primitives; that is made"
        )
        self.runner.notify(self.record.out_of_reach)

    def _change_settings(self) -> None:
        """Run trials of changed settings that save bytes, and adopt the changes that pay.

        The trials use the number of primitives that is closest to :meth:`_wanted`, among the numbers tried so far.
        """
        if self.record.out_of_reach or not (self.target.quality or self.target.megabytes is not None):
            return
        values = list_smaller_settings(self.config, load_config_task(self.config), self.dataset)
        for _ in range(_MAX_CHANGES):
            change = propose_setting_trial(values, self.record.turns)
            wanted = self._wanted()
            bases = [
                a
                for a in self.record.finished("size", "knob")
                if a.words == self.record.words and a.steps == self.record.length
            ]
            if change is None or not bases:
                return
            base = min(bases, key=lambda a: abs(math.log2(a.count / wanted)))
            if not self.runner.fits(base.primitives, self.record.length, _TRIALS):
                self.record.add_reason("no time to try other settings")
                return
            key, before, after = change
            words = {**self.record.words, key: after}
            (tried,) = self.runner.run(Attempt("knob", words, base.primitives, self.record.length))
            loss = {
                n: to_forecast_decibels(n, base.measured(n)) - to_forecast_decibels(n, tried.measured(n))
                for n in ("psnr", "ssim")
            }
            size = (tried.packed / tried.count) / (base.packed / base.count)
            slope = max(SizeCurve.fit(self.predictor.margins()).slope_at(wanted), 0.2)
            adopted = setting_change_pays(max(loss[name] for name in self.predictor.measures), size, slope)
            self.record.turns.append(SettingChange(key, before, after, loss, size, adopted))
            self.runner.write_record()
            end = "kept" if adopted else "not worth it"
            self.runner.notify(f"{key}={after}: {size:.0%} of the bytes, {-loss['psnr']:+.2f} dB; {end}")

    # ------------------------------------------------------------ full runs

    def _run_full(self) -> None:
        """Train full runs until one meets the target without exceeding it by much, or until time is up."""
        for _ in range(_MAX_FULL - (len(self.record.finished("full")) - self.record.before)):
            unfinished = [a for a in self.record.attempts if a.purpose == "full" and a.outcome is None]
            if not unfinished and any(self._is_good(a) for a in self.record.finished("full")):
                return
            attempt = unfinished[-1] if unfinished else self._plan_full()
            if attempt is None:
                return
            expected = ", ".join(format_target_forecast(name, *pair) for name, pair in attempt.predicted.items())
            text = f"full run: {attempt.primitives:,} primitives, {attempt.steps:,} steps; expected {expected}"
            self.runner.notify(text)
            self.runner.notify(_describe_attempt(self.runner.run(attempt)[0], {}))

    def _is_good(self, attempt: Attempt) -> bool:
        """Return whether a full run is so good that another full run is unlikely to be better."""
        if exceeded_limit(self.target, attempt) is not None:
            return False
        if not self.target.quality:
            return self._wanted() <= _MORE * attempt.count
        margin = self.predictor.margin_of(attempt)
        return MIN_MARGIN <= margin <= _MAX_MARGIN and attempt.count <= _NEAR * self._wanted()

    def _plan_full(self) -> Attempt | None:
        """Return the next full run; None if time is too short, or if it would hardly differ from an earlier run."""
        finished, wanted, budget = self.record.finished("full"), self._wanted(), self.record.asked["budget"]
        pace, left = self.runner.pace(wanted), self.runner.seconds_left - self._reserve(wanted)
        share = left if finished else max(left / 2, min(left, _FULL * budget))
        least = self.record.length * (4 if finished else 1)
        steps = int(min(self.max_steps, share / pace))
        if finished and steps < max(least, _MORE_STEPS * finished[-1].steps):
            self.record.add_reason(f"no time for another full run: {max(left, 0):.0f} s are left")
            return None
        if finished and any(abs(math.log2(wanted / a.count)) < math.log2(_MIN_STEP) / 2 for a in finished):
            self.record.add_reason("another size promises nothing better")
            return None
        steps = max(steps, least)
        seconds = round(max(min(_SLOWER * steps * pace, left), 0.02 * budget, 1.0), 1)
        return Attempt("full", self.record.words, wanted, steps, seconds, self.predictor.predict(wanted))

    def _reserve(self, primitives: int) -> float:
        """Return the seconds to reserve for the steps after a full run: evaluation, pictures, quantization."""
        trials = self.record.finished("size", "full")
        frame = forecast_time([(a.count, a.measured("ms_per_frame")) for a in trials], primitives) / 1e3
        held_out = min(VIEWS, len(self.dataset.train) // self.record.hold_out)
        frames = 6 * held_out + 3 * len(self.dataset.test) + 40
        return 2 * frame * frames + 2 * max(self.runner.overhead(), 0.0)


def _describe_attempt(attempt: Attempt, predicted: Mapping[str, Sequence[float]]) -> str:
    changes = "".join(f" {key.rpartition('.')[2]}={value}" for key, value in sorted(attempt.words.items()))
    expected = ", ".join(format_target_forecast(name, *pair) for name, pair in predicted.items())
    measured = f"held out {attempt.measured('psnr'):.2f} dB, ssim {attempt.measured('ssim'):.4f}"
    return (
        f"{attempt.count:,} primitives{changes}, {attempt.steps:,} steps, {attempt.packed / 1e3:.1f} kB: {measured}"
        f"{f'; a full run: {expected}' if expected else ''} ({attempt.seconds:.1f} s)"
    )
