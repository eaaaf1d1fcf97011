"""The built-in tasks pass every check that a third party's task has to pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from neuprim.conformance import ConformanceError, check_task, checks, named_checks
from neuprim.conformance.task_under_test import TaskUnderTest
from neuprim.core.errors import ConfigError
from neuprim.core.task import TaskSpec
from neuprim.tasks.dynamic import TASK as DYNAMIC
from neuprim.tasks.relight import TASK as RELIGHT
from neuprim.tasks.static import TASK as STATIC

Check = Callable[[], None]


VARIANTS: dict[str, tuple[TaskSpec, str | None, dict[str, Any]]] = {
    "static": (STATIC, None, {}),
    "static-gaussian": (STATIC, None, {"density": {"form": "gaussian"}, "colour": {"form": "lobes", "lobes": 1}}),
    "static-harmonics": (STATIC, None, {"colour": {"form": "sh"}}),
    "static-edge": (STATIC, None, {"density": {"edge": 1, "gain": True}, "colour": {"form": "sh"}, "sh_degree": 0}),
    "dynamic": (DYNAMIC, None, {}),
    "dynamic-edge": (
        DYNAMIC,
        "paper",
        {"density": {"time": "phase+offset+window+motion", "edge": 2, "gain": True}},
    ),
    "relight": (RELIGHT, None, {"colour": {"form": "multiplicative", "hidden": 4, "visibility": "none"}}),
    "relight-surface": (RELIGHT, None, {"colour": {"form": "surface", "lobes": 1, "visibility": "none"}}),
}


@pytest.mark.parametrize(
    "check",
    [
        pytest.param(run, id=f"{variant}-{name}")
        for variant, (task, preset, model) in VARIANTS.items()
        for name, run in named_checks(task, preset, model).items()
    ],
)
def test_built_in_tasks(check: Check) -> None:
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
        match=f"^conformance example: images have {channels} colour channels; task relight expects 3, because lights",
    ):
        TaskUnderTest(RELIGHT).with_channels(channels).build_fields()


def test_check_task_lists_every_failure() -> None:
    broken = replace(STATIC, check=lambda model: None, fields={})
    with pytest.raises(ConformanceError) as caught:
        check_task(broken, model={"neurons": 2, "colour": {"form": "sh"}, "sh_degree": 0})
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
