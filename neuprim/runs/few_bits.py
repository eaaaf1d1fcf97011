"""Training that knows in how few bits its numbers will be stored (quantisation-aware fine-tuning)."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from neuprim.config import RunConfig
from neuprim.core.compressed import BitTable, Schemes, folded, rounded, schemes
from neuprim.core.data import Dataset
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import TaskSpec
from neuprim.runs.finetune import fine_tuner, steps_in
from neuprim.runs.fit import one_torch_thread
from neuprim.runs.prune.cut import zeros_of
from neuprim.runs.prune.judge import judge_of

__all__ = ["train_for"]


def train_for(
    config: RunConfig,
    task: TaskSpec,
    dataset: Dataset,
    model: Primitives,
    table: BitTable,
    seconds: float,
    steps: int | None,
    progress: Callable[[str, float], None],
) -> tuple[Primitives, Schemes, int, list[str]]:
    """A folded model and how it is to be coded, the steps that it was trained for, and what there is to say about it.

    Args:
        seconds: about, where there are no ``steps``.
    """
    with one_torch_thread():
        if steps is None:
            steps = steps_in(seconds, config, task, dataset, model)
        whole = folded(model)
        made, judge = schemes(whole, table), judge_of(config, dataset)
        before = judge(_read_back(whole, made))
        trainer = fine_tuner(config, task, dataset, whole, steps)
        trainer.zeros = zeros_of(trainer.model)
        there = {name: scheme.to(trainer.device) for name, scheme in made.items()}

        def stored(params: dict[str, Tensor]) -> dict[str, Tensor]:
            return rounded(params, there)

        trainer.stored = stored
        for done in range(steps):
            trainer.train_step()
            if done % 20 == 0:
                progress("training for few bits", done / steps)
        trained = Primitives(whole.density, whole.colour, {name: value.detach().cpu() for name, value in trainer.model.params.items()})
        after = judge(_read_back(trained, made))
    if after <= before:
        return (
            whole,
            made,
            steps,
            [f"{steps:,} steps for few bits brought nothing ({after - before:+.3f} dB on training views); stored as it was"],
        )
    return trained, made, steps, []


def _read_back(model: Primitives, made: Schemes) -> Primitives:
    return Primitives(model.density, model.colour, {name: value.detach() for name, value in rounded(model.params, made).items()})
