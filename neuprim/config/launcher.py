"""Settings of where runs work, ``launcher=processes launcher.workers=4``; they change nothing of what a run makes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, get_args

from neuprim.config.overrides import take_group
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.validation import Range, format_value, validate, validate_fields

__all__ = ["LAUNCHERS", "LauncherSettings", "take_launcher"]

Name = Literal["inline", "processes", "ray", "slurm"]
LAUNCHERS: tuple[str, ...] = get_args(Name)
_POSITIVE = Range(1, says="a positive whole number")


@dataclass(frozen=True)
class LauncherSettings:
    """Where runs work, and how many at once.

    Attributes:
        name: one of :data:`LAUNCHERS`.
        workers: runs at once; None: as many as there are, and as the cores of this machine or the cluster allow.
        threads: of each run; None shares the cores.
        retries: how often a run continues from its checkpoint after its worker died.
        address: of Ray, as ``ray.init`` takes it; of Slurm, submitit's executor ("slurm" or "local"). None: the Ray of
            ``RAY_ADDRESS``, else one on this machine; Slurm.
        options: for the engine: Ray's options of a task, such as ``num_gpus``; submitit's, such as ``slurm_partition``.
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


def take_launcher(overrides: Sequence[str]) -> tuple[LauncherSettings, list[str]]:
    """Return the launcher that overrides ask for, and the other overrides.

    Raises:
        ConfigError: no such launcher or setting of it, an impossible value, or one that this launcher does not use.
    """
    values, others = take_group(overrides, "launcher")
    if "" in values:
        name = values.pop("")
        if name not in LAUNCHERS:
            raise ConfigError(f"launcher={format_value(name)}: no such launcher{nearest(str(name), LAUNCHERS)}")
        values["name"] = name
    settings = validate(LauncherSettings, values, "launcher")
    _refuse_unused(settings)
    return settings, others


def _refuse_unused(settings: LauncherSettings) -> None:
    """Refuse a setting that the launcher does not use: it would look as if it did something."""
    users = dict.fromkeys(("address", "options"), "ray or launcher=slurm")
    users |= dict.fromkeys(("workers", "retries"), "processes, launcher=ray or launcher=slurm")
    unused = {"inline": tuple(users), "processes": ("address", "options")}.get(settings.name, ())
    for name in unused:
        if name in settings.given():
            raise ConfigError(
                f"launcher.{name}: launcher={settings.name} does not use it; expected it with launcher={users[name]}"
            )
