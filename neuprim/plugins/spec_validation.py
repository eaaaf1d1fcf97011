"""Check a plugin's description, e.g. a TaskSpec, when the plugin is loaded.

Without this check, a wrong description would fail only in the middle of a run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import PurePath
from typing import Any

from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Exporter, LossExtension
from neuprim.core.io.exr import exr_channel_name_error
from neuprim.core.model.fields import ConditionSpec, Field
from neuprim.core.render.layer_frame import COMMON, LIGHTS, LayerSpec
from neuprim.core.task import SceneSpec, TaskSpec
from neuprim.core.train.settings import OPTIONAL
from neuprim.core.validation import option_type_to_validate, validate_value

_NESTED: dict[str, type] = {kind.__name__: kind for kind in (SceneSpec, ConditionSpec, LayerSpec)}
_FUNCTIONS = ("Callable", "Display", "Illuminate")
"""Beginnings of the type annotations of members that must be functions."""


class _InvalidMember(Exception):
    """A member of a plugin's description is invalid. The message names the member, its value and what was expected."""


def validate_spec(spec: Any) -> str | None:
    """Return why a plugin's description is invalid, ``"MEMBER is WHAT; expected WHAT"``; None if it is valid."""
    try:
        _check_spec(spec)
    except _InvalidMember as problem:
        return str(problem)
    return None


def _require_member(ok: bool, text: str) -> None:
    if not ok:
        raise _InvalidMember(text)


def _check_spec(spec: Any) -> None:
    """Check every member of a plugin's description (a dataclass) against its annotation and the rules of its class.

    Raises:
        _InvalidMember: a member is invalid.
    """
    for member in fields(spec):
        name, annotation, value = member.name, str(member.type), getattr(spec, member.name)
        kind, optional = annotation.removesuffix(" | None"), annotation.endswith("| None")
        found = f"{name} is of type {type(value).__name__}"
        if optional and value is None:
            continue
        if kind == "str":
            required = member.default is MISSING
            _require_member(
                isinstance(value, str) and (bool(value.strip()) or not required), f"{name} is {value!r}; expected text"
            )
        elif kind.startswith(_FUNCTIONS):
            _require_member(callable(value), f"{found}; expected a function{' or None' * optional}")
        elif kind.startswith("Mapping"):
            _require_member(isinstance(value, Mapping), f"{found}; expected a mapping")
        elif kind in _NESTED:
            _check_spec_member(value, _NESTED[kind], name)
        elif kind.startswith("tuple"):
            nested = _NESTED.get(kind.removeprefix("tuple[").removesuffix(", ...]"))
            expected = "a tuple" if nested is None else f"a tuple of {nested.__name__}"
            _require_member(isinstance(value, tuple | list), f"{found}; expected {expected}")
            if nested is not None:
                for i, entry in enumerate(value):
                    _check_spec_member(entry, nested, f"{name}[{i}]")
                names = [entry.name for entry in value]
                _require_member(len(set(names)) == len(names), f"{name} has a name twice: {', '.join(names)}")
    for kind_of_spec, check in _CHECKS.items():
        if isinstance(spec, kind_of_spec):
            check(spec)


def _check_spec_member(member: Any, kind: type, where: str) -> None:
    _require_member(isinstance(member, kind), f"{where} is of type {type(member).__name__}; expected a {kind.__name__}")
    try:
        _check_spec(member)
    except _InvalidMember as problem:
        raise _InvalidMember(f"{where}.{problem}") from None


def _check_plugin_task_spec(spec: TaskSpec) -> None:
    _check_plugin_options(spec, "model.", "train.")
    for name, field in (spec.fields or {}).items():
        where, is_field = f"fields[{name!r}]", isinstance(field, type) and issubclass(field, Field)
        _require_member(is_field, f"{where} is {field!r}; expected a subclass of neuprim.core.model.fields.Field")
        abstract = ", ".join(sorted(getattr(field, "__abstractmethods__", ())))
        _require_member(not abstract, f"{where} lacks the methods {abstract}")
    _check_plugin_channel_names(spec.channels)


def _check_plugin_channel_names(names: Any) -> None:
    wrong = exr_channel_name_error(names)
    _require_member(wrong is None, f"channels{wrong}")


def _check_plugin_condition_spec(spec: ConditionSpec) -> None:
    ends = spec.range
    numbers = len(ends) == 2 and all(isinstance(end, int | float) for end in ends)
    _require_member(numbers and ends[0] < ends[1], f"range is {ends!r}; expected a lower and a higher number")


def _check_layer_spec(spec: LayerSpec) -> None:
    short = spec.name.isidentifier() and spec.name.isascii() and len(spec.name) <= 31
    _require_member(short, f"name is {spec.name!r}; expected at most 31 letters, digits and _")
    taken = spec.name in {LIGHTS, *(common.name for common in COMMON)} or spec.name.startswith("light_")
    _require_member(not taken, f"name is {spec.name!r}, which is taken; expected another name")
    _check_plugin_channel_names(spec.channels)


def _check_exporter(spec: Exporter) -> None:
    for name, value in spec.options.items():
        pair = isinstance(value, tuple | list) and len(value) == 2 and isinstance(value[1], str)
        _require_member(pair, f"options[{name!r}] is {value!r}; expected (default, one line of help)")
    plain = PurePath(spec.default).name == spec.default and spec.default != ".."
    _require_member(plain, f"default is {spec.default!r}; expected the name of a file or folder")


def _check_plugin_options(spec: TaskSpec | LossExtension, *groups: str) -> None:
    """Check the members ``options`` and ``uses`` of a plugin's description.

    ``uses`` may only name optional settings whose names begin with one of ``groups``, e.g. "train.".
    """
    for name, entry in spec.options.items():
        known = isinstance(name, str) and name.isidentifier()
        _require_member(known, f"options has {name!r}; expected a name of letters, digits and _")
        where = f"options[{name!r}]"
        fits = isinstance(entry, tuple | list) and len(entry) in (2, 3) and isinstance(entry[1], str)
        _require_member(fits, f"{where} is {entry!r}; expected (default, one line of help), and perhaps a type")
        plain = isinstance(entry[0], bool | int | float | str | list | Mapping | None)
        _require_member(plain, f"{where} has a default of type {type(entry[0]).__name__}; expected what YAML can hold")
        try:
            validate_value(entry[0], option_type_to_validate(tuple(entry)), where)
        except ConfigError as error:
            raise _InvalidMember(f"the default of {error}") from None
    names = [name for name in OPTIONAL if name.startswith(groups)]
    for name in spec.uses:
        _require_member(name in names, f"uses has {name!r}; expected some of {', '.join(names)}")


_CHECKS: dict[type, Any] = {
    TaskSpec: _check_plugin_task_spec,
    ConditionSpec: _check_plugin_condition_spec,
    LayerSpec: _check_layer_spec,
    LossExtension: lambda spec: _check_plugin_options(spec, "train."),
    Exporter: _check_exporter,
}
