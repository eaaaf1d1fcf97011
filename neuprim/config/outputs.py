"""Where a run writes: a fresh directory unless told otherwise, and never into somebody's files."""

from __future__ import annotations

import os
import re
from pathlib import Path

from neuprim.core.errors import ConfigError
from neuprim.plugins.registry import split_plugin_name

ROOT = Path("outputs")
DEFAULT_TASK = "static"


def config_output_name(task: str, scene: str) -> str:
    """Return the name of a run's directory where users chose none; ``PACKAGE:NAME`` becomes a part of it."""
    return "-".join(part for word in (task, scene) for part in split_plugin_name(word) if part)


def config_output_directory(asked: str | None, name: str, resume: bool, check: bool = True) -> Path:
    """Return the directory of a run or sweep; nothing is created.

    Args:
        asked: the user's ``output_dir``, or None for ``outputs/NAME``, ``outputs/NAME-2``, ...
        name: ``<task>-<scene>``.
        resume: take the directory as it is; without ``asked``, the one with the highest number.
        check: whether an ``asked`` directory that holds files is refused (unless ``resume``).
    """
    if asked is None:
        number = max(_config_output_numbers(name), default=0) + (not resume)
        return ROOT / (name if number <= 1 else f"{name}-{number}")
    if not asked.strip():
        raise ConfigError("output_dir='': expected a directory")
    path = Path(asked).expanduser()
    if not check:
        return path
    try:
        if not resume and path.is_dir() and any(path.iterdir()):
            raise ConfigError(
                f"output_dir={path}: exists and is not empty; choose another, or continue its run with resume=true"
            )
        there = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
        if not there.is_dir():
            raise ConfigError(f"output_dir={path}: {there} is a file; expected a directory")
        if not os.access(there, os.W_OK | os.X_OK):
            raise ConfigError(f"output_dir={path}: {there} cannot be written to")
    except (OSError, ValueError) as error:
        raise ConfigError(f"output_dir={path}: {error}") from error
    return path


def _config_output_numbers(name: str) -> list[int]:
    """Numbers of the existing ``NAME`` (1) and ``NAME-n`` under the output root."""
    if not ROOT.is_dir():
        return []
    pattern = re.compile(re.escape(name) + r"(?:-(\d+))?")
    matches = (pattern.fullmatch(entry.name) for entry in ROOT.iterdir())
    return [int(m.group(1) or 1) for m in matches if m]
