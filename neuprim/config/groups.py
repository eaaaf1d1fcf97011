"""A task's YAML files: which scenes and presets it has, and what its own ``task/NAME.yaml`` says.

A task's ``config_package`` holds ``task/NAME.yaml``, ``scene/NAME/*.yaml`` and ``preset/NAME/*.yaml``. Scenes and presets lie
under the task's name because several tasks have a scene of the same name with other settings.
"""

from __future__ import annotations

from importlib import resources
from importlib.resources.abc import Traversable
from typing import TYPE_CHECKING

from neuprim.core.errors import ConfigError

if TYPE_CHECKING:
    from neuprim.core.task import TaskSpec

__all__ = ["check_groups", "presets"]


def presets(spec: TaskSpec) -> list[str]:
    """Names of a task's presets."""
    return _names(spec, "preset")


def check_groups(spec: TaskSpec) -> None:
    """Raises ConfigError when the configuration package cannot be used or lacks the file of a scene."""
    root = _root(spec)
    if not (root / "task" / f"{spec.name}.yaml").is_file():
        raise ConfigError(f"task {spec.name!r}: {spec.config_package} has no task/{spec.name}.yaml")
    have = _names(spec, "scene")
    for scene in spec.scenes:
        if scene.name not in have:
            raise ConfigError(f"task {spec.name!r}: {spec.config_package} has no scene/{spec.name}/{scene.name}.yaml")
    if not presets(spec):
        raise ConfigError(f"task {spec.name!r}: {spec.config_package} has no preset/{spec.name}/*.yaml")


def _root(spec: TaskSpec) -> Traversable:
    try:
        root = resources.files(spec.config_package)
    except Exception as error:  # importing a package can fail in any way
        text = " ".join(str(error).split())
        raise ConfigError(f"task {spec.name!r}: cannot open its config_package {spec.config_package!r} ({text})") from error
    if not (root / "__init__.py").is_file():
        raise ConfigError(f"task {spec.name!r}: config_package {spec.config_package!r} needs an __init__.py (Hydra looks for it)")
    return root


def _names(spec: TaskSpec, group: str) -> list[str]:
    folder = _root(spec) / group / spec.name
    if not folder.is_dir():
        return []
    return sorted(entry.name[: -len(".yaml")] for entry in folder.iterdir() if entry.name.endswith(".yaml"))
