"""Plugins by name, from entry points: tasks, and scenes, losses, exporters and inspectors for the tasks of others.

The built-in ones come through the same groups as anybody's. Listing reads package metadata only; a plugin is imported
when it is asked for, so a broken one stops nothing but itself. A name is ``NAME``, or ``PACKAGE:NAME`` for the plugin
of one package; a bare name that a built-in has is the built-in's. See :mod:`neuprim.plugins.mechanism`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from neuprim.core.errors import nearest
from neuprim.core.notices import warn_once
from neuprim.plugins.editable import not_installed_yet
from neuprim.plugins.mechanism import Group, PluginError, PluginInfo, PluginReport, UnknownPlugin
from neuprim.plugins.names import normalised, split

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
    "UnknownPlugin",
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
    "neuprim.scenes",
    "scene",
    "scene={}",
    "neuprim.core.extensions:SceneExtension",
    lambda s: f"{s.task}.{s.scene.name}",
    lambda name: name.partition(".")[2],
)
"""Entry points here are called ``TASK.SCENE``, so that metadata alone says what there is for a task."""
LOSSES: Group[LossExtension] = Group("neuprim.losses", "loss", "train.loss={}", "neuprim.core.extensions:LossExtension")
EXPORTERS: Group[Exporter] = Group("neuprim.exporters", "exporter", "--format {}", "neuprim.core.extensions:Exporter")
INSPECTORS: Group[Inspector] = Group(
    "neuprim.inspectors", "inspector", "--show {}", "neuprim.core.extensions:Inspector"
)

# ---------------------------------------------------------------- tasks


def list_tasks() -> list[PluginInfo]:
    """All registered tasks by name, without importing any; a name claimed twice is listed twice."""
    return TASKS.listed()


def load_task(name: str) -> TaskSpec:
    """The task that ``NAME`` or ``PACKAGE:NAME`` chooses; imports it and no other.

    Raises:
        UnknownPlugin: no such task.
        PluginError: two packages claim the bare name, or the plugin is broken or was written for another version.
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
        added_by: who adds it; None for the task's own.
    """

    spec: SceneSpec
    config_package: str
    added_by: PluginInfo | None = None


def list_scenes(task: str | None = None) -> list[PluginInfo]:
    """Scenes that packages add to tasks of others (to ``task`` only, if given), without importing any; named
    ``TASK.SCENE``."""
    return [info for info in SCENES.listed() if task is None or info.name.startswith(f"{task}.")]


def scene_names(task: TaskSpec) -> list[str]:
    """Names of all scenes of a task: its own ones, then those that other packages add."""
    own = [scene.name for scene in task.scenes]
    return [
        *own,
        *dict.fromkeys(
            n for n in (i.name.removeprefix(f"{task.name}.") for i in list_scenes(task.name)) if n not in own
        ),
    ]


def find_scene(task: TaskSpec, word: str) -> FoundScene:
    """The scene that ``NAME`` or ``PACKAGE:NAME`` chooses, the task's own or one that another package adds; imports no
    other.

    A bare name is the task's own scene where it has one; a package that adds another of that name is named in a
    warning.

    Raises:
        UnknownPlugin: there is none.
        PluginError: two packages add the name, or the one that adds it is broken.
    """
    package, name = split(word)
    own = [scene for scene in task.scenes if scene.name == name]
    if own and package is None:
        for info in list_scenes(task.name):
            if info.name == f"{task.name}.{name}":
                warn_once(SCENES.hidden(info, f"one of task {task.name!r} itself"))
    if own and (package is None or package == _package_of(task)):
        return FoundScene(own[0], task.config_package)
    added = f"{task.name}.{name}" if package is None else f"{package}:{task.name}.{name}"
    try:
        info, extension = SCENES.loaded(added)
    except UnknownPlugin:
        offered = scene_names(task)
        if package is not None:
            offered = [scene.name for scene in task.scenes] if package == _package_of(task) else []
            offered += [
                SCENES.typed_name(i.name) for i in list_scenes(task.name) if normalised(i.distribution) == package
            ]
        whose = f"task {task.name!r} has no such scene" + (f" of {package}" if package else "")
        late = not_installed_yet(SCENES.entry_points, f"{task.name}.{name}", package)
        raise UnknownPlugin(f"scene={word}: {whose}{nearest(name, offered)}{late}") from None
    return FoundScene(extension.scene, extension.config_package, info)


def _package_of(task: TaskSpec) -> str | None:
    owner = TASKS.owner(task)
    return None if owner is None else normalised(owner.distribution)


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
