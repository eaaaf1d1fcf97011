"""What all tests share: how long one may take, and the ways in which an operation is computed."""

from __future__ import annotations

import os

if "PYTEST_XDIST_WORKER" in os.environ:
    # Each worker has one core; more threads of torch wait for each other. Torch reads this when it is imported.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import hypothesis
import pytest

from neuprim.core.compute import device

hypothesis.settings.register_profile("neuprim", deadline=None)  # a busy machine is no failure
hypothesis.settings.load_profile("neuprim")

SLOW = 3600.0
"""Seconds that a test marked slow may take; the others have ``timeout`` of pyproject.toml."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let slow tests take their time, and move the extremes behind the tests of searches.

    Two workers that draw the extremes early would compile the same kernels at once.
    """
    extremes = [item for item in items if item.path.name == "test_extremes.py"]
    others = [item for item in items if item.path.name != "test_extremes.py"]
    after = [at for at, item in enumerate(others, 1) if item.path.parent.name == "search"] or [len(others)]
    items[:] = others[: after[-1]] + extremes + others[after[-1] :]
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW))


@pytest.fixture(params=["fused", "twin"])
def either_way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Once as compiled for the processor, once by the twins in torch code that tensors on a card take."""
    if request.param == "twin":
        monkeypatch.setattr(device, "on_numba", lambda *tensors: False)
    return str(request.param)
