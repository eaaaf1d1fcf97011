"""Free settings of a task, checked against what the task offers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuprim.core.errors import ConfigError, nearest

__all__ = ["choose"]

_KINDS = {str: "text", int: "a whole number", float: "a number", bool: "true or false"}


def choose(found: Mapping[str, Any], where: str, offered: Mapping[str, tuple[Any, ...] | type]) -> None:
    """Refuse unknown keys, and values that are none of those offered (or not of the type offered).

    Args:
        found: what the user and the preset set.
        where: dotted name of the group, for messages.

    Raises:
        ConfigError: naming the key, what was found and what is expected.
    """
    for key, value in found.items():
        if key not in offered:
            raise ConfigError(f"{where}.{key}: no such setting{nearest(key, offered) or '; there is none'}")
        options = offered[key]
        if isinstance(options, tuple):
            if value not in options:
                raise ConfigError(f"{where}.{key}={value!r}: expected {' or '.join(map(str, options))}")
        elif not isinstance(value, (int, float) if options is float else options) or (isinstance(value, bool) and options is not bool):
            raise ConfigError(f"{where}.{key}={value!r}: expected {_KINDS.get(options, options.__name__)}")
