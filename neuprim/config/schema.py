"""What the settings dataclasses say about names and defaults, for composing; their values are checked by
``neuprim.core.validation``."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, get_origin

from neuprim.core.validation import coerce, field_types, infer_type, join_key

__all__ = ["REQUIRED", "defaults", "is_free", "like", "setting_names"]

REQUIRED = "???"
"""How a scene's YAML says that a setting has no default (OmegaConf's mark for a missing value)."""


def like(value: Any, default: Any, where: str) -> Any:
    """``value`` as the type of a scene's ``default``; a null or required default accepts anything."""
    return value if default == REQUIRED else coerce(value, infer_type(default), where)


def defaults(cls: type) -> dict[str, Any]:
    """The plain nested mapping of a settings dataclass's defaults."""
    return dataclasses.asdict(cls())


def setting_names(cls: type, where: str = "") -> Iterator[str]:
    """Dotted names of all settings of a dataclass, nested ones included; free dictionaries by their own name."""
    for own, hint in field_types(cls).items():
        name = join_key(where, own)
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
        hints = field_types(hint)
        if part not in hints:
            return False
        hint = hints[part]
        if hint is Any and i + 1 < len(path):
            return True
    return True
