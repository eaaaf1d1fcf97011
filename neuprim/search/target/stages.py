"""What becomes of the full run that was chosen: a usual run directory, and a model in as few bytes as the target lets
it have."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuprim.config import suspects_of, task_of
from neuprim.config.target import Target
from neuprim.core.checkpoint import extra_of, load_model, save_compressed
from neuprim.core.compression import Quantizers
from neuprim.core.data.dataset import hold_out_views
from neuprim.core.io.files import atomic_path, write_text
from neuprim.core.metrics import psnr, ssim
from neuprim.core.model.primitives import Primitives
from neuprim.runs.evaluate import evaluate_fitted
from neuprim.runs.events import Finishing
from neuprim.runs.measure import measure_quality, render_image
from neuprim.runs.open import COMPRESSED, move_to_render_device, read_metrics
from neuprim.runs.training import train_in_directory
from neuprim.search.few_bits import Rounding
from neuprim.search.prune.judge import judge_of
from neuprim.search.prune.run import Request, prune_run
from neuprim.search.target.judge import ALLOWANCE, ROOM, Judge
from neuprim.search.target.prediction import decibels
from neuprim.search.target.record import Attempt
from neuprim.search.target.trying import VIEWS, Trying, packed_bytes
from neuprim.search.target.words import shortfall
from neuprim.search.truths import masked, truths_of

__all__ = ["STAGES", "Finished", "chosen", "publish"]

_FIRST = 0.05
"""Share of the squared error that rounding adds where the search for coarse numbers begins."""

_APART = 0.3
"""dB between the test views and the views held out that are worth a line."""

_TUNED = 3
"""Times the steps of the full run that fine-tuning may have."""

_PRUNED = 600
"""Steps of fine-tuning without which pruning leaves a model worse than it need be."""

_KEPT = ("model.safetensors", "checkpoint.safetensors", "metrics.jsonl")


@dataclass(frozen=True)
class Finished:
    """The result as it is after a stage.

    Attributes:
        run_dir: a run directory; that of the search unless a stage made another.
        held: measures on the views held out.
        packed: bytes of its smallest file.
        test: measures on the test views, where a stage measured them.
    """

    run_dir: Path
    held: dict[str, float]
    packed: int
    test: dict[str, float]
    facts: dict[str, Any]


@dataclass(frozen=True)
class Workshop:
    """What stages work with."""

    trying: Trying
    target: Target
    judge: Judge
    attempt: Attempt

    def measured(self, model: Primitives) -> dict[str, float]:
        """PSNR and SSIM on the views held out that judged the trainings."""
        trying = self.trying
        judged = hold_out_views(trying.dataset, trying.record.hold_out)
        truths, rows = truths_of(judged, VIEWS), []
        settings = trying.config.renderer
        with torch.no_grad():
            model = move_to_render_device(model, settings, truths[0].view)
            for truth in truths:
                image = masked(render_image(model, truth.view, settings, judged.background), truth)
                rows.append((psnr(image, truth.image, truth.mask), ssim(image, truth.image)))
        return dict(zip(("psnr", "ssim"), (float(np.mean(column)) for column in zip(*rows, strict=True)), strict=True))


def publish(trying: Trying, target: Target, judge: Judge) -> None:
    """Makes the run's directory of the full run that is best by the target, takes it through :data:`STAGES`, and
    records what was achieved."""
    attempt = chosen(judge)
    trying.record.chosen = attempt.folder
    finished = _directory(trying, attempt)
    for stage in STAGES:
        finished = stage(Workshop(trying, target, judge, attempt), finished)
    record = trying.record
    metrics = read_metrics(finished.run_dir)
    margin = judge.margin(finished.held) if target.quality else 0.0
    limit = shortfall(target, attempt, finished.packed)
    if limit is not None or margin < 0:
        missed = limit or f"{_missed(target, finished.held)} on the views held out"
        record.warning = f"{target} is missed: {missed}; the best found is made"
        record.why += [record.out_of_reach] if record.out_of_reach else []
    else:
        record.warning = None
        record.why.append(f"{target} is met on the views held out")
    for name, goal in target.quality.items():
        apart = decibels(name, finished.test[name]) - decibels(name, finished.held[name])
        if abs(apart) > _APART:
            side = "above" if decibels(name, finished.test[name]) >= decibels(name, goal) else "below"
            record.why.append(
                f"{name} of the test views is {apart:+.2f} dB from that of the views held out, and {side} the target: they are other views, and decide nothing"
            )
    record.achieved = {
        "run_dir": str(finished.run_dir),
        "primitives": finished.facts.get("pruned", {}).get("primitives", attempt.count),
        "held_out": finished.held,
        "test_before_storing": {name: metrics[name] for name in ("psnr", "ssim")},
        "test": finished.test,
        "fps": 1e3 / attempt.quality("ms_per_frame"),
        "model_bytes": (finished.run_dir / "model.safetensors").stat().st_size,
        "packed_bytes": finished.packed,
        **finished.facts,
        "predicted": attempt.predicted,
        "seconds": trying.spent,
    }


def chosen(judge: Judge) -> Attempt:
    """Of the full runs that meet the target the smallest, of those with room for few bits before others; if none does,
    the best."""
    done = judge.record.done("full")
    within = [a for a in done if shortfall(judge.target, a) is None] or done

    def margin(a: Attempt) -> float:
        return judge.margin({name: a.quality(name) for name in judge.measures})

    for room in (ROOM, 0.0):
        met = [a for a in within if judge.target.quality and margin(a) >= room]
        if met:
            return min(met, key=lambda a: a.packed)
    return max(within, key=margin)


def _directory(trying: Trying, attempt: Attempt) -> Finished:
    """The run's directory from that of the training: its files, and what every run has beside them."""
    config = trying.config_of(attempt)
    trying.events(Finishing("measuring held-out views"))
    fitted, _ = train_in_directory(
        replace(config, resume=True), suspects_of(config), dataset=trying.dataset, hold_out=trying.record.hold_out
    )
    for name in _KEPT:
        with atomic_path(trying.folder / name) as temporary:
            shutil.copyfile(config.output_dir / name, temporary)
    final = replace(fitted.config, output_dir=trying.folder, resume=False)
    write_text(trying.folder / "config.yaml", final.to_yaml())
    dataset = replace(trying.dataset, train=fitted.dataset.train)
    evaluate_fitted(replace(fitted, config=final, dataset=dataset), trying.folder)
    metrics = read_metrics(trying.folder)
    return Finished(
        trying.folder,
        {name: attempt.quality(name) for name in ("psnr", "ssim")},
        int(metrics["model_bytes"]),
        {name: float(metrics[name]) for name in ("psnr", "ssim")},
        {},
    )


def quantised(shop: Workshop, before: Finished) -> Finished:
    """The model in numbers as coarse as the target lets them be; where it is missed anyway, so coarse that it costs
    next to nothing. With a limit of bytes alone, as fine as that allows."""
    trying, target, judge = shop.trying, shop.target, shop.judge
    task, file = task_of(trying.config), before.run_dir / COMPRESSED
    model, header = load_model(before.run_dir / "model.safetensors", task)
    words = (before.run_dir / "config.yaml").read_text(encoding="utf-8")
    least = min(0.0, judge.margin(before.held)) - (ALLOWANCE if judge.margin(before.held) < 0 else 0.0)
    trying.events(Finishing("storing in few bits"))
    views = replace(trying.dataset, train=hold_out_views(trying.dataset, trying.record.hold_out).train)
    rounding = Rounding(model, views, judge_of(trying.config, views))

    def stored(made: Quantizers) -> int:
        save_compressed(file, rounding.model, task.name, extra_of(header), made, words)
        return file.stat().st_size

    def enough(made: Quantizers) -> bool:
        held = shop.measured(rounding.read_back(made))
        return judge.margin(held) >= least if target.quality else before.held["psnr"] - held["psnr"] <= ALLOWANCE

    if target.quality or target.megabytes is None:
        made, share = rounding.coarsest(enough, _FIRST)
    else:
        most = 1e6 * target.megabytes
        made, share = rounding.finest(lambda tried: stored(tried) <= most, _FIRST)
    size = stored(made)
    again = load_model(file, task)[0]
    test = dict(
        zip(("psnr", "ssim"), measure_quality(again, task, trying.dataset, trying.config.renderer), strict=True)
    )
    return replace(
        before,
        held=shop.measured(again),
        packed=size,
        test=test,
        facts={**before.facts, "rounding": share, "file": str(file)},
    )


def pruned(shop: Workshop, before: Finished) -> Finished:
    """Without what its views do not require, as far as the target lets it, in half of the time that is left; as it was
    where that is not enough, or what is left misses the target."""
    trying, attempt, margin = shop.trying, shop.attempt, shop.judge.margin(before.held)
    if not shop.target.quality or margin < 0:
        return before
    steps = int(min(trying.left / 2 / trying.pace(attempt.count), _TUNED * attempt.steps))
    if steps < _PRUNED:
        trying.record.why.append(f"no time to prune: {max(trying.left, 0):.0f} s are left")
        return before
    folder = before.run_dir / "pruned"
    request = Request(
        before.run_dir,
        max(margin - ROOM, ROOM),
        steps=steps,
        out=folder,
        overwrite=True,
        hold_out=trying.record.hold_out,
    )
    made = prune_run(request, lambda text, fraction: trying.events(Finishing(f"pruning: {text}")))
    if made.run_dir is None:
        trying.record.why.append("nothing could be pruned")
        return before
    task = task_of(trying.config)
    model, _ = load_model(made.run_dir / "model.safetensors", task)
    held, metrics = shop.measured(model), read_metrics(made.run_dir)
    sizes = [packed_bytes(folder, task) for folder in (before.run_dir, made.run_dir)]
    kept = shop.judge.margin(held) >= 0 and sizes[1] < sizes[0]
    found = f"{model.count:,} primitives, {sizes[1] / 1e3:.1f} kB in place of {sizes[0] / 1e3:.1f}, held out {held['psnr']:.2f} dB, ssim {held['ssim']:.4f}"
    trying.tell(f"pruned: {found}; {'kept' if kept else 'not worth it'}")
    if not kept:
        return before
    test = {name: float(metrics[name]) for name in ("psnr", "ssim")}
    facts = {
        **before.facts,
        "pruned": {"primitives": model.count, "bytes_usual": sizes[1], "bytes_usual_before": sizes[0]},
    }
    return Finished(made.run_dir, held, int(made.after["bytes"]), test, facts)


STAGES: tuple[Callable[[Workshop, Finished], Finished], ...] = (pruned, quantised)
"""In their order; each makes the model smaller as far as the target lets it."""


def _missed(target: Target, held: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {held[name]:.4g}" for name, goal in target.quality.items() if held[name] < goal)
