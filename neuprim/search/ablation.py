"""Trade-offs of training: train a designed set of models, measure them together, and find the Pareto fronts.

The set holds the *centre*, which the user's overrides define, every setting changed alone, and promising combinations.
All models train for the same time. The same request continues an earlier set.
"""

from __future__ import annotations

import math
import shlex
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

from neuprim.config import Job, RunConfig, compose, find_run_plugins, task_of
from neuprim.config.command_settings import LauncherSettings
from neuprim.config.outputs import ROOT
from neuprim.config.overrides import parse, quote_override
from neuprim.core.compute.threads import limit_process_threads
from neuprim.core.data import Dataset
from neuprim.core.data.dataset_check import check_dataset
from neuprim.core.errors import ConfigError, DataError, NeuprimError, nearest
from neuprim.core.validation import validate
from neuprim.report.tradeoff import write_tradeoff
from neuprim.runs.fit import use_one_torch_thread
from neuprim.runs.ground_truth import render_ground_truth_for_training
from neuprim.runs.launch.executors import count_parallel_jobs
from neuprim.runs.launch.launcher import use_launcher_threads
from neuprim.runs.open import load_dataset
from neuprim.runs.run_directory import lock_directory
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
from neuprim.search.eval_views import EvalView, eval_views
from neuprim.search.measuring import (
    EvaluationSetup,
    Renderer,
    TimedPoint,
    describe_conditions,
    describe_setup,
    load_setup,
    measure_point,
    render_exact,
    render_front_pictures,
    time_points,
)
from neuprim.search.points import COMBINED, TRADEOFF_FILE, Record, read_record, write_csv
from neuprim.search.trials import Outcome, Trial, TrialFailed, launch_trials

TRIALS = "trials"
"""Folder of the models."""

_PACES, _TRAINING = 0.2, 0.5
"""Shares of the budget for measuring step times, and, of the rest, for training single changes."""

_SINGLES, _TIMES, _COMBINED = 0.58, 0.64, 0.88
"""Shares of the rest by which single changes are trained and timed, and combinations trained."""

_EXACT = 0.004
"""Share of the budget for one model's exact images."""

_MAX_COMBINATIONS = 12

Progress = Callable[[str, float], None]
Tell = Callable[[str], None]


@dataclass(frozen=True)
class AblationRequest:
    """What to train and measure.

    Attributes:
        words: overrides of ``neuprim run``; they define the centre and, with ``output_dir``, the folder of the set.
        budget: seconds for everything, about; what does not fit is left out.
        views: evaluation views, evenly spread.
        repeats: rounds of timing.
        knobs: names of those to change; empty for all.
        seeds: trainings of every model.
        lpips: weights for LPIPS; None for those of the configuration.
        launcher: where models are trained; they are measured here.
    """

    words: Sequence[str]
    budget: float = 1200.0
    views: int = 5
    repeats: int = 15
    knobs: Sequence[str] = ()
    seeds: int = 1
    lpips: Path | None = None
    launcher: LauncherSettings = LauncherSettings()  # noqa: RUF009 (frozen)


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
    words, folder, centre = _compose_centre(request)
    file, task = folder / TRADEOFF_FILE, task_of(centre)
    with use_one_torch_thread(), use_launcher_threads(request.launcher), ExitStack() as stack:
        stack.enter_context(find_run_plugins(centre).attribute_errors())
        variants = list_variants(centre, task)
        for name in request.knobs:
            if name not in variants:
                known = nearest(name, variants)
                raise ConfigError(f"--knobs {name}: no such knob of a model of task {task.name!r}{known}")
        before = read_record(file)
        _check_folder(folder, before, centre, request)
        stack.enter_context(lock_directory(folder, "set"))
        plan = None if before is None else _parse_plan(file, before)
        render_ground_truth_for_training(centre, request.launcher, progress)
        dataset = load_dataset(Job(centre, task), progress)
        check_dataset(dataset, task.conditions)
        views = eval_views(dataset, request.views)
        if not views:
            raise DataError(f"{dataset.name} has no test views; expected some to measure on")
        record = _resume_record(folder, before, _identity(centre, views, request), tell)
        session = _Session(request, _Set(folder, words, centre, dataset, views), plan, record, progress)
        chosen = {name: own for name, own in variants.items() if not request.knobs or name in request.knobs}
        for name, own in chosen.items():
            if not own:
                record.leave_out(name, (), "the centre has no other value")
        # The first of every knob, then the second, so that short budgets change as many knobs as possible.
        rungs = [variant for rung in zip_longest(*chosen.values()) for variant in rung if variant is not None]
        session.run([Variant(CENTRE), *rungs])
        progress("pictures of the front", 0.0)
        pictures = render_front_pictures(record, views, session.renderer)
    write_tradeoff(folder, record.to_dict(), pictures, format_run_command)
    return folder, record


@dataclass
class _Set:
    """A set of models: its folder, the centre's overrides and configuration, its data, and the evaluation views."""

    folder: Path
    words: list[str]
    centre: RunConfig
    dataset: Dataset
    views: list[EvalView]


class _Session:
    """Train and measure a set within the budget."""

    def __init__(
        self, request: AblationRequest, models: _Set, plan: Plan | None, record: Record, progress: Progress
    ) -> None:
        self.request, self.set, self.record, self.progress = request, models, record, progress
        self._plan = plan
        spent = record.facts.get("spent_seconds", 0.0)
        self._begun = time.monotonic() - (float(spent) if isinstance(spent, int | float) else 0.0)
        self._planned_at = 0.0
        self._step_times: StepTimes | None = None
        self._setups: dict[str, EvaluationSetup] = {}
        self._workers, self._threads = count_parallel_jobs(request.launcher, 1000)

    @property
    def plan(self) -> Plan:
        assert self._plan is not None, "made by measuring step times"
        return self._plan

    @property
    def spent(self) -> float:
        """Seconds of the budget so far, with earlier sessions and without compiling."""
        compiling = 0.0 if self._step_times is None else self._step_times.compiling
        return time.monotonic() - self._begun - compiling

    def _left(self, part: float) -> float:
        """Seconds until a share of what remained after planning is used."""
        return self._planned_at + part * max(self.request.budget - self._planned_at, 0.0) - self.spent

    def run(self, wanted: Sequence[Variant]) -> None:
        """Train single changes, then combinations, and find the fronts."""
        with limit_process_threads(self._threads):  # as the trainings have
            wanted = self._measure_paces(wanted)
        alone = len({variant.knob for variant in wanted}) <= 2  # the centre and one knob: nothing to combine
        self._planned_at = self.spent
        self._train(wanted, _COMBINED if alone else _SINGLES)
        self._take_times(1.0 if alone else _TIMES)
        self._train(self._combinations(), _COMBINED)
        self._train(wanted, _COMBINED)
        self._take_times(1.0)
        self.record.facts |= {
            **describe_setup(self._setup(self.record.points[0].run_dir)),
            "preset": self.set.centre.preset,
            "words": list(self.set.words),
            "seeds": self.request.seeds,
            "budget_seconds": self.request.budget,
            "length": self.plan.describe(),
        }
        self.record.find_fronts()
        self._write()
        write_csv(self.set.folder / "tradeoff.csv", self.record)

    def _write(self) -> None:
        self.record.facts |= {"spent_seconds": self.spent, "plan": vars(self.plan)}
        self.record.write(self.set.folder / TRADEOFF_FILE)

    # ------------------------------------------------------------ step times

    def _measure_paces(self, wanted: Sequence[Variant]) -> list[Variant]:
        """Return the variants whose step time is known; makes the plan."""
        kept, latest = list[Variant](), self.spent + _PACES * (self.request.budget - self.spent)
        paces = {CENTRE: 1.0} if self._plan is None else dict(self._plan.paces)
        for number, variant in enumerate(wanted):
            self.progress(f"step time of {variant.name}", number / len(wanted))
            late = variant.name not in paces and variant.turned and self.spent > latest
            reason = self._no_time() if late else self._find_pace(variant, paces)
            if reason is None:
                kept.append(variant)
            else:
                self.record.leave_out(variant.knob, variant.label, reason)
        if self._plan is None:
            lengths = [variant.length for variant in kept for _ in range(self.request.seeds)]
            seconds = _TRAINING * (self.request.budget - self.spent) * self._workers
            self._plan = plan_lengths(self.set.centre, self._times().seconds, seconds, lengths)
        self._plan.paces.update(paces)
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
        seeds = self.request.seeds
        several = max(self._workers // seeds, 1)
        for first in range(0, len(todo), several):
            batch: list[Variant] = []
            for variant in todo[first : first + several]:
                begun = (self._run_dir(variant, 0) / "checkpoint.safetensors").exists()
                rounds = math.ceil((len(batch) + 1) * seeds / self._workers)
                if not begun and variant.name != CENTRE and rounds * self.plan.seconds > self._left(part):
                    self.record.leave_out(variant.knob, variant.label, self._no_time())
                    continue
                self.record.left_out = [one for one in self.record.left_out if one.words != variant.label]
                batch.append(variant)
            text = f"training {first + 1} of {len(todo)}, {', '.join(variant.name for variant in batch)}"
            trials = [self._trial(variant, seed) for variant in batch for seed in range(seeds)]
            hear = lambda fraction, text=text: self.progress(text, fraction)  # noqa: E731
            results = launch_trials(trials, self.request.launcher, self.set.folder, hear) if trials else []
            for i, variant in enumerate(batch):
                own = results[i * seeds : (i + 1) * seeds]
                failed = next((result for result in own if result.state == "failed"), None)
                if failed is None:
                    self._measure(variant, [result.value for result in own])
                elif variant.name == CENTRE:
                    raise TrialFailed(failed.line)
                else:
                    self.record.leave_out(variant.knob, variant.label, failed.line)

    def _trial(self, variant: Variant, seed: int) -> Trial:
        words = self.plan.overrides(variant, self.set.words, self.set.centre)
        quiet = [] if any(a.key == "train.eval_every" for a in parse(words)) else ["train.eval_every=0"]
        place = quote_override("output_dir", str(self._run_dir(variant, seed)))
        own = [*quiet, quote_override("seed", self.set.centre.seed + seed), place]
        return Trial(compose(override(words, own), check_output=False), views=self.request.views)

    def _run_dir(self, variant: Variant, seed: int) -> Path:
        suffix = f"_seed-{self.set.centre.seed + seed}" if seed else ""
        return self.set.folder / TRIALS / (variant.folder + suffix)

    # ------------------------------------------------------------ measuring

    def _setup(self, run_dir: str) -> EvaluationSetup:
        if run_dir not in self._setups:
            loaded = self.set.dataset, self.set.views
            path = self.set.folder / run_dir
            self._setups[run_dir] = load_setup(path, (), len(self.set.views), self.request.lpips, loaded)
        return self._setups[run_dir]

    def renderer(self, number: int) -> tuple[EvaluationSetup, Renderer]:
        """Return the setup of a point's model, and what draws it."""
        setup = self._setup(self.record.points[number].run_dir)
        return setup, setup.renderer(setup.reference)

    def _measure(self, variant: Variant, outcomes: Sequence[Outcome]) -> None:
        first, run_dir = outcomes[0], self._run_dir(variant, 0).relative_to(self.set.folder).as_posix()
        setup = self._setup(run_dir)
        known = self.record.facts.get("exact")
        float64 = bool(known["float64"]) if isinstance(known, dict) and "float64" in known else None
        exact = render_exact(setup, _EXACT * self.request.budget, float64)  # all models alike
        self.record.facts.setdefault("exact", exact.to_dict())
        point, _ = measure_point(setup, variant.knob, setup.reference, exact)
        means = {name: statistics.fmean(getattr(one, name) for one in outcomes) for name in ("psnr", "ssim")}
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
            seeds=tuple(one.psnr for one in outcomes),
            run_dir=run_dir,
        )
        self.record.points.append(trained)
        self._write()

    def _take_times(self, part: float) -> None:
        """Time all models that lack rounds."""
        points, timed = self.record.points, list[TimedPoint]()
        for number, point in enumerate(points):
            timed.append(TimedPoint(point, lambda i=number: self.renderer(i)[1], self.request.repeats))  # type: ignore[misc]

        def done(number: int, count: int) -> None:
            self._write()
            self.progress(f"round {number} of {count}, {len(timed)} models", number / count)

        time_points(timed, self.set.views, time.monotonic() + self._left(part), done)
        for point in points:
            point.centre_ms = statistics.median(points[0].ms)

    def _combinations(self) -> list[Variant]:
        """Return combinations of earlier sessions, and as many new ones as there is time for."""
        points = self.record.points
        allowed = [Variant(COMBINED, point.turned) for point in points if point.knob == COMBINED]
        rounds = self._left(_COMBINED) / max(self.plan.seconds * self.request.seeds, 1e-9)
        most = min(int(self._workers * rounds), _MAX_COMBINATIONS - len(allowed))
        for way in combine_models(points, most):
            variant = Variant(COMBINED, way)
            reason = self._find_pace(variant, self.plan.paces)
            if reason is None:
                allowed.append(variant)
            else:
                self.record.leave_out(variant.knob, variant.label, reason)
        return allowed


# ---------------------------------------------------------------- the folder


def _compose_centre(request: AblationRequest) -> tuple[list[str], Path, RunConfig]:
    """Return the centre's overrides, the folder of the set, and the centre's configuration."""
    said = parse(request.words)
    words = [a.text for a in said if a.key not in ("output_dir", "resume", "budget")]
    places = [a.value for a in said if a.key == "output_dir" and a.value is not None]
    centre = compose([*words, "output_dir=null"], check_output=False)
    folder = Path(str(places[-1])).expanduser() if places else ROOT / f"tradeoff-{centre.task}-{centre.scene_name}"
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"output_dir={folder}: is a file; expected a directory")
    return words, folder, centre


def _centre_settings(centre: RunConfig) -> dict[str, Any]:
    own = ("output_dir", "resume", "overrides", "non_default", "made_by")
    return {name: value for name, value in centre.to_dict().items() if name not in own}


def _check_folder(folder: Path, before: Record | None, centre: RunConfig, request: AblationRequest) -> None:
    """Refuse a folder that holds something else, or another set."""
    if before is None:
        if folder.is_dir() and any(folder.iterdir()) and not (folder / TRIALS).is_dir():
            raise ConfigError(f"output_dir={folder}: holds something else; expected a new directory, or that of a set")
        return
    if before.same.get("kind") != "models":
        raise DataError(f"{folder / TRADEOFF_FILE}: of a finished run; expected another output_dir=DIR for trainings")
    wanted = {"centre": _centre_settings(centre), "seeds": request.seeds}
    changed = [name for name, value in wanted.items() if before.same.get(name) != value]
    if changed:
        expected = "expected the same overrides, or another output_dir=DIR"
        raise ConfigError(f"{folder}: holds a set with another {' and '.join(changed)}; {expected}")


def _identity(centre: RunConfig, views: Sequence[EvalView], request: AblationRequest) -> dict[str, Any]:
    """Return what must be equal to keep earlier measurements; JSON-able."""
    return {
        "kind": "models",
        "centre": _centre_settings(centre),
        "seeds": request.seeds,
        "lpips": str(request.lpips or centre.metrics.lpips or ""),
        **describe_conditions(views),
    }


def _resume_record(folder: Path, before: Record | None, identity: Mapping[str, Any], tell: Tell) -> Record:
    """Return the earlier record; without points if they were measured otherwise."""
    if before is None:
        return Record(dict(identity))
    facts: dict[str, Any] = {name: before.facts[name] for name in ("spent_seconds", "exact") if name in before.facts}
    changed = [name for name in identity if before.same.get(name) != identity[name]]
    if changed:
        what = " and ".join(changed)
        tell(f"{folder / TRADEOFF_FILE}: measured with another {what}; models are kept, and measured anew")
        return Record(dict(identity), facts)
    points = [p for p in before.points if p.run_dir and (folder / p.run_dir / "model.safetensors").exists()]
    if not points or points[0].name != CENTRE:
        return Record(dict(identity), facts)
    tell(f"{folder / TRADEOFF_FILE}: {len(points)} models are kept; delete the folder to train anew")
    return Record(dict(identity), facts, points)


def _parse_plan(file: Path, record: Record) -> Plan | None:
    try:
        return validate(Plan, record.facts["plan"], "plan") if "plan" in record.facts else None
    except ConfigError as error:
        raise DataError(f"{file}: damaged ({error}); delete the folder to train anew") from error
