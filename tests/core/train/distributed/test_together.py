"""Several ranks train what one process with as many views a step does, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.train.distributed import ALONE
from neuprim.core.train.distributed.group import Group
from neuprim.core.train.step import StepReport
from neuprim.core.train.trainer import Trainer
from tests.core import tiny
from tests.ranks import done, together

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


@pytest.fixture(scope="module")
def scene() -> Dataset:
    return tiny.two_primitives(random_background=True)


def photographs() -> Dataset:
    """The same without alpha, so that exposures may be learned."""
    dataset = tiny.two_primitives()
    white = torch.ones(3)
    dataset.train.images = [replace(p, rgb=p.over(white), alpha=None) for p in dataset.train.images]  # type: ignore[attr-defined]
    return dataset


def curve(reports: list[StepReport]) -> list[tuple[Any, ...]]:
    return [(r.step, r.loss, r.parts, r.psnr, r.primitives, r.view, r.change) for r in reports]


def same(a: Trainer, b: Trainer) -> None:
    first, second = a.state(), b.state()
    assert {**first[1], "elapsed": 0} == {**second[1], "elapsed": 0}
    assert first[0].keys() == second[0].keys()
    for name, value in first[0].items():
        assert value.dtype == second[0][name].dtype and torch.equal(value, second[0][name]), name


def trained(size: int, make: Callable[[int], Trainer], views: int = 1) -> None:
    """One process with all views a step, and ``size`` ranks with ``views`` each, end alike; and say alike what they
    did."""
    alone = make(views * size)
    expected = list(alone.run())
    assert [r.change for r in expected if r.change], "the population must have changed, or the test says nothing of it"

    def work(group: Group) -> tuple[Trainer, list[StepReport]]:
        trainer = make(views)
        trainer.join(group)
        return trainer, list(trainer.run())

    elapsed = set()
    for trainer, reports in done(together(size, work)):
        assert curve(reports) == curve(expected)
        same(trainer, alone)
        elapsed.add(trainer.elapsed)
    assert len(elapsed) == 1, "all ranks have the first one's clock"


@pytest.mark.parametrize(("size", "views"), [(2, 1), (3, 1), (2, 3)])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_ranks_are_one_process_with_as_many_views(size: int, views: int, strategy: str, scene: Dataset) -> None:
    more = {"warmup_steps": 5, "anisotropy_weight": 1e-3, "anisotropy_from": 10, "cooldown": 0.3}
    trained(
        size,
        lambda looks: tiny.trainer(scene, STEPS, population=STRATEGIES[strategy], views_per_step=looks, **more),
        views,
    )


def test_exposures_of_photographs_are_shared() -> None:
    dataset = photographs()
    # more views a step than there are: one is seen twice in a step
    trained(
        4,
        lambda looks: tiny.trainer(
            dataset, STEPS, population=STRATEGIES["relocate"], views_per_step=looks, exposure_rate=0.02
        ),
        2,
    )


def test_a_budget_of_seconds_is_the_first_ranks(scene: Dataset) -> None:
    def work(group: Group) -> tuple[int, float, list[float]]:
        trainer = tiny.trainer(scene, 10**9, max_seconds=0.3)
        trainer.join(group)
        seconds = [report.seconds for report in trainer.run()]
        return trainer.step, trainer.elapsed, seconds

    first, second = done(together(2, work))
    assert first == second
    steps, elapsed, seconds = first
    assert steps > 3 and elapsed >= 0.3 and seconds == sorted(seconds)


def test_a_state_goes_on_with_any_number_of_ranks(scene: Dataset) -> None:
    """Six views a step: by three ranks, then by one process, then by two ranks; and by one process throughout."""

    def make(views: int) -> Trainer:
        return tiny.trainer(scene, STEPS, population=STRATEGIES["relocate"], views_per_step=views)

    whole = make(6)
    list(whole.run())

    def part(views: int, size: int, state: Any) -> Any:
        def work(group: Group) -> Any:
            trainer = make(views)
            if state is not None:
                tensors, header = state
                trainer.load_state({name: value.clone() for name, value in tensors.items()}, header, "state")
            trainer.join(group)
            for _ in range(10):
                trainer.train_step()
            return trainer

        return done(together(size, work))[0] if size > 1 else work(ALONE)  # type: ignore[arg-type]

    trainer = part(2, 3, None)
    trainer = part(6, 1, trainer.state())
    trainer = part(3, 2, trainer.state())
    same(trainer, whole)


def test_one_rank_that_is_asked_to_stop_stops_all_after_the_same_step(scene: Dataset) -> None:
    def work(group: Group) -> int:
        trainer = tiny.trainer(scene, 1000)
        trainer.join(group)
        last = group.last(lambda: group.rank == 1 and trainer.step >= 4)
        assert any(last() for _ in trainer.run())
        return trainer.step

    assert done(together(3, work)) == [5, 5, 5]


def test_voxels_alone_have_no_views_to_share(scene: Dataset) -> None:
    trainer = tiny.trainer(scene)
    trainer.settings = replace(trainer.settings, supervision="voxels")
    with pytest.raises(
        ConfigError,
        match=r"train\.supervision=voxels: there are no views that 2 ranks could share; expected one process",
    ):
        trainer.join(type("Two", (), {"size": 2})())
    trainer.join(ALONE)
