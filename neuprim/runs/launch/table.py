"""The launchers by name, and the one function that launches."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from neuprim.config.launcher import LauncherSettings
from neuprim.core.errors import BackendUnavailable, NeuprimError
from neuprim.runs.launch.engine import Ended, Engine, Hear, through
from neuprim.runs.launch.inline import inline
from neuprim.runs.launch.jobs import Job, Result
from neuprim.runs.launch.processes import Processes
from neuprim.runs.launch.share import shared_out
from neuprim.runs.launch.status import Status

__all__ = ["FOLDER", "check_launcher", "launch", "nobody"]

FOLDER = "launch"
"""Of a sweep's directory: statuses while it works, and the logs of workers that printed something."""


def _processes(settings: LauncherSettings, jobs: int, folder: Path) -> Engine:
    return Processes(*shared_out(settings, jobs), folder)


def _ray(settings: LauncherSettings, jobs: int, folder: Path) -> Engine:
    from neuprim.runs.launch.ray import Ray

    return Ray(settings, jobs)


def _slurm(settings: LauncherSettings, jobs: int, folder: Path) -> Engine:
    from neuprim.runs.launch.slurm import Slurm

    return Slurm(settings, jobs, folder)


@dataclass(frozen=True)
class _Kind:
    """How an engine is made of (settings, number of jobs, folder), and the package that it needs."""

    make: Callable[[LauncherSettings, int, Path], Engine]
    package: str | None = None


_ENGINES = {"processes": _Kind(_processes), "ray": _Kind(_ray, "ray"), "slurm": _Kind(_slurm, "submitit")}


def check_launcher(settings: LauncherSettings, jobs: int) -> None:
    """Refuses what cannot work, before anything is written.

    Raises:
        BackendUnavailable: the launcher needs a package that is not installed.
        ConfigError: more workers than this machine has cores.
    """
    kind = _ENGINES.get(settings.name)
    if kind is None:
        return
    if kind.package is None:
        shared_out(settings, jobs)
        return
    try:
        importlib.import_module(kind.package)
    except ImportError as error:
        raise BackendUnavailable(
            f"launcher={settings.name} needs the package {kind.package} ({error}): pip install 'neuprim[{settings.name}]'"
        ) from None


def nobody(number: int, status: Status) -> None:
    """Nobody listens."""


def kept_for_later(number: int, result: Result) -> None:
    """Results are looked at when all are there."""


def launch(
    jobs: Sequence[Job], settings: LauncherSettings, folder: Path, hear: Hear = nobody, ended: Ended = kept_for_later
) -> list[Result | None]:
    """Have every job done.

    Ctrl-C stops all of them as it stops a run: the step is finished and a checkpoint written.

    Args:
        folder: where launcher and workers meet; every worker sees it under this path. It is gone afterwards, unless
        workers printed something. hear: told (number of a job, its status) whenever there is something new.
        ended: told (number of a job, its result) once it is over, before ``hear`` is.

    Returns:
        results in the order of the jobs; None of those that Ctrl-C came before.

    Raises:
        BackendUnavailable: the launcher needs a package that is not installed, or cannot be reached.
        ConfigError: more workers than this machine has cores, or an option that the engine refuses.
    """
    check_launcher(settings, len(jobs))
    if settings.name == "inline":
        return inline(jobs, settings, hear, ended)
    if not jobs:
        return []
    try:
        engine = _ENGINES[settings.name].make(settings, len(jobs), folder)
    except NeuprimError:
        with suppress(OSError):  # there is none
            folder.rmdir()
        raise
    return through(engine, jobs, folder, settings.retries, hear, ended)
