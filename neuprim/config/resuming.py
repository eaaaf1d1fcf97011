"""What a run that goes on has from its directory: who made it, where that is not installed, and the units that its rates began in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from neuprim.config.outputs import ROOT
from neuprim.config.overrides import Assignment
from neuprim.config.record import RunConfig, recorded
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.notices import warn_once
from neuprim.plugins.mechanism import Group, UnknownPlugin
from neuprim.plugins.names import qualified, split
from neuprim.plugins.provenance import Maker, missing
from neuprim.plugins.registry import LOSSES, SCENES, TASKS

__all__ = ["not_installed", "units_as_begun"]


def not_installed(assignments: Sequence[Assignment], task: str, scene: str | None) -> ConfigError | None:
    """The error that names what made the run to resume, where that is missing; None where nothing is resumed or the fault is another.

    Args:
        assignments: all that was typed.
        task, scene: words that chose them; None: nothing was typed.
    """
    given: dict[str, Any] = {a.key: a.value for a in assignments}
    if given.get("resume") is not True:
        return None
    directory = _latest(task) if given.get("output_dir") is None else Path(str(given["output_dir"])).expanduser()
    try:
        made_by = None if directory is None else RunConfig.from_yaml(directory).made_by
    except NeuprimError:  # a damaged run says nothing
        return None
    if directory is None or made_by is None:
        return None
    kinds: tuple[tuple[Group[Any], Maker | None, Any], ...] = (
        (TASKS, made_by.task, task),
        (SCENES, made_by.scene, scene),
        (LOSSES, made_by.loss, given.get("train.loss")),
    )
    for group, maker, word in kinds:
        if maker is None or split(str(word))[1] != maker.name:
            continue  # the run had none, or another one is wanted now
        entry = f"{made_by.task.name}.{maker.name}" if group is SCENES else maker.name
        try:
            group.find(qualified(maker.package, entry))
        except UnknownPlugin:
            return ConfigError(f"{directory / 'config.yaml'}: {missing(group, maker, entry)}")
    return None


def units_as_begun(directory: Path, preset: str, units: Mapping[str, Any]) -> Mapping[str, Any]:
    """``train.rate_units`` of a run that goes on and for which none were typed.

    A run that is older than these, or than those of its preset, had its rates in the parameters' own units: others would change its speed
    half way.

    Args:
        directory: of the run; it may be new.
        preset: as chosen now.
        units: the preset's.
    """
    begun = recorded(directory)
    if not units or begun is None or begun.get("preset") != preset or (begun.get("train") or {}).get("rate_units"):
        return units
    names = ", ".join(units)
    warn_once(
        f"{directory / 'config.yaml'}: without train.rate_units; rates of {names} go on in the unit that they began in, the parameter's own"
    )
    return {}


def _latest(task: str) -> Path | None:
    """The newest directory that a run of that task made without being told where."""
    package, name = split(task)
    starts = (f"{name}-", f"{package}-{name}-")
    found = [entry for entry in ROOT.iterdir() if entry.name.startswith(starts)] if ROOT.is_dir() and name else []
    files = [entry / "config.yaml" for entry in found if (entry / "config.yaml").is_file()]
    return max(files, key=lambda file: file.stat().st_mtime).parent if files else None
