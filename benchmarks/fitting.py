"""A training without a run directory, for benchmarks."""

from __future__ import annotations

from typing import Any

from neuprim.config import RunConfig
from neuprim.core.channels import channels_of
from neuprim.core.train.trainer import Trainer
from neuprim.plugins.registry import load_task
from neuprim.runs.measure import measure, summary

__all__ = ["finish"]


def finish(config: RunConfig, trainer: Trainer) -> dict[str, Any]:
    """Trains to the end of the budget; the metrics of `neuprim run` on the test views, the model's size as its tensors' bytes."""
    for _ in trainer.run():
        pass
    for field in (trainer.model.density, trainer.model.colour):
        field.set_progress(1.0)
    size = 4 * sum(v.numel() for v in trainer.model.params.values())
    training = {"iterations": trainer.step, "train_seconds": trainer.elapsed}
    channels = channels_of(load_task(config.task), trainer.dataset)
    views = measure(trainer.model, trainer.dataset, config.renderer, channels)
    return summary(config, trainer.model, trainer.dataset, channels, views, size, training)
