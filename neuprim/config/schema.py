"""Settings dataclasses from plain mappings, with errors that name the key, what was found and what was expected."""

from __future__ import annotations

import dataclasses
import math
import types
from collections.abc import Iterator, Mapping
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from neuprim.core.errors import ConfigError, nearest

__all__ = ["build", "convert", "defaults", "is_free", "like", "setting_names"]

T = TypeVar("T")

REQUIRED = "???"
"""How a scene's YAML says that a setting has no default (OmegaConf's mark for a missing value)."""


def build(cls: type[T], values: object, where: str = "") -> T:
    """An instance of the settings dataclass ``cls``.

    Args:
        values: field name -> value, as read from YAML or the command line; absent fields keep their defaults.
        where: dotted key of this node, for messages; empty at the root.

    Raises:
        ConfigError: for an unknown key or a value of the wrong type or range.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where}={_show(values)}: expected settings, each as {where}.KEY=VALUE")
    hints = get_type_hints(cls)
    names = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    for key in values:
        if key not in names:
            raise ConfigError(
                f"{_join(where, str(key))}: no such setting" + nearest(_join(where, str(key)), [_join(where, n) for n in names])
            )
    made = cls(**{name: convert(values[name], hints[name], _join(where, name)) for name in names if name in values})
    check = getattr(made, "check", None)
    if check is not None:
        check()
    return made


def convert(value: Any, hint: Any, where: str) -> Any:
    """``value`` as the annotated type ``hint``; only conversions that lose nothing."""
    origin, args = get_origin(hint), get_args(hint)
    if hint is Any:
        return value
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return build(hint, value, where)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        options = [a for a in args if a is not type(None)]
        return convert(value, options[0], where)
    if origin is Literal:
        if value not in args:
            raise ConfigError(f"{where}={_show(value)}: expected {_either(args)}")
        return value
    if origin is dict:
        if not isinstance(value, Mapping):
            raise ConfigError(f"{where}={_show(value)}: expected entries, each as {where}.KEY=VALUE")
        return {str(k): convert(v, args[1], _join(where, str(k))) for k, v in value.items()}
    return _scalar(value, hint, where)


def like(value: Any, default: Any, where: str) -> Any:
    """``value`` as the type of a scene's ``default``; a null or required default accepts anything."""
    if default is None or default == REQUIRED:
        return value
    if isinstance(default, Mapping):
        return convert(value, dict[str, Any], where)
    if isinstance(default, list):
        if not isinstance(value, list):
            raise ConfigError(f"{where}={_show(value)}: expected a list such as [{', '.join(map(str, default))}]")
        return value
    return _scalar(value, type(default), where)


def defaults(cls: type) -> dict[str, Any]:
    """The plain nested mapping of a settings dataclass's defaults."""
    return dataclasses.asdict(cls())


def setting_names(cls: type, where: str = "") -> Iterator[str]:
    """Dotted names of all settings of a dataclass, nested ones included; free dictionaries by their own name."""
    hints = get_type_hints(cls)
    for f in dataclasses.fields(cls):
        name, hint = _join(where, f.name), hints[f.name]
        if dataclasses.is_dataclass(hint) and isinstance(hint, type):
            yield from setting_names(hint, name)
        else:
            yield name


def is_free(cls: type, path: list[str]) -> bool:
    """Whether ``path`` (field names from ``cls`` down) ends in a setting or inside a free dictionary."""
    hint: Any = cls
    for i, part in enumerate(path):
        if get_origin(hint) is dict:
            return True
        if not (dataclasses.is_dataclass(hint) and isinstance(hint, type)):
            return False
        hints = get_type_hints(hint)
        if part not in hints:
            return False
        hint = hints[part]
        if hint is Any and i + 1 < len(path):
            return True
    return True


def _scalar(value: Any, kind: type, where: str) -> Any:
    if kind is bool and isinstance(value, bool):
        return value
    if kind is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if kind is int and isinstance(value, float) and value.is_integer():
        return int(value)  # 1e5 is how people write large counts
    if kind is float and isinstance(value, (int, float, str)) and not isinstance(value, bool):
        try:
            number = float(value)  # a string, because YAML 1.1 reads 1e-3 as text
        except ValueError:
            number = math.nan
        if math.isfinite(number):
            return number
    if kind is str and isinstance(value, (str, int)) and not isinstance(value, bool):
        return str(value)  # a directory may be called 123
    expected = {bool: "true or false", int: "a whole number", float: "a finite number", str: f"text (quote it: {where}='...')"}
    raise ConfigError(f"{where}={_show(value)}: expected {expected.get(kind, kind.__name__)}")


def _join(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _show(value: object) -> str:
    return {None: "null", True: "true", False: "false"}.get(value, str(value)) if isinstance(value, (bool, type(None))) else str(value)


def _either(args: tuple[object, ...]) -> str:
    words = [str(a) for a in args]
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " or " + words[-1]
