"""The knobs that a task offers for trading quality for speed or size, checked where they enter neuprim."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neuprim.core.task import TaskSpec
from neuprim.plugins.judging import TaskFault

__all__ = ["traded"]

_GROUPS = ("model.", "task.options.")


def traded(task: TaskSpec, settings: Mapping[str, Any]) -> dict[str, tuple[Any, ...]]:
    """Setting -> the values that the task finds worth training.

    Args:
        settings: what the task's ``build`` gets.

    Raises:
        TaskFault: it offers something else.
    """
    found = task.trade(settings)
    if not isinstance(found, Mapping):
        raise TaskFault(f"trade: found a {type(found).__name__}; expected a dictionary of setting names to values")
    for name, values in found.items():
        if not isinstance(name, str) or not name.startswith(_GROUPS):
            raise TaskFault(f"trade: {name!r}; expected the name of a setting, beginning with {' or '.join(_GROUPS)}")
        if (
            not isinstance(values, Sequence)
            or isinstance(values, str)
            or not all(isinstance(v, bool | int | float | str) for v in values)
        ):
            raise TaskFault(f"trade: {name} has {values!r}; expected a list of numbers, texts, true or false")
    return {name: tuple(values) for name, values in found.items()}
