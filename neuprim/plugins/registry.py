"""Plugins by name, from entry points: tasks, and scenes, losses, exporters and inspectors for the tasks of others.

The built-in ones come through the same groups as anybody's. Listing reads package metadata only; a plugin is imported when
it is asked for, so a broken one stops nothing but itself. See :mod:`neuprim.plugins.mechanism`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from neuprim.core.errors import ConfigError, nearest
from neuprim.plugins.mechanism import Group, PluginError, PluginInfo, PluginReport

if TYPE_CHECKING:  # importing the interfaces imports torch, which listing does not need
    from neuprim.core.extensions import Exporter, Inspector, LossExtension, SceneExtension
    from neuprim.core.task import SceneSpec, TaskSpec

__all__ = [
    "ALL",
    "EXPORTERS",
    "INSPECTORS",
    "LOSSES",
    "SCENES",
    "TASKS",
    "FoundScene",
    "Group",
    "PluginError",
    "PluginInfo",
    "PluginReport",
    "find_scene",
    "list_exporters",
    "list_inspectors",
    "list_losses",
    "list_scenes",
    "list_tasks",
    "load_exporter",
    "load_inspector",
    "load_loss",
    "load_task",
    "scene_names",
    "survey",
]

TASKS: Group[TaskSpec] = Group("neuprim.tasks", "task", "task={}", "neuprim.core.task:TaskSpec")
SCENES: Group[SceneExtension] = Group(
    "neuprim.scenes", "scene", "scene {}", "neuprim.core.extensions:SceneExtension", lambda s: f"{s.task}.{s.scene.name}"
)
"""Entry points here are called ``TASK.SCENE``, so that metadata alone says what there is for a task."""
LOSSES: Group[LossExtension] = Group("neuprim.losses", "loss", "train.loss={}", "neuprim.core.extensions:LossExtension")
EXPORTERS: Group[Exporter] = Group("neuprim.exporters", "exporter", "--format {}", "neuprim.core.extensions:Exporter")
INSPECTORS: Group[Inspector] = Group("neuprim.inspectors", "inspector", "--show {}", "neuprim.core.extensions:Inspector")

# ---------------------------------------------------------------- tasks


def list_tasks() -> list[PluginInfo]:
    """All registered tasks by name, without importing any; a name claimed twice is listed twice."""
    return TASKS.listed()


def load_task(name: str) -> TaskSpec:
    """The task of that name; imports it and no other.

    Raises:
        ConfigError: no such task.
        PluginError: the name is claimed twice, or its plugin is broken or was written for another version.
    """
    return TASKS.load(name)


def survey() -> list[PluginReport[TaskSpec]]:
    """Every registered task, loaded one by one; the broken ones come with their error."""
    return TASKS.survey()


# ---------------------------------------------------------------- scenes


@dataclass(frozen=True)
class FoundScene:
    """A scene of a task, from the task's own package or another.

    Attributes:
        config_package: the package that holds its ``scene/TASK/NAME.yaml``.
    """

    spec: SceneSpec
    config_package: str


def list_scenes(task: str | None = None) -> list[PluginInfo]:
    """Scenes that packages add to tasks of others (to ``task`` only, if given), without importing any; named ``TASK.SCENE``."""
    return [info for info in SCENES.listed() if task is None or info.name.startswith(f"{task}.")]


def scene_names(task: TaskSpec) -> list[str]:
    """Names of all scenes of a task: its own ones, then those that other packages add."""
    own = [scene.name for scene in task.scenes]
    return [*own, *dict.fromkeys(n for n in (i.name.removeprefix(f"{task.name}.") for i in list_scenes(task.name)) if n not in own)]


def find_scene(task: TaskSpec, name: str) -> FoundScene:
    """The scene of that name, the task's own or one that another package adds; imports no other.

    Raises:
        ConfigError: there is none.
        PluginError: two packages claim the name, or the one that adds it is broken.
    """
    own = [scene for scene in task.scenes if scene.name == name]
    key = f"{task.name}.{name}"
    added = [info for info in list_scenes(task.name) if info.name == key]
    if own and added:
        claims = [*(info for info in list_tasks() if info.name == task.name), *added]
        raise PluginError(SCENES.clash(key, claims))
    if own:
        return FoundScene(own[0], task.config_package)
    if not added:
        raise ConfigError(f"scene={name}: task {task.name!r} has no such scene{nearest(name, scene_names(task))}")
    extension = SCENES.load(key)
    return FoundScene(extension.scene, extension.config_package)


# ---------------------------------------------------------------- losses, exporters, inspectors


def list_losses() -> list[PluginInfo]:
    """Losses for any task, without importing any."""
    return LOSSES.listed()


def load_loss(name: str) -> LossExtension:
    """The loss of that name; raises as :func:`load_task`."""
    return LOSSES.load(name)


def list_exporters() -> list[PluginInfo]:
    """Export formats, without importing any."""
    return EXPORTERS.listed()


def load_exporter(name: str) -> Exporter:
    """The export format of that name; raises as :func:`load_task`."""
    return EXPORTERS.load(name)


def list_inspectors() -> list[PluginInfo]:
    """Ways of showing a density, without importing any."""
    return INSPECTORS.listed()


def load_inspector(name: str) -> Inspector:
    """The way of showing a density of that name; raises as :func:`load_task`."""
    return INSPECTORS.load(name)


ALL: tuple[Group[Any], ...] = (TASKS, SCENES, LOSSES, EXPORTERS, INSPECTORS)
