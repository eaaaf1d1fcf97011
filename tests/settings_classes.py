"""Every settings dataclass of the package, found and not listed, and values that each of its fields must refuse."""

from __future__ import annotations

import dataclasses
import importlib
import math
import pkgutil
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import neuprim
from neuprim.core.validation import Range, Unbounded, field_types

REQUIRED: dict[str, Any] = {
    "path": Path("folder"),
    "simulation": "smoke_fire",
    "direction": (0.0, 0.0, 1.0),
    "irradiance": (1.0, 1.0, 1.0),
    "task": {"name": "static"},
    "scene": {"name": "solids"},
    "preset": "quick",
    "made_by": {"neuprim": "0.1.0", "task": {"name": "static", "package": "neuprim", "version": "0.1.0"}},
}
"""What a dataclass needs beside its defaults."""


def settings_classes() -> list[type]:
    """All classes of the package whose name ends in Settings, and dataclasses that verify themselves."""
    found: dict[str, type] = {}
    for module in pkgutil.walk_packages(neuprim.__path__, "neuprim."):
        if module.name.startswith(("neuprim.plugins.template", "neuprim.cli.__main__")) or module.name.endswith(
            "__main__"
        ):
            continue
        for name, value in vars(importlib.import_module(module.name)).items():
            if (
                isinstance(value, type)
                and value.__module__ == module.name
                and (name.endswith("Settings") or _validates_itself(value))
            ):
                found[f"{module.name}.{name}"] = value
    return [found[name] for name in sorted(found)]


def _validates_itself(cls: type) -> bool:
    return (
        "validate_fields"
        in getattr(getattr(cls, "__post_init__", None), "__code__", settings_classes.__code__).co_names
    )


def required(cls: type) -> dict[str, Any]:
    """The fewest values that make one."""
    return {name: REQUIRED[name] for name in field_types(cls) if name in REQUIRED}


def leaves(hint: Any) -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """The types inside an annotation with their notes: of unions and of what containers hold."""
    plain, notes = (hint.__origin__, hint.__metadata__) if get_origin(hint) is Annotated else (hint, ())
    inner = get_args(plain) if get_origin(plain) in (Union, types.UnionType, dict, tuple) or _mapping(plain) else ()
    if inner:
        for one in inner:
            yield from leaves(one)
    else:
        yield plain, notes


def unbounded_numbers(hint: Any) -> list[Any]:
    """The numbers of an annotation that say neither bounds nor why there are none."""
    return [
        plain
        for plain, notes in leaves(hint)
        if plain in (int, float) and not any(isinstance(n, Range | Unbounded) for n in notes)
    ]


def bad_values(hint: Any) -> list[Any]:
    """Values that a field must refuse: wrong types, beyond its bounds, and no numbers; none for a field that takes
    anything."""
    options = list(leaves(hint))
    kinds = [plain for plain, _ in options]
    if Any in kinds and not _mapping(hint):
        return []
    if _mapping(hint):
        inner = next(args for args in [get_args(hint)])[1]
        return [3, "x", [1], *({"a": bad} for bad in bad_values(inner))]
    if get_origin(hint) is list:
        return [3, "x", {"a": 1}]
    if len(kinds) == 1 and dataclasses.is_dataclass(kinds[0]):
        return [3, "x", [1], {"no_such_setting": 1}]
    found: list[Any] = [[1], {"a": 1}]
    if type(None) not in kinds:
        found.append(None)
    if int in kinds or float in kinds:
        found += [
            True,
            math.nan,
            math.inf,
            -math.inf,
            "nan",
            "many",
            *(v for plain, notes in options for v in beyond(plain, notes)),
        ]
    if kinds == [bool]:
        found += [1, 0, "yes", 1.0]
    if int in kinds:
        found += [1.5, "1.5"]
    if get_origin(kinds[0]) is Literal:
        found += [True, 1, "no such choice", ""]
    if str in kinds or Path in kinds:
        found += [True, 1.5]
    return found


def beyond(plain: Any, notes: tuple[Any, ...]) -> Iterator[float]:
    """Numbers just outside the bounds."""
    step = 1 if plain is int else 1e-6
    for note in notes:
        if isinstance(note, Range):
            ends = ((note.at_least, -step), (note.above, 0), (note.at_most, step), (note.below, 0))
            yield from (end + by for end, by in ends if end is not None and end + by not in note.also)


def _mapping(hint: Any) -> bool:
    origin = get_origin(hint)
    return (isinstance(origin, type) and issubclass(origin, dict | types.MappingProxyType)) or getattr(
        origin, "__name__", ""
    ) == "Mapping"
