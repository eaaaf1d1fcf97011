"""A task's YAML files: which scenes and presets it has, and what its own ``task/NAME.yaml`` says.

A task's ``config_package`` holds ``task/NAME.yaml``, ``scene/NAME/*.yaml`` and ``preset/NAME/*.yaml``. Scenes and
presets lie under the task's name because several tasks have a scene of the same name with other settings.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from typing import TYPE_CHECKING, Any

from neuprim.config.declared import complete_options
from neuprim.core.errors import ConfigError, nearest

if TYPE_CHECKING:
    from neuprim.core.task import TaskSpec

__all__ = ["TaskChoices", "check_groups", "check_scene", "package_root", "presets", "read_yaml", "task_choices"]

DEFAULT_PRESET = "quick"


@dataclass(frozen=True)
class TaskChoices:
    """What ``task/NAME.yaml`` says: the scene and preset of a run that names none, and defaults of the task's own
    options.

    Attributes:
        options: all that the task declares; those that the file does not name at their defaults.
    """

    scene: str
    preset: str
    options: dict[str, Any]


def task_choices(spec: TaskSpec) -> TaskChoices:
    """Reads ``task/NAME.yaml``, which is a plain file without a defaults list.

    Raises:
        ConfigError: it is not YAML, has a key other than ``scene``, ``preset`` and ``options``, or sets an option that
        the task does
            not declare.
    """
    file = f"task/{spec.name}.yaml"
    node = read_yaml(package_root(spec) / file, f"task {spec.name!r}: {file}")
    known = ("scene", "preset", "options")
    for key in node:
        if key not in known:
            raise ConfigError(f"task {spec.name!r}: {file}: {key!s}: no such setting" + nearest(str(key), known))
    scene, preset = node.get("scene") or spec.scenes[0].name, node.get("preset") or DEFAULT_PRESET
    options = node.get("options") or {}
    for key, value, names in (("scene", scene, [s.name for s in spec.scenes]), ("preset", preset, presets(spec))):
        if value not in names:
            raise ConfigError(f"task {spec.name!r}: {file}: {key}={value}: no such {key}" + nearest(str(value), names))
    if not isinstance(options, dict):
        raise ConfigError(f"task {spec.name!r}: {file}: options: expected a mapping")
    try:
        return TaskChoices(scene, preset, complete_options(spec.options, options, "its TaskSpec", "options"))
    except ConfigError as error:
        raise ConfigError(f"task {spec.name!r}: {file}: {error}") from error


def read_yaml(file: Traversable, who: str) -> dict[Any, Any]:
    """A plain mapping of a task's package.

    Raises:
        ConfigError: there is no such file, or it is none; the message begins with ``who``.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    try:
        node = OmegaConf.to_container(OmegaConf.create(file.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(f"{who} cannot be read ({' '.join(str(error).split())})") from error
    if not isinstance(node, dict):
        raise ConfigError(f"{who}: expected a mapping")
    return node


def presets(spec: TaskSpec) -> list[str]:
    """Names of a task's presets."""
    return _names(spec, "preset")


def check_groups(spec: TaskSpec) -> None:
    """Raises ConfigError when the configuration package cannot be used or lacks a file that a run would need."""
    root = package_root(spec)
    if not (root / "task" / f"{spec.name}.yaml").is_file():
        raise ConfigError(f"task {spec.name!r}: {spec.config_package} has no task/{spec.name}.yaml")
    if not spec.scenes:
        raise ConfigError(f"task {spec.name!r}: its TaskSpec has no scenes")
    have = _names(spec, "scene")
    for scene in spec.scenes:
        if scene.name not in have:
            raise ConfigError(f"task {spec.name!r}: {spec.config_package} has no scene/{spec.name}/{scene.name}.yaml")
    if not presets(spec):
        raise ConfigError(f"task {spec.name!r}: {spec.config_package} has no preset/{spec.name}/*.yaml")


def check_scene(spec: TaskSpec, scene: str, package: str) -> None:
    """Raises ConfigError when the package that adds ``scene`` to a task has no YAML file for it."""
    who = f"scene {scene!r} of task {spec.name!r}"
    if not (_package(package, who) / "scene" / spec.name / f"{scene}.yaml").is_file():
        raise ConfigError(f"{who}: {package} has no scene/{spec.name}/{scene}.yaml")


def package_root(spec: TaskSpec) -> Traversable:
    """Where a task's YAML files lie. Raises ConfigError when its package cannot be opened."""
    return _package(spec.config_package, f"task {spec.name!r}")


def _package(name: str, who: str) -> Traversable:
    try:
        root = resources.files(name)
    except (Exception, SystemExit) as error:  # importing a package can fail in any way
        text = " ".join(str(error).split())
        raise ConfigError(f"{who}: cannot open its config_package {name!r} ({text})") from error
    if not (root / "__init__.py").is_file():
        raise ConfigError(f"{who}: config_package {name!r} needs an __init__.py (Hydra looks for it)")
    return root


def _names(spec: TaskSpec, group: str) -> list[str]:
    folder = package_root(spec) / group / spec.name
    if not folder.is_dir():
        return []
    return sorted(entry.name[: -len(".yaml")] for entry in folder.iterdir() if entry.name.endswith(".yaml"))
