"""What a plugin's description must hold to be usable, checked when it is loaded rather than in the middle of a run."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Exporter, Inspector, LossExtension, SceneExtension
from neuprim.core.io.exr import channel_name_error
from neuprim.core.layers import layer_fault
from neuprim.core.model.fields import ConditionSpec, Field
from neuprim.core.task import SceneSpec, TaskSpec
from neuprim.core.used_settings import OPTIONAL
from neuprim.core.validation import coerce, option_type

__all__ = ["fault"]

_TEXTS: dict[type, tuple[str, ...]] = {
    TaskSpec: ("name", "summary", "config_package"),
    SceneSpec: ("name", "summary"),
    SceneExtension: ("task", "config_package"),
    ConditionSpec: ("name",),
    LossExtension: ("name", "summary"),
    Exporter: ("name", "summary"),
    Inspector: ("name", "summary"),
}
_CALLS: dict[type, tuple[str, ...]] = {
    TaskSpec: ("build", "loss", "check", "mask", "judge", "diagnose", "clips", "facts", "orbit", "trade"),
    SceneSpec: ("load",),
    SceneExtension: (),
    ConditionSpec: ("parse", "in_frames"),
    LossExtension: ("make",),
    Exporter: ("write",),
    Inspector: ("layers",),
}


def fault(spec: Any) -> str | None:
    """``"MEMBER is WHAT; expected WHAT"`` of the first member of a description that cannot be used; None if all is
    well."""
    kind = next(k for k in _TEXTS if isinstance(spec, k))
    for name in (*_TEXTS[kind], *_CALLS[kind]):
        if not hasattr(spec, name):
            return f"{name} is missing"
    for name in _TEXTS[kind]:
        value = getattr(spec, name)
        if not isinstance(value, str) or not value.strip():
            return f"{name} is {value!r}; expected text"
    for name in _CALLS[kind]:
        if not callable(getattr(spec, name)):
            return f"{name} is of type {type(getattr(spec, name)).__name__}; expected a function"
    if isinstance(spec, TaskSpec):
        return _declared(spec, "model.", "train.") or _task(spec)
    if isinstance(spec, LossExtension):
        return _declared(spec, "train.")
    if isinstance(spec, SceneExtension):
        return _one(spec.scene, SceneSpec, "scene")
    if isinstance(spec, ConditionSpec):
        return _condition(spec)
    if isinstance(spec, Inspector):
        return _inspector(spec)
    return _exporter(spec) if isinstance(spec, Exporter) else None


def _condition(spec: ConditionSpec) -> str | None:
    ends = spec.range
    numbers = isinstance(ends, tuple | list) and len(ends) == 2 and all(isinstance(end, int | float) for end in ends)
    if not numbers or not ends[0] < ends[1]:
        return f"range is {ends!r}; expected a lower and a higher number"
    return None


def _inspector(spec: Inspector) -> str | None:
    try:
        signature = inspect.signature(spec.layers)
    except (TypeError, ValueError):  # of compiled code that does not say
        return None
    try:
        signature.bind(None)
    except TypeError:
        return f"layers is a function of {signature}; expected one of a frame alone, which returns layers"
    return None


def _exporter(spec: Exporter) -> str | None:
    if not isinstance(spec.options, Mapping):
        return f"options is of type {type(spec.options).__name__}; expected a mapping"
    for name, value in spec.options.items():
        if not isinstance(value, tuple | list) or len(value) != 2 or not isinstance(value[1], str):
            return f"options[{name!r}] is {value!r}; expected (default, one line of help)"
    if not isinstance(spec.default, str) or PurePath(spec.default).name != spec.default or spec.default == "..":
        return f"default is {spec.default!r}; expected the name of a file or folder"
    suffixes = spec.suffixes
    if not isinstance(suffixes, tuple | list) or not all(
        isinstance(s, str) and s.startswith(".") and s == s.lower() for s in suffixes
    ):
        return f"suffixes is {suffixes!r}; expected a tuple of such as '.json', in lower case"
    if spec.default and suffixes and not spec.default.lower().endswith(tuple(suffixes)):
        return f"default is {spec.default!r}; expected a name that ends in {' or '.join(suffixes)}, its suffixes"
    return None


def _task(spec: TaskSpec) -> str | None:
    groups: tuple[tuple[str, Any, type], ...] = (
        ("scenes", spec.scenes, SceneSpec),
        ("conditions", spec.conditions, ConditionSpec),
    )
    for name, members, kind in groups:
        if not isinstance(members, tuple | list):
            return f"{name} is of type {type(members).__name__}; expected a tuple of {kind.__name__}"
        for i, member in enumerate(members):
            wrong = _one(member, kind, f"{name}[{i}]")
            if wrong:
                return wrong
        names = [member.name for member in members]
        if len(set(names)) != len(names):
            return f"{name} has two of one name among {', '.join(names)}"
    if spec.fields is not None and not isinstance(spec.fields, Mapping):
        return f"fields is of type {type(spec.fields).__name__}; expected a mapping of class names to classes"
    for name, field in (spec.fields or {}).items():
        if not isinstance(field, type) or not issubclass(field, Field):
            return f"fields[{name!r}] is {field!r}; expected a subclass of neuprim.core.model.fields.Field"
        if inspect.isabstract(field):
            lacking = ", ".join(sorted(field.__abstractmethods__))
            return f"fields[{name!r}] lacks the methods {lacking}"
    if spec.example is not None and not callable(spec.example):
        return f"example is of type {type(spec.example).__name__}; expected a function or None"
    if not isinstance(spec.channels, tuple | list):
        return f"channels is of type {type(spec.channels).__name__}; expected a tuple of names"
    wrong = channel_name_error(spec.channels)
    if wrong:
        return f"channels{wrong}"
    if spec.display is not None and not callable(spec.display):
        return f"display is of type {type(spec.display).__name__}; expected a function or None"
    wrong = layer_fault(spec.layers)
    return f"layers{wrong}" if wrong else None


def _one(member: Any, kind: type, where: str) -> str | None:
    if not isinstance(member, kind):
        return f"{where} is of type {type(member).__name__}; expected a {kind.__name__}"
    wrong = fault(member)
    return None if wrong is None else f"{where}.{wrong}"


def _declared(spec: TaskSpec | LossExtension, *groups: str) -> str | None:
    """What is wrong with ``options`` or ``uses``, which may name optional settings of these groups."""
    if not isinstance(spec.options, Mapping):
        return f"options is of type {type(spec.options).__name__}; expected a mapping of names to (default, one line of help)"
    for name, entry in spec.options.items():
        if not isinstance(name, str) or not name.isidentifier():
            return f"options has {name!r}; expected a name of letters, digits and _"
        if not isinstance(entry, tuple | list) or len(entry) not in (2, 3) or not isinstance(entry[1], str):
            return f"options[{name!r}] is {entry!r}; expected (default, one line of help), and perhaps a type"
        if not isinstance(entry[0], bool | int | float | str | list | Mapping | None):
            return (
                f"options[{name!r}] has a default of type {type(entry[0]).__name__}; expected what a YAML file can hold"
            )
        try:
            coerce(entry[0], option_type(tuple(entry)), f"options[{name!r}]")
        except ConfigError as error:
            return f"the default of {error}"
    known = [name for name in OPTIONAL if name.startswith(groups)]
    if not isinstance(spec.uses, tuple | list):
        return f"uses is of type {type(spec.uses).__name__}; expected a tuple of setting names"
    for name in spec.uses:
        if name not in known:
            return f"uses has {name!r}; expected some of {', '.join(known)}"
    return None
