"""The built-in tasks pass every check that a third party's task has to pass."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace

import pytest

from neuprim.conformance import ConformanceError, check_task, checks, named_checks
from neuprim.conformance.task_under_test import TaskUnderTest
from neuprim.core.errors import ConfigError
from neuprim.tasks.dynamic import TASK as DYNAMIC
from neuprim.tasks.relight import TASK as RELIGHT
from neuprim.tasks.static import TASK as STATIC

Check = Callable[[], None]


@checks(STATIC)
def test_static(check: Check) -> None:
    check()


@checks(STATIC, model={"density": {"form": "gaussian"}, "sh_degree": 0})
def test_static_with_a_gaussian_density(check: Check) -> None:
    check()


@checks(STATIC, model={"density": {"edge": 1, "gain": True}, "sh_degree": 0})
def test_static_with_a_soft_edge(check: Check) -> None:
    check()


@checks(DYNAMIC, preset="paper", model={"density": {"time": "phase+offset+window+motion", "edge": 2, "gain": True}})
def test_dynamic_with_a_soft_edge(check: Check) -> None:
    check()


@checks(DYNAMIC)
def test_dynamic(check: Check) -> None:
    check()


@checks(RELIGHT, model={"colour": {"form": "multiplicative", "hidden": 4, "visibility": "none"}})
def test_relight(check: Check) -> None:
    check()


@pytest.mark.slow
@checks(RELIGHT)
def test_relight_with_shadows(check: Check) -> None:
    """The depth image out of the light is drawn by the compiled kernels."""
    check()


@pytest.mark.parametrize("channels", [1, 5])
def test_relighting_takes_rgb_only(channels: int) -> None:
    """A light's intensity has three numbers."""
    with pytest.raises(
        ConfigError,
        match=f"^conformance example: {channels} colour channels; task relight expects 3, as light_intensity has",
    ):
        TaskUnderTest(RELIGHT).with_channels(channels).build_fields()


def test_check_task_lists_every_failure() -> None:
    broken = replace(STATIC, check=lambda model: None, fields={})
    with pytest.raises(ConformanceError) as caught:
        check_task(broken, model={"neurons": 2, "sh_degree": 0})
    lines = str(caught.value).splitlines()
    assert all(line.startswith("task 'static': ") for line in lines)
    failed = {line.split(": ")[1] for line in lines}
    assert {"description", "fields", "save_load"} <= failed
    assert not {"gradients", "split", "resume"} & failed


def test_an_unforeseen_error_names_task_and_check() -> None:
    def build(model: object, dataset: object) -> None:
        raise RuntimeError("boom\nboom")

    with pytest.raises(
        ConformanceError,
        match=r"task 'static': split: stopped by RuntimeError: boom boom in test_.*build \(test_checks\.py, line \d+\)",
    ) as caught:
        named_checks(replace(STATIC, build=build))["split"]()  # type: ignore[arg-type]
    assert isinstance(caught.value.__cause__, RuntimeError)


def test_pytest_is_imported_only_where_it_is_used() -> None:
    code = "import sys, neuprim.conformance as c; c.named_checks; sys.exit('pytest' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
