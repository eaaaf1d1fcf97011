"""What the generated scenes' settings have in common: known names, whole numbers within limits, a key for the cache."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from neuprim.core.errors import ConfigError, nearest

__all__ = ["check_names", "check_whole", "settings_key"]


def check_names(settings: Mapping[str, Any], known: Iterable[str]) -> None:
    """:class:`ConfigError` for a name that is not known."""
    names = list(known)
    for name in settings:
        if name not in names:
            raise ConfigError(f"scene.{name} is not a setting of this scene{nearest(str(name), names)}")


def check_whole(settings: object, limits: Mapping[str, tuple[int, int]]) -> None:
    """:class:`ConfigError` for an attribute that is no whole number from its lowest to its highest."""
    for name, (lowest, highest) in limits.items():
        value = getattr(settings, name)
        if isinstance(value, bool) or not isinstance(value, int) or not lowest <= value <= highest:
            raise ConfigError(f"scene.{name} is {value!r}; expected a whole number from {lowest} to {highest}")


def settings_key(settings: Any, version: int) -> str:
    """A short hash of every field of a settings dataclass and the generator's version."""
    text = json.dumps({"version": version, **asdict(settings)}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
