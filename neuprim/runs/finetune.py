"""Training that goes on with a model that was changed: the end of a run once more, at the rates of its end, with the
primitives that there are."""

from __future__ import annotations

from dataclasses import replace

from neuprim.config import RunConfig
from neuprim.core import checkpoint
from neuprim.core.data import Dataset
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import TaskSpec
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import keep_model_settings, make_loss

BEGIN = 0.8
"""Progress of the run that the fine-tuning stands for at its first step."""

START, COOL = 3.0, 0.02
"""The rates at the first step over those at the end of the run, and those at the last step over these at the first:
with next to none at the end, numbers settle, which is worth something by itself (row "trained as long" of
docs/tradeoffs.md) and decides where numbers are rounded."""

LONG, LEAST_START = 2000, 1.0
"""Steps from which on rates begin so high; of fewer they begin lower, in proportion, but not below :data:`LEAST_START`.
A few hundred steps at high rates leave a well trained volume worse than they found it: they unsettle more than there is
time to settle."""

VOXELS_EVERY = 8
"""Steps between two looks at voxels, at most, where a run learned from them: in a few hundred steps with looks as rare
as in a whole run some frames are hardly met, and their extinction drifts for the sake of the images; at every fourth
step images are lost for the sake of voxels."""

_WARM, _PACED = 5, 20
"""Steps before the pace is taken, and those that it is taken of."""


def fine_tuner(
    config: RunConfig,
    task: TaskSpec,
    dataset: Dataset,
    model: Primitives,
    steps: int,
    begin: float = BEGIN,
    voxels_every: int = VOXELS_EVERY,
) -> Trainer:
    """A trainer of a copy of a finished run's model that is ``steps`` steps before the end of its budget.

    Schedules are those of a run from the progress ``begin`` on, but for the rates (:data:`START`, :data:`COOL`);
    nothing is born, moves or is removed, and views are as they are. Gains of photographs' exposures go on from the
    run's checkpoint, where there is one.
    """
    copy = Primitives(
        model.density, model.colour, {name: value.detach().clone() for name, value in model.params.items()}
    )
    whole = round(steps / (1 - begin))
    usual = keep_model_settings(config.train, task, copy)
    final = COOL ** (1 / (1 - begin))  # a rate's factor is final ** progress
    scale = max(START * min(steps / LONG, 1.0), LEAST_START) * usual.final_rate / final**begin
    settings = replace(
        usual,
        iterations=whole,
        final_rate=final,
        cooldown=0.0,
        rates={spec.name: scale * usual.rates.get(spec.name, spec.lr) for spec in copy.specs},
        max_seconds=None,
        coarse=1,
        warmup_steps=0,
        voxels_every=min(usual.voxels_every, voxels_every),
        population=replace(config.train.population, strategy="fixed", grow_from=1.0),
    )
    trainer = Trainer(copy, dataset, make_loss(config, task), settings, config.renderer, config.seed)
    trainer.step = whole - steps
    saved = config.output_dir / "checkpoint.safetensors"
    if trainer.exposures is not None and saved.exists():
        _, tensors = checkpoint.read(saved, "checkpoint")
        trainer.exposures.load_state(
            {name.removeprefix("exposure."): t for name, t in tensors.items() if name.startswith("exposure.")}
        )
    return trainer


def steps_in(seconds: float, config: RunConfig, task: TaskSpec, dataset: Dataset, model: Primitives) -> int:
    """How many steps fit into some seconds, at the pace that a few of them have; none in 0 seconds."""
    if seconds <= 0:
        return 0
    trainer = fine_tuner(config, task, dataset, model, _WARM + _PACED)
    for _ in range(_WARM):
        trainer.train_step()
    before = trainer.elapsed
    for _ in range(_PACED):
        trainer.train_step()
    return max(int(seconds * _PACED / max(trainer.elapsed - before, 1e-9)), 1)
