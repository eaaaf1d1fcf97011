"""How any kind of plugin is found and loaded; :mod:`neuprim.plugins.registry` says which kinds there are.

Listing reads package metadata only. A plugin is imported when it is asked for by name, so a broken one stops nothing
but itself.

A name means the built-in plugin where there is one, whoever else claims it. Everything else of that name is chosen as
``PACKAGE:NAME``; what was not chosen is not imported.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from typing import Any, Generic, TypeVar

from neuprim.core.errors import ConfigError, NeuprimError, nearest
from neuprim.core.notices import warn_once
from neuprim.plugins.editable import not_installed_yet
from neuprim.plugins.names import BUILT_IN, normalised, qualified, split

__all__ = ["Group", "PluginError", "PluginInfo", "PluginReport", "UnknownPlugin", "installed"]

T = TypeVar("T")

_PREFIX = "neuprim."
"""Of all our groups; tells a damaged distribution that concerns us from one that does not."""


class PluginError(NeuprimError):
    """A plugin is installed but cannot be used; the message names plugin, distribution and reason."""


class UnknownPlugin(ConfigError):
    """No installed package registers a plugin of that name."""


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

    @property
    def built_in(self) -> bool:
        """Whether neuprim's own distribution registers it."""
        return normalised(self.distribution) == BUILT_IN


@dataclass(frozen=True)
class PluginReport(Generic[T]):
    """One registered plugin, loaded, or the reason it could not be.

    Attributes:
        note: how to choose it, where its bare name does not; None where it does.
    """

    info: PluginInfo
    spec: T | None = None
    error: str | None = None
    note: str | None = None


@dataclass(frozen=True)
class Group(Generic[T]):
    """One kind of plugin.

    Attributes:
        entry_points: the entry-point group.
        kind: the word for one of them in messages.
        typed: how a user names one, e.g. ``"task={}"``.
        described_by: ``module:class`` of the descriptions; imported with the first plugin, because the interfaces
        import torch. name_of: the name that a description gives itself; it must be the entry point's.
        typed_name: what a user types for an entry point's name.
    """

    entry_points: str
    kind: str
    typed: str
    described_by: str
    name_of: Callable[[Any], str] = lambda spec: str(spec.name)
    typed_name: Callable[[str], str] = lambda name: name

    def listed(self) -> list[PluginInfo]:
        """All registered plugins by name, without importing any; a name claimed twice is listed twice."""
        return [info for info, _ in self._registered()]

    def find(self, word: str) -> PluginInfo:
        """Who registers the plugin that ``NAME`` or ``PACKAGE:NAME`` chooses; imports nothing. Raises as
        :meth:`load`."""
        return self._find(word)[0]

    def load(self, word: str) -> T:
        """The plugin that ``NAME`` or ``PACKAGE:NAME`` chooses; imports it and no other.

        A bare name is the built-in's where there is one; a package that claims it too is named in a warning.

        Raises:
            UnknownPlugin: there is none.
            PluginError: the bare name is claimed by several packages, or the plugin is broken or was written for
            another version.
        """
        return self.loaded(word)[1]

    def loaded(self, word: str) -> tuple[PluginInfo, T]:
        """Who registers it, and the plugin, as :meth:`load`."""
        info, entry = self._find(word)
        return info, self._load(info, entry)

    def survey(self) -> list[PluginReport[T]]:
        """Every registered plugin, loaded one by one; the broken ones come with their error."""
        reports: list[PluginReport[T]] = []
        registered = self._registered()
        for info, entry in registered:
            same = [other for other, _ in registered if other.name == info.name]
            if sum(other.distribution == info.distribution for other in same) > 1:
                reports.append(PluginReport(info, error=self.clash(info.name, same)))
                continue
            note = self._note(info, same)
            try:
                reports.append(PluginReport(info, self._load(info, entry), note=note))
            except PluginError as error:
                reports.append(PluginReport(info, error=str(error), note=note))
        return reports

    def clash(self, name: str, claims: Sequence[PluginInfo]) -> str:
        """The message that names everybody who claims ``name``, and how to choose one of them."""
        claims = sorted(claims, key=lambda info: (info.origin, info.target))
        origins = " and ".join(f"{info.origin} ({info.target})" for info in claims)
        if len({normalised(info.distribution) for info in claims}) < len(claims):
            return f"{self.kind} {name!r} is registered by {origins}; a package may register a name once"
        return f"{self.kind} {name!r} is registered by {origins}; choose {' or '.join(self.choice(info) for info in claims)}"

    def hidden(self, info: PluginInfo, by: str = "neuprim's own") -> str:
        """The warning that ``info`` has a name that means something else."""
        what = f"{self.kind} {self.typed_name(info.name)!r} of {info.origin} ({info.target})"
        return f"{what} has the name of {by}, which is used; {self.choice(info)} chooses the other"

    def choice(self, info: PluginInfo) -> str:
        """What a user types to choose exactly this one, e.g. ``task=PACKAGE:NAME``."""
        return self.typed.format(qualified(info.distribution, self.typed_name(info.name)))

    def word(self, info: PluginInfo) -> str:
        """The shortest word that chooses this one: its name where that is not another's, else ``PACKAGE:NAME``."""
        same = [other for other in self.listed() if other.name == info.name]
        return (
            self.typed_name(info.name)
            if self._note(info, same) is None
            else qualified(info.distribution, self.typed_name(info.name))
        )

    def owner(self, spec: T) -> PluginInfo | None:
        """Who registers this very object, as far as the modules that are imported tell; the built-in before others."""
        for info in sorted(self.listed(), key=lambda info: not info.built_in):
            module, _, path = info.target.partition("[")[0].partition(":")
            found: Any = sys.modules.get(module.strip())
            for part in path.strip().split("."):
                found = inspect.getattr_static(found, part, None)
            if found is spec:
                return info
        return None

    # ------------------------------------------------------------ inside

    def _find(self, word: str) -> tuple[PluginInfo, metadata.EntryPoint]:
        registered = self._registered()
        package, name = split(word)
        found = [
            pair for pair in registered if pair[0].name == name and package in (None, normalised(pair[0].distribution))
        ]
        if not found:
            raise UnknownPlugin(self._unknown(word, [info for info, _ in registered]))
        if package is None:
            own = [pair for pair in found if pair[0].built_in]
            for info, _ in found if own else ():
                if not info.built_in:
                    warn_once(self.hidden(info))
            found = own or found
        if len(found) > 1:
            raise PluginError(self.clash(name, [info for info, _ in found]))
        return found[0]

    def _unknown(self, word: str, registered: Sequence[PluginInfo]) -> str:
        package, name = split(word)
        names = {info.name for info in registered if package in (None, normalised(info.distribution))}
        of = f" of {package}" if package and names else ""
        hint = nearest(name, names) or (
            f"; no {self.kind} is installed" if package is None else _nothing_of(package, self.kind)
        )
        return f"{self.typed.format(word)}: no such {self.kind}{of}{hint}{not_installed_yet(self.entry_points, name, package)}"

    def _note(self, info: PluginInfo, same: Sequence[PluginInfo]) -> str | None:
        others = [other for other in same if other != info]
        if info.built_in or not others:
            return None
        if any(other.built_in for other in others):
            return f"hidden by the built-in {self.kind}; {self.choice(info)} chooses it"
        return (
            f"also registered by {' and '.join(other.origin for other in others)}; {self.choice(info)} chooses this one"
        )

    def _registered(self) -> list[tuple[PluginInfo, metadata.EntryPoint]]:
        result = []
        for dist in _distributions():
            for entry in dist.entry_points:
                if entry.group == self.entry_points:
                    who = dist.metadata["Name"] or "unnamed distribution"
                    result.append((PluginInfo(entry.name, who, _version(dist), entry.value), entry))
        return sorted(result, key=lambda pair: (pair[0].name, not pair[0].built_in, pair[0].distribution))

    def _load(self, info: PluginInfo, entry: metadata.EntryPoint) -> T:
        from neuprim.core.task import API_VERSION
        from neuprim.plugins.members import fault

        who = f"{self.kind} {info.name!r} of {info.origin}"
        if ":" in info.name:
            raise PluginError(f"{who}: a name cannot hold ':', which stands between package and name")
        _forget_half_imported(info.target)
        try:
            spec = entry.load()
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # whatever a plugin does when imported is its own fault, and must be named
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


def installed(package: str) -> str | None:
    """Name and version of an installed distribution, None where there is none of that name."""
    try:
        found = metadata.distribution(package)
    except (metadata.PackageNotFoundError, ValueError):  # ValueError: no name at all
        return None
    return f"{found.metadata['Name'] or package} {_version(found)}".strip()


def _nothing_of(package: str, kind: str) -> str:
    """Why ``PACKAGE:NAME`` finds nothing where the package has nothing of that kind."""
    if not package:
        return f"; expected NAME or PACKAGE:NAME of a {kind}"
    there = installed(package)
    return f"; {package} is not installed" if there is None else f"; {there} registers no {kind}"


def _forget_half_imported(target: str) -> None:
    """Drops modules whose package is not imported, of the top-level package of a ``module:attribute``.

    They are left over where a package imported them and failed itself. Python would hand them out without importing the
    package again, so that what is broken would look fine to everybody but the first who asks.
    """
    top = target.partition(":")[0].partition(".")[0].strip()
    for name in [n for n in list(sys.modules) if n.startswith(f"{top}.")]:
        parts = name.split(".")
        if any(".".join(parts[:i]) not in sys.modules for i in range(1, len(parts))):
            sys.modules.pop(name, None)


def _distributions() -> list[metadata.Distribution]:
    """Installed distributions that register anything with us, each once: of two copies on ``sys.path`` the first
    counts.

    Distributions whose entry points cannot be read are left out: one damaged folder in site-packages must not take the
    others along.
    """
    found, names = [], set()
    for dist in metadata.distributions():
        try:
            text = dist.read_text("entry_points.txt") or ""
            if f"[{_PREFIX}" not in text.replace(" ", ""):
                continue
            own = dist.metadata["Name"] or ""
            name, first = normalised(own), metadata.distribution(own) if own else dist
            if (name and name in names) or (first.read_text("entry_points.txt") or "") != text:
                continue  # shadowed by a copy further up
            list(dist.entry_points)
        except Exception:  # a half-removed package can be broken in any way
            continue
        names.add(name)
        found.append(dist)
    return found


def _version(dist: metadata.Distribution) -> str:
    return str(dist.metadata["Version"] or "")
