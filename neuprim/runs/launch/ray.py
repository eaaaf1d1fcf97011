"""``launcher=ray``: tasks of Ray, on this machine or on a cluster whose machines have neuprim and see the output
directory under the same path."""

from __future__ import annotations

import logging
import os
import socket
from typing import Any
from urllib.parse import urlsplit

from neuprim.config.launcher import LauncherSettings
from neuprim.core.compute.threads import machine_cores
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.runs.launch.engine import WorkerDied
from neuprim.runs.launch.jobs import Result
from neuprim.runs.launch.share import shared_out
from neuprim.runs.launch.worker import PASSED_ON, Task

__all__ = ["Ray"]

LOCAL = "local"
_PATIENCE = 5.0
"""Seconds for a machine to answer; Ray itself would wait for minutes."""


class Ray:
    """An engine; see :class:`~neuprim.runs.launch.engine.Engine`.

    Raises:
        BackendUnavailable: nothing answers at the address, or no Ray.
        ConfigError: options that Ray refuses, or more threads than any of its machines has.
    """

    def __init__(self, settings: LauncherSettings, jobs: int) -> None:
        import ray  # an extra, so that this module can be imported without it

        self._ray = ray
        self._refs: list[Any] = []
        self._mine = not ray.is_initialized()
        if self._mine:
            _connect(ray, settings.address or os.environ.get("RAY_ADDRESS") or LOCAL)
        try:
            self.workers, self.threads = _shared_out(ray, settings, jobs)
            self._do = ray.remote(_do).options(**{"num_cpus": self.threads, **settings.options}, max_retries=0)
        except (ValueError, TypeError) as error:
            self.close(True)
            raise ConfigError(f"launcher.options: Ray refuses them: {_line(error)}") from None
        except ConfigError:
            self.close(True)
            raise

    def submit(self, task: Task) -> Any:
        ref = self._do.remote(task)
        self._refs.append(ref)
        return ref

    def done(self, handle: Any) -> bool:
        return bool(self._ray.wait([handle], timeout=0)[0])

    def result(self, handle: Any) -> Result:
        self._refs.remove(handle)
        try:
            result: Result = self._ray.get(handle)
            return result
        except (
            self._ray.exceptions.RayTaskError
        ) as error:  # the worker lacks something: a job's own errors are in its result
            return Result("failed", line=f"the worker cannot do it: {_line(error.cause)}", trace=str(error))
        except self._ray.exceptions.RayError as error:
            raise WorkerDied(_line(error)) from None

    def cancel(self, handle: Any) -> None:
        self._ray.cancel(handle, force=False)

    def close(self, now: bool) -> None:
        for ref in self._refs if now else []:
            self._ray.cancel(ref, force=True)
        if self._mine:
            self._ray.shutdown()


def _do(task: Task) -> Result:
    return task()


def _connect(ray: Any, address: str) -> None:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    how: dict[str, Any] = {"num_cpus": machine_cores(), "include_dashboard": False}
    if address != LOCAL:
        _reach(address)
        how = {"runtime_env": {"env_vars": {name: os.environ[name] for name in PASSED_ON if name in os.environ}}}
    try:
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, **how)
    except (ValueError, ConnectionError, RuntimeError, SystemExit) as error:
        raise BackendUnavailable(f"launcher.address={address}: no Ray there ({_line(error)})") from None


def _reach(address: str) -> None:
    """Raises BackendUnavailable where nothing listens at ``HOST:PORT`` or ``ray://HOST:PORT``."""
    if address == "auto":
        return
    try:
        parts = urlsplit(address if "://" in address else f"ray://{address}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host, port = None, None
    if not host or not port:
        raise ConfigError(f"launcher.address={address}: expected auto, HOST:PORT or ray://HOST:PORT")
    try:
        socket.create_connection((host, port), _PATIENCE).close()
    except OSError as error:
        raise BackendUnavailable(
            f"launcher.address={address}: nothing answers there ({error}); expected a machine where `ray start --head` runs"
        ) from None


def _shared_out(ray: Any, settings: LauncherSettings, jobs: int) -> tuple[int, int]:
    """(runs at once, threads of each); what is more than the cluster has at a time waits in Ray's queue."""
    machines = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
    if len(machines) == 1 and settings.address is None:
        return shared_out(settings, jobs)
    most, cores = int(max(machines, default=1)), int(sum(machines))
    workers = settings.workers or jobs
    threads = settings.threads or max(min(cores // workers, most), 1)
    if threads > most:
        raise ConfigError(
            f"launcher.threads={threads}: no machine of this Ray cluster has as many; expected at most {most}"
        )
    return workers, threads


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
