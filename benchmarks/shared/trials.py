"""Many short trainings side by side: one thread each, budgets in steps, every result kept as it comes."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from neuprim.config import compose
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.compute.threads import cpu_name
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import Events, Fitted, compile_run_kernels, prepare_training, train_to_end
from neuprim.runs.launch.jobs import JobResult, JobStatus, LaunchJob
from neuprim.runs.launch.launcher import launch_jobs
from shared.tables import read_trials, update_record

_TURN, _DRAWS = 16, 500

Measure = Callable[[Fitted, dict[str, Any]], dict[str, Any]]


@dataclass(frozen=True)
class Trial:
    """One training.

    Attributes:
        name: unique; what has been recorded under it is not run again.
        words: of the command line, without budget and seed.
        iterations: the budget, in steps.
        hold_out: n > 1: judge by every n-th training view instead of the test views.
        facts: what the record says of it besides its numbers.
        interventions: into the population, spread evenly, so that short runs have as many as one of the preset's own
            length; None leaves the steps between two of them to the preset.
        change: a function of a module that changes the training before it starts.
    """

    name: str
    words: tuple[str, ...]
    iterations: int
    seed: int = 0
    hold_out: int = 0
    facts: tuple[tuple[str, Any], ...] = ()
    interventions: int | None = 20
    change: Callable[[Fitted], None] | None = None


def begin(trial: Trial) -> Fitted:
    """Data and a fresh model."""
    words = [*trial.words, f"seed={trial.seed}", f"train.iterations={trial.iterations}"]
    words += ["train.max_seconds=null", "train.eval_every=0", "renderer.threads=1"]
    if trial.interventions and not any(word.startswith("train.population.every=") for word in words):
        words.append(f"train.population.every={max(trial.iterations // trial.interventions, 1)}")
    fitted = prepare_training(compose(words, check_output=False), hold_out=trial.hold_out)
    if trial.change is not None:
        trial.change(fitted)
    return fitted


def train(trial: Trial, wanted: Sequence[str] | Measure) -> dict[str, Any]:
    """One run and its numbers; ``cpu_seconds`` are those that this thread computed while the model learned."""
    torch.set_num_threads(1)
    fitted = begin(trial)
    compile_run_kernels(fitted.trainer)
    start = time.thread_time()
    train_to_end(fitted)
    numbers = {"trial": trial.name, "seed": trial.seed, "iterations": trial.iterations}
    numbers["cpu_seconds"] = time.thread_time() - start
    metrics = fitted.metrics()
    chosen = wanted(fitted, metrics) if callable(wanted) else {k: metrics[k] for k in wanted if k in metrics}
    return {**numbers, **dict(trial.facts), **chosen}


def train_job(data: tuple[Trial, Sequence[str] | Measure], attempt: int, events: Events) -> dict[str, Any]:
    """The function of a job; after its worker died a trial begins anew."""
    return train(*data)


def run_all(
    trials: Sequence[Trial],
    path: Path,
    wanted: Any,
    jobs: int = 1,
    call: str = f"{__name__}:train_job",
    **entries: Any,
) -> None:
    """Do what the record at ``path`` does not have yet, ``jobs`` at a time, and write it after every one.

    Args:
        wanted: names of metrics, of which those that a task has are recorded, or a function of a module that makes the
            numbers of the record; what else ``call`` takes.
        call: the function of a job, called with ``(trial, wanted)``, the attempt and a listener of events.
        entries: further entries of the record.
    """
    known = {row["trial"] for row in read_trials(path)}
    waiting = [trial for trial in trials if trial.name not in known]
    shown = dict.fromkeys(range(len(waiting)), 0)

    def say(text: str) -> None:
        print(f"{time.strftime('%H:%M')} {text}", flush=True)

    def keep(number: int, result: JobResult) -> None:
        if result.state == "done":
            row = result.value
            rows = sorted([*read_trials(path), row], key=lambda r: r["trial"])
            update_record(path, **{"cpu": cpu_name(), **entries, "trials": rows})
            say(f"{row['trial']}: {row.get('psnr', float('nan')):.2f} dB")

    def show(number: int, status: JobStatus) -> None:
        quarters = int(4 * status.progress)
        if quarters > shown[number]:
            shown[number] = quarters
            say(f"{waiting[number].name}: {status.progress:.0%} of the training")

    work = [LaunchJob(trial.name, call, (trial, wanted)) for trial in waiting]
    settings = LauncherSettings("processes", workers=jobs, threads=1)
    results = launch_jobs(work, settings, path.parent / f".{path.stem}-launch", show, keep)
    failed = [
        f"{trial.name}: {result.trace or result.line}"
        for trial, result in zip(waiting, results, strict=True)
        if result is not None and result.state == "failed"
    ]
    if failed:
        raise SystemExit("\n".join(failed))
    if any(result is None or result.state == "interrupted" for result in results):
        raise KeyboardInterrupt


def measure_paces(path: Path, reference: Trial, others: Mapping[str, Trial], steps: int) -> dict[str, float]:
    """Time of a step over that of ``reference``, by name; measured where the record at ``path`` does not have it."""
    known = dict(update_record(path).get("paces", {}))
    missing = {name: trial for name, trial in others.items() if name not in known}
    if missing:  # ratios travel, seconds do not: the reference takes part every time
        torch.set_num_threads(1)
        trainers = {name: begin(trial).trainer for name, trial in {"": reference, **missing}.items()}
        took = time_steps(trainers, steps)
        known |= {name: took[name] / took[""] for name in missing}
        update_record(path, paces=known)
        print("paces:", {name: round(known[name], 3) for name in missing}, flush=True)
    return known


def time_steps(trainers: Mapping[str, Trainer], steps: int) -> dict[str, float]:
    """Seconds a step of each, taking turns so that all meet the same noise; a mean over ``steps``, as a run pays for
    every one of them.

    Primitives grow, move and shrink as a run goes on, so the fairest pace is that of a whole one. Turns are as long as
    the rarest look at voxels is apart. Of trainers with one thread the clock counts what it computes, and not what
    others on the machine do meanwhile.
    """
    for trainer in trainers.values():
        compile_run_kernels(trainer)
        if trainer.dataset.points is not None:  # files are read once in a run, which is next to nothing in a long one
            generator = torch.Generator().manual_seed(0)
            for _ in range(_DRAWS):
                trainer.dataset.points.draw(8, generator)
    alone = all(trainer.renderer.threads == 1 for trainer in trainers.values())
    clock = time.thread_time if alone else time.perf_counter
    took, turns = dict.fromkeys(trainers, 0.0), max(steps // _TURN, 1)
    for _ in range(turns):
        for name, trainer in trainers.items():
            start = clock()
            for _ in range(_TURN):
                trainer.train_step()
            took[name] += clock() - start
    return {name: seconds / (turns * _TURN) for name, seconds in took.items()}
