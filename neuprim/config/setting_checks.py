"""Check settings that a settings dataclass cannot check: scene keys, task and loss options, unused shared settings."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, get_origin

from neuprim.config.overrides import Assignment
from neuprim.config.run_config import RunSettings
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.model.geometry import GEOMETRY_SPECS
from neuprim.core.train.settings import OPTIONAL
from neuprim.core.validation import (
    Option,
    field_types,
    format_setting_value,
    join_setting_key,
    option_type_to_validate,
    validate_setting_names,
    validate_value,
)

if TYPE_CHECKING:
    from neuprim.core.extensions import LossExtension
    from neuprim.core.task import TaskSpec

CHOICES = ("task", "scene", "preset", "effort")
"""Keys that choose a task, scene, preset or level of effort."""


def check_config_key(assignment: Assignment, scene: Mapping[str, Any], scene_name: str) -> None:
    """Raise ConfigError if the key of an override names no setting; the error suggests settings with similar names.

    Args:
        assignment: the override ``key=value``.
        scene: the scene's settings; ``scene.NAME`` is a valid key for each name.
    """
    key = assignment.key
    head, *rest = key.split(".")
    if head == "scene" and rest:
        if rest[0] not in scene or (len(rest) > 1 and not isinstance(scene[rest[0]], Mapping)):
            own = [f"scene.{name}" for name in scene]
            hint = nearest(key, own) or "; this scene has no settings"
            raise ConfigError(f"{key}: no such setting of scene {scene_name!r}{hint}")
    elif head == "task":
        if rest[:1] != ["options"]:
            raise ConfigError(f"{key}: no such setting{nearest(key, ['task.options'])}")
    elif not _is_setting([head, *rest]):
        names = [*CHOICES, "task.options", *_setting_names(RunSettings), *(f"scene.{name}" for name in scene)]
        inside = [name for name in names if name.startswith(f"{head}.")]
        raise ConfigError(f"{key}: no such setting{nearest(key, inside or names)}")
    elif dataclasses.is_dataclass(field_types(RunSettings)[head]) and not rest:
        if not isinstance(assignment.value, Mapping):
            raise ConfigError(f"{assignment.text}: {head} is a group of settings; set one of them as {head}.KEY=VALUE")


def _setting_names(cls: type, where: str = "") -> Iterator[str]:
    for own, hint in field_types(cls).items():
        name = join_setting_key(where, own)
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            yield from _setting_names(hint, name)
        else:
            yield name


def _is_setting(path: list[str]) -> bool:
    """Return whether ``path``, a dotted key split at the dots, names something in :class:`RunSettings`.

    Valid are a setting, a group of settings, and any entry of a setting that is a dictionary.
    """
    hint: Any = RunSettings
    for part in path:
        if get_origin(hint) is dict or hint is Any:
            return True
        if not dataclasses.is_dataclass(hint) or part not in field_types(hint):  # type: ignore[arg-type]
            return False
        hint = field_types(hint)[part]  # type: ignore[arg-type]
    return True


# ---------------------------------------------------------------- task.options


def task_and_loss_options(spec: TaskSpec, loss: LossExtension | None) -> Mapping[str, Option]:
    """Return the options that are valid under ``task.options``: those of the task and those of the chosen loss."""
    if loss is None:
        return spec.options
    for name in sorted(spec.options.keys() & loss.options.keys()):
        raise ConfigError(
            f"train.loss={loss.name}: the loss and task {spec.name!r} both have an option {name!r}; "
            "choose another loss, or rename the option in its plugin"
        )
    return {**spec.options, **loss.options}


def complete_task_options(
    declared: Mapping[str, Option], given: Any, owner: str, where: str = "task.options"
) -> dict[str, Any]:
    """Return option -> value for every declared option: the value in ``given``, or else the default.

    Raise ConfigError for an undeclared option or an invalid value. The message names ``owner``, who declares the
    options, e.g. "task 'static'", and ``where``, the dotted key of the options.
    """
    if not isinstance(given, Mapping):
        raise ConfigError(f"{where}={format_setting_value(given)}: expected entries, each as {where}.KEY=VALUE")
    for key in given:
        if key not in declared:
            shared = [name for name in _setting_names(RunSettings) if name.rpartition(".")[2] == key]
            hint = f"; did you mean {' or '.join(map(repr, shared))}?" if shared else nearest(str(key), declared)
            raise ConfigError(f"{where}.{key}: {owner} has no such option{hint or ' and no other options'}")
    return {
        key: validate_value(given.get(key, option[0]), option_type_to_validate(option), f"{where}.{key}")
        for key, option in declared.items()
    }


# ---------------------------------------------------------------- shared settings


def unused_settings(spec: TaskSpec, loss: LossExtension | None) -> tuple[str, ...]:
    """Return the dotted names of the optional shared settings that neither the run's task nor its loss reads.

    Optional shared settings are, for example, ``model.neurons``. A task or loss lists in ``uses`` those that it reads.
    """
    train = spec.uses if loss is None else loss.uses
    return tuple(name for name in OPTIONAL if name not in (spec.uses if name.startswith("model.") else train))


def refuse_unused(names: Iterable[str], spec: TaskSpec, loss: LossExtension | None) -> None:
    """Raise ConfigError if ``names`` has a shared setting that neither task nor loss reads; suggest what they read."""
    unused = unused_settings(spec, loss)
    for name in names:
        if name in unused:
            of_loss = loss is not None and name.startswith("train.")
            owner = f"loss {loss.name!r}" if loss is not None and of_loss else f"task {spec.name!r}"
            uses = loss.uses if loss is not None and of_loss else spec.uses
            used = f"; it uses {', '.join(uses)}" if uses else ""
            raise ConfigError(f"{name}: {owner} does not use this setting{used}")


def check_config_parameter_names(spec: TaskSpec, settings: RunSettings) -> None:
    """Raise ConfigError for unknown parameter names under ``model.init``, ``train.rates`` and ``train.rate_units``.

    A name is unknown if none of the task's fields (density and colour functions) has it. Does nothing if the task does
    not list its fields. A name that the chosen fields lack, but another field has, is refused later.
    """
    if not spec.fields:
        return
    init = {"scale", "points", "surroundings", *(name for cls in spec.fields.values() for name in cls.init_settings)}
    validate_setting_names(settings.model.init, init, "model.init")
    try:
        own = [parameter for cls in spec.fields.values() for parameter in cls.every_parameter()]
    except TypeError:  # a field that cannot be made without settings
        return
    parameters = {parameter.name for parameter in (*GEOMETRY_SPECS, *own)}
    for group, given in (("rates", settings.train.rates), ("rate_units", settings.train.rate_units)):
        for key in given:
            if key not in parameters:
                raise ConfigError(f"train.{group}.{key}: no such parameter{nearest(key, parameters)}")
