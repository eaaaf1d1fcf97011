"""Trade-offs of training settings: train a set of models, measure them together, and find the Pareto fronts.

One model of the set, the *centre*, has the user's settings. The other models differ from the centre in a single
setting, or in a promising combination of settings. All models train for the same time, except those that vary the
training length. Running the same request again continues an earlier set.
"""

from __future__ import annotations

import shlex
import statistics
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import Any

from neuprim.config import Job, RunConfig, compose, find_config_plugins, load_config_task
from neuprim.config.command_settings import LauncherSettings
from neuprim.config.overrides import drop_output_overrides, parse_overrides, quote_override
from neuprim.config.stored_run import ROOT
from neuprim.core.compute.threads import limit_process_threads
from neuprim.core.data import Dataset
from neuprim.core.data.dataset_check import check_dataset_views
from neuprim.core.errors import ConfigError, DataError, NeuprimError
from neuprim.core.validation import validate_settings
from neuprim.runs.fit import use_one_torch_thread_for_run
from neuprim.runs.ground_truth import render_ground_truth_before_run
from neuprim.runs.launch.executors import count_parallel_jobs
from neuprim.runs.launch.launcher import use_launcher_threads_for_runs
from neuprim.runs.open import load_dataset, lock_run_directory
from neuprim.runs.render_config import RenderConfig
from neuprim.search.ablation_plan import (
    CENTRE,
    AblationPlan,
    AblationStepTimes,
    Variant,
    combine_ablation_changes,
    list_variants,
    merge_variant_overrides,
    plan_training_lengths,
)
from neuprim.search.model_quality import EvalView, choose_trial_views
from neuprim.search.tradeoff_measuring import (
    Progress,
    Tell,
    TradeoffRequest,
    TradeoffSession,
    TradeoffSetup,
    check_knobs,
    describe_tradeoff_conditions,
    describe_tradeoff_setup,
    load_tradeoff_setup,
    measure_point,
)
from neuprim.search.tradeoff_record import COMBINED, TRADEOFF_FILE, TradeoffRecord, read_tradeoff_record
from neuprim.search.trials import NOT_TRAINED_WITH, Outcome, Trial, TrialFailed, launch_trials

TRIALS = "trials"  # folder of the models

__all__ = ["run_ablation"]

_PACES, _TRAINING = 0.2, 0.5
"""``_PACES``: fraction of the time budget for measuring the time per training step. ``_TRAINING``: fraction of the
remaining budget for training the models that change a single setting."""

_SINGLES, _TIMES, _COMBINED = 0.58, 0.64, 0.88
"""Deadlines, as fractions of the time budget that is left after planning: for training models with a single changed
setting, for timing their frames, and for training models that combine changes."""

_MAX_COMBINATIONS = 12


def format_ablation_run_command(overrides: Sequence[str]) -> str:
    """Return the ``neuprim run`` command that trains a model with these overrides."""
    return shlex.join(["neuprim", "run", *overrides])


def run_ablation(
    request: TradeoffRequest,
    launcher: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
    tell: Tell = lambda text: None,
    progress: Progress = lambda text, fraction: None,
) -> tuple[Path, TradeoffRecord]:
    """Train and measure models with varied settings; write ``tradeoff.json``, ``tradeoff.html`` and ``front.png``.

    A second call with the same settings and a larger budget trains more models.

    Args:
        request: settings to vary, and the budget. ``request.words`` are overrides (``key=value``) of ``neuprim run``.
        launcher: settings of the launcher that trains the models. This process measures them.
        tell: called with lines of text for the user.
        progress: called with (text, done fraction 0..1).

    Returns:
        The folder with the three files, and the content of ``tradeoff.json``.

    Raises:
        NeuprimError: overrides, settings, data or folder are wrong.
    """
    models = _compose_ablation_set(request, launcher)
    folder, centre, task = models.folder, models.centre, load_config_task(models.centre)
    with use_one_torch_thread_for_run(), use_launcher_threads_for_runs(launcher), ExitStack() as stack:
        stack.enter_context(find_config_plugins(centre).attribute_errors())
        variants = list_variants(centre, task)
        check_knobs(request, variants, f"a model of task {task.name!r}")
        before = read_tradeoff_record(folder / TRADEOFF_FILE)
        _check_ablation_folder(models, before)
        stack.enter_context(lock_run_directory(folder, "set"))
        plan = None if before is None else _parse_ablation_plan(folder / TRADEOFF_FILE, before)
        render_ground_truth_before_run(centre, launcher, progress)
        dataset = load_dataset(Job(centre, task), progress)
        check_dataset_views(dataset, task.conditions)
        views = choose_trial_views(dataset, request.views)
        if not views:
            raise DataError(f"{dataset.name} has no test views; expected at least one")
        lpips = str(request.lpips or centre.metrics.lpips or "")
        identity = {"kind": "models", **models.identity(), "lpips": lpips, **describe_tradeoff_conditions(views)}
        record = _resume_ablation_set(folder, before, identity, tell)
        session = _AblationSession(models, (dataset, views), request, record, progress, plan)
        # The first value of every knob, then the second, so that short budgets change as many knobs as possible.
        rungs = zip_longest(*session.choose_knobs(variants).values())
        session.run([Variant(CENTRE), *(variant for rung in rungs for variant in rung if variant is not None)])
    return folder, record


@dataclass(frozen=True)
class _AblationSet:
    """A set of models to compare, and the settings of the launcher that trains them.

    ``words`` and ``centre`` are the overrides and the configuration of the model with the user's settings.
    """

    folder: Path
    words: list[str]
    centre: RunConfig
    launcher: LauncherSettings

    def identity(self) -> dict[str, Any]:
        """Return the centre's settings as JSON-ready values. A set can only be continued with equal settings."""
        own = (*NOT_TRAINED_WITH, "made_by")
        settings = {name: value for name, value in self.centre.to_dict().items() if name not in own}
        return {"centre": settings}


class _AblationSession(TradeoffSession):
    """Session that trains and measures a set of models within a time budget."""

    def __init__(
        self,
        models: _AblationSet,
        loaded: tuple[Dataset, list[EvalView]],
        request: TradeoffRequest,
        record: TradeoffRecord,
        progress: Progress,
        plan: AblationPlan | None,
    ) -> None:
        super().__init__(models.folder, request, record, progress)
        self.words, self.centre, self.launcher = models.words, models.centre, models.launcher
        self._loaded, self._plan, self._planned_at, self._compiling = loaded, plan, 0.0, 0.0
        spent = record.facts.get("spent_seconds", 0.0)
        self.begun -= float(spent) if isinstance(spent, int | float) else 0.0
        self._setups: dict[str, TradeoffSetup] = {}
        self._workers, self._threads = count_parallel_jobs(self.launcher, 1000)

    @property
    def plan(self) -> AblationPlan:
        assert self._plan is not None, "made by measuring step times"
        return self._plan

    @property
    def spent(self) -> float:
        """Seconds of the budget used so far, including earlier sessions but not the compilation of kernels."""
        return time.monotonic() - self.begun - self._compiling

    def seconds_left(self, part: float) -> float:
        """Return the seconds until the fraction ``part`` (0..1) of the budget that was left after planning is used."""
        return self._planned_at + part * max(self.request.budget - self._planned_at, 0.0) - self.spent

    def run(self, wanted: Sequence[Variant]) -> None:
        """Train and time all models, find the Pareto fronts, and write the results.

        The ``wanted`` variants (the centre, and models that change one setting each) come first. Models that combine
        changes follow.
        """
        with limit_process_threads(self._threads):  # as many threads as a training has
            wanted = self._measure_step_times(wanted)
        alone = len({variant.knob for variant in wanted}) <= 2  # the centre and one knob: nothing to combine
        self._planned_at = self.spent
        self._train(wanted, _COMBINED if alone else _SINGLES)
        self.take_times(1.0 if alone else _TIMES)
        self._train(self._combinations(), _COMBINED)
        self._train(wanted, _COMBINED)
        self.take_times(1.0)
        self.record.facts |= {
            **describe_tradeoff_setup(self.point_setup(0)[0]),
            "preset": self.centre.preset,
            "words": list(self.words),
            "budget_seconds": self.request.budget,
            "length": self.plan.describe(),
        }
        self.record.find_fronts()
        self.write_results(format_ablation_run_command)

    def write_record(self) -> None:
        self.record.facts |= {"spent_seconds": self.spent, "plan": vars(self.plan)}
        super().write_record()

    # ------------------------------------------------------------ step times

    def _measure_step_times(self, wanted: Sequence[Variant]) -> list[Variant]:
        """Measure the time per training step of variants and plan how long to train; return the measured variants."""
        kept, latest = list[Variant](), self.spent + _PACES * (self.request.budget - self.spent)
        paces = {CENTRE: 1.0} if self._plan is None else dict(self._plan.paces)
        for number, variant in enumerate(wanted):
            self.progress(f"step time of {variant.name}", number / len(wanted))
            late = variant.name not in paces and variant.turned and self.spent > latest
            reason = self.no_time if late else self._find_pace(variant, paces)
            if reason is None:
                kept.append(variant)
            else:
                self.record.leave_out(variant.knob, variant.label, reason)
        if self._plan is None:
            lengths = [variant.length for variant in kept]
            seconds = _TRAINING * (self.request.budget - self.spent) * self._workers
            self._plan = plan_training_lengths(self.centre, self._step_times.seconds, seconds, lengths)
        self._plan.paces.update(paces)
        return kept

    @cached_property
    def _step_times(self) -> AblationStepTimes:
        return AblationStepTimes(self.centre, self._loaded[0])

    def _find_pace(self, variant: Variant, paces: dict[str, float]) -> str | None:
        """Measure a variant's time per training step, and store it in ``paces``, divided by the centre's time per step.

        Return the reason if the variant cannot be trained, else None.
        """
        if not variant.turned:
            paces[variant.name] = 1.0
        if variant.name in paces:
            return None
        words = merge_variant_overrides(self.words, [*variant.turned, "output_dir=null"])
        try:
            ratio = self._step_times.measure(compose(words, check_output=False))
        except NeuprimError as error:
            return str(error)
        finally:
            self._compiling = self._step_times.compiling
        if ratio is None:
            return "the same model as the centre"
        paces[variant.name] = ratio
        return None

    # ------------------------------------------------------------ training

    def _train(self, wanted: Sequence[Variant], part: float) -> None:
        """Train and measure the variants that are not in the record yet.

        A variant is skipped if its training would end too late: after the fraction ``part`` of the budget that was left
        after planning. The centre (the model with the user's settings) and interrupted trainings are never skipped.
        """
        known = {(point.turned, point.length) for point in self.record.points}
        todo = [variant for variant in wanted if (variant.turned, variant.length) not in known]
        for first in range(0, len(todo), self._workers):
            batch: list[Variant] = []
            for variant in todo[first : first + self._workers]:
                begun = (self._run_dir(variant) / "checkpoint.safetensors").exists()
                if not begun and variant.name != CENTRE and self.plan.seconds > self.seconds_left(part):
                    self.record.leave_out(variant.knob, variant.label, self.no_time)
                    continue
                self.record.left_out = [one for one in self.record.left_out if one.words != variant.label]
                batch.append(variant)
            if not batch:
                continue
            text = f"training {first + 1} of {len(todo)}, {', '.join(variant.name for variant in batch)}"
            trials = [self._trial(variant) for variant in batch]
            show = lambda fraction, text=text: self.progress(text, fraction)  # noqa: E731
            results = launch_trials(trials, self.launcher, self.folder, show)
            for variant, result in zip(batch, results, strict=True):
                if result.state != "failed":
                    self._measure_model(variant, result.value)
                elif variant.name == CENTRE:
                    raise TrialFailed(result.line)
                else:
                    self.record.leave_out(variant.knob, variant.label, result.line)

    def _trial(self, variant: Variant) -> Trial:
        words = self.plan.overrides(variant, self.words, self.centre)
        quiet = [] if any(a.key == "train.eval_every" for a in parse_overrides(words)) else ["train.eval_every=0"]
        own = [*quiet, quote_override("output_dir", str(self._run_dir(variant)))]
        return Trial(compose(merge_variant_overrides(words, own), check_output=False), views=self.request.views)

    def _run_dir(self, variant: Variant) -> Path:
        return self.folder / TRIALS / variant.folder

    # ------------------------------------------------------------ measuring

    def _setup(self, run_dir: str) -> TradeoffSetup:
        if run_dir not in self._setups:
            path, views = self.folder / run_dir, len(self._loaded[1])
            self._setups[run_dir] = load_tradeoff_setup(path, (), views, self.request.lpips, self._loaded)
        return self._setups[run_dir]

    def point_setup(self, number: int) -> tuple[TradeoffSetup, RenderConfig]:
        setup = self._setup(self.record.points[number].run_dir)
        return setup, setup.reference

    def _measure_model(self, variant: Variant, outcome: Outcome) -> None:
        run_dir = self._run_dir(variant).relative_to(self.folder).as_posix()
        setup = self._setup(run_dir)
        point = measure_point(setup, variant.knob, setup.reference)
        trained = replace(
            point,
            words=tuple(self.plan.overrides(variant, self.words, self.centre)),
            quality={**point.quality, "psnr": outcome.psnr, "ssim": outcome.ssim},
            turned=variant.turned,
            length=variant.length,
            primitives=outcome.primitives,
            parameters_per_primitive=outcome.parameters_per_primitive,
            steps=outcome.steps,
            seconds=outcome.seconds,
            run_dir=run_dir,
        )
        self.record.points.append(trained)
        self.write_record()

    def take_times(self, part: float) -> None:
        super().take_times(part)
        for point in self.record.points:
            point.centre_ms = statistics.median(self.record.points[0].ms)

    def _combinations(self) -> list[Variant]:
        """Return variants that combine changes: recorded combinations, and as many new combinations as time allows."""
        points = self.record.points
        allowed = [Variant(COMBINED, point.turned) for point in points if point.knob == COMBINED]
        rounds = self.seconds_left(_COMBINED) / max(self.plan.seconds, 1e-9)
        most = min(int(self._workers * rounds), _MAX_COMBINATIONS - len(allowed))
        for variant in (Variant(COMBINED, way) for way in combine_ablation_changes(points, most)):
            reason = self._find_pace(variant, self.plan.paces)
            if reason is None:
                allowed.append(variant)
            else:
                self.record.leave_out(variant.knob, variant.label, reason)
        return allowed


# ---------------------------------------------------------------- the folder


def _compose_ablation_set(request: TradeoffRequest, launcher: LauncherSettings) -> _AblationSet:
    words = drop_output_overrides(request.words)
    centre = compose(words, check_output=False)
    folder = request.out or ROOT / f"tradeoff-{centre.task}-{centre.scene_name}"
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"--out {folder}: is a file; expected a directory")
    return _AblationSet(folder, words, centre, launcher)


def _check_ablation_folder(models: _AblationSet, before: TradeoffRecord | None) -> None:
    """Raise an error if the folder holds unrelated files, or the models of another trade-off."""
    folder = models.folder
    if before is None:
        if folder.is_dir() and any(folder.iterdir()) and not (folder / TRIALS).is_dir():
            raise ConfigError(f"--out {folder}: has other files; expected a new directory, or a directory of trainings")
    elif before.same.get("kind") != "models":
        raise DataError(f"{folder / TRADEOFF_FILE}: is about a finished run, not trainings; expected another --out DIR")
    elif changed := before.changes(models.identity()):
        expected = "expected the same settings, or another --out DIR"
        raise ConfigError(f"{folder}: has trainings with another {' and '.join(changed)}; {expected}")


def _resume_ablation_set(
    folder: Path, before: TradeoffRecord | None, identity: Mapping[str, Any], tell: Tell
) -> TradeoffRecord:
    """Return the record with which the ablation continues.

    The points (measured models) of the earlier record ``before`` are kept if the facts in ``identity`` (configuration,
    views, machine, versions) have not changed.
    """
    record = TradeoffRecord(dict(identity))
    if before is None:
        return record
    record.facts = {"spent_seconds": before.facts.get("spent_seconds", 0.0)}
    if changed := before.changes(identity):
        what = " and ".join(changed)
        tell(f"{folder / TRADEOFF_FILE}: measured with another {what}; models are kept, and measured anew")
        return record
    points = [p for p in before.points if p.run_dir and (folder / p.run_dir / "model.safetensors").exists()]
    if points and points[0].name == CENTRE:
        tell(f"{folder / TRADEOFF_FILE}: {len(points)} models are kept; delete the folder to train again")
        record.points = points
    return record


def _parse_ablation_plan(file: Path, record: TradeoffRecord) -> AblationPlan | None:
    try:
        return validate_settings(AblationPlan, record.facts["plan"], "plan") if "plan" in record.facts else None
    except ConfigError as error:
        raise DataError(f"{file}: damaged ({error}); delete {file.parent} to train again") from error
