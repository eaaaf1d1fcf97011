"""Record which packages and versions made a run, and load the same plugins again.

``config.yaml`` stores the record under ``made_by``. A stored run is read with the plugins of the packages that made the
run, even if a plugin's bare name now means the plugin of another package.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion, Version

from neuprim.core.errors import CheckpointError, ConfigError, warn_once
from neuprim.core.validation import Accepts, validate_settings
from neuprim.plugins.registry import (
    BUILT_IN,
    FoundScene,
    PluginGroup,
    PluginInfo,
    UnknownPlugin,
    installed_version,
    qualified_plugin_name,
)
from neuprim.version import __version__

T = TypeVar("T")

_LONGEST = 200


def _is_version_text(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _LONGEST and value.isprintable()


def _is_plugin_name(value: Any) -> bool:
    return _is_version_text(value) and bool(value.strip()) and ":" not in value


_Name = Annotated[str, Accepts(_is_plugin_name, f"a name of at most {_LONGEST} characters")]
_Version = Annotated[str, Accepts(_is_version_text, f"a version of at most {_LONGEST} characters")]


@dataclass(frozen=True)
class PluginVersion:
    """The package and version that one plugin of a run came from.

    Attributes:
        name: name of the task, scene or loss, without its package.
        package, version: name and version of the distribution that provided the plugin; the version may be empty.
    """

    name: _Name
    package: _Name
    version: _Version

    @classmethod
    def of(cls, info: PluginInfo, name: str | None = None) -> PluginVersion:
        """Return package and version of an installed plugin.

        ``name`` is the plugin's name; None if it equals the name of the entry point. For a scene, the names differ.
        """
        version = "".join(c for c in info.version if c.isprintable())[:_LONGEST]  # so that it can be read again
        return cls(info.name if name is None else name, info.distribution, version)

    @property
    def origin(self) -> str:
        """Package and version as text, e.g. ``"neuprim-spectral 0.1"``."""
        return f"{self.package} {self.version}".strip()

    @property
    def qualified_name(self) -> str:
        """Name of the plugin as a user types it, ``PACKAGE:NAME``."""
        return qualified_plugin_name(self.package, self.name)


@dataclass(frozen=True)
class Provenance:
    """Versions of neuprim and of the plugins that made a run.

    Attributes:
        neuprim: version of neuprim.
        scene: plugin of the scene, if another package adds it to the task; None for one of the task's own scenes.
        loss: plugin of the loss, if ``train.loss`` chooses it; None for the task's own loss.
    """

    neuprim: _Version
    task: PluginVersion
    scene: PluginVersion | None = None
    loss: PluginVersion | None = None

    @classmethod
    def of_installed(cls, task: PluginInfo, scene: FoundScene, loss: PluginInfo | None) -> Provenance:
        """Return the installed versions of neuprim and of a run's plugins; ``loss`` is the plugin of ``train.loss``."""
        added = None if scene.added_by is None else PluginVersion.of(scene.added_by, scene.spec.name)
        return cls(__version__, PluginVersion.of(task), added, None if loss is None else PluginVersion.of(loss))

    @property
    def plugins(self) -> dict[str, PluginVersion]:
        """Kind ("task", "scene", "loss") -> plugin. Kinds without a plugin are left out."""
        found = {"task": self.task, "scene": self.scene, "loss": self.loss}
        return {kind: plugin for kind, plugin in found.items() if plugin is not None}

    def to_dict(self) -> dict[str, Any]:
        """Return the provenance as plain values for YAML and JSON."""
        return {"neuprim": self.neuprim, **{kind: asdict(plugin) for kind, plugin in self.plugins.items()}}

    @classmethod
    def from_dict(cls, value: object) -> Provenance:
        """Validate values in the form of :meth:`to_dict`, read from an untrusted file; return the provenance."""
        return validate_settings(cls, value, "made_by")

    def origins(self) -> dict[str, str]:
        """Return kind ("task", "scene", "loss") -> package and version as text, and "neuprim" -> its version."""
        return {"neuprim": self.neuprim, **{kind: plugin.origin for kind, plugin in self.plugins.items()}}


def load_recorded_plugin(
    group: PluginGroup[T], plugin: PluginVersion, file: Path | None = None, entry: str | None = None
) -> tuple[PluginInfo, T]:
    """Load the plugin that made a run, and warn if another version of the plugin is installed.

    Args:
        plugin: the package and version that made the run.
        file: file that ``plugin`` was read from, for messages.
        entry: name of the entry point, if it differs from the plugin's name.

    Raises:
        ConfigError: the package is not installed, or no longer has a plugin of that name.
        PluginError: the plugin is broken, or was written for another version of the interfaces.
    """
    try:
        info, spec = group.load_with_info(qualified_plugin_name(plugin.package, entry or plugin.name))
    except UnknownPlugin as error:
        there = installed_version(plugin.package)
        what = "which is not installed" if there is None else f"but the installed {there} has no such {group.kind}"
        made = f"this run was made by {plugin.origin} ({group.kind} {plugin.name}), {what}"
        raise ConfigError(_prefix_provenance_file(file, made)) from error
    if not info.built_in:
        _warn_of_plugin_version(file, plugin, group.kind, PluginVersion.of(info))
    return info, spec


def warn_of_other_provenance(made_by: Provenance, file: Path | None = None) -> None:
    """Warn if another minor version of neuprim made a run. Patch versions of neuprim do not change results."""
    if _minor_provenance_version(made_by.neuprim) != _minor_provenance_version(__version__):
        text = f"this run was made by neuprim {made_by.neuprim}; this is neuprim {__version__}"
        warn_once(_prefix_provenance_file(file, text))


def check_resumed_provenance(stored: object, now: Provenance, file: Path) -> None:
    """Compare the provenance ``stored`` in a checkpoint with that of the resuming run; warn if versions differ.

    Raises:
        CheckpointError: the task of the checkpoint is from another package, or ``stored`` is invalid.
    """
    try:
        before = Provenance.from_dict(stored)
    except ConfigError as error:
        raise CheckpointError(f"{file}: {error}") from error
    if canonicalize_name(before.task.package) != canonicalize_name(now.task.package):
        raise CheckpointError(
            f"{file}: written for task {before.task.name!r} of {before.task.origin}; "
            f"this run uses the task {now.task.name!r} of {now.task.origin}; use the package that wrote the file"
        )
    warn_of_other_provenance(before, file)
    for kind, old in before.plugins.items():
        new = now.plugins.get(kind)
        if new is not None and new.qualified_name == old.qualified_name and canonicalize_name(old.package) != BUILT_IN:
            _warn_of_plugin_version(file, old, kind, new)


def _warn_of_plugin_version(file: Path | None, plugin: PluginVersion, kind: str, installed: PluginVersion) -> None:
    if installed.version != plugin.version:
        text = f"this run was made by {plugin.origin} ({kind} {plugin.name}); installed is {installed.origin}"
        warn_once(_prefix_provenance_file(file, text))


def _prefix_provenance_file(file: Path | None, text: str) -> str:
    return text if file is None else f"{file}: {text}"


def _minor_provenance_version(version: str) -> object:
    try:
        return Version(version).release[:2]
    except InvalidVersion:
        return version
