"""Find and load plugins: tasks, scenes, losses, exporters and inspectors, registered as entry points.

Built-in plugins are registered like the plugins of any other package. Listing plugins reads package metadata only. A
plugin is imported when it is chosen by name, so a broken plugin does not affect other plugins.

Users choose a plugin by ``NAME`` or ``PACKAGE:NAME``. If there is a built-in plugin of that name, a bare name means
the built-in plugin, even if other packages register the name, too.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from packaging.utils import canonicalize_name

from neuprim.core.errors import ConfigError, NeuprimError, nearest, warn_once

if TYPE_CHECKING:  # these modules import torch, which listing does not need
    from neuprim.core.extensions import Exporter, Inspector, LossExtension, SceneExtension
    from neuprim.core.task import SceneSpec, TaskSpec

T = TypeVar("T")

__all__ = ["FoundScene", "PluginError", "UnknownPlugin", "find_registered_scene", "load_task"]

BUILT_IN = "neuprim"
"""The distribution whose plugins are the built-in ones."""


class PluginError(NeuprimError):
    """A plugin is installed but cannot be used; the message names the plugin, its package and the reason."""


class UnknownPlugin(ConfigError):
    """No installed package registers a plugin of the given name."""


def split_plugin_name(word: str) -> tuple[str | None, str]:
    """Split ``PACKAGE:NAME`` into (normalised package, name); the package is None for a bare name."""
    package, colon, name = word.partition(":")
    return (canonicalize_name(package.strip()), name.strip()) if colon else (None, word)


def qualified_plugin_name(distribution: str, name: str) -> str:
    """Return ``PACKAGE:NAME``, as a user types it, for a plugin ``name`` of a distribution."""
    return f"{canonicalize_name(distribution)}:{name}"


def installed_version(package: str) -> str | None:
    """Return "NAME VERSION" of the distribution ``package``; None if this distribution is not installed."""
    try:
        found = metadata.distribution(package)
    except (metadata.PackageNotFoundError, ValueError):  # ValueError: an empty name
        return None
    return f"{found.metadata['Name'] or package} {found.metadata['Version'] or ''}".strip()


@dataclass(frozen=True)
class PluginInfo:
    """Registration of a plugin, from package metadata.

    Attributes:
        name: name of the entry point; for a task this is what the user types after ``task=``.
        distribution, version: name and version of the installed package that registers the plugin.
        target: ``module:attribute`` of the plugin's description, for example of a :class:`~neuprim.core.task.TaskSpec`.
    """

    name: str
    distribution: str
    version: str
    target: str

    @property
    def origin(self) -> str:
        """Package and version as text, e.g. ``"neuprim 0.1.0"``."""
        return f"{self.distribution} {self.version}".strip()

    @property
    def built_in(self) -> bool:
        """Whether neuprim's own distribution registers the plugin."""
        return canonicalize_name(self.distribution) == BUILT_IN


@dataclass(frozen=True)
class PluginReport(Generic[T]):
    """A registered plugin with its loaded description, or with the reason why the description cannot be loaded."""

    info: PluginInfo
    spec: T | None = None
    error: str | None = None


@dataclass(frozen=True)
class PluginGroup(Generic[T]):
    """One kind of plugin, e.g. tasks: lists, finds and loads them.

    Attributes:
        entry_points: name of the entry-point group.
        kind: word for a plugin of this kind in messages, e.g. "task".
        typed: what a user types to choose a plugin of this kind, e.g. ``"task={}"`` with the plugin's name for ``{}``.
        described_by: ``module:class`` of the descriptions. The module is only imported when the first plugin is loaded,
            because the module imports torch.
        name_of: function that returns the name in a description, which must equal the entry point's name.
        typed_name: function that converts an entry point's name to what a user types.
    """

    entry_points: str
    kind: str
    typed: str
    described_by: str
    name_of: Callable[[Any], str] = lambda spec: str(spec.name)
    typed_name: Callable[[str], str] = lambda name: name

    def list_plugins(self) -> list[PluginInfo]:
        """List all registered plugins of this kind by name without importing them; a name may occur more than once."""
        return [info for info, _ in self._entries()]

    def find(self, word: str) -> PluginInfo:
        """Return the registration of the plugin ``word``, ``NAME`` or ``PACKAGE:NAME``, without importing the plugin.

        Raises the errors of :meth:`load`, except those of a broken plugin.
        """
        return self._find(word)[0]

    def load(self, word: str) -> T:
        """Import and check the plugin ``word``, ``NAME`` or ``PACKAGE:NAME``; return its description, e.g. a TaskSpec.

        Raises:
            UnknownPlugin: no installed package registers such a plugin.
            PluginError: several packages register the bare name, or the plugin is broken or was written for another
                version of the interfaces.
        """
        return self.load_with_info(word)[1]

    def load_with_info(self, word: str) -> tuple[PluginInfo, T]:
        """Return a plugin's registration and its description. Raises the errors of :meth:`load`."""
        info, entry = self._find(word)
        return info, self._load(info, entry)

    def survey(self) -> list[PluginReport[T]]:
        """Load every registered plugin of this kind; the report of a broken plugin has an error and no description."""
        reports: list[PluginReport[T]] = []
        for info, entry in self._entries():
            try:
                reports.append(PluginReport(info, self._load(info, entry)))
            except PluginError as error:
                reports.append(PluginReport(info, error=str(error)))
        return reports

    def choice(self, info: PluginInfo) -> str:
        """Return what a user types to choose exactly this plugin, e.g. ``task=PACKAGE:NAME``."""
        return self.typed.format(qualified_plugin_name(info.distribution, self.typed_name(info.name)))

    def shortest_name(self, info: PluginInfo) -> str:
        """Return the shortest name that chooses this plugin: the bare ``NAME`` if possible, else ``PACKAGE:NAME``."""
        name = self.typed_name(info.name)
        clash = any(other.name == info.name and other != info for other in self.list_plugins())
        return qualified_plugin_name(info.distribution, name) if clash and not info.built_in else name

    def warn_of_hidden(self, info: PluginInfo, by: str) -> None:
        """Warn that the bare name of the plugin ``info`` chooses another plugin of the same name.

        The text ``by`` describes the chosen plugin. The warning also says what to type to choose ``info``.
        """
        what = f"{self.kind} {self.typed_name(info.name)!r} of {info.origin}"
        warn_once(f"two plugins have the same name: {by} is used, not {what}; to use it, write {self.choice(info)}")

    def _find(self, word: str) -> tuple[PluginInfo, metadata.EntryPoint]:
        entries = self._entries()
        package, name = split_plugin_name(word)
        found = [(i, e) for i, e in entries if i.name == name and package in (None, canonicalize_name(i.distribution))]
        if not found:
            raise UnknownPlugin(self._unknown_plugin_message(word, [info for info, _ in entries]))
        built_in = [pair for pair in found if pair[0].built_in]
        if package is None and built_in:
            for info, _ in found:
                if not info.built_in:
                    self.warn_of_hidden(info, "neuprim's own")
            found = built_in
        if len(found) > 1:
            origins = " and ".join(f"{info.origin} ({info.target})" for info, _ in found)
            choices = list(dict.fromkeys(self.choice(info) for info, _ in found))
            advice = f"choose {' or '.join(choices)}" if len(choices) > 1 else "a package may register a name only once"
            raise PluginError(f"{self.kind} {name!r} is registered by {origins}; {advice}")
        return found[0]

    def _unknown_plugin_message(self, word: str, registered: Sequence[PluginInfo]) -> str:
        package, name = split_plugin_name(word)
        names = {info.name for info in registered if package in (None, canonicalize_name(info.distribution))}
        hint = nearest(name, names)
        if package is not None and not names:
            there = installed_version(package)
            hint = f"; {package or 'the package'} is not installed" if there is None else f"; {there} registers none"
        return f"{self.typed.format(word)}: no such {self.kind}{hint}"

    def _entries(self) -> list[tuple[PluginInfo, metadata.EntryPoint]]:
        """List the entry points of this kind of plugin, with their registrations, sorted by name, built-in ones first.

        If sys.path has several copies of a package, only the entry points of the copy that Python imports are listed.
        """
        registered = _registered_entry_points(tuple((path, _modification_time(path)) for path in sys.path))
        found = [(info, entry) for info, entry in registered if entry.group == self.entry_points]
        return sorted(found, key=lambda pair: (pair[0].name, not pair[0].built_in, pair[0].distribution))

    def _load(self, info: PluginInfo, entry: metadata.EntryPoint) -> T:
        from neuprim.core.task import API_VERSION
        from neuprim.plugins.spec_validation import validate_spec

        who = f"{self.kind} {info.name!r} of {info.origin}"
        try:
            spec = entry.load()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # an import can fail in any way, and the message must name the package
            text = " ".join(str(error).split())
            raise PluginError(f"{who}: cannot import {info.target}: {type(error).__name__}: {text}") from error
        module, _, class_name = self.described_by.partition(":")
        expected = getattr(importlib.import_module(module), class_name)
        if not isinstance(spec, expected):
            found = f"{info.target} is of type {type(spec).__name__}"
            raise PluginError(f"{who}: {found}; expected a {module}.{class_name}")
        api = getattr(spec, "api", None)
        if api != API_VERSION:
            older = isinstance(api, int) and api < API_VERSION
            upgrade = info.distribution if older else "neuprim"
            raise PluginError(f"{who}: written for plugin API {api}, this neuprim has {API_VERSION}; upgrade {upgrade}")
        if (problem := validate_spec(spec)) is not None:
            raise PluginError(f"{who}: {class_name}.{problem}")
        if (own := self.name_of(spec)) != info.name:
            raise PluginError(f"{who}: its {class_name} is named {own!r}; expected {info.name!r}, as the entry point")
        return spec  # type: ignore[no-any-return]


def _modification_time(folder: str) -> int:
    """Return when an entry of sys.path last changed, in nanoseconds; 0 if it does not exist."""
    try:
        return os.stat(folder or ".").st_mtime_ns
    except OSError:
        return 0


@functools.lru_cache(maxsize=1)  # a run looks plugins up many times, and each scan reads files of all packages
def _registered_entry_points(path: tuple[tuple[str, int], ...]) -> list[tuple[PluginInfo, metadata.EntryPoint]]:
    """List the entry points of all groups for a state of sys.path, given by its entries and when each last changed."""
    found, packages = [], set()
    for dist in metadata.distributions():
        try:
            entries = [entry for entry in dist.entry_points if entry.group.startswith(f"{BUILT_IN}.")]
            if not entries:
                continue
            name, version = str(dist.metadata["Name"] or ""), str(dist.metadata["Version"] or "")
            hidden = metadata.distribution(name).locate_file("") != dist.locate_file("")
        except Exception:  # a half-removed package must not hide the others
            continue
        if hidden or canonicalize_name(name) in packages:  # a copy further down sys.path, which is not imported
            continue
        packages.add(canonicalize_name(name))
        found += [(PluginInfo(entry.name, name, version, entry.value), entry) for entry in entries]
    return found


TASKS: PluginGroup[TaskSpec] = PluginGroup("neuprim.tasks", "task", "task={}", "neuprim.core.task:TaskSpec")
SCENES: PluginGroup[SceneExtension] = PluginGroup(
    "neuprim.scenes",
    "scene",
    "scene={}",
    "neuprim.core.extensions:SceneExtension",
    lambda extension: f"{extension.task}.{extension.scene.name}",
    lambda name: name.partition(".")[2],
)
"""Scenes that packages add to tasks. Their entry points are named ``TASK.SCENE``, so that package metadata alone says
which scenes are added to a task."""
LOSSES: PluginGroup[LossExtension] = PluginGroup(
    "neuprim.losses", "loss", "train.loss={}", "neuprim.core.extensions:LossExtension"
)
EXPORTERS: PluginGroup[Exporter] = PluginGroup(
    "neuprim.exporters", "exporter", "--format {}", "neuprim.core.extensions:Exporter"
)
INSPECTORS: PluginGroup[Inspector] = PluginGroup(
    "neuprim.inspectors", "inspector", "--show {}", "neuprim.core.extensions:Inspector"
)
PLUGIN_GROUPS: tuple[PluginGroup[Any], ...] = (TASKS, SCENES, LOSSES, EXPORTERS, INSPECTORS)


def load_task(name: str) -> TaskSpec:
    """Load the task ``NAME`` or ``PACKAGE:NAME``. Raises UnknownPlugin, or PluginError if the task is broken."""
    return TASKS.load(name)


def list_scene_names(task: PluginInfo) -> list[str]:
    """List the scenes of a task without importing it.

    The task's own scenes are the YAML files in the folder ``conf/scene/NAME`` of the package that defines the task
    ``NAME``. Scenes that other packages register are listed, too. If the YAML files of a task are in another folder,
    only the registered scenes are listed.
    """
    added = [SCENES.typed_name(info.name) for info in SCENES.list_plugins() if info.name.startswith(f"{task.name}.")]
    try:
        found = importlib.util.find_spec(task.target.partition(":")[0])
    except Exception:  # finding a module imports the packages around it, which can fail in any way
        found = None
    folders = [] if found is None else found.submodule_search_locations or []
    own = {file.stem for folder in folders for file in Path(folder, "conf", "scene", task.name).glob("*.yaml")}
    return sorted(own.union(added))


@dataclass(frozen=True)
class FoundScene:
    """A scene of a task, with the package that provides the scene: the task's own package or another package."""

    spec: SceneSpec  # the scene
    config_package: str  # the package with scene/TASK/NAME.yaml
    added_by: PluginInfo | None = None  # the plugin that adds the scene; None for the task's own


def find_registered_scene(task: TaskSpec, word: str) -> FoundScene:
    """Return the scene ``NAME`` or ``PACKAGE:NAME`` of a task.

    A bare ``NAME`` means the task's own scene of that name; if there is none, a scene that another package registers.

    Raises UnknownPlugin, or PluginError if the scene's plugin is broken.
    """
    package, name = split_plugin_name(word)
    own = {scene.name: scene for scene in task.scenes}
    added = [info for info in SCENES.list_plugins() if info.name.startswith(f"{task.name}.")]
    if name in own:
        if package is None:
            for info in added:
                if info.name == f"{task.name}.{name}":
                    SCENES.warn_of_hidden(info, f"one of task {task.name!r} itself")
        owners = [
            i for i in TASKS.list_plugins() if i.name == task.name and canonicalize_name(i.distribution) == package
        ]
        of_package = any(TASKS.load(qualified_plugin_name(i.distribution, i.name)) is task for i in owners)
        if package is None or of_package:
            return FoundScene(own[name], task.config_package)
    entry = f"{task.name}.{name}"
    try:
        info, extension = SCENES.load_with_info(entry if package is None else f"{package}:{entry}")
    except UnknownPlugin:
        names = [*own, *(SCENES.typed_name(info.name) for info in added)]
        of = f" of {package}" if package else ""
        raise UnknownPlugin(f"scene={word}: task {task.name!r} has no such scene{of}{nearest(name, names)}") from None
    return FoundScene(extension.scene, extension.config_package, info)
