"""``neuprim run target.psnr=30 budget=10m``: find and train the smallest model that meets a target.

Trials and full runs find the number of primitives. The chosen full run becomes the run directory. Pruning and
quantization then make its model smaller. Only training views, some of them held out, are used for decisions.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from neuprim.config import Job, RunConfig, find_config_plugins, load_config_task
from neuprim.config.command_settings import LauncherSettings, SearchTarget
from neuprim.core.checkpoint import load_model_checkpoint, read_header_extra, save_compressed
from neuprim.core.compression.codec import Quantizers
from neuprim.core.data import Dataset
from neuprim.core.data.dataset import hold_out_views
from neuprim.core.data.dataset_check import check_dataset_views
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.files import atomic_path, write_text
from neuprim.core.model.primitives import Primitives
from neuprim.runs.evaluate import evaluate_fitted
from neuprim.runs.fit import Events, Finishing, Preparing, compile_run_kernels, ignore_run_event, prepare_training
from neuprim.runs.ground_truth import render_ground_truth_before_run
from neuprim.runs.launch.launcher import use_launcher_threads_for_runs
from neuprim.runs.measure import measure_quality
from neuprim.runs.open import COMPRESSED, load_dataset, lock_run_directory, move_to_render_device
from neuprim.runs.training import train_in_directory
from neuprim.search.compress import QuantizationSearch, dequantize
from neuprim.search.model_quality import SearchQuality, choose_trial_views, measure_trial_views
from neuprim.search.pruning import PruneRequest, prune_run
from neuprim.search.size_forecast import ALLOWANCE, MIN_MARGIN, SizePredictor, exceeded_limit
from neuprim.search.size_search import SizeSearch
from neuprim.search.target_record import (
    TARGET_FILE,
    VIEWS,
    Attempt,
    TargetRecord,
    TrialRunner,
    count_compressed_trial_bytes,
    read_target_record,
)
from neuprim.search.trials import NOT_TRAINED_WITH

__all__ = ["run_target"]

_FIRST_SHARE = 0.05  # share of the squared error at which the search for coarse numbers begins

_MAX_TUNING, _MIN_TUNING = 3, 600
"""Largest number of fine-tuning steps divided by the steps of the full run; least number of steps to prune a model."""

_KEPT = ("model.safetensors", "checkpoint.safetensors", "metrics.jsonl")

_MEASURES = ("psnr", "ssim")


def run_target(
    config: RunConfig,
    target: SearchTarget,
    budget: float,
    events: Events = ignore_run_event,
    clock: Callable[[], float] = time.monotonic,
    launcher: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
) -> TargetRecord:
    """Find and train the smallest model that reaches a target, or the best one within limits.

    The directory of ``config`` becomes a run directory with ``target.json`` and ``model.neuprim``.

    Args:
        config: settings of the run. Its number of primitives is the first to try; its iterations limit a full run.
        target: quality to reach, and limits of size and speed.
        budget: seconds for search, training and measuring; compiling kernels does not count.
        clock: function that returns monotonic seconds.
        launcher: settings of the launcher that runs the trainings.

    Raises:
        KeyboardInterrupt: after Ctrl-C; the same call with ``resume`` continues.
        NeuprimError: the input is wrong, or the budget is too small for any training.
    """
    _check_target_config(config)
    record = _resume_target_search(config, {**target.given_settings(), "budget": budget})
    if record.achieved:
        return record
    plugins, begun, task, folder = find_config_plugins(config), clock(), load_config_task(config), config.output_dir
    with lock_run_directory(folder, "search"), plugins.attribute_errors(), use_launcher_threads_for_runs(launcher):

        def show_progress(text: str, fraction: float) -> None:
            events(Preparing(text, fraction))

        render_ground_truth_before_run(config, launcher, show_progress)
        dataset = load_dataset(Job(config, task), show_progress)
        check_dataset_views(dataset, task.conditions)
        record.hold_out = choose_target_hold_out(dataset)
        loaded = clock()
        compile_run_kernels(prepare_training(config, dataset=dataset).trainer, events)
        begun += clock() - loaded
        runner = TrialRunner(config, dataset, record, events, clock, launcher, begun - record.spent)
        try:
            search = SizeSearch(config, target, dataset, record, runner)
            search.run()
            _finish_target_search(runner, search.predictor)
        finally:
            runner.write_record()
    return record


def choose_target_hold_out(dataset: Dataset) -> int:
    """Return n if every n-th training view is to be held out: 8, or 2 to 7 for fewer than 64 training views."""
    count = len(dataset.train)
    if count < 4:
        raise DataError(f"{dataset.name}: {count} training views; a target needs 4 or more, because some are held out")
    return min(8, max(2, count // 8))


def _check_target_config(config: RunConfig) -> None:
    train, population = config.train, config.train.population
    if train.max_seconds is not None and "train.max_seconds" in config.non_default:
        raise ConfigError(
            f"train.max_seconds={train.max_seconds:g}: a run with a target takes its time from budget=; leave this out"
        )
    if train.iterations == 0:
        raise ConfigError("train.iterations=0: a run with a target must train; expected a positive number")
    decides = "a target determines the number of primitives"
    if population.strategy == "gradient":
        raise ConfigError(f"train.population.strategy=gradient: {decides}; expected relocate or fixed")
    if population.grow_to is not None:
        raise ConfigError(f"train.population.grow_to={population.grow_to}: {decides}; expected null")


def _resume_target_search(config: RunConfig, asked: dict[str, float]) -> TargetRecord:
    """Return the record of an earlier search in the run's directory, or a new record.

    If the target or the budget has changed, the new record keeps the finished trainings, but the used time starts at 0.
    """
    folder, own = config.output_dir, (*NOT_TRAINED_WITH, "made_by")
    same: dict[str, Any] = json.loads(json.dumps({k: v for k, v in config.to_dict().items() if k not in own}))
    before = read_target_record(folder) if config.resume else None
    if before is None:
        if (folder / "config.yaml").exists():
            expected = "expected a new directory, or the directory of a run with a target"
            raise ConfigError(f"--out {folder}: contains a run without a target; {expected}")
        return TargetRecord(asked, same)
    if different := [key for key in same if before.same.get(key) != same[key]]:
        expected = "expected the same settings, or a new --out DIR"
        raise ConfigError(
            f"{folder / TARGET_FILE}: the search was started with another {', '.join(different)}; {expected}"
        )
    if before.asked == asked:
        return before
    finished = [a for a in before.attempts if a.outcome is not None]
    return TargetRecord(asked, same, length=before.length, attempts=finished, before=len(before.finished("full")))


# ---------------------------------------------------------------- the result


@dataclass(frozen=True)
class _TargetResult:
    """Result of a target search, before or after pruning and quantization.

    Attributes:
        run_dir: the run directory, or the directory of the pruned model in it.
        held, test: PSNR and SSIM of held-out training views and of test views.
        packed: bytes of the smallest model file.
        facts: entries that pruning and quantization add to :attr:`TargetRecord.achieved`.
    """

    run_dir: Path
    held: dict[str, float]
    test: dict[str, float]
    packed: int
    facts: dict[str, Any]


def choose_full_run(predictor: SizePredictor) -> Attempt:
    """Return the full run with the smallest file of those that meet the target; if none does, the best full run. Full
    runs that leave room for the loss by quantization are preferred.
    """
    finished = predictor.record.finished("full")
    within = [a for a in finished if exceeded_limit(predictor.target, a) is None] or finished
    for room in (MIN_MARGIN, 0.0):
        met = [a for a in within if predictor.target.quality and predictor.margin_of(a) >= room]
        if met:
            return min(met, key=lambda a: a.packed)
    return max(within, key=predictor.margin_of)


def _finish_target_search(runner: TrialRunner, predictor: SizePredictor) -> None:
    """Turn the best full run into the run directory, prune and quantize the model, and record what was achieved."""
    record, target = runner.record, predictor.target
    attempt = choose_full_run(predictor)
    record.chosen = attempt.folder
    result = _write_target_result(runner, attempt)
    result = _prune_full_run(runner, predictor, attempt, result)
    result = _quantize_target_model(runner, predictor, result)
    limit = exceeded_limit(target, attempt, result.packed)
    missed = [f"{n} {result.held[n]:.4g}" for n, goal in target.quality.items() if result.held[n] < goal]
    record.warning = None
    if limit is not None or missed:
        reason = limit or f"{', '.join(missed)} on the views held out"
        record.warning = f"{target} is missed: {reason}; the best found is made"
        record.why += [record.out_of_reach] if record.out_of_reach else []
    else:
        record.why.append(f"{target} is met on the views held out")
    record.achieved = {
        "run_dir": str(result.run_dir),
        "primitives": result.facts.get("pruned", {}).get("primitives", attempt.count),
        "held_out": result.held,
        "test": result.test,
        "fps": 1e3 / attempt.measured("ms_per_frame"),
        "model_bytes": (result.run_dir / "model.safetensors").stat().st_size,
        "packed_bytes": result.packed,
        **result.facts,
        "predicted": attempt.predicted,
        "seconds": runner.seconds_spent,
    }


def _write_target_result(runner: TrialRunner, attempt: Attempt) -> _TargetResult:
    """Copy the chosen full run from its folder to the run directory, evaluate the test views, and return the result."""
    config, folder = runner.configure(attempt), runner.config.output_dir
    runner.events(Finishing("measuring test views"))
    resumed = replace(config, resume=True)
    fitted, _ = train_in_directory(resumed, dataset=runner.dataset, hold_out=runner.record.hold_out)
    for name in _KEPT:
        with atomic_path(folder / name) as temporary:
            shutil.copyfile(config.output_dir / name, temporary)
    final = replace(fitted.config, output_dir=folder, resume=False)
    write_text(folder / "config.yaml", final.to_yaml())
    dataset = replace(runner.dataset, train=fitted.dataset.train)
    metrics = evaluate_fitted(replace(fitted, config=final, dataset=dataset), folder)
    held, test = ({name: float(of(name)) for name in _MEASURES} for of in (attempt.measured, metrics.__getitem__))
    return _TargetResult(folder, held, test, int(metrics["model_bytes"]), {})


def _measure_target_held_out(runner: TrialRunner, model: Primitives) -> dict[str, float]:
    """Return a model's PSNR and SSIM on the held-out training views, on which the search compares trainings."""
    dataset, settings = hold_out_views(runner.dataset, runner.record.hold_out), runner.config.renderer
    views = choose_trial_views(dataset, VIEWS)
    with torch.no_grad():
        model = move_to_render_device(model, settings, views[0].view)
        quality = measure_trial_views(model, views, settings, dataset.background)
    return {"psnr": quality.psnr, "ssim": quality.ssim}


def _prune_full_run(
    runner: TrialRunner, predictor: SizePredictor, attempt: Attempt, before: _TargetResult
) -> _TargetResult:
    """Prune the model of a full run as far as the target allows, in half of the time left; return the new result.

    Return ``before`` if the target leaves no room, if too little time is left, or if pruning saves no bytes.
    """
    record, margin = runner.record, predictor.margin(before.held)
    if not predictor.target.quality or margin < 0:
        return before
    steps = int(min(runner.seconds_left / 2 / runner.pace(attempt.count), _MAX_TUNING * attempt.steps))
    if steps < _MIN_TUNING:
        record.why.append(f"no time to prune: {max(runner.seconds_left, 0):.0f} s are left")
        return before
    tolerance, folder = max(margin - MIN_MARGIN, MIN_MARGIN), before.run_dir / "pruned"
    request = PruneRequest(before.run_dir, tolerance, 0.0, steps, folder, True, record.hold_out)
    made = prune_run(request, lambda text, fraction: runner.events(Finishing(f"pruning: {text}")))
    if made.run_dir is None:
        record.why.append("nothing could be pruned")
        return before
    task = load_config_task(runner.config)
    model, _ = load_model_checkpoint(made.run_dir / "model.safetensors", task)
    held = _measure_target_held_out(runner, model)
    old, new = (count_compressed_trial_bytes(one, task) for one in (before.run_dir, made.run_dir))
    kept = predictor.margin(held) >= 0 and new < old
    runner.notify(
        f"pruned: {model.count:,} primitives, {new / 1e3:.1f} kB in place of {old / 1e3:.1f}, held out "
        f"{held['psnr']:.2f} dB, ssim {held['ssim']:.4f}; {'kept' if kept else 'not worth it'}"
    )
    if not kept:
        return before
    test = {name: made.after[name] for name in _MEASURES}
    facts = {"pruned": {"primitives": model.count, "bytes_usual": new, "bytes_usual_before": old}}
    return _TargetResult(made.run_dir, held, test, int(made.after["bytes"]), facts)


def _quantize_target_model(runner: TrialRunner, predictor: SizePredictor, before: _TargetResult) -> _TargetResult:
    """Write the quantized model file; return the new result. Numbers are rounded as coarsely as the target allows.

    If the model misses the target quality already, it loses at most :data:`ALLOWANCE` dB more. If the target only
    limits the bytes, numbers are rounded as finely as this limit allows.
    """
    target, task, file = predictor.target, load_config_task(runner.config), before.run_dir / COMPRESSED
    model, header = load_model_checkpoint(before.run_dir / "model.safetensors", task)
    text = (before.run_dir / "config.yaml").read_text(encoding="utf-8")
    margin = predictor.margin(before.held)
    least = 0.0 if margin >= 0 else margin - ALLOWANCE
    runner.events(Finishing("quantizing"))
    views = replace(runner.dataset, train=hold_out_views(runner.dataset, runner.record.hold_out).train)
    search = QuantizationSearch(model, views, SearchQuality.of_run(runner.config, views))

    def save(quantizers: Quantizers) -> int:
        save_compressed(file, search.model, task.name, read_header_extra(header), quantizers, text)
        return file.stat().st_size

    def accept(quantizers: Quantizers) -> bool:
        held = _measure_target_held_out(runner, dequantize(search.model, quantizers))
        if target.quality:
            return predictor.margin(held) >= least
        return before.held["psnr"] - held["psnr"] <= ALLOWANCE

    if target.quality or target.megabytes is None:
        quantizers, share = search.find_coarsest(accept, _FIRST_SHARE)
    else:
        most = 1e6 * target.megabytes
        quantizers, share = search.find_finest(lambda tried: save(tried) <= most, _FIRST_SHARE)
    size = save(quantizers)
    decoded, _ = load_model_checkpoint(file, task)
    test = dict(zip(_MEASURES, measure_quality(decoded, task, runner.dataset, runner.config.renderer), strict=True))
    facts = {**before.facts, "rounding": share, "file": str(file)}
    return replace(before, held=_measure_target_held_out(runner, decoded), packed=size, test=test, facts=facts)
