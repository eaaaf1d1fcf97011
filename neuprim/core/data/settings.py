"""Settings of the loaders: what each accepts, checked before any file is touched."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuprim.core.errors import ConfigError, DataError, nearest

__all__ = ["BACKGROUNDS", "Setting", "count", "data_folder", "flag", "read_settings", "text"]

BACKGROUNDS = ("auto", "white", "black", "random")


@dataclass(frozen=True)
class Setting:
    """One key of a scene's settings: its default, what it expects in words, and the test of a value."""

    default: Any
    expected: str
    accepts: Callable[[Any], bool]


def count(default: int, low: int, expected: str) -> Setting:
    """A whole number of at least ``low``."""
    return Setting(default, expected, lambda v: isinstance(v, int) and not isinstance(v, bool) and v >= low)


def flag(default: bool) -> Setting:
    return Setting(default, "true or false", lambda v: isinstance(v, bool))


def text(default: str | None, expected: str) -> Setting:
    return Setting(default, expected, lambda v: isinstance(v, str) and bool(v) and "\0" not in v)


_COMMON: dict[str, Setting] = {
    "path": Setting(None, "the data set's folder", lambda v: isinstance(v, (str, Path)) and bool(str(v)) and "\0" not in str(v)),
    "background": Setting("auto", "one of " + ", ".join(BACKGROUNDS), lambda v: isinstance(v, str) and v in BACKGROUNDS),
    "downsample": count(1, 1, "a whole number of at least 1"),
    "preload": flag(True),
}


def read_settings(settings: Mapping[str, Any], own: Mapping[str, Setting]) -> dict[str, Any]:
    """All settings of a loader, defaults filled in.

    Common to every loader: ``path`` (required), ``background`` ("auto": white for data with alpha, else black; "white";
    "black"; "random": training composites random colours, evaluation white), ``downsample`` (whole factor, area filter on
    premultiplied values), ``preload`` (decode all images at once, so that damaged files are found before training).

    Raises:
        ConfigError: an unknown key or a value that is not accepted, with what was expected.
    """
    known = {**_COMMON, **own}
    for key in settings:
        if key not in known:
            raise ConfigError(f"scene.{key} is not a setting of this scene{nearest(str(key), known)}")
    values = {}
    for key, setting in known.items():
        value = settings.get(key)
        if value is None:
            value = setting.default
            if value is None and key == "path":
                raise ConfigError(f"scene.path is missing; expected {setting.expected}")
        elif not setting.accepts(value):
            raise ConfigError(f"scene.{key} is {value!r}; expected {setting.expected}")
        values[key] = value
    return values


def data_folder(path: Any) -> Path:
    """The existing folder of the ``path`` setting, ``~`` expanded.

    Raises:
        DataError: there is no such folder.
    """
    try:
        folder = Path(path).expanduser()
        usable = folder.is_dir()
    except (OSError, RuntimeError) as error:  # a name that is too long, a home folder that nobody has
        raise DataError(f"{path}: {error}; expected the data set's folder (scene.path)") from None
    if not usable:
        found = "is a file" if folder.exists() else "does not exist"
        raise DataError(f"{folder}: {found}; expected the data set's folder (scene.path)")
    return folder
