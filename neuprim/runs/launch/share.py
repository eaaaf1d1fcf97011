"""How many runs at once, and how many threads each: cores are shared out, and never promised twice."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

from neuprim.config.launcher import LauncherSettings
from neuprim.core.compute.threads import limit_process_threads, machine_cores
from neuprim.core.errors import ConfigError

__all__ = ["at_once", "own_share", "shared_out"]


def shared_out(settings: LauncherSettings, jobs: int) -> tuple[int, int]:
    """(runs at once, threads of each) on this machine.

    Raises:
        ConfigError: together they would be more than the cores of this machine.
    """
    cores, workers, threads = machine_cores(), settings.workers, settings.threads
    if workers is None:
        workers = max(min(jobs, cores // (threads or 1)), 1)
    if threads is None:
        threads = max(cores // workers, 1)
    if workers * threads > cores:
        said = {
            name: value
            for name, value in (("workers", settings.workers), ("threads", settings.threads))
            if value is not None
        }
        found = " with ".join(f"launcher.{name}={value}" for name, value in said.items())
        raise ConfigError(
            f"{found}: more than the {cores} core{'s' * (cores > 1)} of this machine; expected at most {cores} threads together"
        )
    return workers, threads


def at_once(settings: LauncherSettings, jobs: int) -> tuple[int, int]:
    """(runs at once, threads of each, 0 for all) that a search may count on; raises as :func:`shared_out`.

    What a cluster has at a given time nobody knows: there it is what the user says, else as many as this machine has
    cores, with one thread.
    """
    if settings.name == "inline":
        return 1, settings.threads or 0
    here = {"processes": (None,), "ray": (None, "local"), "slurm": ("local",)}[settings.name]
    if settings.address in here:
        return shared_out(settings, jobs)
    return min(settings.workers or machine_cores(), jobs), settings.threads or 1


def own_share(settings: LauncherSettings) -> AbstractContextManager[None]:
    """Inside, this process has the threads that runs in it shall have; where nothing is said, or they work elsewhere,
    those that it has."""
    return (
        limit_process_threads(settings.threads)
        if settings.name == "inline" and settings.threads is not None
        else nullcontext()
    )
