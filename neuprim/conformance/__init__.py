"""What the framework relies on in a task, as separately named checks that anybody can run on theirs.

    from neuprim.conformance import check_task, checks

    check_task(TASK)            # all of them; ConformanceError lists what failed

    @checks(TASK)               # in a test file: one test per check
    def test_conforms(check):
        check()

Each check builds tiny models on the reference backend from the task's default preset, on the task's own ``example`` or
on a small synthetic data set with the conditions it declares. The docstring of a check says what it demands and why.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from neuprim.conformance.channels import check_channels
from neuprim.conformance.edges import check_clear_errors, check_conditions, check_extremes, check_missing_conditions
from neuprim.conformance.forms import (
    check_alive,
    check_finite_differences,
    check_gradients,
    check_line_integral,
    check_lowered_forms,
    check_opaque_twin,
)
from neuprim.conformance.layers import check_layers
from neuprim.conformance.less import check_pieces, check_reductions
from neuprim.conformance.parameters import (
    check_fields,
    check_files,
    check_initialisers,
    check_members,
    check_parameter_specs,
    check_trade,
)
from neuprim.conformance.population import check_clone, check_divide, check_on_split, check_scale_density
from neuprim.conformance.subject import ConformanceError, Subject
from neuprim.conformance.training import (
    check_dataset,
    check_determinism,
    check_display,
    check_folded,
    check_judging,
    check_learning,
    check_loss,
    check_resume,
    check_save_load,
)
from neuprim.core.errors import FormError
from neuprim.core.task import TaskSpec

__all__ = ["CHECKS", "ConformanceError", "check_task", "checks", "named_checks"]

CHECKS: dict[str, Callable[[Subject], None]] = {
    function.__name__.removeprefix("check_"): function
    for function in (
        check_members,
        check_files,
        check_trade,
        check_fields,
        check_parameter_specs,
        check_initialisers,
        check_dataset,
        check_display,
        check_loss,
        check_judging,
        check_lowered_forms,
        check_channels,
        check_layers,
        check_alive,
        check_line_integral,
        check_opaque_twin,
        check_gradients,
        check_finite_differences,
        check_scale_density,
        check_clone,
        check_on_split,
        check_divide,
        check_determinism,
        check_learning,
        check_save_load,
        check_folded,
        check_reductions,
        check_pieces,
        check_resume,
        check_conditions,
        check_missing_conditions,
        check_extremes,
        check_clear_errors,
    )
}
"""Every check by name, in the order in which they are best read."""


_FRAMEWORK = ("neuprim.core", "neuprim.config", "neuprim.plugins")
_LIBRARIES = ("torch", "numpy", "scipy", "numba", "importlib", "omegaconf", "hydra", "yaml")


def _origin(error: BaseException) -> str:
    """``" in Waves.on_split (fields.py, line 12)"``: the innermost line of the task's own code; nothing where none was
    running."""
    for frame, line in reversed(list(traceback.walk_tb(error.__traceback__))):
        module = str(frame.f_globals.get("__name__", ""))
        if not module.startswith(_FRAMEWORK) and module.split(".")[0] not in _LIBRARIES:
            return f" in {frame.f_code.co_qualname} ({Path(frame.f_code.co_filename).name}, line {line})"
    return ""


def named_checks(
    task: TaskSpec, preset: str | None = None, model: Mapping[str, Any] | None = None
) -> dict[str, Callable[[], None]]:
    """Check name -> function without arguments that raises :class:`ConformanceError`.

    Args:
        preset: whose settings the models are built with; None is the task's default.
        model: changes to its model settings, e.g. ``{"neurons": 2, "density": {"form": "gaussian"}}``.
    """

    shared: list[Subject] = []

    def subject_of(name: str) -> Subject:
        if not shared:
            first = Subject(task, name, preset, model)
            with suppress(Exception):  # a task whose files are broken fails the checks that need them, not the others
                _ = first.settings, first.options  # read once for all
            shared.append(first)
        return shared[0].named(name)

    def bind(name: str, check: Callable[[Subject], None]) -> Callable[[], None]:
        def run() -> None:
            try:
                check(subject_of(name))
            except ConformanceError:
                raise
            except FormError as error:  # it names field, method and tensor
                raise ConformanceError(f"task {task.name!r}: {name}: {error}") from error
            except (Exception, SystemExit) as error:  # whatever a task's code does, the message must say whose it is
                text = " ".join(str(error).split())
                raise ConformanceError(
                    f"task {task.name!r}: {name}: stopped by {type(error).__name__}: {text}{_origin(error)}"
                ) from error

        run.__doc__ = check.__doc__
        return run

    return {name: bind(name, check) for name, check in CHECKS.items()}


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
    """A pytest decorator that runs a test once per check, which it passes as ``check``; see :func:`named_checks` for
    the arguments."""
    import pytest

    return pytest.mark.parametrize(
        "check", [pytest.param(run, id=name) for name, run in named_checks(task, preset, model).items()]
    )
