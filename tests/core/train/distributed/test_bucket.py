"""Sums over views in their order, and the bytes that they cost."""

from __future__ import annotations

import math

import pytest
import torch

from neuprim.core.render import Contributions
from neuprim.core.render.output import sum_contributions as added
from neuprim.core.train.distributed.bucket import Bucket, Pair
from neuprim.core.train.distributed.group import Group
from tests.core import tiny
from tests.ranks import Threads, done, together

COUNT = 7
SHAPES = {"means": (COUNT, 3), "W1": (COUNT, 5, 3), "none": (COUNT, 0), "b2": (COUNT,), "still": (COUNT, 2)}


def gradients(place: int) -> dict[str, torch.Tensor]:
    """Of a view, of all sizes, so that another order of adding has other bits."""
    generator = torch.Generator().manual_seed(place)
    return {
        name: torch.randn(shape, generator=generator) * 10.0 ** (place % 5)
        for name, shape in SHAPES.items()
        if name != "still"
    }


def tally(place: int) -> Contributions:
    generator = torch.Generator().manual_seed(100 + place)
    rows = torch.tensor([0, 2, 5]) if place % 2 else None
    numbers = 3 if place % 2 else COUNT
    return Contributions(
        torch.rand(numbers, generator=generator) * 10.0 ** (place % 3), torch.rand(numbers, generator=generator), rows
    )


@pytest.mark.parametrize(
    ("size", "views", "pair"), [(2, 1, True), (2, 1, False), (2, 4, False), (3, 2, False), (5, 1, False)]
)
def test_sums_are_those_of_adding_one_view_after_the_other(size: int, views: int, pair: bool) -> None:
    expected = gradients(0)
    for place in range(1, size * views):
        expected = {name: value + gradients(place)[name] for name, value in expected.items()}
    other = {
        name: sum((gradients(place)[name] for place in reversed(range(size * views))), torch.zeros(()))
        for name in expected
    }
    assert size * views == 2 or any(not torch.equal(expected[name], other[name]) for name in expected), (
        "no order would be wrong"
    )
    of_all = added([tally(place) for place in range(size * views)], COUNT)
    threads = Threads(size)

    def work(group: Group) -> None:
        params = {name: torch.zeros(shape, requires_grad=True) for name, shape in SHAPES.items()}
        bucket = Pair(params, group.rank, 64) if pair else Bucket(params, size, 64)
        assert (
            bucket.fits(params, 64)
            and not bucket.fits(params, 128)
            and not bucket.fits({**params, "b2": torch.zeros(3)}, 64)
        )
        for _ in range(2):  # the second time it is not new
            for place in range(group.rank, size * views, size):
                for name, value in gradients(place).items():
                    params[name].grad = value
                there = bucket.take(params, tally(place))
                assert there == [True, True, True, True, False] and all(value.grad is None for value in params.values())
                bucket.add(lambda rows, found: threads.swap(group.rank, rows, found))
            letters = bucket.spread(
                lambda rows, found: threads.swap(group.rank, rows, found), bytes([group.rank + 0xF0]) * 64
            )
            assert letters == [bytes([rank + 0xF0]) * 64 for rank in range(size)], "whatever bits are in them"
            sums = bucket.give(params, there)
            assert params["still"].grad is None, "what nobody had a gradient of has none"
            for name, value in expected.items():
                assert torch.equal(params[name].grad, value), name  # type: ignore[arg-type]
            assert (
                torch.equal(sums.weight, of_all.weight)
                and torch.equal(sums.error_weight, of_all.error_weight)
                and sums.rows is None
            )

    done(together(size, work))


@pytest.mark.parametrize(("size", "views"), [(2, 1), (2, 3), (3, 1), (4, 2)])
def test_a_step_sends_what_the_page_says(size: int, views: int) -> None:
    dataset = tiny.two_primitives()

    def work(group: Group) -> tuple[int, int]:
        trainer = tiny.trainer(dataset, 5, views_per_step=views)
        trainer.join(group)
        trainer.train_step()
        before = group.sent
        trainer.train_step()
        return group.sent - before, 4 * sum(value.numel() + 15 for value in trainer.model.params.values()) + 4 * 2 * (
            trainer.model.count + 15
        )

    whole = 4 * (sum(v.numel() for v in tiny.trainer(dataset).model.params.values()) + 2 * 12)
    for sent, padded in done(together(size, work)):
        letters = views * 2048 * (size - 1)
        assert (
            (views + 1) * whole * (size - 1) / size
            <= sent - letters
            <= (views + 1) * (size - 1) * (math.ceil(padded / size) + 64)
        )


def test_statistics_of_several_frames_are_added_in_their_order() -> None:
    """As ranks add them: a sum over a stack has an order of its own."""
    tallies = [tally(place) for place in range(9)]
    weight, error = tallies[0].of_all(COUNT)
    for each in tallies[1:]:
        weight, error = weight + each.of_all(COUNT)[0], error + each.of_all(COUNT)[1]
    found = added(tallies, COUNT)
    assert torch.equal(found.weight, weight) and torch.equal(found.error_weight, error)
