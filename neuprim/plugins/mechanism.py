"""How any kind of plugin is found and loaded; :mod:`neuprim.plugins.registry` says which kinds there are.

Listing reads package metadata only. A plugin is imported when it is asked for by name, so a broken one stops nothing but itself.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any, Generic, TypeVar

from neuprim.core.errors import ConfigError, NeuprimError, nearest

__all__ = ["Group", "PluginError", "PluginInfo", "PluginReport"]

T = TypeVar("T")

_PREFIX = "neuprim."
"""Of all our groups; tells a damaged distribution that concerns us from one that does not."""


class PluginError(NeuprimError):
    """A plugin is installed but cannot be used; the message names plugin, distribution and reason."""


@dataclass(frozen=True)
class PluginInfo:
    """What package metadata says about a plugin.

    Attributes:
        name: of the entry point, such as what the user types after ``task=``.
        distribution, version: the installed package that registers it.
        target: ``module:attribute`` of what describes it, such as a :class:`~neuprim.core.task.TaskSpec`.
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
class PluginReport(Generic[T]):
    """One registered plugin, loaded, or the reason it could not be."""

    info: PluginInfo
    spec: T | None = None
    error: str | None = None


@dataclass(frozen=True)
class Group(Generic[T]):
    """One kind of plugin.

    Attributes:
        entry_points: the entry-point group.
        kind: the word for one of them in messages.
        typed: how a user names one, e.g. ``"task={}"``.
        described_by: ``module:class`` of the descriptions; imported with the first plugin, because the interfaces import torch.
        name_of: the name that a description gives itself; it must be the entry point's.
    """

    entry_points: str
    kind: str
    typed: str
    described_by: str
    name_of: Callable[[Any], str] = lambda spec: str(spec.name)

    def listed(self) -> list[PluginInfo]:
        """All registered plugins by name, without importing any; a name claimed twice is listed twice."""
        return [info for info, _ in self._registered()]

    def load(self, name: str) -> T:
        """The plugin of that name; imports it and no other.

        Raises:
            ConfigError: there is none.
            PluginError: the name is claimed twice, or the plugin is broken or was written for another version.
        """
        registered = self._registered()
        found = [(info, entry) for info, entry in registered if info.name == name]
        if not found:
            hint = nearest(name, {info.name for info, _ in registered}) or f"; no {self.kind} is installed"
            raise ConfigError(f"{self.typed.format(name)}: no such {self.kind}{hint}")
        if len(found) > 1:
            raise PluginError(self.clash(name, [info for info, _ in found]))
        return self._load(*found[0])

    def survey(self) -> list[PluginReport[T]]:
        """Every registered plugin, loaded one by one; the broken ones come with their error."""
        reports: list[PluginReport[T]] = []
        registered = self._registered()
        for info, entry in registered:
            same = [other for other, _ in registered if other.name == info.name]
            if len(same) > 1:
                reports.append(PluginReport(info, error=self.clash(info.name, same)))
                continue
            try:
                reports.append(PluginReport(info, spec=self._load(info, entry)))
            except PluginError as error:
                reports.append(PluginReport(info, error=str(error)))
        return reports

    def clash(self, name: str, claims: Sequence[PluginInfo]) -> str:
        """The message that names everybody who claims ``name``."""
        origins = " and ".join(sorted(f"{info.origin} ({info.target})" for info in claims))
        return f"{self.kind} {name!r} is registered by {origins}; uninstall one of them"

    # ------------------------------------------------------------ inside

    def _registered(self) -> list[tuple[PluginInfo, metadata.EntryPoint]]:
        result = []
        for dist in _distributions():
            for entry in dist.entry_points:
                if entry.group == self.entry_points:
                    who = dist.metadata["Name"] or "unnamed distribution"
                    result.append((PluginInfo(entry.name, who, _version(dist), entry.value), entry))
        return sorted(result, key=lambda pair: (pair[0].name, pair[0].distribution))

    def _load(self, info: PluginInfo, entry: metadata.EntryPoint) -> T:
        from neuprim.core.task import API_VERSION
        from neuprim.plugins.members import fault

        who = f"{self.kind} {info.name!r} of {info.origin}"
        try:
            spec = entry.load()
        except (Exception, SystemExit) as error:  # whatever a plugin does when imported is its own fault, and must be named
            text = " ".join(str(error).split())
            raise PluginError(f"{who}: cannot import {info.target}: {type(error).__name__}: {text}") from error
        module, _, name = self.described_by.partition(":")
        expected = getattr(importlib.import_module(module), name)
        if not isinstance(spec, expected):
            raise PluginError(f"{who}: {info.target} is of type {type(spec).__name__}; expected a {module}.{name}")
        api = getattr(spec, "api", None)
        if api != API_VERSION:
            older = isinstance(api, int) and api < API_VERSION
            todo = f"upgrade {info.distribution}" if older else "upgrade neuprim"
            raise PluginError(f"{who}: written for plugin API {api}, this neuprim has {API_VERSION}; {todo}")
        wrong = fault(spec)
        if wrong is not None:
            raise PluginError(f"{who}: {name}.{wrong}")
        own = self.name_of(spec)
        if own != info.name:
            raise PluginError(f"{who}: its {name} is named {own!r}; the entry point and the {name} must agree")
        return spec  # type: ignore[no-any-return]


def _distributions() -> list[metadata.Distribution]:
    """Installed distributions that register anything with us, each once: of two copies on ``sys.path`` the first counts.

    Distributions whose entry points cannot be read are left out: one damaged folder in site-packages must not take the others along.
    """
    found, names = [], set()
    for dist in metadata.distributions():
        try:
            text = dist.read_text("entry_points.txt") or ""
            if f"[{_PREFIX}" not in text.replace(" ", ""):
                continue
            name = dist.metadata["Name"] or ""
            first = metadata.distribution(name) if name else dist
            if name in names or (first.read_text("entry_points.txt") or "") != text:
                continue  # shadowed by a copy further up
            list(dist.entry_points)
        except Exception:  # a half-removed package can be broken in any way
            continue
        names.add(name)
        found.append(dist)
    return found


def _version(dist: metadata.Distribution) -> str:
    return str(dist.metadata["Version"] or "")
