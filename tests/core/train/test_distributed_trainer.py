"""R ranks with V views a step train what one process with R x V views a step does, bit for bit."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.config import compose
from neuprim.core.data import Dataset, Pixels
from neuprim.core.errors import ConfigError, NeuprimError, NonFiniteError, RankError
from neuprim.core.train.distributed_trainer import DistributedTrainer
from neuprim.core.train.process_group import ProcessGroup
from neuprim.core.train.trainer import StepReport, Trainer
from neuprim.runs.fit import prepare_training
from tests.core import tiny
from tests.ranks import Killed, results, run_ranks

STEPS = 30
STRATEGIES: dict[str, dict[str, Any]] = {
    "relocate": {"strategy": "relocate", "fraction": 0.2, "grow_to": 16},
    "gradient": {
        "strategy": "gradient",
        "grow_threshold": 1e-4,
        "prune_threshold": 1e-9,
        "clone_scale": 0.05,
        "max_primitives": 20,
    },
}
SMALL = [
    "train.iterations=24",
    "train.population.every=5",
    "train.population.idle=null",
    "seed=2",
    "renderer.device=cpu",
]
TASKS = {
    "static": ["scene=solids", "scene.size=24", "scene.train_views=8", "scene.test_views=2", "model.primitives=60"],
    "dynamic": ["scene=smoke_fire", "scene.size=24", "scene.resolution=16", "scene.timesteps=3", "scene.cameras=5",
        "model.primitives=60",
                "train.supervision=both", "train.voxels_every=2", "train.voxels_per_step=200"],
    "relight": ["scene=lit_solids", "scene.size=24", "model.primitives=40"],
}  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Dataset:
    return tiny.two_primitives(random_background=True)


def same_state(a: Trainer, b: Trainer) -> None:
    first, second = a.state(), b.state()
    assert {**first[1], "elapsed": 0} == {**second[1], "elapsed": 0}
    assert first[0].keys() == second[0].keys()
    for name, value in first[0].items():
        assert value.dtype == second[0][name].dtype and torch.equal(value, second[0][name]), name


def assert_equal_to_one_process(size: int, views: int, make: Callable[[int, ProcessGroup | None], Trainer]) -> None:
    def curve(reports: list[StepReport]) -> list[tuple[Any, ...]]:
        return [(r.step, r.loss, r.parts, r.psnr, r.primitives, r.view, r.change) for r in reports]

    alone = make(views * size, None)
    expected = list(alone.run())
    assert any(report.change for report in expected), "the population must change"

    def work(group: ProcessGroup) -> tuple[Trainer, list[StepReport]]:
        trainer = make(views, group)
        return trainer, list(trainer.run())

    found = results(run_ranks(size, work))
    for trainer, reports in found:
        assert curve(reports) == curve(expected)
        same_state(trainer, alone)
    assert len({trainer.elapsed for trainer, _ in found}) == 1, "all ranks have the first one's clock"


@pytest.mark.parametrize(
    ("size", "views", "strategy"), [(2, 1, "gradient"), (3, 1, "relocate"), (2, 3, "relocate"), (5, 1, "gradient")]
)
def test_ranks_equal_one_process(size: int, views: int, strategy: str, scene: Dataset) -> None:
    more = {"warmup_steps": 5, "anisotropy_weight": 1e-3, "anisotropy_from": 10, "cooldown": 0.3}
    assert_equal_to_one_process(
        size,
        views,
        lambda count, group: tiny.trainer(
            scene, STEPS, group=group, population=STRATEGIES[strategy], views_per_step=count, **more
        ),
    )


def test_ranks_share_exposures_of_photographs() -> None:
    dataset, white = tiny.two_primitives(), torch.ones(3)
    dataset.train.images = [replace(p, rgb=p.over(white), alpha=None) for p in dataset.train.images]  # type: ignore[attr-defined]
    more = {"population": STRATEGIES["relocate"], "exposure_rate": 0.02}
    # eight views a step of six: some are used twice
    assert_equal_to_one_process(
        4, 2, lambda count, group: tiny.trainer(dataset, STEPS, group=group, views_per_step=count, **more)
    )


@pytest.mark.parametrize("task", TASKS)
def test_two_ranks_equal_one_process_in_every_task(task: str, tmp_path: Path) -> None:
    overrides = [f"task={task}", *TASKS[task], *SMALL, f"output_dir={tmp_path / 'out'}"]
    configs = {count: compose([*overrides, f"train.views_per_step={count}"]) for count in (1, 2)}
    dataset = prepare_training(configs[1]).dataset
    assert_equal_to_one_process(
        2, 1, lambda count, group: prepare_training(configs[count], dataset=dataset, group=group).trainer
    )


def test_a_state_continues_with_any_number_of_ranks(scene: Dataset) -> None:
    """Six views a step by three ranks, then by one process, then by two ranks."""

    def make(views: int, group: ProcessGroup | None = None) -> Trainer:
        return tiny.trainer(scene, STEPS, group=group, population=STRATEGIES["relocate"], views_per_step=views)

    whole = make(6)
    list(whole.run())
    state = make(6).state()
    for views, size in ((2, 3), (6, 1), (3, 2)):

        def work(group: ProcessGroup, views: int = views, size: int = size, state: Any = state) -> Trainer:
            trainer = make(views, group if size > 1 else None)
            trainer.load_state({name: value.clone() for name, value in state[0].items()}, state[1], "state")
            for _ in range(10):
                trainer.train_step()
            return trainer

        trainer = results(run_ranks(size, work))[0]
        state = trainer.state()
    same_state(trainer, whole)


def test_a_budget_of_seconds_follows_the_first_rank(scene: Dataset) -> None:
    def work(group: ProcessGroup) -> list[float]:
        trainer = tiny.trainer(scene, 10**9, group=group, max_seconds=0.3)
        return [report.seconds for report in trainer.run()]

    first, second = results(run_ranks(2, work))
    assert first == second and len(first) > 3 and first[-1] >= 0.3 and first == sorted(first)


def test_ranks_share_a_number_that_the_first_one_finds() -> None:
    asked: list[int] = []

    def work(group: ProcessGroup) -> int:
        with group.in_turn():
            return group.share_number("primitives", lambda: asked.append(group.rank) or 10**9)  # type: ignore[func-returns-value]

    assert results(run_ranks(3, work)) == [10**9] * 3 and asked == [0]


def test_all_ranks_stop_after_the_same_step(scene: Dataset) -> None:
    def work(group: ProcessGroup) -> int:
        trainer = tiny.trainer(scene, 1000, group=group)
        trainer.stop_requested = lambda: group.rank == 1 and trainer.step >= 4
        assert any(trainer.stopping for _ in trainer.run())
        return trainer.step

    assert results(run_ranks(3, work)) == [5, 5, 5]


def test_a_training_without_views_is_refused(tmp_path: Path) -> None:
    overrides = [
        "task=dynamic",
        *TASKS["dynamic"],
        *SMALL,
        "train.supervision=voxels",
        f"output_dir={tmp_path / 'out'}",
    ]
    config = compose(overrides)
    first, _ = run_ranks(2, lambda group: prepare_training(config, group=group))
    assert isinstance(first, ConfigError) and "expected 1 process, found 2" in str(first)


# ------------------------------------------------------------ failures


def make(scene: Dataset, group: ProcessGroup | None = None, views: int = 1) -> Trainer:
    return tiny.trainer(scene, 20, group=group, views_per_step=views, population=STRATEGIES["relocate"])


@pytest.mark.parametrize("dead", [0, 1, 2])
def test_a_killed_rank_costs_no_step(dead: int, scene: Dataset) -> None:
    trainers: dict[int, Trainer] = {}

    def work(group: ProcessGroup) -> None:
        trainer = trainers[group.rank] = make(scene, group)
        for _ in trainer.run():
            if group.rank == dead and trainer.step == 8:
                raise Killed

    found = run_ranks(3, work)
    assert isinstance(found.pop(dead), Killed)
    unreported = [error for error in found if isinstance(error, RankError) and not error.reported]
    assert unreported and "step 9: another rank ended without a message" in str(unreported[0])

    whole, again = make(scene, views=3), make(scene, views=3)
    list(whole.run())
    again.load_state(*trainers[(dead + 1) % 3].state(), "state")
    assert again.step == 8
    list(again.run())
    same_state(again, whole)


def test_an_error_of_one_rank_reaches_the_others() -> None:
    class Spoiled(tiny.Views):
        def pixels(self, index: int) -> Pixels:
            whole = super().pixels(index)
            return Pixels(whole.rgb * float("nan"), whole.alpha) if index == 3 else whole

    spoiled = tiny.two_primitives(views=Spoiled)
    found = run_ranks(2, lambda group: list(make(spoiled, group).run()))
    (own,) = [error for error in found if isinstance(error, NeuprimError) and not isinstance(error, RankError)]
    (other,) = [error for error in found if isinstance(error, RankError)]
    assert other.reported and str(own) in str(other)


def test_all_ranks_refuse_a_sum_that_is_not_finite(scene: Dataset) -> None:
    def work(group: ProcessGroup) -> None:
        trainer = make(scene, group)
        backward = trainer._backward

        def spoil(*arguments: Any) -> float:
            cost = backward(*arguments)
            if group.rank == 1 and trainer.step == 2:
                trainer.model.params["means"].grad[4] = float("inf")  # type: ignore[index]
            return cost

        trainer._backward = spoil  # type: ignore[method-assign]
        list(trainer.run())

    for error in run_ranks(2, work):
        assert isinstance(error, NonFiniteError) and "gradient of means of primitive 4" in str(error)


def test_a_rank_that_computes_differently_is_found_at_the_next_step(scene: Dataset) -> None:
    def work(group: ProcessGroup) -> None:
        trainer = make(scene, group)
        for _ in trainer.run():
            if group.rank == 1 and trainer.step == 3:
                trainer.model.params["means"].detach()[0, 0] += 1e-7

    for error in run_ranks(2, work):
        assert isinstance(
            error, RankError
        ) and "step 4: rank 1 computes other positions of primitives than rank 0" in str(error)


@pytest.mark.parametrize(
    ("change", "what"),
    [({"seed": 5}, "state"), ({"final_rate": 0.5}, "settings"), ({"views": 5}, "training views"),
        ({"steps": 1}, "steps done")],
)  # fmt: skip
def test_ranks_that_start_differently_are_refused(change: dict[str, Any], what: str, scene: Dataset) -> None:
    def work(group: ProcessGroup) -> None:
        own = dict(change) if group.rank == 1 else {}
        dataset, steps = scene, own.pop("steps", 0)
        if own.pop("views", 0):
            dataset = tiny.two_primitives()
            dataset.train.cameras = dataset.train.cameras[:5]  # type: ignore[attr-defined]
        trainer = tiny.trainer(dataset, 20, group=group, **own)
        assert isinstance(trainer, DistributedTrainer)
        trainer.step += steps
        trainer.check_same_start()

    for error in run_ranks(2, work):
        assert isinstance(error, RankError) and re.search(rf"rank 1 has {what} .+, but rank 0 has ", str(error))


def test_ranks_go_in_turn() -> None:
    went: list[int] = []

    def work(group: ProcessGroup) -> None:
        with group.in_turn():
            went.append(group.rank)

    results(run_ranks(3, work))
    assert went[0] == 0 and sorted(went) == [0, 1, 2]

    def fail(group: ProcessGroup) -> None:
        with group.in_turn():
            raise NeuprimError("no such folder") if group.is_first else AssertionError("its turn came")

    first, second = run_ranks(2, fail)
    assert type(first) is NeuprimError
    assert isinstance(second, RankError) and second.reported and str(second) == "rank 0: no such folder"
