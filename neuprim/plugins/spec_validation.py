"""Check a plugin's description when it is loaded, so that nothing fails in the middle of a run."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from neuprim.core.errors import ConfigError
from neuprim.core.extensions import Exporter, Inspector, LossExtension, SceneExtension
from neuprim.core.io.exr import channel_name_error
from neuprim.core.layers import COMMON, LIGHTS, LayerSpec
from neuprim.core.model.fields import ConditionSpec, Field
from neuprim.core.task import SceneSpec, TaskSpec
from neuprim.core.used_settings import OPTIONAL
from neuprim.core.validation import coerce, option_type

_TEXTS: dict[type, tuple[str, ...]] = {
    TaskSpec: ("name", "summary", "config_package"),
    SceneSpec: ("name", "summary"),
    SceneExtension: ("task", "config_package"),
    ConditionSpec: ("name",),
    LayerSpec: ("name", "summary"),
    LossExtension: ("name", "summary"),
    Exporter: ("name", "summary"),
    Inspector: ("name", "summary"),
}
_FUNCTIONS: dict[type, tuple[str, ...]] = {
    TaskSpec: ("build", "loss", "check", "mask", "judge", "diagnose", "clips", "facts", "orbit", "trade"),
    SceneSpec: ("load",),
    SceneExtension: (),
    ConditionSpec: ("parse", "in_frames"),
    LayerSpec: ("draw",),
    LossExtension: ("make",),
    Exporter: ("write",),
    Inspector: ("layers",),
}


class _Invalid(Exception):
    """A member that cannot be used; the text says which, what it is and what was expected."""


def validate_spec(spec: Any) -> str | None:
    """Find the first member of a plugin's description that cannot be used.

    Returns:
        ``"MEMBER is WHAT; expected WHAT"``, or None if the description is valid.
    """
    try:
        _check_spec(spec)
    except _Invalid as problem:
        return str(problem)
    return None


def _require(ok: bool, text: str) -> None:
    if not ok:
        raise _Invalid(text)


def _check_spec(spec: Any) -> None:
    kind = next(k for k in _TEXTS if isinstance(spec, k))
    for name in (*_TEXTS[kind], *_FUNCTIONS[kind]):
        _require(hasattr(spec, name), f"{name} is missing")
    for name in _TEXTS[kind]:
        value = getattr(spec, name)
        _require(isinstance(value, str) and bool(value.strip()), f"{name} is {value!r}; expected text")
    for name in _FUNCTIONS[kind]:
        _require_type(callable(getattr(spec, name)), spec, name, "a function")
    if kind in _CHECKS:
        _CHECKS[kind](spec)


def _require_type(ok: bool, spec: Any, name: str, expected: str) -> None:
    _require(ok, f"{name} is of type {type(getattr(spec, name)).__name__}; expected {expected}")


def _check_members(spec: Any, name: str, kind: type) -> None:
    """Check a tuple of descriptions, whose names must differ."""
    members = getattr(spec, name)
    _require_type(isinstance(members, tuple | list), spec, name, f"a tuple of {kind.__name__}")
    for i, member in enumerate(members):
        _check_member(member, kind, f"{name}[{i}]")
    names = [member.name for member in members]
    _require(len(set(names)) == len(names), f"{name} has two of one name among {', '.join(names)}")


def _check_member(member: Any, kind: type, where: str) -> None:
    _require(isinstance(member, kind), f"{where} is of type {type(member).__name__}; expected a {kind.__name__}")
    try:
        _check_spec(member)
    except _Invalid as problem:
        raise _Invalid(f"{where}.{problem}") from None


def _check_task(spec: TaskSpec) -> None:
    _check_options(spec, "model.", "train.")
    _check_members(spec, "scenes", SceneSpec)
    _check_members(spec, "conditions", ConditionSpec)
    _check_members(spec, "layers", LayerSpec)
    _require_type(spec.fields is None or isinstance(spec.fields, Mapping), spec, "fields", "a mapping of classes")
    for name, field in (spec.fields or {}).items():
        where, is_field = f"fields[{name!r}]", isinstance(field, type) and issubclass(field, Field)
        _require(is_field, f"{where} is {field!r}; expected a subclass of neuprim.core.model.fields.Field")
        abstract = ", ".join(sorted(getattr(field, "__abstractmethods__", ())))
        _require(not abstract, f"{where} lacks the methods {abstract}")
    _require_type(isinstance(spec.channels, tuple | list), spec, "channels", "a tuple of names")
    _check_channel_names(spec.channels)
    for name in ("example", "display"):
        value = getattr(spec, name)
        _require_type(value is None or callable(value), spec, name, "a function or None")


def _check_channel_names(names: Any) -> None:
    wrong = channel_name_error(names)
    _require(wrong is None, f"channels{wrong}")


def _check_scene_extension(spec: SceneExtension) -> None:
    _check_member(spec.scene, SceneSpec, "scene")


def _check_condition(spec: ConditionSpec) -> None:
    ends = spec.range
    numbers = isinstance(ends, tuple | list) and len(ends) == 2 and all(isinstance(end, int | float) for end in ends)
    _require(numbers and ends[0] < ends[1], f"range is {ends!r}; expected a lower and a higher number")


def _check_layer(spec: LayerSpec) -> None:
    short = spec.name.isidentifier() and spec.name.isascii() and len(spec.name) <= 31
    _require(short, f"name is {spec.name!r}; expected at most 31 letters, digits and _")
    taken = spec.name in {LIGHTS, *(common.name for common in COMMON)} or spec.name.startswith("light_")
    _require(not taken, f"name is {spec.name!r}, which is taken; expected another name")
    _require_type(isinstance(spec.channels, tuple | list), spec, "channels", "a tuple of names")
    _check_channel_names(spec.channels)


def _check_loss(spec: LossExtension) -> None:
    _check_options(spec, "train.")


def _check_inspector(spec: Inspector) -> None:
    try:
        signature = inspect.signature(spec.layers)
    except (TypeError, ValueError):  # compiled code may have no signature
        return
    try:
        signature.bind(None)
    except TypeError:
        raise _Invalid(
            f"layers is a function of {signature}; expected one of a frame alone, returning layers"
        ) from None


def _check_exporter(spec: Exporter) -> None:
    _require_type(isinstance(spec.options, Mapping), spec, "options", "a mapping")
    for name, value in spec.options.items():
        pair = isinstance(value, tuple | list) and len(value) == 2 and isinstance(value[1], str)
        _require(pair, f"options[{name!r}] is {value!r}; expected (default, one line of help)")
    default, suffixes = spec.default, spec.suffixes
    plain = isinstance(default, str) and PurePath(default).name == default and default != ".."
    _require(plain, f"default is {default!r}; expected the name of a file or folder")
    lower = isinstance(suffixes, tuple | list) and all(
        isinstance(suffix, str) and suffix.startswith(".") and suffix == suffix.lower() for suffix in suffixes
    )
    _require(lower, f"suffixes is {suffixes!r}; expected a tuple of such as '.json', in lower case")
    fits = not default or not suffixes or default.lower().endswith(tuple(suffixes))
    _require(fits, f"default is {default!r}; expected a name that ends in {' or '.join(suffixes)}")


def _check_options(spec: TaskSpec | LossExtension, *groups: str) -> None:
    """Check ``options``, and ``uses``, which may name optional settings of these groups."""
    _require_type(
        isinstance(spec.options, Mapping), spec, "options", "a mapping of names to (default, one line of help)"
    )
    for name, entry in spec.options.items():
        known = isinstance(name, str) and name.isidentifier()
        _require(known, f"options has {name!r}; expected a name of letters, digits and _")
        where = f"options[{name!r}]"
        fits = isinstance(entry, tuple | list) and len(entry) in (2, 3) and isinstance(entry[1], str)
        _require(fits, f"{where} is {entry!r}; expected (default, one line of help), and perhaps a type")
        plain = isinstance(entry[0], bool | int | float | str | list | Mapping | None)
        _require(plain, f"{where} has a default of type {type(entry[0]).__name__}; expected what YAML can hold")
        try:
            coerce(entry[0], option_type(tuple(entry)), where)
        except ConfigError as error:
            raise _Invalid(f"the default of {error}") from None
    names = [name for name in OPTIONAL if name.startswith(groups)]
    _require_type(isinstance(spec.uses, tuple | list), spec, "uses", "a tuple of setting names")
    for name in spec.uses:
        _require(name in names, f"uses has {name!r}; expected some of {', '.join(names)}")


_CHECKS: dict[type, Any] = {
    TaskSpec: _check_task,
    SceneExtension: _check_scene_extension,
    ConditionSpec: _check_condition,
    LayerSpec: _check_layer,
    LossExtension: _check_loss,
    Exporter: _check_exporter,
    Inspector: _check_inspector,
}
