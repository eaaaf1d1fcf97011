"""Read and override single settings of a composed configuration, by dotted names."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from neuprim.config import RunConfig

__all__ = ["get_setting", "override_settings"]

_OPTIONS = "task.options."


def _locate(config: RunConfig, key: str) -> tuple[str, list[str]]:
    """Return the attribute of the configuration, and the path of a setting below it."""
    if key.startswith(_OPTIONS):
        return "options", key.removeprefix(_OPTIONS).split(".")
    group, *path = key.split(".")
    return group, path


def get_setting(config: RunConfig, key: str) -> Any:
    """Return a setting below ``model``, ``train`` or ``task.options``; None where the configuration lacks it."""
    group, path = _locate(config, key)
    node = getattr(config, group)
    for part in path:
        node = node.get(part) if isinstance(node, Mapping) else getattr(node, part, None)
    return node


def override_settings(config: RunConfig, values: Mapping[str, Any]) -> RunConfig:
    """Return the configuration with other settings, and with its record of what is not a default."""
    for key, value in values.items():
        non_default = dict(config.non_default)
        for name, before, after in _flatten(key, get_setting(config, key), value):
            default = non_default.pop(name, (before, before))[0]
            if after != default:
                non_default[name] = (default, after)
        group, path = _locate(config, key)
        changed = _replace_nested(getattr(config, group), path, value)
        config = replace(config, **{group: changed}, non_default=non_default)
    return config


def _replace_nested(node: Any, path: list[str], value: Any) -> Any:
    first, *rest = path
    if isinstance(node, Mapping):
        return {**node, first: _replace_nested(node.get(first), rest, value) if rest else value}
    return replace(node, **{first: _replace_nested(getattr(node, first), rest, value) if rest else value})


def _flatten(key: str, before: Any, after: Any) -> list[tuple[str, Any, Any]]:
    """Return (dotted name, value before, value after) of a setting, or of every setting of a group."""
    if not dataclasses.is_dataclass(before):
        return [(key, before, after)]
    return [(f"{key}.{f.name}", getattr(before, f.name), getattr(after, f.name)) for f in dataclasses.fields(before)]
