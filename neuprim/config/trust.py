"""What opening a run that was read from a file may reach, and the user's word for more.

Rule: a stored configuration is text of somebody else. What it names is read from this machine's own folders, as any
user's run does. What is an address of another machine, and what would be written to outside of the run, is used only
where the user typed it or said ``--trust``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from neuprim.config.run_config import RunConfig
from neuprim.core.errors import ConfigError, cut
from neuprim.core.io.trust import ENVIRONMENT, FLAG, trusted

_WRITTEN = "cache"
"""The setting of scenes that is written to."""


def check_stored(config: RunConfig, typed: Mapping[str, Any] | None = None) -> None:
    """Refuse what a configuration from a file would reach outside of its run, unless the user trusts it.

    Args:
        config: of a file, if its ``source`` says so; any other passes.
        typed: dotted keys that the user gave values for beside the file; None: there is no way to give any, and the
        flag is it.

    Raises:
        ConfigError: names file, key and value, and what to type.
    """
    if config.source is None or trusted():
        return
    tree = {
        "scene": config.scene,
        "task.options": config.options,
        "model.init": config.model.init,
        "metrics.lpips": config.metrics.lpips,
    }
    for key, value in _texts("", tree):
        if typed is not None and any(key == name or key.startswith(f"{name}.") for name in typed):
            continue
        share = value.startswith("\\\\" if os.name != "nt" else ("\\\\", "//"))
        if share or "://" in value or "::" in value:  # a URL, a chain of them, or a Windows share
            what = "an address, which would be contacted"
        elif key == f"scene.{_WRITTEN}" and not _inside(value, config.source.parent):
            what = "a folder outside of the run, which would be written to"
        else:
            continue
        allow = f"type {key}=... to use it" if typed is not None else f"{FLAG} allows it"
        raise ConfigError(
            f"{config.source}: {key} is {cut(value)!r}, {what}; {allow}, {ENVIRONMENT}=1 in the "
            "environment does so for all runs"
        )


def refuse_links(run_dir: Path) -> None:
    """Refuse a run directory with folders that are links out of it, unless the user trusts it: what is written into
    them would be elsewhere.

    Raises:
        ConfigError: names the link.
    """
    if trusted() or not run_dir.is_dir():
        return
    whole = run_dir.resolve()
    for entry in os.scandir(run_dir):
        if entry.is_symlink() and entry.is_dir() and whole not in (there := Path(entry.path).resolve()).parents:
            raise ConfigError(
                f"{entry.path}: is a link to {there}, outside of the run; expected a folder, or {FLAG} to write there"
            )


def _inside(value: str, run_dir: Path) -> bool:
    return Path(value).expanduser().resolve().is_relative_to(run_dir.resolve())


def _texts(key: str, value: Any) -> Iterator[tuple[str, str]]:
    """(dotted key, text) of everything in a tree of settings."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _texts(f"{key}.{name}" if key else str(name), item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _texts(key, item)
    elif isinstance(value, str | Path):
        yield key, str(value)
