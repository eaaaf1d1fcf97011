"""Settings as flat lists of dotted names, and what differs between two of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from neuprim.config.schema import REQUIRED

__all__ = ["differences", "flat"]


def flat(node: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in node.items():
        name = f"{where}.{key}" if where else str(key)
        if isinstance(value, Mapping) and value:
            found.update(flat(value, name))
        elif not isinstance(value, Mapping):
            found[name] = value
    return found


def differences(default: Mapping[str, Any], actual: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    found: dict[str, tuple[Any, Any]] = {}
    for key in [*default, *(k for k in actual if k not in default)]:
        before, after = default.get(key), actual.get(key)
        before = None if before == REQUIRED else before
        if before != after:
            found[key] = (before, after)
    return found
