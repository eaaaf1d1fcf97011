"""Every task by two ranks, from its own preset, is what one process trains with two views a step; also where each has
half of the primitives."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from neuprim.config import compose
from neuprim.core.train.distributed.group import Group
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import start
from tests.ranks import done, together
from tests.shards import different, share, whole_of

TASKS = {
    "static": ["scene=solids", "scene.size=24", "scene.train_views=8", "scene.test_views=2", "model.primitives=60"],
    "dynamic": [
        *(
            "scene=smoke_fire",
            "scene.size=24",
            "scene.resolution=16",
            "scene.timesteps=3",
            "scene.cameras=5",
            "model.primitives=60",
        ),
        *("train.supervision=both", "train.voxels_every=2", "train.voxels_per_step=200"),
    ],
    "relight": ["scene=lit_solids", "scene.size=24", "model.primitives=40"],
}


@pytest.mark.parametrize("task", TASKS)
def test_a_task_by_two_ranks(task: str, tmp_path: Path) -> None:
    words = [
        f"task={task}",
        *TASKS[task],
        "train.iterations=24",
        "train.population.every=5",
        "train.population.idle=null",
        "seed=2",
        f"output_dir={tmp_path / 'out'}",
        "renderer.device=cpu",
    ]
    config = compose(words)
    alone = start(compose([*words, "train.views_per_step=2"]))
    expected = [(report.loss, report.parts, report.change) for report in alone.trainer.run()]
    assert any(change for *_, change in expected), "the population must have changed"

    def work(group: Group) -> tuple[Trainer, list[object]]:
        trainer = start(config, dataset=alone.dataset).trainer
        trainer.join(group)
        return trainer, [(report.loss, report.parts, report.change) for report in trainer.run()]

    whole = alone.trainer.state()[0]
    for trainer, reports in done(together(2, work)):
        assert reports == expected
        state = trainer.state()[0]
        assert state.keys() == whole.keys()
        assert [name for name, value in state.items() if not torch.equal(value, whole[name])] == []

    def part(group: Group) -> tuple[Trainer, list[object]]:
        trainer = share(start(config, dataset=alone.dataset).trainer, group)
        return trainer, [(report.loss, report.parts, report.change) for report in trainer.run()]

    found = done(together(2, part))
    assert [reports for _, reports in found] == [expected, expected]
    assert different(whole_of([trainer for trainer, _ in found]), whole) == []
