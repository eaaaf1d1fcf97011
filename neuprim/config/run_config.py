"""The typed configuration of one run, its YAML form, and the task and scene plugins that it names."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import yaml

from neuprim.core.errors import CheckpointError, ConfigError
from neuprim.core.io.json_reader import parse_yaml_file
from neuprim.core.render import backends
from neuprim.core.settings import MetricsSettings, RenderSettings
from neuprim.core.train import population
from neuprim.core.train.settings import OPTIONAL, ModelSettings, TrainSettings
from neuprim.core.validation import Range, join_setting_key, validate_fields, validate_settings
from neuprim.plugins.attribution import RunPlugins
from neuprim.plugins.provenance import Provenance, load_recorded_plugin
from neuprim.plugins.registry import LOSSES, SCENES, TASKS, FoundScene, find_registered_scene, split_plugin_name

if TYPE_CHECKING:
    from neuprim.core.task import TaskSpec

_MAX_BYTES = 1_000_000
"""Largest size of a configuration file in bytes. A real configuration has a few kilobytes."""


@dataclass
class RunSettings:
    """The part of the configuration that is the same for every task; defaults are a run's defaults.

    Attributes:
        output_dir: directory of the run, on the command line ``--out DIR``; null for a new directory in ``outputs``.
        seed: seed of every random number of the run.
        resume: continue the run in its directory from the checkpoint.
    """

    model: ModelSettings = field(default_factory=ModelSettings)  # settings under model
    train: TrainSettings = field(default_factory=TrainSettings)  # settings under train
    renderer: RenderSettings = field(default_factory=lambda: RenderSettings(near="auto"))  # settings under renderer
    metrics: MetricsSettings = field(default_factory=MetricsSettings)  # settings under metrics
    output_dir: str | None = None
    seed: Annotated[int, Range(0, 2**63 - 1, says="a whole number from 0 to 2^63 - 1")] = 0
    resume: bool = False

    def __post_init__(self) -> None:
        validate_fields(self, "")
        backends.check_backend_name(self.renderer.backend)
        backends.check_backend_device(self.renderer)
        population.check_strategy(self.train.population.strategy)


@dataclass
class RunConfig:
    """All settings of a run, validated.

    Attributes:
        scene: settings of the scene, as the scene's loader takes them.
        options: settings of the task and its loss (``task.options``).
        unused: names of the shared settings that nothing in this run reads; ``config.yaml`` omits them.
        output_dir: directory of the run; it need not exist yet.
        seed: seed of every random number of the run.
        resume: whether to continue from the checkpoint in ``output_dir``, if there is one.
        overrides: overrides that the user typed.
        non_default: dotted key -> (value without overrides, value of this run), for settings where the two differ.
        source: file that the configuration was read from; None for a new configuration.
        made_by: packages and versions of task, scene and loss.
    """

    task: str  # name of the task
    scene_name: str  # name of the scene
    scene: dict[str, Any]
    preset: str  # name of the preset
    model: ModelSettings
    train: TrainSettings
    renderer: RenderSettings
    output_dir: Path
    made_by: Provenance
    metrics: MetricsSettings = field(default_factory=MetricsSettings)
    seed: int = 0
    resume: bool = False
    options: dict[str, Any] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    overrides: list[str] = field(default_factory=list)
    non_default: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    source: Path | None = field(default=None, compare=False)

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration as plain nested values, with the keys of the command line."""
        tree: dict[str, Any] = {
            "task": {"name": self.task, "options": self.options},
            "scene": {"name": self.scene_name, **self.scene},
            "preset": self.preset,
            "model": dataclasses.asdict(self.model),
            "train": dataclasses.asdict(self.train),
            "renderer": dataclasses.asdict(self.renderer),
            "metrics": dataclasses.asdict(self.metrics),
            "output_dir": str(self.output_dir),
            "seed": self.seed,
            "resume": self.resume,
            "overrides": list(self.overrides),
            "non_default": {key: list(pair) for key, pair in self.non_default.items()},
            "made_by": self.made_by.to_dict(),
        }
        for name in self.unused:
            group, _, key = name.partition(".")
            del tree[group][key]
        return tree

    def override(self, values: Mapping[str, Any]) -> RunConfig:
        """Return a copy in which ``values``, dotted key -> value, replace settings; :attr:`non_default` is updated."""
        tree = self.to_dict()
        for key, value in values.items():
            *path, name = key.split(".")
            group = reduce(lambda node, part: node[part], path, tree)
            default = tree["non_default"].pop(key, (group.get(name), None))[0]
            group[name] = value
            if value != default:
                tree["non_default"][key] = [default, value]
        return dataclasses.replace(RunConfig.from_dict(tree), source=self.source)

    def to_yaml(self) -> str:
        """Return the resolved configuration as YAML text; :meth:`from_yaml` restores it unchanged."""
        return yaml.dump(self.to_dict(), Dumper=_PlainDumper, sort_keys=False, allow_unicode=True, width=120)

    @classmethod
    def from_yaml(cls, path: str | Path) -> RunConfig:
        """Read the configuration from a run's ``config.yaml``; no code in the file is executed.

        Args:
            path: the file or the run directory.

        Raises:
            CheckpointError: there is no such file, or it is not a run's configuration.
            ConfigError: a setting in the file does not exist or has an invalid value.
        """
        file = Path(path)
        if file.is_dir():
            file = file / "config.yaml"
        elif file.name != "config.yaml" and not file.exists():
            raise CheckpointError(f"{path}: no such run directory")
        data = _read_config_yaml(file)
        try:
            return dataclasses.replace(cls.from_dict(data), source=file)
        except ConfigError as error:
            raise ConfigError(f"{file}: {error}") from error

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> RunConfig:
        """Make a configuration from the values that :meth:`to_dict` returned.

        Raises:
            ConfigError: a setting in ``data`` does not exist or has an invalid value.
        """
        stored_keys = flatten(data)
        unused = tuple(name for name in OPTIONAL if name not in stored_keys)
        stored = validate_settings(_StoredConfig, data)
        if stored.output_dir is None:
            raise ConfigError("output_dir: missing; expected a directory")
        scene = dict(stored.scene)
        scene_name = scene.pop("name", None)
        if not isinstance(scene_name, str):
            raise ConfigError("scene.name: missing; expected a name")
        loss = None if stored.train.loss is None else split_plugin_name(stored.train.loss)[1]
        names = {
            "task": ("task.name", stored.task.name),
            "scene": ("scene.name", scene_name),
            "loss": ("train.loss", loss),
        }
        for kind, plugin in stored.made_by.plugins.items():
            key, name = names[kind]
            if plugin.name != name:
                raise ConfigError(f"made_by.{kind}.name: found {plugin.name!r}; expected {name!r}, the value of {key}")
        same = "preset model train renderer metrics seed resume overrides non_default made_by".split()
        return cls(
            task=stored.task.name,
            scene_name=scene_name,
            scene=scene,
            output_dir=Path(stored.output_dir),
            options=stored.task.options,
            unused=unused,
            **{name: getattr(stored, name) for name in same},
        )


@dataclass
class _StoredTask:
    """The entries under ``task`` in ``config.yaml``."""

    name: str
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(kw_only=True)
class _StoredConfig(RunSettings):
    """The content of a run's ``config.yaml``."""

    task: _StoredTask
    scene: dict[str, Any]
    preset: str
    made_by: Provenance
    overrides: list[str] = field(default_factory=list)
    non_default: dict[str, tuple[Any, Any]] = field(default_factory=dict)


class _PlainDumper(yaml.SafeDumper):
    """YAML dumper that never uses anchors and aliases: a value that occurs twice is written twice."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _read_config_yaml(file: Path) -> Mapping[str, Any]:
    try:
        if file.stat().st_size > _MAX_BYTES:
            raise CheckpointError(f"{file}: larger than {_MAX_BYTES} bytes; not a run's configuration")
        data = parse_yaml_file(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise CheckpointError(f"{file}: missing; expected a directory written by `neuprim run`") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f" line {mark.line + 1}" if mark is not None else ""
        problem = getattr(error, "problem", None) or "not YAML"
        raise CheckpointError(f"{file}{place}: damaged configuration ({problem})") from error
    except (OSError, UnicodeDecodeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{file}: cannot be read ({type(error).__name__}: {error})") from error
    if not isinstance(data, Mapping):
        raise CheckpointError(f"{file}: not a run's configuration (expected a mapping, found {type(data).__name__})")
    return data


def flatten(node: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Return dotted key -> value of nested settings; ``where`` is the dotted key of ``node`` itself, "" at the top."""
    found: dict[str, Any] = {}
    for key, value in node.items():
        name = join_setting_key(where, str(key))
        found |= flatten(value, name) if isinstance(value, Mapping) else {name: value}
    return found


# ---------------------------------------------------------------- the plugins of a run


@dataclass(frozen=True)
class Job:
    """A run's configuration with its loaded task, so that the task is loaded only once."""

    config: RunConfig
    task: TaskSpec

    @classmethod
    def of(cls, config: RunConfig) -> Job:
        """Return the job of a configuration: load its task, and keep the conditions that the run's scene has.

        Conditions are inputs of an image besides the camera, e.g. time. Raises the errors of :func:`load_config_task`.
        """
        task = load_config_task(config, config.source)
        conditions = tuple(spec for spec in task.conditions if spec.of_scene(config.scene))
        return cls(config, task if conditions == task.conditions else replace(task, conditions=conditions))

    @property
    def scene(self) -> FoundScene:
        """The run's scene, and the package that provides it: the package of the task or another."""
        return find_config_scene(self.config, self.task, self.config.source)

    @property
    def plugins(self) -> RunPlugins:
        """Names and packages of the run's plugins (task, scene, loss), for messages about errors in their code."""
        return find_config_plugins(self.config)


def load_config_task(config: RunConfig, file: Path | None = None) -> TaskSpec:
    """Load a run's task from the package that made the run; warn if another version of the package is installed.

    Raises:
        ConfigError: the package is not installed. The message names ``file``, the source of the configuration.
        PluginError: the task is broken.
    """
    return load_recorded_plugin(TASKS, config.made_by.task, file)[1]


def find_config_scene(config: RunConfig, task: TaskSpec, file: Path | None = None) -> FoundScene:
    """Find a run's scene, among the task's own scenes or the scenes that other packages add to the task.

    Raises the errors of :func:`load_config_task`.
    """
    if config.made_by.scene is None:
        own = [scene for scene in task.scenes if scene.name == config.scene_name]
        return FoundScene(own[0], task.config_package) if own else find_registered_scene(task, config.scene_name)
    info, extension = load_recorded_plugin(SCENES, config.made_by.scene, file, f"{config.task}.{config.scene_name}")
    return FoundScene(extension.scene, extension.config_package, info)


def current_config_provenance(config: RunConfig, task: TaskSpec) -> Provenance:
    """Return the record of the packages that provide a run's task, scene and loss, with the versions installed now."""
    task_info = TASKS.find(config.made_by.task.qualified_name)
    loss = None if config.train.loss is None else LOSSES.find(config.train.loss)
    return Provenance.of_installed(task_info, find_config_scene(config, task), loss)


def find_config_plugins(config: RunConfig) -> RunPlugins:
    """Return names and packages of a run's task, scene and loss, for messages about errors in their code."""
    made = config.made_by
    scene = config.scene_name if made.scene is None else made.scene.qualified_name
    return RunPlugins(made.task.qualified_name, scene, config.train.loss)


def refuse_missing_config_plugins(config: RunConfig) -> None:
    """Raise ConfigError if a package that made a stored run is not installed."""
    find_config_scene(config, load_config_task(config, config.source), config.source)
    if config.made_by.loss is not None:
        load_recorded_plugin(LOSSES, config.made_by.loss, config.source)
