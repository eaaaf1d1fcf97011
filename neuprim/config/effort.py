"""Levels of effort: what a task found worth its time, as settings frozen under the numbers 1 to 9.

A task's ``config_package`` may hold ``effort/NAME.yaml``::

    preset: quick                # what the levels are settings over
    levels:
      1: {model.primitives: 700, train.iterations: 300}
      ...
      9: {model.primitives: 12000, train.iterations: 80000}

All nine are there. A level stands below what the user types and above the preset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from neuprim.config.groups import package_root, read_yaml
from neuprim.config.overrides import Assignment, word
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.validation import format_value

if TYPE_CHECKING:
    from neuprim.core.task import TaskSpec

__all__ = ["EFFORT", "LEVELS", "Level", "chosen_level", "levels_of"]

EFFORT = "effort"
LEVELS = range(1, 10)

_KNOWN = ("preset", "levels")
_GROUPS = ("model.", "train.", "renderer.")


@dataclass(frozen=True)
class Level:
    """The preset that a level was measured with, and its settings as if they were typed."""

    preset: str
    settings: tuple[Assignment, ...]


def chosen_level(spec: TaskSpec, chosen: str | None, preset: str | None, presets: Sequence[str]) -> Level | None:
    """The level that ``effort=N`` names; None where that was not typed.

    Args:
        chosen, preset: what was typed for them.
        presets: names of the task's.

    Raises:
        ConfigError: no such level, the task has none, or they are not of the preset that was typed.
    """
    if chosen is None:
        return None
    if chosen not in map(str, LEVELS):
        raise ConfigError(f"{EFFORT}={chosen}: expected a level from {LEVELS[0]} (fast) to {LEVELS[-1]} (good)")
    levels = levels_of(spec, presets)
    if levels is None:
        raise ConfigError(
            f"{EFFORT}={chosen}: task {spec.name!r} has no levels; set model.primitives=N and train.iterations=N instead"
        )
    level = levels[int(chosen)]
    if preset not in (None, level.preset):
        raise ConfigError(
            f"{EFFORT}={chosen}: levels of task {spec.name!r} are of preset={level.preset}, found preset={preset}; expected one of the two"
        )
    return level


def levels_of(spec: TaskSpec, presets: Sequence[str]) -> Mapping[int, Level] | None:
    """A task's levels by their numbers; None where it has none.

    Raises:
        ConfigError: its file is no such list.
    """
    place = f"effort/{spec.name}.yaml"
    file = package_root(spec) / place
    if not file.is_file():
        return None
    who = f"task {spec.name!r}: {place}"
    node = read_yaml(file, who)
    for key in node:
        if key not in _KNOWN:
            raise ConfigError(f"{who}: {key!s}: no such setting{nearest(str(key), _KNOWN)}")
    preset, levels = node.get("preset"), node.get("levels")
    if not isinstance(preset, str) or preset not in presets:
        raise ConfigError(f"{who}: preset={format_value(preset)}: no such preset{nearest(str(preset), presets)}")
    if not isinstance(levels, Mapping) or list(levels) != list(LEVELS):
        found = format_value(list(levels)) if isinstance(levels, Mapping) else format_value(levels)
        raise ConfigError(f"{who}: levels: found {found}; expected {LEVELS[0]} to {LEVELS[-1]}, in this order")
    return {number: Level(preset, _settings(given, f"{who}: levels.{number}")) for number, given in levels.items()}


def _settings(given: Any, who: str) -> tuple[Assignment, ...]:
    if not isinstance(given, Mapping) or not all(isinstance(key, str) and key.startswith(_GROUPS) for key in given):
        raise ConfigError(
            f"{who}: found {format_value(given)}; expected settings of model, train and renderer by their dotted keys"
        )
    return tuple(Assignment(key, value, word(key, value)) for key, value in given.items())
