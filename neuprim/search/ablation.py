"""Trade-offs of training: train a designed set of models, measure them together, and find the Pareto fronts.

The set holds the *centre*, which the user's overrides define, every setting changed alone, and promising combinations.
All models train for the same time. The same request continues an earlier set.
"""

from __future__ import annotations

import math
import shlex
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

import numpy as np

from neuprim.config import RunConfig, compose, find_run_plugins, task_of
from neuprim.config.overrides import parse, quote_override
from neuprim.core.compute.threads import limit_process_threads
from neuprim.core.data import Dataset
from neuprim.core.data.dataset_check import check_dataset
from neuprim.core.errors import ConfigError, NeuprimError, nearest
from neuprim.report.tradeoff import Picture, write_tradeoff
from neuprim.runs.events import Event, Note, Preparing, Step
from neuprim.runs.fit import use_one_torch_thread
from neuprim.runs.ground_truth import render_ground_truth_for_training
from neuprim.runs.launch.executors import count_parallel_jobs
from neuprim.runs.launch.launcher import use_launcher_threads
from neuprim.runs.open import load_dataset
from neuprim.runs.run_directory import lock_directory
from neuprim.search.ablation_folder import (
    TRIALS,
    AblationRequest,
    check_folder,
    compose_centre,
    describe_identity,
    parse_plan,
    resume_record,
)
from neuprim.search.ablation_plan import (
    CENTRE,
    Plan,
    StepTimes,
    Variant,
    combine_models,
    list_variants,
    override,
    plan_lengths,
)
from neuprim.search.eval_views import eval_views, fill_masked
from neuprim.search.measuring import (
    MEMORY_UNKNOWN,
    EvaluationSetup,
    TimedPoint,
    load_setup,
    measure_point,
    render_exact,
    time_points,
)
from neuprim.search.points import COMBINED, TRADEOFF_FILE, Record, read_record, write_csv
from neuprim.search.trials import Outcome, Trial, launch_trials, run_trial

__all__ = ["format_run_command", "run_ablation"]

_PACES, _TRAINING = 0.2, 0.5
"""Shares of the budget for measuring step times, and, of the rest, for training single changes."""

_SINGLES, _TIMES, _COMBINED = 0.58, 0.64, 0.88
"""Shares of the rest by which single changes are trained and timed, and combinations trained."""

_EXACT = 0.004
"""Share of the budget for one model's exact images."""

_MAX_COMBINATIONS = 12

_MAX_PSNR = 200.0
"""dB that stand for equal images."""

Progress = Callable[[str, float], None]
Tell = Callable[[str], None]


def format_run_command(overrides: Sequence[str]) -> str:
    """Return the command that trains a model."""
    return shlex.join(["neuprim", "run", *overrides])


def run_ablation(
    request: AblationRequest, tell: Tell = lambda text: None, progress: Progress = lambda text, fraction: None
) -> tuple[Path, Record]:
    """Train, measure, and write ``tradeoff.json``, ``tradeoff.csv``, ``tradeoff.html`` and ``front.png``.

    Returns the folder of the set and its record. A larger budget adds what did not fit.

    Raises:
        NeuprimError: invalid overrides, no such knob, data that cannot be read, or a folder that holds something else.
    """
    words, folder, centre = compose_centre(request)
    task = task_of(centre)
    with use_one_torch_thread(), use_launcher_threads(request.launcher), ExitStack() as stack:
        stack.enter_context(find_run_plugins(centre).attribute_errors())
        variants = list_variants(centre, task)
        for name in request.knobs:
            if name not in variants:
                raise ConfigError(
                    f"--knobs {name}: no such knob of a model of task {task.name!r}{nearest(name, variants)}"
                )
        before = read_record(folder / TRADEOFF_FILE)
        check_folder(folder, before, centre, request)
        stack.enter_context(lock_directory(folder, "set"))
        plan = parse_plan(folder / TRADEOFF_FILE, before)
        render_ground_truth_for_training(centre, request.launcher, progress)
        dataset = load_dataset(centre, task, progress)
        check_dataset(dataset, task.conditions)
        record = resume_record(folder, before, describe_identity(centre, dataset, request), tell)
        session = _Session(request, _Set(folder, words, centre, dataset, plan), record, tell, progress)
        chosen = {name: own for name, own in variants.items() if not request.knobs or name in request.knobs}
        for name, own in chosen.items():
            if not own:
                record.leave_out(name, (), "the centre has no other value")
        pictures = session.run([Variant(CENTRE), *_interleave(chosen)])
    write_tradeoff(folder, record.to_dict(), pictures, format_run_command)
    return folder, record


def _interleave(variants: Mapping[str, Sequence[Variant]]) -> Iterator[Variant]:
    """Yield the first of every knob, then the second, so that short budgets change as many knobs as possible."""
    for rung in zip_longest(*variants.values()):
        yield from (variant for variant in rung if variant is not None)


@dataclass
class _Set:
    folder: Path
    words: list[str]
    centre: RunConfig
    dataset: Dataset
    plan: Plan | None


class _Session:
    """Train and measure a set within the budget."""

    def __init__(self, request: AblationRequest, models: _Set, record: Record, tell: Tell, progress: Progress) -> None:
        self.request, self.set, self.record, self.tell, self.progress = request, models, record, tell, progress
        self.views = eval_views(models.dataset, request.views)
        spent = record.facts.get("spent_seconds", 0.0)
        self._begun = time.monotonic() - (float(spent) if isinstance(spent, int | float) else 0.0)
        self._planned_at = 0.0
        self._step_times: StepTimes | None = None
        self._setups: dict[str, EvaluationSetup] = {}
        self._workers, self._threads = count_parallel_jobs(request.launcher, 1000)
        self._notes: set[str] = set()

    @property
    def plan(self) -> Plan:
        assert self.set.plan is not None
        return self.set.plan

    @property
    def spent(self) -> float:
        """Seconds of the budget so far, with earlier sessions and without compiling."""
        compiling = 0.0 if self._step_times is None else self._step_times.compiling
        return time.monotonic() - self._begun - compiling

    def _left(self, part: float) -> float:
        """Seconds until a share of what remained after planning is used."""
        return self._planned_at + part * max(self.request.budget - self._planned_at, 0.0) - self.spent

    def run(self, wanted: Sequence[Variant]) -> dict[int, Picture]:
        """Train single changes, then combinations; returns pictures of the fronts."""
        with limit_process_threads(self._threads):  # as the trainings have
            wanted = self._measure_paces(wanted)
        alone = len({variant.knob for variant in wanted}) <= 2  # the centre and one knob: nothing to combine
        self._planned_at = self.spent
        self._train(wanted, _COMBINED if alone else _SINGLES)
        self._take_times(1.0 if alone else _TIMES)
        self._train(self._combinations(), _COMBINED)
        self._train(wanted, _COMBINED)
        self._take_times(1.0)
        self._describe()
        self.record.find_fronts(lambda point: True, lambda point: True)
        self._write()
        write_csv(self.set.folder / "tradeoff.csv", self.record)
        self.progress("pictures of the front", 0.0)
        return self._render_pictures()

    def _write(self) -> None:
        self.record.facts["spent_seconds"] = self.spent
        if self.set.plan is not None:
            self.record.facts["plan"] = vars(self.set.plan)
        self.record.write(self.set.folder / TRADEOFF_FILE)

    # ------------------------------------------------------------ step times

    def _measure_paces(self, wanted: Sequence[Variant]) -> list[Variant]:
        """Return the variants whose step time is known; makes the plan."""
        kept, latest = list[Variant](), self.spent + _PACES * (self.request.budget - self.spent)
        paces = dict(self.set.plan.paces) if self.set.plan is not None else {}
        for number, variant in enumerate(wanted):
            self.progress(f"step time of {variant.name}", number / len(wanted))
            known = not variant.turned or variant.name in paces
            late = not known and self.spent > latest
            reason = self._no_time() if late else self._find_pace(variant, paces)
            if reason is None:
                kept.append(variant)
            else:
                self.record.leave_out(variant.knob, variant.label, reason)
        if self.set.plan is None:
            lengths = [variant.length for variant in kept for _ in range(self.request.seeds)]
            seconds = _TRAINING * (self.request.budget - self.spent) * self._workers
            self.set.plan = plan_lengths(self.set.centre, self._times().seconds, seconds, lengths)
        self.plan.paces.update(paces)
        return kept

    def _times(self) -> StepTimes:
        if self._step_times is None:
            self._step_times = StepTimes(self.set.centre, self.set.dataset)
        return self._step_times

    def _find_pace(self, variant: Variant, paces: dict[str, float]) -> str | None:
        """Measure a variant's step time; returns why it cannot be trained."""
        if not variant.turned:
            paces[variant.name] = 1.0
        if variant.name in paces:
            return None
        words = override(self.set.words, [*variant.turned, "output_dir=null"])
        try:
            ratio = self._times().measure(compose(words, check_output=False))
        except NeuprimError as error:
            return str(error)
        if ratio is None:
            return "the same model as the centre"
        paces[variant.name] = ratio
        return None

    def _no_time(self) -> str:
        return f"no time left of the budget of {self.request.budget:g} s"

    # ------------------------------------------------------------ training

    def _train(self, wanted: Sequence[Variant], part: float) -> None:
        """Train and measure what is missing and fits; the centre and begun trainings always do."""
        known = {(point.turned, point.length) for point in self.record.points}
        todo = [variant for variant in wanted if (variant.turned, variant.length) not in known]
        several = max(self._workers // self.request.seeds, 1)
        for first in range(0, len(todo), several):
            batch: list[Variant] = []
            for variant in todo[first : first + several]:
                begun = (self._run_dir(variant, 0) / "checkpoint.safetensors").exists()
                rounds = math.ceil((len(batch) + 1) * self.request.seeds / self._workers)
                if not begun and variant.name != CENTRE and rounds * self.plan.seconds > self._left(part):
                    self.record.leave_out(variant.knob, variant.label, self._no_time())
                    continue
                self.record.left_out = [one for one in self.record.left_out if one.words != variant.label]
                batch.append(variant)
            text = f"training {first + 1} of {len(todo)}, {', '.join(variant.name for variant in batch)}"
            for variant, outcomes in zip(batch, self._run_trials(batch, text), strict=True):
                if not isinstance(outcomes, NeuprimError):
                    self._measure(variant, outcomes)
                elif variant.name == CENTRE:
                    raise outcomes
                else:
                    self.record.leave_out(variant.knob, variant.label, str(outcomes))

    def _run_trials(self, variants: Sequence[Variant], text: str) -> list[list[Outcome] | NeuprimError]:
        """Return the outcomes of every seed of each variant, or why there are none."""
        groups = [[self._trial(variant, seed) for seed in range(self.request.seeds)] for variant in variants]
        if self.request.launcher.name != "inline":
            hear = lambda part: self.progress(text, part)  # noqa: E731
            return launch_trials(groups, self.request.launcher, self.set.folder, hear)
        outcomes: list[list[Outcome] | NeuprimError] = []
        for group in groups:
            try:
                outcomes.append([run_trial(trial, self.set.dataset, self._listener(text)) for trial in group])
            except NeuprimError as error:
                outcomes.append(error)
        return outcomes

    def _trial(self, variant: Variant, seed: int) -> Trial:
        words = self.plan.overrides(variant, self.set.words, self.set.centre)
        quiet = [] if any(a.key == "train.eval_every" for a in parse(words)) else ["train.eval_every=0"]
        place = quote_override("output_dir", str(self._run_dir(variant, seed)))
        own = [*quiet, quote_override("seed", self.set.centre.seed + seed), place]
        return Trial(compose(override(words, own), check_output=False), views=self.request.views)

    def _run_dir(self, variant: Variant, seed: int) -> Path:
        suffix = f"_seed-{self.set.centre.seed + seed}" if seed else ""
        return self.set.folder / TRIALS / (variant.folder + suffix)

    def _listener(self, text: str) -> Callable[[Event], None]:
        def hear(event: Event) -> None:
            match event:
                case Step():
                    self.progress(text, event.progress)
                case Preparing():
                    self.progress(f"{text}: {event.text}", event.fraction)
                case Note() if event.text not in self._notes:
                    self._notes.add(event.text)
                    self.tell(event.text)

        return hear

    # ------------------------------------------------------------ measuring

    def _setup(self, run_dir: str) -> EvaluationSetup:
        if run_dir not in self._setups:
            loaded = self.set.dataset, self.views
            path = self.set.folder / run_dir
            self._setups[run_dir] = load_setup(path, (), len(self.views), self.request.lpips, loaded)
        return self._setups[run_dir]

    def _measure(self, variant: Variant, outcomes: Sequence[Outcome]) -> None:
        first, run_dir = outcomes[0], self._run_dir(variant, 0).relative_to(self.set.folder).as_posix()
        setup = self._setup(run_dir)
        known = self.record.facts.get("exact")
        float64 = bool(known["float64"]) if isinstance(known, dict) and "float64" in known else None
        exact = render_exact(setup, _EXACT * self.request.budget, float64)  # all models alike
        self.record.facts.setdefault("exact", exact.to_dict())
        point, _ = measure_point(setup, variant.knob, setup.reference, exact)
        means = {name: float(np.mean([getattr(one, name) for one in outcomes])) for name in ("psnr", "ssim")}
        trained = replace(
            point,
            words=tuple(self.plan.overrides(variant, self.set.words, self.set.centre)),
            quality={**point.quality, **means},
            turned=variant.turned,
            length=variant.length,
            primitives=first.primitives,
            parameters_per_primitive=first.parameters_per_primitive,
            steps=first.steps,
            seconds=first.seconds,
            steps_in_turns=(self.plan.paces[variant.name],),
            seeds=tuple(min(one.psnr, _MAX_PSNR) for one in outcomes),
            run_dir=run_dir,
        )
        self.record.points.append(trained)
        self._write()

    def _take_times(self, part: float) -> None:
        """Time all models that lack rounds."""
        timed = []
        for point in self.record.points:
            setup = self._setup(point.run_dir)
            timed.append(TimedPoint(point, lambda s=setup: s.renderer(s.reference), self.request.repeats))  # type: ignore[misc]

        def done(number: int, count: int) -> None:
            self._write()
            self.progress(f"round {number} of {count}, {len(timed)} models", number / count)

        if any(len(one.point.ms) < one.rounds for one in timed):
            time_points(timed, self.views, time.monotonic() + self._left(part), done)
        for point in self.record.points:
            point.centre_ms = statistics.median(self.record.points[0].ms)

    def _combinations(self) -> list[Variant]:
        """Return combinations of earlier sessions, and as many new ones as there is time for."""
        points = self.record.points
        old = [Variant(COMBINED, point.turned) for point in points if point.knob == COMBINED]
        rounds = self._left(_COMBINED) / max(self.plan.seconds * self.request.seeds, 1e-9)
        most = min(int(self._workers * rounds), _MAX_COMBINATIONS - len(old))
        new = [Variant(COMBINED, way) for way in combine_models(points, most)]
        allowed = []
        for variant in new:
            reason = self._find_pace(variant, self.plan.paces)
            if reason is None:
                allowed.append(variant)
            else:
                self.record.leave_out(variant.knob, variant.label, reason)
        return [*old, *allowed]

    def _describe(self) -> None:
        centre, setup = self.set.centre, self._setup(self.record.points[0].run_dir)
        self.record.facts |= {
            "task": centre.task,
            "scene": centre.scene_name,
            "preset": centre.preset,
            "dataset": self.set.dataset.name,
            "data_source": self.set.dataset.data_source,
            "words": list(self.set.words),
            "seeds": self.request.seeds,
            "budget_seconds": self.request.budget,
            "length": self.plan.describe(),
            "backend": setup.backend(setup.reference).name,
            "not_measured": {} if setup.lpips else {"lpips": "no weights were given (--lpips FILE)"},
        }
        if not Path("/proc/self/clear_refs").exists():
            self.record.facts["not_measured"]["peak_bytes"] = MEMORY_UNKNOWN

    def _render_pictures(self) -> dict[int, Picture]:
        """Return pictures of the fronts' models beside the ground truth, which is under -1."""
        points = self.record.points
        centre = self._setup(points[0].run_dir)
        view = max(self.views, key=lambda one: float(centre.channels.display(one.image).var()))
        wanted = centre.display(view.image)
        pictures = {-1: Picture(wanted, None)}
        for number in dict.fromkeys((0, *self.record.speed, *self.record.size)):
            setup = self._setup(points[number].run_dir)
            image = setup.renderer(setup.reference)(view.view)
            pictures[number] = Picture(centre.display(fill_masked(image, view)), wanted)
        return pictures
