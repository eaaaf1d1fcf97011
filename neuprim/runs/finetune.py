"""Train a changed model further: the end of a run once more, at the rates of its end, with the primitives that there
are."""

from __future__ import annotations

from dataclasses import replace

from neuprim.config import Job
from neuprim.core import checkpoint
from neuprim.core.data import Dataset
from neuprim.core.model.primitives import Primitives
from neuprim.core.train.trainer import Trainer
from neuprim.core.train.trainer_state import select_state_tensors
from neuprim.runs.fit import drop_unused_run_rates, make_run_loss

BEGIN = 0.8
"""Progress of the run that the first step stands for."""

START, COOL = 3.0, 0.02
"""The rates at the first step over those at the end of the run, and those at the last step over these at the first.
With next to none at the end, numbers settle, which improves quality by itself (row "trained as long" of
docs/tradeoffs.md) and decides where numbers are rounded."""

LONG, LEAST_START = 2000, 1.0
"""Steps from which on rates begin so high. Fewer steps begin lower, in proportion, but not below
:data:`LEAST_START`: a few hundred steps at high rates leave a well trained volume worse than they found it."""

VOXELS_EVERY = 8
"""Largest number of steps between two uses of voxels, where a run learned from them. In a few hundred steps with uses
as rare as in a run some frames are hardly met, and their extinction drifts; at every fourth step images get worse."""

_PACE_WARMUP, _PACE_STEPS = 5, 20
"""Steps before the pace is measured, and those that it is measured over."""


def make_run_finetune_trainer(
    job: Job,
    dataset: Dataset,
    model: Primitives,
    steps: int,
    begin: float = BEGIN,
    voxels_every: int = VOXELS_EVERY,
) -> Trainer:
    """Make a trainer of a copy of a finished run's model that is ``steps`` steps before the end of its budget.

    Schedules are those of a run from the progress ``begin`` on, except for the rates (:data:`START`, :data:`COOL`);
    the population is fixed, and views keep their resolution. Gains of photographs' exposures go on from the run's
    checkpoint, if there is one.
    """
    config, params = job.config, {name: value.detach().clone() for name, value in model.params.items()}
    copy = Primitives(model.density, model.colour, params)
    total = round(steps / (1 - begin))
    usual = drop_unused_run_rates(config.train, job.task, copy)
    final = COOL ** (1 / (1 - begin))  # a rate's factor is final ** progress
    scale = max(START * min(steps / LONG, 1.0), LEAST_START) * usual.final_rate / final**begin
    settings = replace(
        usual,
        iterations=total,
        final_rate=final,
        cooldown=0.0,
        rates={spec.name: scale * usual.rates.get(spec.name, spec.lr) for spec in copy.specs},
        max_seconds=None,
        coarse=1,
        warmup_steps=0,
        voxels_every=min(usual.voxels_every, voxels_every),
        population=replace(config.train.population, strategy="fixed", grow_from=1.0),
    )
    trainer = Trainer(copy, dataset, make_run_loss(job), settings, config.renderer, config.seed)
    trainer.step = total - steps
    saved = config.output_dir / "checkpoint.safetensors"
    if trainer.exposures is not None and saved.exists():
        trainer.exposures.load_state(select_state_tensors(checkpoint.read_tensors(saved, "checkpoint")[1], "exposure."))
    return trainer


def count_run_finetune_steps(seconds: float, job: Job, dataset: Dataset, model: Primitives) -> int:
    """How many steps of fine-tuning fit into some seconds, at the measured pace; none in 0 seconds."""
    if seconds <= 0:
        return 0
    trainer = make_run_finetune_trainer(job, dataset, model, _PACE_WARMUP + _PACE_STEPS)
    for _ in range(_PACE_WARMUP):
        trainer.train_step()
    before = trainer.elapsed
    for _ in range(_PACE_STEPS):
        trainer.train_step()
    return max(int(seconds * _PACE_STEPS / max(trainer.elapsed - before, 1e-9)), 1)
