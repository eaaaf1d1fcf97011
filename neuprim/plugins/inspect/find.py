"""Inspectors by name, from the entry-point group ``neuprim.inspectors``."""

from __future__ import annotations

from importlib import metadata

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.extensions import Inspector

__all__ = ["list_inspectors", "load_inspector"]


def list_inspectors() -> list[str]:
    """Names of all that are registered, without importing any."""
    return sorted({entry.name for entry in metadata.entry_points(group="neuprim.inspectors")})


def load_inspector(name: str) -> Inspector:
    """The inspector of that name; imports it and no other."""
    for entry in metadata.entry_points(group="neuprim.inspectors", name=name):
        found = entry.load()
        if not isinstance(found, Inspector):
            raise ConfigError(
                f"--show {name}: {entry.value} is of type {type(found).__name__}; expected a neuprim.core.extensions.Inspector"
            )
        return found
    raise ConfigError(f"--show {name}: no such inspector{nearest(name, list_inspectors()) or '; none is installed (reinstall neuprim)'}")
