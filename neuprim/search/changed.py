"""A run's configuration with other settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from neuprim.config import RunConfig

__all__ = ["changed", "value_of"]

_OPTIONS = "task.options"


def value_of(config: RunConfig, key: str) -> Any:
    """A setting by its dotted name below ``model``, ``train`` or ``task.options``; None where the configuration does
    not say it."""
    node, path = _root(config, key)
    for part in path:
        node = node.get(part) if isinstance(node, Mapping) else getattr(node, part, None)
    return node


def _root(config: RunConfig, key: str) -> tuple[Any, list[str]]:
    if key.startswith(f"{_OPTIONS}."):
        return config.options, key[len(_OPTIONS) + 1 :].split(".")
    group, *path = key.split(".")
    return getattr(config, group), path


def changed(config: RunConfig, values: Mapping[str, Any]) -> RunConfig:
    """A configuration with other settings, by dotted names below ``model``, ``train`` and ``task.options``, and with
    its record of what is not a default."""
    for key, value in values.items():
        config = _with(config, key, value)
    return config


def _with(config: RunConfig, key: str, value: Any) -> RunConfig:
    different = dict(config.non_default)
    for own, was, now in _leaves(key, value_of(config, key), value):
        default = different.pop(own, (was, was))[0]
        if now != default:
            different[own] = (default, now)
    root, path = _root(config, key)
    made = _inside(root, path, value)
    if key.startswith(f"{_OPTIONS}."):
        return replace(config, options=made, non_default=different)
    return replace(config, **{key.partition(".")[0]: made}, non_default=different)


def _inside(node: Any, path: list[str], value: Any) -> Any:
    """A group of settings, a dictionary or a dataclass, with one of them changed."""
    first, *rest = path
    if isinstance(node, Mapping):
        return {**node, first: _inside(node.get(first), rest, value) if rest else value}
    return replace(node, **{first: _inside(getattr(node, first), rest, value) if rest else value})


def _leaves(key: str, before: Any, after: Any) -> list[tuple[str, Any, Any]]:
    """(dotted name, value before, value after) of a setting, or of every setting of a group."""
    if not dataclasses.is_dataclass(before):
        return [(key, before, after)]
    return [(f"{key}.{f.name}", getattr(before, f.name), getattr(after, f.name)) for f in dataclasses.fields(before)]
