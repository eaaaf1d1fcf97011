"""Read a task's YAML files: its scenes, presets, defaults and levels of effort.

A task's ``config_package`` holds ``task/NAME.yaml``, ``scene/NAME/*.yaml``, ``preset/NAME/*.yaml`` and optionally
``effort/NAME.yaml``; NAME is the task, because several tasks have a scene of the same name. A preset or scene may
extend others in its folder, as in Hydra: ``defaults: [paper, _self_]``.

``effort/NAME.yaml`` has settings for each level of effort, 1 to 9::

    preset: quick                # the preset that the levels change
    levels:
      1: {model.primitives: 700, train.iterations: 300}
      ...
      9: {model.primitives: 12000, train.iterations: 80000}
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from importlib.resources.abc import Traversable
from typing import TYPE_CHECKING, Any

from neuprim.config.overrides import Assignment, quote_override
from neuprim.config.setting_checks import complete_task_options
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.validation import format_setting_value, validate_setting_names

if TYPE_CHECKING:
    from neuprim.core.task import TaskSpec

DEFAULT_PRESET = "quick"
EFFORT = "effort"
LEVELS = range(1, 10)
PRESET_GROUPS = ("model", "train", "renderer")
"""Groups of settings that a preset or level may set."""


@dataclass(frozen=True)
class TaskChoices:
    """Content of ``task/NAME.yaml``: default scene and preset of the task, and defaults of the task's own options."""

    scene: str
    preset: str
    options: dict[str, Any]


@dataclass(frozen=True)
class Level:
    """A level of effort, 1 (fast) to 9 (good): the name of a preset, and settings that replace values of the preset."""

    preset: str
    settings: tuple[Assignment, ...]


def read_task_config(spec: TaskSpec) -> TaskChoices:
    """Read ``task/NAME.yaml``; raise ConfigError if it names a scene, preset or option that the task lacks."""
    place = f"task/{spec.name}.yaml"
    who = f"task {spec.name!r}: {place}"
    node = read_task_yaml(find_config_package(spec) / place, who)
    try:
        validate_setting_names(node, ("scene", "preset", "options"), "")
        scene, preset = node.get("scene") or spec.scenes[0].name, node.get("preset") or DEFAULT_PRESET
        for key, value, names in (
            ("scene", scene, [s.name for s in spec.scenes]),
            ("preset", preset, list_task_presets(spec)),
        ):
            if value not in names:
                raise ConfigError(f"{key}={value}: no such {key}" + nearest(str(value), names))
        options = complete_task_options(spec.options, node.get("options") or {}, "its TaskSpec", "options")
    except ConfigError as error:
        raise ConfigError(f"{who}: {error}") from error
    return TaskChoices(scene, preset, options)


def list_task_presets(spec: TaskSpec) -> list[str]:
    """Return the names of a task's presets."""
    folder = find_config_package(spec) / "preset" / spec.name
    entries = folder.iterdir() if folder.is_dir() else ()
    return sorted(entry.name.removesuffix(".yaml") for entry in entries if entry.name.endswith(".yaml"))


def check_config_groups(spec: TaskSpec) -> None:
    """Raise ConfigError if a task's configuration package cannot be used, or lacks a file that a run would need."""
    who = f"task {spec.name!r}"
    if not spec.scenes:
        raise ConfigError(f"{who}: its TaskSpec has no scenes; expected at least one")
    places = [f"task/{spec.name}.yaml", *(f"scene/{spec.name}/{scene.name}.yaml" for scene in spec.scenes)]
    for place in places:
        _require_config_file(spec.config_package, place, who)
    if not list_task_presets(spec):
        raise ConfigError(f"{who}: {spec.config_package} has no preset/{spec.name}/*.yaml")


def check_scene_config(spec: TaskSpec, scene: str, package: str) -> None:
    """Raise ConfigError if ``package``, which adds ``scene`` to a task, has no YAML file for the scene."""
    _require_config_file(package, f"scene/{spec.name}/{scene}.yaml", f"scene {scene!r} of task {spec.name!r}")


def _require_config_file(package: str, place: str, who: str) -> None:
    if not (_open_config_package(package, who) / place).is_file():
        raise ConfigError(f"{who}: {package} has no {place}")


def find_config_package(spec: TaskSpec) -> Traversable:
    """Return the folder of a task's YAML files. Raise ConfigError if the package that holds it cannot be opened."""
    return _open_config_package(spec.config_package, f"task {spec.name!r}")


def read_config_group(spec: TaskSpec, group: str, name: str, package: str | None = None) -> dict[str, Any]:
    """Return the settings in a scene's or preset's YAML file, merged over the files that its entry ``defaults`` lists.

    References ``${...}`` are not resolved.

    Args:
        group: "scene" or "preset".
        name: name of the scene or preset.
        package: package that holds the YAML file; None for the task's own.
    """
    root = find_config_package(spec) if package is None else _open_config_package(package, f"scene {name!r}")
    return _read_with_defaults(root, f"{group}/{spec.name}", name, f"task {spec.name!r}: ", ())


def _read_with_defaults(
    root: Traversable, folder: str, name: str, who: str, readers: tuple[str, ...]
) -> dict[str, Any]:
    from omegaconf import OmegaConf

    place = f"{folder}/{name}.yaml"
    if name in readers:
        raise ConfigError(
            f"{who}{place}: defaults: the file includes itself, maybe through other files; remove one of these defaults"
        )
    own = read_task_yaml(root / folder / f"{name}.yaml", f"{who}{place}")
    names = own.pop("defaults", ["_self_"])
    if not isinstance(names, list) or not all(isinstance(entry, str) for entry in names):
        raise ConfigError(f"{who}{place}: defaults={format_setting_value(names)}: expected a list of file names")
    names += [] if "_self_" in names else ["_self_"]
    parts = [own if n == "_self_" else _read_with_defaults(root, folder, n, who, (*readers, name)) for n in names]
    return omegaconf_to_plain(OmegaConf.merge(*parts), resolve=False)


def read_task_yaml(file: Traversable, who: str) -> dict[str, Any]:
    """Read a YAML file of a task's package as a mapping; error messages begin with ``who``."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException
    from yaml import YAMLError

    try:
        node = OmegaConf.create(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, OmegaConfBaseException, YAMLError) as error:
        raise ConfigError(f"{who} cannot be read ({' '.join(str(error).split())})") from error
    return omegaconf_to_plain(node, resolve=False, who=who)


def omegaconf_to_plain(node: Any, resolve: bool = True, who: str = "configuration") -> dict[str, Any]:
    """Convert an OmegaConf mapping to plain values; error messages begin with ``who``."""
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        plain = OmegaConf.to_container(node, resolve=resolve)
    except OmegaConfBaseException as error:
        text = str(error).strip().splitlines()[0]
        raise ConfigError(f"{getattr(error, 'full_key', None) or who}: {text}") from error
    if not isinstance(plain, dict):
        raise ConfigError(f"{who}: expected a mapping, found a {type(plain).__name__}")
    return {str(key): value for key, value in plain.items()}


def _open_config_package(name: str, who: str) -> Traversable:
    try:
        return resources.files(name)
    except (Exception, SystemExit) as error:  # importing a package can fail in any way
        text = " ".join(str(error).split())
        raise ConfigError(f"{who}: cannot open its config_package {name!r} ({text})") from error


# ---------------------------------------------------------------- levels of effort


def choose_config_effort_level(
    spec: TaskSpec, chosen: str | None, preset: str | None, presets: Sequence[str]
) -> Level | None:
    """Return the level of effort that the user chose; None if ``chosen`` is None.

    ``chosen`` is the text after ``effort=``, 1 (fast) to 9 (good). ``presets`` are the task's presets. Raise
    ConfigError if there is no such level, or the user typed a ``preset`` other than the level's.
    """
    if chosen is None:
        return None
    if chosen not in map(str, LEVELS):
        raise ConfigError(f"{EFFORT}={chosen}: expected a level from {LEVELS[0]} (fast) to {LEVELS[-1]} (good)")
    levels = read_config_effort_levels(spec, presets)
    typed = f"{EFFORT}={chosen}"
    if levels is None:
        instead = "set model.primitives=N and train.iterations=N instead"
        raise ConfigError(f"{typed}: task {spec.name!r} has no effort levels; {instead}")
    level = levels[int(chosen)]
    if preset not in (None, level.preset):
        found = f"this level of task {spec.name!r} uses preset={level.preset}, not preset={preset}"
        raise ConfigError(f"{typed}: {found}; leave out {EFFORT} or preset")
    return level


def read_config_effort_levels(spec: TaskSpec, presets: Sequence[str]) -> Mapping[int, Level] | None:
    """Return number (1 to 9) -> level of effort; None if the task has no levels. ``presets``: names of its presets."""
    place = f"effort/{spec.name}.yaml"
    file = find_config_package(spec) / place
    if not file.is_file():
        return None
    who = f"task {spec.name!r}: {place}"
    node = read_task_yaml(file, who)
    try:
        return _parse_config_effort_levels(node, presets)
    except ConfigError as error:
        raise ConfigError(f"{who}: {error}") from error


def _parse_config_effort_levels(node: Mapping[str, Any], presets: Sequence[str]) -> dict[int, Level]:
    validate_setting_names(node, ("preset", "levels"), "")
    preset, levels = node.get("preset"), node.get("levels")
    if preset not in presets:
        raise ConfigError(f"preset={format_setting_value(preset)}: no such preset{nearest(str(preset), presets)}")
    if not isinstance(levels, Mapping) or list(levels) != list(LEVELS):
        found = format_setting_value(list(levels) if isinstance(levels, Mapping) else levels)
        raise ConfigError(f"levels: found {found}; expected the keys {LEVELS[0]} to {LEVELS[-1]}, in this order")
    made = {}
    for number, given in levels.items():
        if not isinstance(given, Mapping) or any(str(key).partition(".")[0] not in PRESET_GROUPS for key in given):
            groups = "settings of model, train and renderer by their dotted keys"
            raise ConfigError(f"levels.{number}: found {format_setting_value(given)}; expected {groups}")
        settings = tuple(Assignment(key, value, quote_override(key, value)) for key, value in given.items())
        made[number] = Level(str(preset), settings)
    return made
