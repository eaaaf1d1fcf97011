"""A run to do or to open: its configuration, and the task and scene of the packages that made it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from neuprim.config.run_config import RunConfig
from neuprim.plugins.attribution import RunPlugins
from neuprim.plugins.provenance import Provenance, load_recorded_plugin
from neuprim.plugins.registry import LOSSES, SCENES, TASKS, FoundScene, find_registered_scene

if TYPE_CHECKING:
    from neuprim.core.task import TaskSpec


@dataclass(frozen=True)
class Job:
    """A configuration with the task that its name stands for, looked up once and handed on together."""

    config: RunConfig
    task: TaskSpec

    @classmethod
    def of(cls, config: RunConfig) -> Job:
        """Load the task of a configuration. Raises as :func:`load_config_task`."""
        return cls(config, load_config_task(config, config.source))

    @property
    def scene(self) -> FoundScene:
        """The scene, of the task or of another package."""
        return find_config_scene(self.config, self.task, self.config.source)

    @property
    def plugins(self) -> RunPlugins:
        """The plugins of the run, which errors in their code name."""
        return find_config_plugins(self.config)


def load_config_task(config: RunConfig, file: Path | None = None) -> TaskSpec:
    """Load the task of a run's configuration from the package that made the run; warn of another version of it.

    Raises:
        ConfigError: the package is not installed; names it and ``file``, where the configuration was read from.
        PluginError: the task is broken.
    """
    return load_recorded_plugin(TASKS, config.made_by.task, file)[1]


def find_config_scene(config: RunConfig, task: TaskSpec, file: Path | None = None) -> FoundScene:
    """Find the scene of a run's configuration, the task's own or of the package that made the run.

    Raises as :func:`load_config_task`.
    """
    if config.made_by.scene is None:
        own = [scene for scene in task.scenes if scene.name == config.scene_name]
        return FoundScene(own[0], task.config_package) if own else find_registered_scene(task, config.scene_name)
    info, extension = load_recorded_plugin(SCENES, config.made_by.scene, file, f"{config.task}.{config.scene_name}")
    return FoundScene(extension.scene, extension.config_package, info)


def current_config_provenance(config: RunConfig, task: TaskSpec) -> Provenance:
    """Return the record of a run that starts or goes on now: the same packages, in the versions that are installed."""
    task_info = TASKS.find(config.made_by.task.qualified_name)
    loss = None if config.train.loss is None else LOSSES.find(config.train.loss)
    return Provenance.of_installed(task_info, find_config_scene(config, task), loss)


def find_config_plugins(config: RunConfig) -> RunPlugins:
    """Find the plugins of a run, which errors in their code name."""
    made = config.made_by
    scene = config.scene_name if made.scene is None else made.scene.qualified_name
    return RunPlugins(made.task.qualified_name, scene, config.train.loss)


def refuse_missing_config_plugins(config: RunConfig) -> None:
    """Raise ConfigError for a package that made a stored run and is not installed."""
    find_config_scene(config, load_config_task(config, config.source), config.source)
    if config.made_by.loss is not None:
        load_recorded_plugin(LOSSES, config.made_by.loss, config.source)
