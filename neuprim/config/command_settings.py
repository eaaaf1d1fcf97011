"""Settings of commands that are not stored in a run's configuration: launcher, live viewer, and search target."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, get_args

from neuprim.config.overrides import take_settings
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.validation import Range, format_setting_value, nonempty_text, validate_fields, validate_value

__all__ = ["LauncherSettings", "SearchTarget", "ViewerSettings"]

LOOPBACK = "127.0.0.1"
LauncherName = Literal["inline", "processes", "ray", "slurm"]
LAUNCHERS: tuple[str, ...] = get_args(LauncherName)
_POSITIVE = Range(1, says="a positive whole number")
_TARGETS = "target.psnr=DB, target.ssim=S, target.megabytes=M, target.fps=F"


@dataclass(frozen=True)
class LauncherSettings:
    """Where runs work, and how many at once: ``launcher=NAME launcher.KEY=VALUE``.

    Attributes:
        name: "inline" (this process, one after the other), "processes" (on this machine), "ray" or "slurm".
        workers: runs at the same time; null: as many as there are runs, and as the cores of this machine or the
            cluster allow.
        threads: threads of each run; null shares the cores.
        retries: how often a run continues from its checkpoint after its worker died.
        address: address of Ray, as ``ray.init`` takes it; for Slurm the executor of submitit, "slurm" or "local". null:
            for Ray the cluster at ``RAY_ADDRESS``, else this machine; for submitit "slurm".
        options: options of the engine: of a Ray task, such as ``num_gpus``, or of submitit, such as
            ``slurm_partition``.
    """

    name: LauncherName = "inline"
    workers: Annotated[int, _POSITIVE] | None = None
    threads: Annotated[int, _POSITIVE] | None = None
    retries: Annotated[int, Range(0, 1000, says="a whole number from 0 to 1000")] = 2
    address: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        validate_fields(self, "launcher")

    def given_settings(self) -> dict[str, Any]:
        """Return setting -> value: the name of the launcher, and the settings that differ from the defaults."""
        values, default = dataclasses.asdict(self), dataclasses.asdict(LauncherSettings())
        return {name: value for name, value in values.items() if name == "name" or value != default[name]}


@dataclass(frozen=True)
class ViewerSettings:
    """Show a training in the browser: ``viewer=true viewer.port=8080``; a host or port alone does so, too.

    Attributes:
        host: address of this machine to listen on; only this machine can reach the default.
        port: port of the page; 0 for any free port.
    """

    host: Annotated[str, nonempty_text("an address of this machine")] = LOOPBACK
    port: Annotated[int, Range(0, 65535, says="a port, 1 to 65535, or 0 for any")] = 8080

    def __post_init__(self) -> None:
        validate_fields(self, "viewer")


@dataclass(frozen=True)
class SearchTarget:
    """What a model is to reach: ``target.psnr=30``.

    With ``psnr``, ``ssim`` or both, the result is the smallest model that reaches these values; ``megabytes`` and
    ``fps`` are limits. Without ``psnr`` and ``ssim``, the result is the best model within the limits.

    Attributes:
        psnr: PSNR to reach, mean over views, dB.
        ssim: SSIM to reach, mean over views.
        megabytes: largest size of the compressed model, ``model.neuprim``, in millions of bytes.
        fps: smallest number of frames per second on this machine, at the size of the views.
    """

    psnr: Annotated[float, Range(above=0, at_most=100, says="decibels, above 0 and at most 100")] | None = None
    ssim: Annotated[float, Range(above=0, below=1, says="a number between 0 and 1")] | None = None
    megabytes: Annotated[float, Range(above=0, says="a positive number of megabytes")] | None = None
    fps: Annotated[float, Range(above=0, says="a positive number of frames per second")] | None = None

    def given_settings(self) -> dict[str, float]:
        """Return setting -> value of the targets and limits that are set."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}

    @property
    def quality(self) -> dict[str, float]:
        """Quality measure -> target value, for "psnr" and "ssim" if they are set."""
        return {name: value for name, value in self.given_settings().items() if name in ("psnr", "ssim")}

    def __str__(self) -> str:
        return " ".join(f"target.{name}={value:g}" for name, value in self.given_settings().items())


def take_launcher_overrides(overrides: Sequence[str]) -> tuple[LauncherSettings, list[str]]:
    """Split overrides into launcher settings and other overrides. Refuse settings that the launcher does not use."""
    name, settings, others = take_settings(overrides, "launcher", LauncherSettings)
    if name is not None:
        if name not in LAUNCHERS:
            raise ConfigError(f"launcher={format_setting_value(name)}: no such launcher{nearest(str(name), LAUNCHERS)}")
        settings = dataclasses.replace(settings, name=name)
    given = settings.given_settings()
    engines, pools = "ray or launcher=slurm", "processes, launcher=ray or launcher=slurm"
    users = {"address": engines, "options": engines, "workers": pools, "retries": pools}
    for key, launchers in users.items():
        if key in given and settings.name not in launchers:
            raise ConfigError(
                f"launcher.{key}: launcher={settings.name} does not use this setting; expected launcher={launchers}"
            )
    return settings, others


def take_viewer_overrides(overrides: Sequence[str]) -> tuple[ViewerSettings | None, list[str]]:
    """Split overrides into viewer settings and the other overrides. The settings are None if no viewer is requested. A
    host or port alone requests a viewer.
    """
    shown, settings, others = take_settings(overrides, "viewer", ViewerSettings)
    if shown is None:
        shown = len(others) < len(overrides)
    return (settings if validate_value(shown, bool, "viewer") else None), others


def take_target_overrides(overrides: Sequence[str]) -> tuple[tuple[SearchTarget, float] | None, list[str]]:
    """Split overrides into (target, budget in seconds) and other overrides; the pair is None if neither is given."""
    budget, rest = take_budget_override(overrides)
    whole, target, others = take_settings(rest, "target", SearchTarget)
    if len(others) == len(overrides):
        return None, others
    if whole is not None:
        raise ConfigError(f"target={format_setting_value(whole)}: expected one of {_TARGETS}")
    asked = "target" if budget is None else f"budget={budget}"
    if not target.given_settings():
        other = "train.max_seconds=S for a run without a target"
        raise ConfigError(f"{asked}: no target given; expected one of {_TARGETS}, or {other}")
    if budget is None:
        expected = "a budget, the time for search and training together, such as budget=10m"
        raise ConfigError(f"{target}: expected {expected}")
    return (target, parse_duration_setting(budget, asked)), others


def take_budget_override(overrides: Sequence[str]) -> tuple[str | None, list[str]]:
    """Split overrides into the text after ``budget=`` (None if there is no budget) and the other overrides."""
    budget, _, others = take_settings(overrides, "budget", _Budget)
    return (None if budget is None else str(budget)), others


@dataclass(frozen=True)
class _Budget:
    """Settings group without settings: ``budget=10m`` has a value, and no ``budget.KEY`` is valid."""


def parse_duration_setting(text: str, asked: str) -> float:
    """Convert a duration such as 90s, 5m or 1h to seconds. Errors name ``asked``, the override as typed."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh])", text)
    if match is None or float(match[1]) == 0:
        raise ConfigError(f"{asked}: expected a time such as 90s, 5m or 1h")
    return float(match[1]) * {"s": 1.0, "m": 60.0, "h": 3600.0}[match[2]]
