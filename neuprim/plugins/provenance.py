"""Who made a run: the packages that its task, scene and loss come from, with their versions, as kept in its
``config.yaml``.

A stored run is read with the plugins of the packages that made it, whatever else has their names by now.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

from packaging.version import InvalidVersion, Version

from neuprim.core.errors import CheckpointError, ConfigError, nearest
from neuprim.core.notices import warn_once
from neuprim.plugins.editable import not_installed_yet
from neuprim.plugins.mechanism import Group, PluginInfo, UnknownPlugin, installed
from neuprim.plugins.names import BUILT_IN, normalised, qualified
from neuprim.version import __version__

__all__ = ["MadeBy", "Maker", "check_resumed", "load_recorded", "missing", "warn_of_neuprim"]

T = TypeVar("T")

_LONGEST = 200
"""Characters of a name or version in a file."""


@dataclass(frozen=True)
class Maker:
    """Where one plugin of a run came from.

    Attributes:
        name: what it is called there: a task's, scene's or loss's name, without package.
        package, version: the installed distribution; the version may be "".
    """

    name: str
    package: str
    version: str

    @classmethod
    def of(cls, info: PluginInfo, name: str | None = None) -> Maker:
        """From what is registered; ``name`` where the entry point is called otherwise, as a scene's is."""
        version = "".join(c for c in info.version if c.isprintable())[
            :_LONGEST
        ]  # what is written must be readable again
        return cls(info.name if name is None else name, info.distribution, version)

    @property
    def origin(self) -> str:
        """For example ``"neuprim-spectral 0.1"``."""
        return f"{self.package} {self.version}".strip()


@dataclass(frozen=True)
class MadeBy:
    """Everything that made a run.

    Attributes:
        neuprim: version.
        scene: of a scene that another package adds to the task; None for the task's own.
        loss: of a loss chosen with ``train.loss``; None for the task's own.
    """

    neuprim: str
    task: Maker
    scene: Maker | None = None
    loss: Maker | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain values; what is None is left out."""
        makers = {"task": self.task, "scene": self.scene, "loss": self.loss}
        return {
            "neuprim": self.neuprim,
            **{kind: vars(maker).copy() for kind, maker in makers.items() if maker is not None},
        }

    @classmethod
    def from_dict(cls, value: object) -> MadeBy:
        """Reads :meth:`to_dict` back out of an untrusted file.

        Raises:
            ConfigError: one line that names the key, what was found and what was expected.
        """
        record = _mapping(value, "made_by", [f.name for f in fields(cls)])
        makers = {
            kind: _maker(record[kind], f"made_by.{kind}")
            for kind in ("task", "scene", "loss")
            if record.get(kind) is not None
        }
        if "task" not in makers:
            raise ConfigError("made_by.task: missing; expected name, package and version")
        return cls(_text(record.get("neuprim"), "made_by.neuprim"), **makers)

    def in_words(self) -> dict[str, str]:
        """Kind -> package and version, for people."""
        makers = {"task": self.task, "scene": self.scene, "loss": self.loss}
        return {"neuprim": self.neuprim, **{kind: maker.origin for kind, maker in makers.items() if maker is not None}}


def load_recorded(
    group: Group[T], maker: Maker, file: Path | None = None, entry: str | None = None
) -> tuple[PluginInfo, T]:
    """The plugin that a run was made by; another version of it is named in a warning.

    Args:
        file: that holds the record, for messages.
        entry: name of the entry point, where it is not the plugin's.

    Raises:
        ConfigError: the package is not installed, or has nothing of that name any more.
        PluginError: it is broken, or was written for another version.
    """
    word = qualified(maker.package, entry or maker.name)
    try:
        info, spec = group.loaded(word)
    except UnknownPlugin as error:
        raise ConfigError(_told(file, missing(group, maker, entry))) from error
    if not info.built_in and info.version != maker.version:
        warn_once(
            _told(file, f"this run was made by {maker.origin} ({group.kind} {maker.name}); installed is {info.origin}")
        )
    return info, spec


def missing(group: Group[Any], maker: Maker, entry: str | None = None) -> str:
    """The message for a plugin that made a run and is not there."""
    who, there = f"this run was made by {maker.origin} ({group.kind} {maker.name})", installed(maker.package)
    if there is None:
        return f"{who}, which is not installed"
    late = not_installed_yet(group.entry_points, entry or maker.name, normalised(maker.package))
    return f"{who}; the installed {there} has no such {group.kind}{late}"


def warn_of_neuprim(made_by: MadeBy, file: Path | None = None) -> None:
    """A warning where a run was made by another minor version of neuprim; patches keep results."""
    if _minor(made_by.neuprim) != _minor(__version__):
        warn_once(_told(file, f"this run was made by neuprim {made_by.neuprim}; this is neuprim {__version__}"))


def check_resumed(stored: object, now: MadeBy | None, file: Path) -> None:
    """Whether a run may go on from a checkpoint that ``stored`` (its record) made.

    Warns of other versions.

    Raises:
        CheckpointError: its task comes from another package, or the record is damaged.
    """
    if stored is None or now is None:
        return
    try:
        before = MadeBy.from_dict(stored)
    except ConfigError as error:
        raise CheckpointError(f"{file}: {error}") from error
    if normalised(before.task.package) != normalised(now.task.package):
        raise CheckpointError(
            f"{file}: written for task {before.task.name!r} of {before.task.origin}; this run's task is that of {now.task.origin}"
        )
    warn_of_neuprim(before, file)
    for kind in ("task", "scene", "loss"):
        old, new = getattr(before, kind), getattr(now, kind)
        if old is None or new is None or normalised(old.package) in (BUILT_IN, "") or old.version == new.version:
            continue
        if (normalised(old.package), old.name) == (normalised(new.package), new.name):
            warn_once(_told(file, f"this run was made by {old.origin} ({kind} {old.name}); installed is {new.origin}"))


# ---------------------------------------------------------------- inside


def _told(file: Path | None, text: str) -> str:
    return text if file is None else f"{file}: {text}"


def _minor(version: str) -> object:
    try:
        return Version(version).release[:2]
    except InvalidVersion:
        return version


def _maker(value: object, where: str) -> Maker:
    record = _mapping(value, where, ["name", "package", "version"])
    name, package = (_text(record.get(key), f"{where}.{key}") for key in ("name", "package"))
    if ":" in package:
        raise ConfigError(f"{where}.package: found {package!r}; expected the name of a package")
    return Maker(name, package, _text(record.get("version"), f"{where}.version", empty=True))


def _mapping(value: object, where: str, known: list[str]) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ConfigError(f"{where}: found {type(value).__name__}; expected a mapping of {', '.join(known)}")
    for key in value:
        if key not in known:
            raise ConfigError(f"{where}.{str(key)[:_LONGEST]}: no such setting" + nearest(str(key), known))
    return value


def _text(value: object, where: str, empty: bool = False) -> str:
    if not isinstance(value, str) or len(value) > _LONGEST or not value.isprintable() or not (empty or value.strip()):
        found = (
            repr(value) if len(repr(value)) <= _LONGEST else f"{type(value).__name__} of {len(repr(value))} characters"
        )
        raise ConfigError(f"{where}: found {found}; expected text of at most {_LONGEST} characters")
    return value
