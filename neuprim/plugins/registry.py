"""Tasks by name, from the entry-point group ``neuprim.tasks``.

The built-in tasks come through the same group as anybody's. Listing reads package metadata only; a task is imported when
it is asked for, so a broken plugin stops nothing but itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import TYPE_CHECKING

from neuprim.core.errors import ConfigError, NeuprimError, nearest

if TYPE_CHECKING:  # importing the interfaces imports torch, which listing does not need
    from neuprim.core.task import TaskSpec

__all__ = ["GROUP", "PluginError", "TaskInfo", "TaskReport", "list_tasks", "load_task", "survey"]

GROUP = "neuprim.tasks"


class PluginError(NeuprimError):
    """A plugin is installed but cannot be used; the message names plugin, distribution and reason."""


@dataclass(frozen=True)
class TaskInfo:
    """What package metadata says about a task.

    Attributes:
        name: what the user types after ``task=``.
        distribution, version: the installed package that registers it.
        target: ``module:attribute`` of its :class:`~neuprim.core.task.TaskSpec`.
    """

    name: str
    distribution: str
    version: str
    target: str

    @property
    def origin(self) -> str:
        """For example ``"neuprim 0.1.0"``."""
        return f"{self.distribution} {self.version}".strip()


@dataclass(frozen=True)
class TaskReport:
    """One registered task, loaded, or the reason it could not be."""

    info: TaskInfo
    spec: TaskSpec | None = None
    error: str | None = None


def list_tasks() -> list[TaskInfo]:
    """All registered tasks by name, without importing any; a name claimed twice is listed twice."""
    return sorted((info for info, _ in _registered()), key=lambda i: (i.name, i.distribution))


def load_task(name: str) -> TaskSpec:
    """The task of that name; imports it and no other.

    Raises:
        ConfigError: no such task.
        PluginError: the name is claimed twice, or its plugin is broken or was written for another version.
    """
    found = [(info, entry) for info, entry in _registered() if info.name == name]
    if not found:
        names = {info.name for info, _ in _registered()}
        hint = nearest(name, names) or "; no task is installed (reinstall neuprim)"
        raise ConfigError(f"task={name}: no such task{hint}")
    if len(found) > 1:
        raise PluginError(_clash(name, [info for info, _ in found]))
    return _load(*found[0])


def survey() -> list[TaskReport]:
    """Every registered task, loaded one by one; the broken ones come with their error."""
    reports = []
    registered = sorted(_registered(), key=lambda pair: (pair[0].name, pair[0].distribution))
    for info, entry in registered:
        same = [other for other, _ in registered if other.name == info.name]
        if len(same) > 1:
            reports.append(TaskReport(info, error=_clash(info.name, same)))
            continue
        try:
            reports.append(TaskReport(info, spec=_load(info, entry)))
        except PluginError as error:
            reports.append(TaskReport(info, error=str(error)))
    return reports


def _registered() -> list[tuple[TaskInfo, metadata.EntryPoint]]:
    result = []
    for entry in metadata.entry_points(group=GROUP):
        dist = entry.dist
        name = dist.metadata["Name"] if dist is not None else "unknown distribution"
        version = dist.version if dist is not None else ""
        result.append((TaskInfo(entry.name, name or "unnamed distribution", version or "", entry.value), entry))
    return result


def _load(info: TaskInfo, entry: metadata.EntryPoint) -> TaskSpec:
    from neuprim.core.task import API_VERSION, TaskSpec

    who = f"task {info.name!r} of {info.origin}"
    try:
        spec = entry.load()
    except (Exception, SystemExit) as error:  # whatever a plugin does when imported is its own fault, and must be named
        text = " ".join(str(error).split())
        raise PluginError(f"{who}: cannot import {info.target}: {type(error).__name__}: {text}") from error
    if not isinstance(spec, TaskSpec):
        raise PluginError(f"{who}: {info.target} is of type {type(spec).__name__}; expected a neuprim.core.task.TaskSpec")
    if spec.api != API_VERSION:
        older = isinstance(spec.api, int) and spec.api < API_VERSION
        todo = f"upgrade {info.distribution}" if older else "upgrade neuprim"
        raise PluginError(f"{who}: written for plugin API {spec.api}, this neuprim has {API_VERSION}; {todo}")
    if spec.name != info.name:
        raise PluginError(f"{who}: its TaskSpec is named {spec.name!r}; the entry point and the TaskSpec must agree")
    return spec


def _clash(name: str, claims: Sequence[TaskInfo]) -> str:
    origins = " and ".join(sorted(f"{info.origin} ({info.target})" for info in claims))
    return f"task {name!r} is registered by {origins}; uninstall one of them"
