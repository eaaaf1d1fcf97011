"""Several ranks train what one process with as many views a step does, bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from neuprim.core.data import Dataset
from neuprim.core.train.step import StepReport
from neuprim.core.train.trainer import Trainer
from tests.core import tiny
from tests.ranks import together

STEPS = 30
STRATEGIES: dict[str, dict[str, Any]] = {
    "relocate": {"strategy": "relocate", "fraction": 0.2, "grow_to": 16},
    "gradient": {"strategy": "gradient", "grow_threshold": 1e-4, "prune_threshold": 1e-9, "clone_scale": 0.05, "max_primitives": 20},
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
    """One process with all views a step, and ``size`` ranks with ``views`` each, end alike; and say alike what they did."""
    alone = make(views * size)
    expected = list(alone.run())
    assert [r.change for r in expected if r.change], "the population must have changed, or the test says nothing of it"

    def work(group: Any) -> tuple[Trainer, list[StepReport]]:
        trainer = make(views)
        trainer.join(group)
        return trainer, list(trainer.run())

    found = together(size, work)
    elapsed = set()
    for each in found:
        if isinstance(each, Exception):
            raise each
        trainer, reports = each
        assert curve(reports) == curve(expected)
        same(trainer, alone)
        elapsed.add(trainer.elapsed)
    assert len(elapsed) == 1, "all ranks have the first one's clock"


@pytest.mark.parametrize(("size", "views"), [(2, 1), (3, 1), (2, 3)])
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_ranks_are_one_process_with_as_many_views(size: int, views: int, strategy: str, scene: Dataset) -> None:
    more = {"warmup_steps": 5, "anisotropy_weight": 1e-3, "anisotropy_from": 10, "cooldown": 0.3}
    trained(size, lambda looks: tiny.trainer(scene, STEPS, population=STRATEGIES[strategy], views_per_step=looks, **more), views)


def test_exposures_of_photographs_are_shared() -> None:
    dataset = photographs()
    # more views a step than there are: one is seen twice in a step
    trained(4, lambda looks: tiny.trainer(dataset, STEPS, population=STRATEGIES["relocate"], views_per_step=looks, exposure_rate=0.02), 2)
