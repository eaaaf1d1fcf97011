"""Checks that any task must pass, for authors of tasks.

    from neuprim.conformance import check_task, checks

    check_task(TASK)            # all checks; ConformanceError lists what failed

    @checks(TASK)               # in a test file: one test per check
    def test_conforms(check):
        check()

Each check builds tiny models on the reference backend from the task's default preset. It uses the task's own
``example``, or a small synthetic data set with the conditions that the task declares. The docstring of a check says
what it demands.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from neuprim.conformance.field_checks import (
    check_activity_conformance,
    check_gradients_conformance,
    check_integral_conformance,
    check_reductions_conformance,
    check_scaling_conformance,
    check_split_conformance,
)
from neuprim.conformance.task_checks import (
    check_channels_conformance,
    check_conditions_conformance,
    check_description_conformance,
    check_evaluation_conformance,
    check_fields_conformance,
    check_loss_conformance,
    check_parameters_conformance,
    check_resume_conformance,
    check_save_load_conformance,
)
from neuprim.conformance.task_under_test import ConformanceError, TaskUnderTest
from neuprim.core.errors import FormError
from neuprim.core.task import TaskSpec

__all__ = ["CHECKS", "ConformanceError", "check_task", "checks", "named_checks"]

CHECKS: dict[str, Callable[[TaskUnderTest], None]] = {
    function.__name__.removeprefix("check_").removesuffix("_conformance"): function
    for function in (
        check_description_conformance,
        check_fields_conformance,
        check_parameters_conformance,
        check_evaluation_conformance,
        check_loss_conformance,
        check_channels_conformance,
        check_activity_conformance,
        check_integral_conformance,
        check_gradients_conformance,
        check_scaling_conformance,
        check_split_conformance,
        check_reductions_conformance,
        check_resume_conformance,
        check_save_load_conformance,
        check_conditions_conformance,
    )
}
"""Every check by name, in reading order."""

_NOT_THE_TASKS = ("neuprim.core", "neuprim.config", "neuprim.plugins")
_LIBRARIES = ("torch", "numpy", "scipy", "numba", "importlib", "omegaconf", "hydra", "yaml")


def named_checks(
    task: TaskSpec, preset: str | None = None, model: Mapping[str, Any] | None = None
) -> dict[str, Callable[[], None]]:
    """Return check name -> function without arguments that raises :class:`ConformanceError`.

    Args:
        preset: whose settings the models are built with; None is the task's default.
        model: changes to its model settings, e.g. ``{"neurons": 2, "density": {"form": "gaussian"}}``.
    """
    subject = TaskUnderTest(task, preset=preset, model=model)
    return {name: partial(_run_check, subject, name) for name in CHECKS}


def _run_check(subject: TaskUnderTest, name: str) -> None:
    with suppress(Exception):  # a task whose files are broken fails only the checks that need them
        _ = subject.settings, subject.options  # read once for all checks
    where = f"task {subject.task.name!r}: {name}"
    try:
        CHECKS[name](subject.named(name))
    except ConformanceError:
        raise
    except FormError as error:  # it names field, method and tensor
        raise ConformanceError(f"{where}: {error}") from error
    except (Exception, SystemExit) as error:  # whatever a task's code does, the message must name the task
        text = (
            f"stopped by {type(error).__name__}: {' '.join(str(error).split())}{_find_conformance_failure_line(error)}"
        )
        raise ConformanceError(f"{where}: {text}") from error


def check_task(task: TaskSpec, preset: str | None = None, model: Mapping[str, Any] | None = None) -> None:
    """Run all checks on a task; see :func:`named_checks` for the arguments.

    Raises:
        ConformanceError: one line for each check that failed.
    """
    failed: list[ConformanceError] = []
    for run in named_checks(task, preset, model).values():
        try:
            run()
        except ConformanceError as error:
            failed.append(error)
    if failed:
        raise ConformanceError("\n".join(map(str, failed))) from failed[0]


def checks(task: TaskSpec, preset: str | None = None, model: Mapping[str, Any] | None = None) -> Any:
    """Parametrize a pytest test with the checks, which it gets as ``check``; see :func:`named_checks`."""
    import pytest

    found = named_checks(task, preset, model)
    return pytest.mark.parametrize("check", [pytest.param(run, id=name) for name, run in found.items()])


def _find_conformance_failure_line(error: BaseException) -> str:
    """Return e.g. ``" in Waves.on_split (fields.py, line 12)"``, the innermost line of the task's own code, or ""."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        module = str(frame.f_globals.get("__name__", ""))
        if not module.startswith(_NOT_THE_TASKS) and module.split(".")[0] not in _LIBRARIES:
            return f" in {frame.f_code.co_qualname} ({Path(frame.f_code.co_filename).name}, line {line})"
    return ""
