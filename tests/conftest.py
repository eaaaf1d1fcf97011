"""What all tests share: how long one may take, and the ways in which an operation is computed."""

from __future__ import annotations

import os
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:
    # Each worker has one core; more threads of torch wait for each other. Torch reads this when it is imported.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

import hypothesis
import pytest

from neuprim.core.compute import device

hypothesis.settings.register_profile("neuprim", deadline=None)  # a busy machine is no failure
hypothesis.settings.load_profile("neuprim")

TESTS = Path(__file__).parent

SLOW = 3600.0
"""Seconds that a test marked slow may take; the others have ``timeout`` of pyproject.toml."""


FIRST = (
    "numerics/test_equivalence.py", "cli/test_torchrun.py", "plugins/test_new_task.py",
    "runs/launch/test_launch_processes.py", "search/test_target_run.py", "search/test_ablation.py",
    "conformance/test_checks.py", "webpage/test_page_person.py", "webpage/test_page_exact.py",
    "viewer/test_live_browser.py",
)  # fmt: skip
"""Files with long tests, which start first so that no worker ends alone. While one worker compiles the kernels of the
first file, another compiles those of runs; the other files of numerics find them compiled."""


def pytest_configure(config: pytest.Config) -> None:
    config.option.loadscopereorder = False  # of pytest-xdist, which would start with the files of most tests


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let slow tests take their time, and begin with the files :data:`FIRST`."""
    places = {TESTS / name: place for place, name in enumerate(FIRST)}
    items.sort(key=lambda item: places.get(item.path, len(FIRST)))
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(SLOW))


@pytest.fixture(params=["fused", "twin"])
def either_way(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Once as compiled for the processor, once by the twins in torch code that tensors on a card take."""
    if request.param == "twin":
        monkeypatch.setattr(device, "on_numba", lambda *tensors: False)
    return str(request.param)
