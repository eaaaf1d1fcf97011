"""The words that say where runs work: ``launcher=processes launcher.workers=4``.

Like the words of a target they stand among those after ``neuprim run`` and are taken out of them here: where a run
works changes nothing of what it makes, so that its configuration does not know.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, get_args

from neuprim.config.overrides import key_of, parse, swept_keys
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.validation import Range, validate, validate_fields

__all__ = ["LAUNCHERS", "LauncherSettings", "launcher_words"]

Name = Literal["inline", "processes", "ray", "slurm"]
LAUNCHERS: tuple[str, ...] = get_args(Name)
_POSITIVE = Range(1, says="a positive whole number")


@dataclass(frozen=True)
class LauncherSettings:
    """Where runs work, and how many at once.

    Attributes:
        name: one of :data:`LAUNCHERS`.
        workers: runs at once; None: as many as there are, and as the cores of this machine or the cluster allow.
        threads: of each run; None: the cores are shared out.
        retries: how often a run goes on from its checkpoint after its worker died.
        address: of Ray, as ``ray.init`` takes it: ``auto``, ``HOST:PORT``, ``ray://HOST:PORT``; of Slurm, submitit's
        name of an executor: ``slurm`` or
            ``local``. None: the Ray of ``RAY_ADDRESS``, else one on this machine; Slurm.
        options: handed to the engine: Ray's options of a task, such as ``num_gpus``; submitit's parameters, such as
        ``slurm_partition``.
    """

    name: Name = "inline"
    workers: Annotated[int, _POSITIVE] | None = None
    threads: Annotated[int, _POSITIVE] | None = None
    retries: Annotated[int, Range(0, 1000, says="a whole number from 0 to 1000")] = 2
    address: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        validate_fields(self, "launcher")

    def given(self) -> dict[str, Any]:
        """Name -> value of what differs from the defaults; JSON-able."""
        every = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        default = LauncherSettings()
        return {name: value for name, value in every.items() if name == "name" or value != getattr(default, name)}


_NAMES = tuple(f.name for f in dataclasses.fields(LauncherSettings) if f.name != "name")


def launcher_words(words: Sequence[str]) -> tuple[LauncherSettings, list[str]]:
    """What the words say of the launcher, and the other words.

    Raises:
        ConfigError: no such launcher or setting of it, an impossible value, or one that this launcher does not use.
    """
    own = [word for word in words if _is_own(word)]
    for key in swept_keys(own):
        raise ConfigError(f"{key}: several values; expected one, as all runs have one launcher")
    given: dict[str, Any] = {}
    options: dict[str, Any] = {}
    for said in parse(own):
        _, _, name = said.key.partition(".")
        if name.startswith("options."):
            options[name.removeprefix("options.")] = said.value
        elif not name:
            if said.value not in LAUNCHERS:
                raise ConfigError(f"{said.text}: no such launcher{nearest(str(said.value), LAUNCHERS)}")
            given["name"] = said.value
        elif name not in _NAMES or name == "options":
            raise ConfigError(f"{said.text}: no such setting{nearest(said.key, [f'launcher.{n}' for n in _NAMES])}")
        else:
            given[name] = said.value
    settings = validate(LauncherSettings, {**given, "options": options}, "launcher")
    _check(settings)
    return settings, [word for word in words if not _is_own(word)]


def _check(settings: LauncherSettings) -> None:
    """Refuses what a launcher has no use for: a word that does nothing would be taken for one that does."""
    unused = {
        "inline": ("workers", "retries", "address", "options"),
        "processes": ("address", "options"),
    }.get(settings.name, ())
    for name in unused:
        if name in settings.given():
            raise ConfigError(
                f"launcher.{name}: launcher={settings.name} has no use for it; expected it with launcher={_who_uses(name)}"
            )


def _who_uses(name: str) -> str:
    return "ray or launcher=slurm" if name in ("address", "options") else "processes, launcher=ray or launcher=slurm"


def _is_own(word: str) -> bool:
    key = key_of(word)
    return key == "launcher" or key.startswith("launcher.")
