"""Operations that numba lacks: borrowed arrays, sixteen floats at once, and the compression of sixteen."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
from numba import njit

from neuprim.core.compute import kernels
from neuprim.core.compute.kernels import borrow_array, compress16, copy16


def test_sixteen_floats_are_read_before_they_are_written() -> None:
    @njit
    def copy(target: Any, at: Any, source: Any, first: Any) -> None:
        copy16(target, at, source, first)

    numbers = np.arange(40, dtype=np.float32)
    copy(numbers, 5, numbers, 3)
    assert numbers.tolist() == [*range(5), *range(3, 19), *range(21, 40)]


@pytest.mark.parametrize("compresses", [True, False])
def test_those_of_sixteen_floats_that_count_are_moved_together(
    compresses: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the instruction and one by one, in place, and whatever the flags: not numbers count, and zeros of either sign
    do not."""
    if compresses and not kernels._COMPRESSES:
        pytest.skip("this version of LLVM is not asked for the instruction")
    monkeypatch.setattr(kernels, "_COMPRESSES", compresses)

    @njit
    def keep(array: Any, at: Any, first: Any, flags: Any) -> Any:
        return compress16(array, at, first, flags)

    g = np.random.default_rng(0)
    special, zeros = [1e-40, -2.0, np.nan, np.inf], [0.0, -0.0]
    for chance in (0.0, 0.1, 0.5, 0.9, 1.0):
        for at in (0, 3, 16):
            array = g.normal(size=64).astype(np.float32)
            array[32:48] = np.where(g.random(16) < chance, g.choice(special, 16), g.choice(zeros, 16))
            chosen = array[16:32][array[32:48] != 0]
            expected = array.copy()
            expected[at : at + 16] = [*chosen, *[0.0] * (16 - len(chosen))]
            assert keep(array, at, 16, 32) == len(chosen)
            np.testing.assert_array_equal(array, expected)


def test_a_borrowed_array_is_the_same_array_and_its_owner_keeps_it() -> None:
    @njit
    def total(array: Any) -> float:
        view, result = borrow_array(array), 0.0
        view[0, 0] = 7
        for row in range(view.shape[0]):
            result += view[row].sum()
        return result

    array = np.ones((3, 4), np.float32)
    before = sys.getrefcount(array)
    assert [total(array) for _ in range(100)] == [18.0] * 100
    assert array[0, 0] == 7 and sys.getrefcount(array) == before
