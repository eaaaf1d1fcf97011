"""Checks of names and values that a settings dataclass alone cannot make: keys of a scene, options of a task and loss,
shared settings that nothing reads, and the differences between two configurations."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, get_origin

from neuprim.config.overrides import Assignment
from neuprim.config.run_config import RunSettings
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.model.geometry import GEOMETRY_SPECS
from neuprim.core.used_settings import OPTIONAL
from neuprim.core.validation import (
    Option,
    coerce,
    field_types,
    format_value,
    infer_type,
    join_key,
    option_type,
    refuse_unknown,
)

if TYPE_CHECKING:
    from neuprim.core.extensions import LossExtension
    from neuprim.core.task import TaskSpec

__all__ = [
    "CHOICES",
    "GROUPS",
    "REQUIRED",
    "check_key",
    "check_names",
    "check_preset",
    "check_typed",
    "complete_options",
    "differences",
    "flatten",
    "like_default",
    "options_of",
    "unused_settings",
]

Options = Mapping[str, Option]

CHOICES = ("task", "scene", "preset", "effort")
"""Keys that choose files and levels."""

GROUPS = ("model", "train", "renderer")
"""Groups of settings that a preset may set."""

REQUIRED = "???"
"""How a scene's YAML says that a setting has no default (OmegaConf's mark for a missing value)."""


# ---------------------------------------------------------------- keys


def check_key(assignment: Assignment, base: Mapping[str, Any], scene_name: str) -> None:
    """Raise ConfigError for a key that names no setting, with the nearest that do."""
    key, value = assignment.key, assignment.value
    path = key.split(".")
    head, rest = path[0], path[1:]
    scene: Mapping[str, Any] = base["scene"]
    if head == "scene" and rest and (rest[0] in scene) and (len(rest) == 1 or isinstance(scene[rest[0]], Mapping)):
        return
    if path[:2] == ["task", "options"]:
        return
    if head not in ("scene", "task") and all(path) and _is_setting(RunSettings, path):
        whole = rest == [] and head in GROUPS
        if whole and not isinstance(value, dict):
            raise ConfigError(f"{assignment.text}: {head} is a group of settings; set one of them as {head}.KEY=VALUE")
        return
    names = [*CHOICES, "task.options", *_setting_names(RunSettings), *(f"scene.{k}" for k in scene)]
    if head == "scene" and rest:
        own = sorted(f"scene.{k}" for k in scene)
        hint = nearest(key, own) if own else "; it has none"
        raise ConfigError(f"{key}: no such setting of scene {scene_name!r}{hint}")
    inside = [n for n in names if n.startswith(head + ".")]
    raise ConfigError(f"{key}: no such setting" + nearest(key, inside or names))


def _setting_names(cls: type, where: str = "") -> Iterator[str]:
    """Dotted names of all settings of a dataclass, nested ones included; free dictionaries by their own name."""
    for own, hint in field_types(cls).items():
        name = join_key(where, own)
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            yield from _setting_names(hint, name)
        else:
            yield name


def _is_setting(cls: type, path: list[str]) -> bool:
    """Whether ``path`` (field names from ``cls`` down) ends in a setting or inside a free dictionary."""
    hint: Any = cls
    for i, part in enumerate(path):
        if get_origin(hint) is dict:
            return True
        if not (dataclasses.is_dataclass(hint) and isinstance(hint, type)):
            return False
        hints = field_types(hint)
        if part not in hints:
            return False
        hint = hints[part]
        if hint is Any and i + 1 < len(path):
            return True
    return True


def like_default(value: Any, default: Any, where: str) -> Any:
    """Return ``value`` as the type of a scene's ``default``; a null or required default accepts anything."""
    return value if default == REQUIRED else coerce(value, infer_type(default), where)


# ---------------------------------------------------------------- task.options


def options_of(spec: TaskSpec, loss: LossExtension | None) -> Options:
    """Name -> option of all that may stand under ``task.options``: the task's own and those of the loss chosen.

    Raises:
        ConfigError: both have one of the same name, so that it could not be said which is meant.
    """
    if loss is None:
        return spec.options
    both = sorted(spec.options.keys() & loss.options.keys())
    if both:
        raise ConfigError(
            f"train.loss={loss.name}: the loss and task {spec.name!r} both have an option "
            f"{both[0]!r}; they cannot be combined"
        )
    return {**spec.options, **loss.options}


def complete_options(declared: Options, given: Any, owner: str, where: str = "task.options") -> dict[str, Any]:
    """Every declared option: as given, converted to its type, else the default.

    Args:
        owner: whose options they are, for messages.
        where: dotted name of the group, for messages.

    Raises:
        ConfigError: no such option, or a value that it does not take.
    """
    if not isinstance(given, Mapping):
        raise ConfigError(f"{where}={format_value(given)}: expected entries, each as {where}.KEY=VALUE")
    for key in given:
        if key not in declared:
            raise ConfigError(f"{where}.{key}: {owner} has no such option{_hint(str(key), declared)}")
    return {
        key: coerce(given.get(key, option[0]), option_type(option), f"{where}.{key}")
        for key, option in declared.items()
    }


def _hint(key: str, declared: Options) -> str:
    shared = [name for name in _setting_names(RunSettings) if name.rpartition(".")[2] == key]
    if shared:
        return f"; did you mean {' or '.join(map(repr, shared))}?"
    return nearest(key, declared) or "; it has none"


# ---------------------------------------------------------------- shared settings


def unused_settings(spec: TaskSpec, loss: LossExtension | None) -> tuple[str, ...]:
    """The optional shared settings that neither the task nor the loss of a run reads."""
    train = spec.uses if loss is None else loss.uses
    return tuple(name for name in OPTIONAL if name not in (spec.uses if name.startswith("model.") else train))


def check_typed(spec: TaskSpec, loss: LossExtension | None, values: Sequence[Assignment]) -> None:
    """Refuse what the user typed for a shared setting that nothing would read.

    Raises:
        ConfigError: naming it, and those that are used.
    """
    missing = unused_settings(spec, loss)
    for assignment in values:
        for name in _dotted(assignment.key, assignment.value):
            if name in missing:
                _refuse(name, spec, loss)


def check_preset(spec: TaskSpec, loss: LossExtension | None, preset: Mapping[str, Any]) -> None:
    """As :func:`check_typed`, for what a preset sets; it may also set what the task's own loss reads while another one
    is chosen."""
    missing = set(unused_settings(spec, loss)) & set(unused_settings(spec, None))
    for name in _dotted("", preset):
        if name in missing:
            _refuse(name, spec, None)


def _refuse(name: str, spec: TaskSpec, loss: LossExtension | None) -> None:
    owner, uses = f"task {spec.name!r}", spec.uses
    if loss is not None and name.startswith("train."):
        owner, uses = f"loss {loss.name!r}", loss.uses
    used = f"; it uses {', '.join(uses)}" if uses else ""
    raise ConfigError(f"{name}: {owner} does not use this setting{used}")


def _dotted(where: str, value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _dotted(f"{where}.{key}" if where else str(key), inner)
    else:
        yield where


# ---------------------------------------------------------------- names of parameters and of what initialisers read


def check_names(spec: TaskSpec, settings: RunSettings) -> None:
    """Refuse names under ``model.init``, ``train.rates`` and ``train.rate_units`` that no field of the task has, as far
    as the task lists its fields.

    The model itself may have fewer; what it lacks is refused when it is made.
    """
    classes = list((spec.fields or {}).values())
    if not classes:
        return
    init = {"scale", "points", "surroundings", *(name for cls in classes for name in cls.init_settings)}
    refuse_unknown(settings.model.init, init, "model.init")
    try:
        parameters = {s.name for s in (*GEOMETRY_SPECS, *(s for cls in classes for s in cls.every_parameter()))}
    except TypeError:  # a field that cannot be made without settings
        return
    for group, given in (("rates", settings.train.rates), ("rate_units", settings.train.rate_units)):
        for key in given:
            if key not in parameters:
                raise ConfigError(f"train.{group}.{key}: no such parameter{nearest(key, parameters)}")


# ---------------------------------------------------------------- differences


def flatten(node: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Return dotted names and values of nested settings."""
    found: dict[str, Any] = {}
    for key, value in node.items():
        name = f"{where}.{key}" if where else str(key)
        if isinstance(value, Mapping) and value:
            found.update(flatten(value, name))
        elif not isinstance(value, Mapping):
            found[name] = value
    return found


def differences(default: Mapping[str, Any], actual: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Return key -> (default, value) of the flat settings that differ."""
    found: dict[str, tuple[Any, Any]] = {}
    for key in [*default, *(k for k in actual if k not in default)]:
        before, after = default.get(key), actual.get(key)
        before = None if before == REQUIRED else before
        if before != after:
            found[key] = (before, after)
    return found
