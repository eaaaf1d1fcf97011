"""How many threads work."""

from __future__ import annotations

import threading
import time

import pytest
import torch

from neuprim.core.compute import threads
from neuprim.core.compute.threads import limit_threads, parallel_for


def workers(count: int = 40, asked: int = 0) -> int:
    """How many threads had a part in it."""
    seen = set()

    def work(start: int, stop: int) -> None:
        seen.add(threading.get_ident())
        time.sleep(0.002)

    parallel_for(work, count, 1, asked)
    return len(seen)


def test_all_cores_are_as_many_as_the_limit_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "core_count", lambda: 4)
    assert workers() == 4
    with limit_threads(1):
        assert workers() == 1
        assert workers(asked=3) == 3, "who says how many gets them"
        with limit_threads(0):
            assert workers() == 4
        assert workers() == 1
    assert workers() == 4


def test_a_limit_ends_with_an_error_and_is_not_another_threads() -> None:
    with pytest.raises(KeyError), limit_threads(1):
        raise KeyError
    assert threads._limit.get() == 0
    with limit_threads(1):
        found = []
        other = threading.Thread(target=lambda: found.append(threads._limit.get()))
        other.start()
        other.join()
        assert found == [0] and threads._limit.get() == 1


def test_autograd_goes_back_under_the_same_limit() -> None:
    """On the CPU in the thread that asks for it."""
    seen = []

    class Look(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):  # type: ignore[no-untyped-def, override]
            return x * 2

        @staticmethod
        def backward(ctx, g):  # type: ignore[no-untyped-def, override]
            seen.append(threads._limit.get())
            return g * 2

    x = torch.ones(3, requires_grad=True)
    with limit_threads(2):
        Look.apply(x).sum().backward()
    assert seen == [2]
