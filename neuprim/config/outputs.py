"""Where a run writes: a fresh directory unless told otherwise, and never into somebody's files."""

from __future__ import annotations

import os
import re
from pathlib import Path

from neuprim.core.errors import ConfigError
from neuprim.plugins.registry import split_plugin_name

ROOT = Path("outputs")
DEFAULT_TASK = "static"


def run_name(task: str, scene: str) -> str:
    """The name of a run's directory in the output root, where users chose none; ``PACKAGE:NAME`` becomes a part of
    it."""
    return "-".join(part for word in (task, scene) for part in split_plugin_name(word) if part)


def output_directory(asked: str | None, name: str, resume: bool, check: bool = True) -> Path:
    """The directory of a run or sweep; nothing is created.

    Args:
        asked: the user's ``output_dir``, or None for ``outputs/NAME``, ``outputs/NAME-2``, ...
        name: ``<task>-<scene>``.
        resume: take the directory as it is; without ``asked``, the one with the highest number.
        check: whether an ``asked`` directory that holds files is refused (unless ``resume``).
    """
    if asked is None:
        taken = _numbers(name)
        number = max(taken, default=0) if resume else max(taken, default=0) + 1
        return ROOT / (name if number <= 1 else f"{name}-{number}")
    if not asked.strip():
        raise ConfigError("output_dir='': expected a directory")
    path = Path(asked).expanduser()
    if not check:
        return path
    try:
        if path.exists() and not path.is_dir():
            raise ConfigError(f"output_dir={path}: is a file; expected a directory")
        if not resume and path.is_dir() and any(path.iterdir()):
            raise ConfigError(
                f"output_dir={path}: exists and is not empty; choose another, or continue its run with resume=true"
            )
        _check_place(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"output_dir={path}: {error}") from error
    return path


def _check_place(path: Path) -> None:
    """Refuses a directory that cannot be made or written, before a run has prepared its data for it."""
    there = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
    if not there.is_dir():
        raise ConfigError(f"output_dir={path}: {there} is a file; expected a directory")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"output_dir={path}: {there} cannot be written to")


def _numbers(name: str) -> list[int]:
    """Numbers of the existing ``NAME`` (1) and ``NAME-n`` under the output root."""
    if not ROOT.is_dir():
        return []
    pattern = re.compile(re.escape(name) + r"(?:-(\d+))?")
    matches = (pattern.fullmatch(entry.name) for entry in ROOT.iterdir())
    return [int(m.group(1) or 1) for m in matches if m]
