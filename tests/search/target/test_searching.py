"""Where a search goes next, of records made up."""

from __future__ import annotations

from typing import Any, cast

import pytest

from neuprim.config import compose
from neuprim.config.target import Target
from neuprim.core.data import Dataset
from neuprim.search.target.record import Attempt, Record
from neuprim.search.target.searching import Search
from neuprim.search.target.trying import Trying
from tests.search.target_records import attempt


class Paced:
    """A machine on which a step takes a hundredth of a second, whatever the size."""

    spent = 0.0

    def pace(self, primitives: int) -> float:
        return 0.01


def search(psnr: float, *attempts: Attempt) -> Search:
    config = compose(
        ["task=static", "scene=solids", "model.primitives=400", "train.iterations=800"], check_output=False
    )
    record = Record({"psnr": psnr, "budget": 100.0}, {}, length=200, attempts=list(attempts))
    return Search(config, Target(psnr=psnr), cast(Dataset, None), record, cast(Trying, cast(Any, Paced())))


FLAT = (attempt(400, 100, 23.0), attempt(400, 200, 24.0), attempt(800, 100, 23.0), attempt(800, 200, 24.02))


def test_where_no_size_seems_to_have_the_target_but_may_a_full_run_of_the_smaller_tells() -> None:
    assert search(25.7, *FLAT).promising() == 400
    assert search(25.7, *FLAT).wanted() == 400
    assert search(40.0, *FLAT).promising() is None, "beyond all doubt"
    assert search(25.0, *FLAT).promising() is None, "it seems to have it"
    assert search(25.7, *FLAT, attempt(400, 800, 25.6, "full")).promising() is None, "full runs say how it is"


def test_after_a_full_run_that_has_more_than_the_target_sizes_do_not_fall_at_once() -> None:
    found = search(25.0, *FLAT, attempt(400, 800, 25.85, "full"))
    assert found.down_to() == pytest.approx(200, abs=1) and found.wanted() >= 200
    assert search(25.0, *FLAT).down_to() == 1
    assert search(25.0, *FLAT, attempt(400, 800, 25.85, "full"), attempt(100, 800, 24.0, "full")).down_to() == 1, (
        "it lies between"
    )


def test_near_the_target_is_near_in_bytes_too() -> None:
    below, above = attempt(100, 800, 24.2, "full"), attempt(200, 800, 25.25, "full")
    found = search(25.0, *FLAT, below, above)
    assert not found.close(above), "a quarter of a decibel is a tenth of the bytes here"
    near = attempt(185, 800, 25.12, "full")
    assert search(25.0, *FLAT, below, above, near).close(near)
    assert not search(25.0, *FLAT, below, above, near).close(below)
