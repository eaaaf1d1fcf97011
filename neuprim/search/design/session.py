"""One session of training and measuring: what is done by when, and what is left out for lack of time."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from neuprim.config import RunConfig, compose
from neuprim.config.overrides import parse, quote_override
from neuprim.core.compute.threads import limit_process_threads
from neuprim.core.data import Dataset
from neuprim.core.errors import NeuprimError
from neuprim.runs.events import Event, Note, Preparing, Step
from neuprim.runs.launch.executors import count_parallel_jobs
from neuprim.search.design.combine import combinations
from neuprim.search.design.kept import TRIALS
from neuprim.search.design.pace import Pace, Paces
from neuprim.search.design.plan import Plan, planned
from neuprim.search.design.record import Model
from neuprim.search.design.request import DesignRequest, Progress, Tell
from neuprim.search.design.side_by_side import SideBySide
from neuprim.search.design.variants import CENTRE, COMBINED, Variant, merged
from neuprim.search.tradeoff.knobs import LeftOut
from neuprim.search.tradeoff.record import Record
from neuprim.search.trial_jobs import launched_trials
from neuprim.search.trials import Outcome, Trial, run_trial
from neuprim.search.truths import truths_of

__all__ = ["Session"]

_PACED = 0.2
"""Part of the budget that is left when data are loaded, which finding paces may take."""

_SLOW = 10.0
"""Seconds of compiling that are said."""

_TRAINED, _TOGETHER = 0.5, 0.22
"""Parts of what remains then for training single knobs, and for training combinations; a knob that is the only one has
both."""

_EXACT = 0.08
"""Part of it for the exact images of all models together, of which there are about so many."""
_ABOUT = 20

_MOST = 200.0
"""dB that stand for equal images."""

_COMBINATIONS = 12
"""Of those at most."""

_ROUNDS = 4
"""Of trainings begun together elsewhere, at most: between two of them the time is looked at."""

_MANY = 1000
"""More trainings than any machine has cores."""


class Session:
    """Trains and measures what it is asked for, as far as the budget goes.

    Args:
        folder: of the set.
        words: of the centre.
        record: filled as models are there.
        before: seconds of the budget that earlier sessions used.

    Attributes:
        plan: the lengths, once they are chosen.
        compiling: seconds that went into compiling kernels, which happens once per installation.
    """

    def __init__(
        self,
        request: DesignRequest,
        folder: Path,
        words: list[str],
        centre: RunConfig,
        dataset: Dataset,
        record: Record,
        tell: Tell,
        progress: Progress,
        begun: float,
        before: float,
        plan: Plan | None,
    ) -> None:
        self.request, self.folder, self.words, self.centre, self.dataset = request, folder, words, centre, dataset
        self.record, self.tell, self.progress, self.plan = record, tell, progress, plan
        self._begun, self._before, self._planned_at = begun, before, before
        self.measuring = SideBySide(folder, dataset, truths_of(dataset, request.views), request.lpips, progress)
        self.compiling = 0.0
        self._told: set[str] = set()
        self._paces: Paces | None = None
        self._known: dict[str, Pace] = {}
        self._late = 1.0
        self._workers, self._threads = count_parallel_jobs(request.launcher, _MANY)

    @property
    def models(self) -> list[Model]:
        return [model for model in self.record.points if isinstance(model, Model)]

    # ------------------------------------------------------------ time

    @property
    def spent(self) -> float:
        """Seconds of the budget so far, those of earlier sessions included, but not those that went into compiling
        kernels."""
        return self._before + time.monotonic() - self._begun - self.compiling

    @property
    def remaining(self) -> float:
        """Seconds of the budget that were left when the lengths were chosen, or when this session began, if that was
        later."""
        return max(self.request.budget - self._planned_at, 0.0)

    def left(self, part: float) -> float:
        """Seconds until a part of what remained is used up; negative after that."""
        return self._planned_at + part * self.remaining - self.spent

    def leave_out(self, variant: Variant, reason: str) -> None:
        one = LeftOut(variant.knob, self._said(variant), reason)
        self.record.left_out = [other for other in self.record.left_out if other.words != one.words] + [one]

    def _said(self, variant: Variant) -> tuple[str, ...]:
        length = () if variant.length == 1.0 else (f"{variant.length:g} of the length",)
        return (*variant.turned, *length)

    def _no_time(self) -> str:
        return f"no time left of the budget of {self.request.budget:g} s"

    def write(self) -> None:
        self.record.facts["spent_seconds"] = self.spent
        if self.plan is not None:
            self.record.facts["plan"] = self.plan.to_dict()
        self.record.write(self.folder / "tradeoff.json")

    # ------------------------------------------------------------ paces and lengths

    def with_paces(self, wanted: Sequence[Variant]) -> list[Variant]:
        """Those whose pace could be found in time, and that are models of their own; the others are left out."""
        with limit_process_threads(self._threads):  # as the trainings will have
            return self._with_paces(wanted)

    def _with_paces(self, wanted: Sequence[Variant]) -> list[Variant]:
        kept, begun = list[Variant](), self.spent
        latest = begun + _PACED * (self.request.budget - begun)
        for number, variant in enumerate(wanted):
            self.progress(f"pace of {variant.name}", number / len(wanted))
            late = self.spent > latest
            reason = self._no_time() if late and not self._cheap(variant) else self._find_pace(variant)
            if reason is None:
                kept.append(variant)
            else:
                self.leave_out(variant, reason)
        return kept

    def _cheap(self, variant: Variant) -> bool:
        """Whether nothing has to be trained for the pace, or everything hangs on it."""
        return not variant.turned or (self.plan is not None and variant.name in self.plan.paces)

    def _find_pace(self, variant: Variant) -> str | None:
        """Into what is known; why the variant cannot be trained, or None if it can."""
        if self.plan is not None and variant.name in self.plan.paces:
            return None
        if not variant.turned:
            self._known[variant.name] = self._all_paces().centre
            return None
        words = merged(self.words, [*variant.turned, "output_dir=null"])
        paces = self._all_paces()
        try:
            found = paces.of(compose(words, check_output=False))
        except NeuprimError as error:
            return str(error)
        finally:
            self.compiling = paces.compiling
        if found.like == paces.centre.like:
            return "the same model as the centre"
        self._known[variant.name] = found
        if self.plan is not None:
            self.plan = self.plan.knowing(variant, found.ratio)
        return None

    def _all_paces(self) -> Paces:
        if self._paces is None:
            self.progress(f"pace of {CENTRE}", 0.0)
            self._paces = Paces(self.centre, self.dataset)
            self.compiling = self._paces.compiling
        return self._paces

    def make_plan(self, wanted: Sequence[Variant], combined: bool = True) -> None:
        """Choose lengths with which all of these fit, unless that was done by an earlier session: then the same models
        are trained.

        ``combined``: whether combinations will follow.
        """
        if self.compiling > _SLOW:
            self.tell(f"{self.compiling:.0f} s went into compiling kernels, once per installation; they do not count")
        self._planned_at = self.spent
        if self.plan is None:
            lengths = [variant.length for variant in wanted for _ in range(self.request.seeds)]
            starting = sum(self._known[variant.name].starting for variant in wanted) / len(wanted)
            part = _TRAINED if combined else _TRAINED + _TOGETHER
            self.plan = planned(
                self.centre, self._all_paces().seconds, part * self.remaining * self._workers, lengths, starting
            )
            for variant in wanted:
                self.plan = self.plan.knowing(variant, self._known[variant.name].ratio)
        self.write()

    # ------------------------------------------------------------ training

    def train(self, wanted: Sequence[Variant], part: float) -> None:
        """Train what is not there yet and ends by that part of what remained, and look at its images. What an earlier
        session has begun is ended in any case, and so is the centre, without which nothing can be said."""
        assert self.plan is not None
        todo = [variant for variant in wanted if not any(model.variant == variant for model in self.models)]
        while todo:
            several = self._fitting(todo, part)
            batch, todo = todo[:several], todo[several:]
            fits: list[Variant] = []
            for variant in batch:
                paid = variant.name == CENTRE or (self._run_dir(variant, 0) / "checkpoint.safetensors").exists()
                if not paid and self._late * self._lasts([*fits, variant]) > self.left(part):
                    self.leave_out(variant, self._no_time())
                    continue
                self.record.left_out = [one for one in self.record.left_out if one.words != self._said(variant)]
                fits.append(variant)
            if fits:
                first = wanted.index(fits[0]) + 1
                names = fits[0].name if len(fits) == 1 else f"{fits[0].name} to {fits[-1].name}"
                self._make(fits, f"training {first} of {len(wanted)}, {names}")

    def _fitting(self, todo: Sequence[Variant], part: float) -> int:
        """How many of them to begin together: one in this process; elsewhere as many as are at work at once, some
        rounds of them where there is time, as workers take a while to begin."""
        if self._workers == 1:
            return 1
        most = max(self._workers // self.request.seeds, 1)
        rounds = self.left(part) / max(self._late * self._lasts(todo[:most]), 1e-9)
        return most * int(min(max(rounds, 1), _ROUNDS))

    def _lasts(self, variants: Sequence[Variant]) -> float:
        """Seconds from the begin to the end of training them together."""
        assert self.plan is not None
        rounds = -(-len(variants) * self.request.seeds // self._workers)
        return self.plan.seconds * max(variant.length for variant in variants) * rounds

    def _make(self, variants: Sequence[Variant], text: str) -> None:
        """Train variants and look at their images; those that cannot be trained are left out."""
        begun = time.monotonic()
        made = self._trained(variants, text)
        took = time.monotonic() - begun
        for variant, outcomes in zip(variants, made, strict=True):
            if isinstance(outcomes, NeuprimError):
                if variant.name == CENTRE:
                    raise outcomes
                self.leave_out(variant, str(outcomes))
                continue
            if self._workers == 1:
                took = max(took, sum(outcome.seconds for outcome in outcomes))
            self._late = 0.5 * (self._late + took / max(self._lasts(variants), 1e-9))
            self._look(variant, outcomes)

    def _trained(self, variants: Sequence[Variant], text: str) -> list[list[Outcome] | NeuprimError]:
        """Outcomes of every seed of each variant, or why there are none."""
        trials = [[self._trial(variant, seed) for seed in range(self.request.seeds)] for variant in variants]
        made: list[list[Outcome] | NeuprimError] = []
        if self.request.launcher.name != "inline":
            return launched_trials(
                trials, self.request.launcher, self.folder, lambda fraction: self.progress(text, fraction)
            )
        for several in trials:
            try:
                made.append([run_trial(trial, self.dataset, self._hear(text)) for trial in several])
            except NeuprimError as error:
                made.append(error)
        return made

    def _words_of(self, variant: Variant) -> list[str]:
        assert self.plan is not None
        return self.plan.words_of(variant, self.words, self.centre)

    def _trial(self, variant: Variant, seed: int) -> Trial:
        words = self._words_of(variant)
        quiet = [] if any(a.key == "train.eval_every" for a in parse(words)) else ["train.eval_every=0"]
        own = [
            quote_override("seed", self.centre.seed + seed),
            quote_override("output_dir", str(self._run_dir(variant, seed))),
        ]
        return Trial(compose(merged(words, [*quiet, *own]), check_output=False), views=self.request.views)

    def _look(self, variant: Variant, outcomes: Sequence[Outcome]) -> None:
        """Measure what was trained, into the record."""
        assert self.plan is not None
        first, run_dir = outcomes[0], self._run_dir(variant, 0)
        measured, exact = self.measuring.look(run_dir, variant.knob, _EXACT * self.remaining / _ABOUT, self._float64)
        self.record.facts.setdefault("exact", exact)
        means = {name: float(np.mean([getattr(outcome, name) for outcome in outcomes])) for name in ("psnr", "ssim")}
        paces = self._known[variant.name].ratios if variant.name in self._known else (self.plan.paces[variant.name],)
        self.record.points.append(
            Model(
                knob=variant.knob,
                words=tuple(self._words_of(variant)),
                quality={**measured.quality, **means},
                bytes=measured.bytes,
                peak_bytes=measured.peak_bytes,
                turned=variant.turned,
                length=variant.length,
                primitives=first.primitives,
                parameters_per_primitive=first.parameters_per_primitive,
                steps=first.steps,
                seconds=first.seconds,
                steps_in_turns=paces,
                seeds=tuple(min(outcome.psnr, _MOST) for outcome in outcomes),
                run_dir=run_dir.relative_to(self.folder).as_posix(),
            )
        )
        self.write()

    @property
    def _float64(self) -> bool | None:
        """How the exact images of the first model were drawn: those of all are drawn alike."""
        found = self.record.facts.get("exact")
        return bool(found["float64"]) if isinstance(found, dict) and "float64" in found else None

    def _run_dir(self, variant: Variant, seed: int) -> Path:
        return self.folder / TRIALS / (variant.folder + (f"_seed-{self.centre.seed + seed}" if seed else ""))

    def _hear(self, text: str) -> Callable[[Event], None]:
        def hear(event: Event) -> None:
            match event:
                case Step():
                    self.progress(text, event.progress)
                case Preparing():
                    self.progress(f"{text}: {event.text}", event.fraction)
                case Note() if event.text not in self._told:
                    self._told.add(event.text)
                    self.tell(event.text)

        return hear

    # ------------------------------------------------------------ what comes of it

    def take_times(self, part: float) -> None:
        """Rounds of all models that lack some."""
        self.measuring.take_times(self.models, self.request.repeats, time.monotonic() + self.left(part), self.write)
        for model in self.models:
            model.centre_ms = statistics.median(self.models[0].ms)

    def combinations(self, part: float) -> list[Variant]:
        """Those of an earlier session, and as many more as there is time for."""
        assert self.plan is not None
        old = [model.variant for model in self.models if model.knob == COMBINED]
        seconds = self._workers * min(_TOGETHER * self.remaining, self.left(part))
        most = min(
            int(seconds / max(self._late * self.plan.seconds * self.request.seeds, 1e-9)), _COMBINATIONS - len(old)
        )
        found = combinations(self.models, most)
        return [*old, *(variant for variant in found if self._allowed(variant))]

    def _allowed(self, variant: Variant) -> bool:
        reason = self._find_pace(variant)
        if reason is not None:
            self.leave_out(variant, reason)
        return reason is None
