"""Which held-out views models are compared on."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from neuprim.search.model_quality import eval_views, fill_masked
from tests.core import tiny


@pytest.mark.parametrize(
    ("asked", "found"),
    [(2, ["v0", "v3"]), (3, ["v0", "v2", "v4"]), (6, [f"v{i}" for i in range(6)]), (9, [f"v{i}" for i in range(6)])],
)
def test_evenly_spread_and_all_where_more_are_asked_for(asked: int, found: list[str]) -> None:
    dataset = tiny.two_primitives()
    assert [truth.view.name for truth in eval_views(replace(dataset, test=dataset.train), asked)] == found


def test_none_of_no_views_and_over_the_background() -> None:
    dataset = tiny.two_primitives()
    assert eval_views(replace(dataset, test=tiny.Views(0, 0.0)), 4) == []
    assert torch.equal(eval_views(dataset, 1)[0].image, dataset.test.pixels(0).over(dataset.background))


def test_where_pixels_do_not_count_the_truth_stands() -> None:
    dataset = tiny.two_primitives()
    mask = torch.zeros(tiny.SIZE, tiny.SIZE, dtype=torch.bool)
    mask[3, 4] = True
    dataset.test.images = [replace(pixels, mask=mask) for pixels in dataset.test.images]  # type: ignore[attr-defined]
    truth = eval_views(dataset, 1)[0]
    drawn = fill_masked(torch.full_like(truth.image, 7.0), truth)
    assert drawn[3, 4].tolist() == [7.0] * 3 and torch.equal(drawn[4:], truth.image[4:])
