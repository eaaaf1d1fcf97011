"""A task's YAML files: its scenes, presets, defaults and levels of effort, read and composed by Hydra.

A task's ``config_package`` holds ``task/NAME.yaml``, ``scene/NAME/*.yaml``, ``preset/NAME/*.yaml`` and perhaps
``effort/NAME.yaml``. Scenes and presets lie under the task's name because several tasks have a scene of the same name.

``effort/NAME.yaml`` freezes settings under the numbers 1 to 9, all of which are there::

    preset: quick                # what the levels are settings over
    levels:
      1: {model.primitives: 700, train.iterations: 300}
      ...
      9: {model.primitives: 12000, train.iterations: 80000}

A level stands below what the user types and above the preset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import resources
from importlib.resources.abc import Traversable
from typing import TYPE_CHECKING, Any

from neuprim.config.checks import complete_options
from neuprim.config.overrides import Assignment, quote_override
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.validation import format_value

if TYPE_CHECKING:
    from neuprim.core.task import TaskSpec

__all__ = [
    "EFFORT",
    "LEVELS",
    "GroupReader",
    "Level",
    "TaskChoices",
    "check_groups",
    "check_scene",
    "choose_level",
    "presets",
    "read_levels",
    "task_choices",
    "to_plain",
]

DEFAULT_PRESET = "quick"
EFFORT = "effort"
LEVELS = range(1, 10)

_LEVEL_GROUPS = ("model.", "train.", "renderer.")


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


# ---------------------------------------------------------------- levels of effort


@dataclass(frozen=True)
class Level:
    """The preset that a level was measured with, and its settings as if they were typed."""

    preset: str
    settings: tuple[Assignment, ...]


def choose_level(spec: TaskSpec, chosen: str | None, preset: str | None, presets: Sequence[str]) -> Level | None:
    """The level that ``effort=N`` names; None where that was not typed.

    Args:
        chosen, preset: what was typed for them.
        presets: names of the task's.

    Raises:
        ConfigError: no such level, the task has none, or they are not of the preset that was typed.
    """
    if chosen is None:
        return None
    if chosen not in map(str, LEVELS):
        raise ConfigError(f"{EFFORT}={chosen}: expected a level from {LEVELS[0]} (fast) to {LEVELS[-1]} (good)")
    levels = read_levels(spec, presets)
    if levels is None:
        raise ConfigError(
            f"{EFFORT}={chosen}: task {spec.name!r} has no levels; set model.primitives=N and "
            "train.iterations=N instead"
        )
    level = levels[int(chosen)]
    if preset not in (None, level.preset):
        raise ConfigError(
            f"{EFFORT}={chosen}: levels of task {spec.name!r} are of preset={level.preset}, found "
            f"preset={preset}; expected one of the two"
        )
    return level


def read_levels(spec: TaskSpec, presets: Sequence[str]) -> Mapping[int, Level] | None:
    """A task's levels by their numbers; None where it has none.

    Raises:
        ConfigError: its file is no such list.
    """
    place = f"effort/{spec.name}.yaml"
    file = package_root(spec) / place
    if not file.is_file():
        return None
    who = f"task {spec.name!r}: {place}"
    node = read_yaml(file, who)
    for key in node:
        if key not in ("preset", "levels"):
            raise ConfigError(f"{who}: {key!s}: no such setting{nearest(str(key), ('preset', 'levels'))}")
    preset, levels = node.get("preset"), node.get("levels")
    if not isinstance(preset, str) or preset not in presets:
        raise ConfigError(f"{who}: preset={format_value(preset)}: no such preset{nearest(str(preset), presets)}")
    if not isinstance(levels, Mapping) or list(levels) != list(LEVELS):
        found = format_value(list(levels)) if isinstance(levels, Mapping) else format_value(levels)
        raise ConfigError(f"{who}: levels: found {found}; expected {LEVELS[0]} to {LEVELS[-1]}, in this order")
    return {
        number: Level(preset, _level_settings(given, f"{who}: levels.{number}")) for number, given in levels.items()
    }


def _level_settings(given: Any, who: str) -> tuple[Assignment, ...]:
    if not isinstance(given, Mapping) or not all(
        isinstance(key, str) and key.startswith(_LEVEL_GROUPS) for key in given
    ):
        raise ConfigError(
            f"{who}: found {format_value(given)}; expected settings of model, train and renderer by their dotted keys"
        )
    return tuple(Assignment(key, value, quote_override(key, value)) for key, value in given.items())


# ---------------------------------------------------------------- composition


@dataclass
class GroupReader:
    """Composes scenes and presets by Hydra, each file once, as a sweep composes many runs."""

    _read: dict[tuple[str, ...], Any] = field(default_factory=dict)

    def read_scene(self, spec: TaskSpec, scene: str, package: str) -> dict[str, Any]:
        """Return the settings of a scene, unresolved; ``package`` holds its file and wins over the task's."""
        packages = dict.fromkeys((package, spec.config_package))
        node = self._compose(spec, tuple(packages), f"+scene/{spec.name}@from_scene={scene}")
        return to_plain(node.get("from_scene"), resolve=False, place=f"scene/{spec.name}/{scene}.yaml")

    def read_preset(self, spec: TaskSpec, preset: str) -> tuple[dict[str, Any], dict[str, Any]]:
        """Return the settings of a preset and those of every run, unresolved."""
        node = self._compose(spec, (spec.config_package,), f"+preset/{spec.name}@from_preset={preset}")
        common = {key: value for key, value in to_plain(node, resolve=False).items() if key != "from_preset"}
        return to_plain(node.get("from_preset"), resolve=False, place=f"preset/{spec.name}/{preset}.yaml"), common

    def _compose(self, spec: TaskSpec, packages: tuple[str, ...], group: str) -> Any:
        key = (*packages, group)
        if key not in self._read:
            self._read[key] = _compose_group(spec, packages, group)
        return self._read[key]


def _compose_group(spec: TaskSpec, packages: Sequence[str], group: str) -> Any:
    from hydra import compose, initialize_config_module
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    try:
        with initialize_config_module("neuprim.conf", version_base="1.3"):
            places = ",".join(f"pkg://{package}" for package in packages)
            return compose("config", [f"hydra.searchpath=[{places}]", group])
    except (HydraException, OmegaConfBaseException, YAMLError) as error:
        text = " ".join(str(error).split())
        raise ConfigError(f"task {spec.name!r}: its YAML files do not compose ({text})") from error


def to_plain(node: Any, resolve: bool = True, place: str = "configuration") -> dict[str, Any]:
    """Return an OmegaConf mapping as plain values.

    Raises:
        ConfigError: it is no mapping, or something that it refers to does not exist.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if node is None:
        return {}  # an empty file
    try:
        plain = OmegaConf.to_container(node, resolve=resolve)
    except OmegaConfBaseException as error:
        text = str(error).strip().splitlines()[0]
        raise ConfigError(f"{getattr(error, 'full_key', None) or place}: {text}") from error
    if not isinstance(plain, dict):
        raise ConfigError(f"{place}: expected a mapping of settings, found {type(plain).__name__}")
    return {str(key): value for key, value in plain.items()}
