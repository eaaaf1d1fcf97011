"""Check settings against a dataclass whose annotated fields declare their types, bounds and choices.

    @dataclass(frozen=True)
    class Waves:
        count: Annotated[int, Range(1, 16)] = 3
        form: Literal["sine", "cosine"] = "sine"

    validate_settings(Waves, {"cuont": 4}, "model.density")
    # ConfigError: model.density.cuont: no such setting; did you mean 'model.density.count'?

Types are ``bool``, ``int``, ``float``, ``str``, ``Path``, ``list``, ``Literal``, ``tuple``, ``dict``, other settings
dataclasses, unions of these, and ``Any``. Conversions lose nothing: 1e5 is accepted as a whole number, true is not.
Numbers that are NaN or infinite are refused.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from neuprim.core.errors import ConfigError, cut_error_text, nearest

__all__ = ["Accepts", "Option", "Range", "Unbounded", "validate_choices", "validate_settings"]

T = TypeVar("T")

Option = tuple[Any, str] | tuple[Any, str, Any]
"""An option of a task or loss: (default, one line of help), or (default, one line of help, type). The type may have
bounds or choices, as the annotation of a field in a settings dataclass. Without a type, values are converted to the
type of the default."""

_KINDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a finite number",
    str: "text",
    Path: "a path",
    list: "a list",
    Any: "any value",
}


# ---------------------------------------------------------------- constraints on values


@dataclass(frozen=True)
class Range:
    """Bounds of a number: ``Annotated[float, Range(above=0, at_most=1)]``."""

    at_least: float | None = None  # lowest value
    at_most: float | None = None  # highest value
    above: float | None = None  # lower bound that is itself refused, instead of at_least
    below: float | None = None  # upper bound that is itself refused, instead of at_most
    also: tuple[float, ...] = ()  # further values with a meaning of their own, e.g. 0 for "none"
    says: str = ""  # text of messages for the expected value ("degrees from 1 to 120"); empty: the bounds

    def accepts(self, value: Any) -> bool:
        return value in self.also or not (
            (self.at_least is not None and value < self.at_least)
            or (self.above is not None and value <= self.above)
            or (self.at_most is not None and value > self.at_most)
            or (self.below is not None and value >= self.below)
        )

    def words(self, kind: str) -> str:
        """Return the bounds as text for messages, e.g. "0, or a whole number of at least 2"."""
        low = _format_bound(self.at_least if self.above is None else self.above)
        high = _format_bound(self.at_most if self.below is None else self.below)
        if low and high and self.above is self.below is None:
            limits = f"from {low} to {high}"
        else:
            lower = low and (f"of at least {low}" if self.above is None else f"above {low}")
            upper = high and (f"at most {high}" if self.below is None else f"below {high}")
            limits = (
                f"{lower} and {upper}"
                if lower and upper
                else lower or (upper and f"of {upper}" if self.below is None else upper)
            )
        return "".join(f"{_format_bound(value)}, or " for value in self.also) + f"{kind} {limits}".rstrip()


def _format_bound(value: float | None) -> str:
    """Format a bound of a number for messages; empty if there is no bound."""
    return "" if value is None or math.isinf(value) else str(value) if isinstance(value, int) else f"{value:g}"


@dataclass(frozen=True)
class Accepts:
    """Requirement on a setting's value, with a test: ``Annotated[str, Accepts(str.islower, "lower-case text")]``."""

    test: Callable[[Any], bool]  # test of the converted value
    says: str  # text of messages for the expected value

    def accepts(self, value: Any) -> bool:
        return self.test(value)

    def words(self, kind: str) -> str:
        return self.says


@dataclass(frozen=True)
class Unbounded:
    """Annotation of a number without bounds: every finite value is valid."""

    why: str  # why the number has no bounds


def nonempty_text(says: str) -> Accepts:
    """Return a requirement that accepts a non-empty text or path without NUL; ``says`` describes it in messages."""
    return Accepts(lambda value: bool(str(value)) and "\0" not in str(value), says)


# ---------------------------------------------------------------- settings from plain values


def validate_settings(cls: type[T], values: object, where: str = "") -> T:
    """Return an instance of the settings dataclass ``cls`` with checked and converted ``values``.

    Args:
        values: field name -> value, as read from YAML or the command line; missing fields get their defaults.
        where: dotted key of this group, for messages; empty at the root.

    Raises:
        ConfigError: one line for an unknown or missing key, or a value that its field does not accept.
    """
    if isinstance(values, cls):
        return values
    if not isinstance(values, Mapping):
        raise ConfigError(f"{where}={format_setting_value(values)}: expected settings, each as {where}.KEY=VALUE")
    hints = field_types(cls)  # type: ignore[arg-type]
    validate_setting_names(values, hints, where)
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        if field.name not in values and field.default is field.default_factory is dataclasses.MISSING:
            name = join_setting_key(where, field.name)
            raise ConfigError(f"{name}: required and not given; expected {describe_expected(hints[field.name], name)}")
    return cls(
        **{
            name: validate_value(values[name], hint, join_setting_key(where, name))
            for name, hint in hints.items()
            if name in values
        }
    )


def validate_choices(found: Mapping[str, Any], where: str, offered: Mapping[str, Any]) -> None:
    """Raise ConfigError if a setting is not in ``offered``, or if its value does not have the type in ``offered``.

    Args:
        found: setting name -> value from the user or a preset.
        where: dotted name of the group, for messages.
        offered: setting name -> annotated type, as on a settings dataclass, or a tuple of the allowed values.
    """
    validate_setting_names(found, offered, where)
    for key, value in found.items():
        hint = _choice_type_to_validate(offered[key])
        made = validate_value(value, hint, join_setting_key(where, key))
        if made != value or (isinstance(made, int) and isinstance(value, float)):
            # "1e-3" for a number, 3 for text, 4.0 for a whole number: the field gets the value itself
            raise _UnfitValue(
                join_setting_key(where, key), value, describe_expected(hint, join_setting_key(where, key))
            )


def validate_fields(settings: Any, where: str) -> None:
    """Check and convert a settings dataclass in its ``__post_init__``, as :func:`validate_settings` does."""
    for name, hint in field_types(type(settings)).items():  # type: ignore[arg-type]
        value = getattr(settings, name)
        made = validate_value(value, hint, join_setting_key(where, name))
        if made is not value:
            object.__setattr__(settings, name, made)  # works on frozen classes too; nobody has read the value yet


def validate_value(value: Any, hint: Any, where: str) -> Any:
    """Return ``value`` as the annotated type ``hint``, within its bounds; a ConfigError names ``where``."""
    plain, notes = _split_validation_type(hint)
    if get_origin(plain) in (Union, types.UnionType):
        return _validate_union_value(value, get_args(plain), where)
    made = _validate_plain_value(value, plain, notes, where)
    for note in notes:
        if isinstance(note, Range | Accepts) and not note.accepts(made):
            raise _UnfitValue(where, value, note.says or note.words("a whole number" if plain is int else "a number"))
    return made


def infer_type_to_validate(default: Any) -> Any:
    """Return the type of an option from its default value; a default of None accepts anything."""
    if default is None:
        return Any
    if isinstance(default, Mapping):
        return dict[str, Any]
    if isinstance(default, list):
        return Annotated[list, Accepts(lambda value: True, f"a list such as [{', '.join(map(str, default))}]")]
    return type(default)


def option_type_to_validate(option: Option) -> Any:
    """Return the type that an option's values are converted to."""
    return _choice_type_to_validate(option[2]) if len(option) == 3 else infer_type_to_validate(option[0])


def _choice_type_to_validate(kind: Any) -> Any:
    return Literal[kind] if isinstance(kind, tuple) else kind


# ---------------------------------------------------------------- messages


class _UnfitValue(ConfigError):
    """Error for a setting's value that has a wrong type or is out of bounds."""

    def __init__(self, where: str, value: object, expected: str) -> None:
        super().__init__(f"{where}={format_setting_value(value)}: expected {expected}")
        self.where, self.expected = where, expected


def validate_setting_names(values: Iterable[object], names: Iterable[str], where: str) -> None:
    """Raise ConfigError for the first of ``values`` that is not in ``names``; the message suggests similar names."""
    known = list(names)
    for key in values:
        if key not in known:
            hint = nearest(str(key), known, prefix=join_setting_key(where, "")) or "; this group has no settings"
            raise ConfigError(f"{cut_error_text(join_setting_key(where, str(key)))}: no such setting{hint}")


def join_setting_key(where: str, name: str) -> str:
    """Return the dotted key of a setting; ``where`` is its group, empty at the root."""
    return f"{where}.{name}" if where else name


def format_setting_value(value: object) -> str:
    """Return a value as users type it, shortened if long, and quoted if the text would parse as another type."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if not isinstance(value, str):
        return cut_error_text(" ".join(str(value).split()))
    special = value.lower() in ("", "null", "true", "false") or _setting_reads_as_number(value)
    return cut_error_text(repr(value) if special or not value.isprintable() else value)


def _setting_reads_as_number(value: str) -> bool:
    try:
        float(value)
    except ValueError:
        return False
    return True


def describe_expected(hint: Any, where: str) -> str:
    """Return a text for messages that says what a type accepts, such as ``"a whole number from 1 to 16"``.

    ``where`` is the dotted key of the setting.
    """
    plain, notes = _split_validation_type(hint)
    says = next((note.says for note in notes if isinstance(note, Accepts)), "")
    if says:
        return says
    origin, args = get_origin(plain), get_args(plain)
    if origin in (Union, types.UnionType):
        return ", or ".join("null" if a is type(None) else describe_expected(a, where) for a in args)
    if origin is Literal:
        return _join_choices(args)
    if origin in (tuple, list):
        return (
            f"a list, each {describe_expected(args[0], where)}"
            if origin is list or args[-1] is ...
            else f"a list of {', '.join(describe_expected(a, where) for a in args)}"
        )
    if plain is str:
        return f"text (quote it: {where}='...')"
    if dataclasses.is_dataclass(plain) or origin is dict:
        return "a mapping"
    kind = _KINDS.get(plain, getattr(plain, "__name__", str(plain)))
    bounds = next((note for note in notes if isinstance(note, Range)), None)
    return kind if bounds is None else bounds.words(kind)


def _join_choices(values: tuple[object, ...]) -> str:
    words = ["null" if v is None else str(v) for v in values]
    return words[0] if len(words) == 1 else ", ".join(words[:-1]) + " or " + words[-1]


# ---------------------------------------------------------------- types


@functools.cache
def field_types(cls: type) -> Mapping[str, Any]:
    """Return field name -> annotated type for a settings dataclass."""
    hints = get_type_hints(cls, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls) if field.init}


def _split_validation_type(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Split an annotated type into the plain type and its annotations."""
    return (hint.__origin__, hint.__metadata__) if get_origin(hint) is Annotated else (hint, ())


def _validate_union_value(value: Any, options: tuple[Any, ...], where: str) -> Any:
    """Return the value, converted to the first type of a union that accepts it."""
    if value is None and type(None) in options:
        return None
    refused = []
    for option in options:
        if option is not type(None):
            try:
                return validate_value(value, option, where)
            except _UnfitValue as error:
                if error.where != where:  # the error is inside a group whose type is right
                    raise
                refused.append(error.expected)
    expected = ", or ".join([*refused, *(["null"] if type(None) in options else [])])
    raise _UnfitValue(where, value, expected)


def _validate_plain_value(value: Any, kind: Any, notes: tuple[Any, ...], where: str) -> Any:
    """Return ``value`` as the plain type ``kind``.

    ``notes`` are the annotations of the type; only the error message uses them.
    """
    origin, args = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return validate_settings(kind, value, where)
    if origin is Literal:
        if any(value == a and type(value) is type(a) for a in args):
            return value
    elif isinstance(origin, type) and issubclass(origin, Mapping):
        if isinstance(value, Mapping):
            return _validate_entries(value, args, where)
        raise ConfigError(f"{where}={format_setting_value(value)}: expected entries, each as {where}.KEY=VALUE")
    elif origin in (tuple, list):
        items = (
            args[:1] * len(value) if isinstance(value, list | tuple) and (origin is list or args[-1] is ...) else args
        )
        if isinstance(value, list | tuple) and len(items) == len(value):
            try:
                return origin(validate_value(v, item, where) for v, item in zip(value, items, strict=True))
            except _UnfitValue:  # reported for the whole list below
                pass
    elif (made := _validate_scalar(value, kind)) is not None:
        return made
    hint = Annotated[kind, *notes] if notes else kind
    raise _UnfitValue(where, value, describe_expected(hint, where))


def _validate_entries(value: Mapping[Any, Any], args: tuple[Any, ...], where: str) -> dict[str, Any]:
    names, kind = args
    if get_origin(names) is Literal:
        validate_setting_names(value, get_args(names), where)
    return {str(k): validate_value(v, kind, join_setting_key(where, str(k))) for k, v in value.items()}


def _validate_scalar(value: Any, kind: Any) -> Any:
    """Return ``value`` converted to the type ``kind`` without loss, or None if that is impossible."""
    truth = isinstance(value, bool)
    if kind is bool:
        return value if truth else None
    if kind is int and isinstance(value, int) and not truth:
        return value
    if kind is int and isinstance(value, float) and value.is_integer():
        return int(value)  # 1e5 is how people write large counts
    if kind is float and isinstance(value, int | float | str) and not truth:
        try:
            number = float(value)  # a string, because YAML 1.1 reads 1e-3 as text
        except (ValueError, OverflowError):
            return None
        return number if math.isfinite(number) else None
    if kind is str and isinstance(value, str | int) and not truth:
        return str(value)  # a directory may be called 123
    if kind is Path and isinstance(value, str | int | Path) and not truth and str(value):
        return Path(str(value))  # Path("") would be the working directory
    return value if kind is list and isinstance(value, list) else None
