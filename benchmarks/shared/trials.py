"""Many short trainings side by side: one thread each, budgets in steps, every result kept as it comes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from neuprim.config import compose
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.checkpoint import save_model
from neuprim.core.train.trainer import Trainer
from neuprim.runs.events import Events
from neuprim.runs.fit import Fitted, compile_kernels, prepare_training, train_to_end
from neuprim.runs.launch.jobs import Job, Result
from neuprim.runs.launch.launcher import launch

__all__ = ["Trial", "begin", "paces_of", "recorded", "run_all"]

_TURN, _DRAWS = 16, 500


@dataclass(frozen=True)
class Trial:
    """One training.

    Attributes:
        name: unique; what has been recorded under it is not run again.
        words: of the command line, without budget and seed.
        iterations: the budget, in steps.
        hold_out: n > 1: judge by every n-th training view instead of the test views.
        facts: what the record says of it besides its numbers.
        keep: folder for configuration and model, or None.
        interventions: into the population, spread evenly, so that short runs have as many as one of the preset's own
        length;
            None leaves the steps between two of them to the preset.
    """

    name: str
    words: tuple[str, ...]
    iterations: int
    seed: int = 0
    hold_out: int = 0
    facts: tuple[tuple[str, Any], ...] = ()
    keep: Path | None = None
    interventions: int | None = 20


def begin(trial: Trial) -> Fitted:
    """Data and a fresh model."""
    words = [
        *trial.words,
        f"seed={trial.seed}",
        f"train.iterations={trial.iterations}",
        "train.max_seconds=null",
        "train.eval_every=0",
        "renderer.threads=1",
    ]
    if trial.interventions and not any(word.startswith("train.population.every=") for word in words):
        words.append(f"train.population.every={max(trial.iterations // trial.interventions, 1)}")
    if trial.keep is not None:
        words.append(f"output_dir='{trial.keep.resolve()}'")
    return prepare_training(compose(words, check_output=False), hold_out=trial.hold_out)


Wanted = Sequence[str] | Callable[[dict[str, Any]], dict[str, Any]]
"""Of the metrics: names, of those that are there, or a function of a module that takes out what is to be kept."""


def train(trial: Trial, wanted: Wanted) -> dict[str, Any]:
    """One run and its numbers; ``cpu_seconds`` are those that this thread computed while the model learned."""
    torch.set_num_threads(1)
    fitted = begin(trial)
    compile_kernels(fitted.trainer)
    start = time.thread_time()
    train_to_end(fitted)
    seconds = time.thread_time() - start
    metrics = fitted.metrics()
    if trial.keep is not None:
        trial.keep.mkdir(parents=True, exist_ok=True)
        (trial.keep / "config.yaml").write_text(fitted.config.to_yaml())
        save_model(
            trial.keep / "model.safetensors",
            fitted.model,
            fitted.config.task,
            {"color_space": fitted.dataset.color_space},
        )
    return {
        "trial": trial.name,
        "seed": trial.seed,
        "iterations": trial.iterations,
        "cpu_seconds": seconds,
        **dict(trial.facts),
        **(wanted(metrics) if callable(wanted) else {k: metrics[k] for k in wanted if k in metrics}),
    }


def recorded(path: Path) -> list[dict[str, Any]]:
    """The trials of a file, none if there is no file."""
    found: list[dict[str, Any]] = json.loads(path.read_text()).get("trials", []) if path.exists() else []
    return found


def run_all(
    trials: Sequence[Trial],
    path: Path,
    wanted: Wanted,
    jobs: int,
    shown: Callable[[dict[str, Any]], str],
    beside: Mapping[str, Any] = {},
) -> None:
    """Train what ``path`` does not have yet, ``jobs`` at a time, and write it after every one, with what stands
    ``beside`` the trials."""
    known = {row["trial"] for row in recorded(path)}
    waiting = [trial for trial in trials if trial.name not in known]
    path.parent.mkdir(parents=True, exist_ok=True)

    def keep(number: int, result: Result) -> None:
        if result.state != "done":
            return
        row, whole = result.value, json.loads(path.read_text()) if path.exists() else {}
        whole |= {**beside, "trials": sorted([*whole.get("trials", []), row], key=lambda r: r["trial"])}
        path.write_text(json.dumps(whole, indent=1) + "\n")
        print(f"{time.strftime('%H:%M')} {row['trial']}: {shown(row)}", flush=True)

    work = [Job(trial.name, f"{__name__}:train_one", (trial, wanted)) for trial in waiting]
    settings = LauncherSettings("processes", workers=jobs, threads=1)
    results = launch(work, settings, path.parent / f".{path.stem}-launch", ended=keep)
    failed = [
        f"{trial.name}: {result.trace or result.line}"
        for trial, result in zip(waiting, results, strict=True)
        if result and result.state == "failed"
    ]
    if failed:
        raise SystemExit("\n".join(failed))
    if any(result is None or result.state == "interrupted" for result in results):
        raise KeyboardInterrupt


def train_one(data: tuple[Trial, Wanted], attempt: int, events: Events) -> dict[str, Any]:
    """The function of a job; after its worker died a trial begins anew."""
    return train(*data)


def paces_of(trainers: Mapping[str, Trainer], steps: int = 480) -> dict[str, float]:
    """Seconds a step of each, taking turns so that all meet the same noise; a mean over ``steps``, as a run pays for
    every one of them.

    Primitives grow, move and shrink as a run goes on, so the fairest pace is that of a whole one. Turns are as long as
    the rarest look at voxels is apart. Of trainers with one thread the clock counts what it computes, and not what
    others on the machine do meanwhile.
    """
    for trainer in trainers.values():
        compile_kernels(trainer)
        if trainer.dataset.points is not None:  # files are read once in a run, which is next to nothing in a long one
            generator = torch.Generator().manual_seed(0)
            for _ in range(_DRAWS):
                trainer.dataset.points.draw(8, generator)
    clock = (
        time.thread_time if all(trainer.renderer.threads == 1 for trainer in trainers.values()) else time.perf_counter
    )
    took, turns = dict.fromkeys(trainers, 0.0), max(steps // _TURN, 1)
    for _ in range(turns):
        for name, trainer in trainers.items():
            start = clock()
            for _ in range(_TURN):
                trainer.train_step()
            took[name] += clock() - start
    return {name: seconds / (turns * _TURN) for name, seconds in took.items()}
