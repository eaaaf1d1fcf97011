"""Where tasks run: processes of this machine (concurrent.futures), a Ray cluster, or Slurm (submitit).

All machines of a cluster have neuprim and see the output directory under the same path.
"""

from __future__ import annotations

import itertools
import logging
import multiprocessing
import os
import shutil
import socket
import tempfile
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol
from urllib.parse import urlsplit

from neuprim.config.command_settings import LauncherSettings
from neuprim.core.compute.threads import machine_cores
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.runs.launch.jobs import JobResult
from neuprim.runs.launch.worker import WorkerTask, start_worker_process, worker_cache_variables, worker_environment

_RAY_TIMEOUT = 5.0
"""Seconds for a Ray cluster to answer; Ray itself would wait for minutes."""

_SLURM_MINUTES = 24 * 60
"""Time limit of a job, unless ``launcher.options.timeout_min`` says otherwise; submitit's default is five minutes."""


class WorkerDied(Exception):
    """The process that had a task is gone; the text says what is known."""


class LaunchExecutor(Protocol):
    """Runs tasks in other processes.

    Attributes:
        workers: how many tasks it has at once. threads: of each.
    """

    workers: int
    threads: int

    def submit(self, task: WorkerTask) -> Any:
        """Start a task; returns its handle."""

    def done(self, handle: Any) -> bool:
        """Whether the task is over."""

    def result(self, handle: Any) -> JobResult:
        """The result of a task that is over. Raises WorkerDied."""

    def cancel(self, handle: Any) -> None:
        """Remove a task from a queue, if it has not begun."""

    def close(self, now: bool) -> None:
        """Release everything; ``now`` kills what still works."""


def divide_cores_among_jobs(settings: LauncherSettings, jobs: int) -> tuple[int, int]:
    """(jobs at once, threads of each) on this machine.

    Raises:
        ConfigError: together they would be more than the cores of this machine.
    """
    cores, workers, threads = machine_cores(), settings.workers, settings.threads
    if workers is None:
        workers = max(min(jobs, cores // (threads or 1)), 1)
    if threads is None:
        threads = max(cores // workers, 1)
    if workers * threads > cores:
        given = {"workers": settings.workers, "threads": settings.threads}
        names = " with ".join(f"launcher.{name}={value}" for name, value in given.items() if value is not None)
        raise ConfigError(
            f"{names}: more than the {cores} core{'s' * (cores > 1)} of this machine; "
            f"expected at most {cores} threads together"
        )
    return workers, threads


def count_parallel_jobs(settings: LauncherSettings, jobs: int) -> tuple[int, int]:
    """(jobs at once, threads of each, 0 for all) that a search may count on; raises as :func:`divide_cores_among_jobs`.

    What a cluster has at a given time is unknown: there it is what the user says, else as many as this machine has
    cores, with one thread.
    """
    if settings.name == "inline":
        return 1, settings.threads or 0
    here = {"processes": (None,), "ray": (None, "local"), "slurm": ("local",)}[settings.name]
    if settings.address in here:
        return divide_cores_among_jobs(settings, jobs)
    return min(settings.workers or machine_cores(), jobs), settings.threads or 1


# ------------------------------------------------------------ processes of this machine


@dataclass
class _WorkerProcess:
    """A pool of one process: when the system kills a process, its pool breaks and no other. ``log`` has its output."""

    pool: ProcessPoolExecutor
    log: Path


_ProcessHandle = tuple[Future[JobResult], _WorkerProcess]


class ProcessExecutor:
    """``launcher=processes``: workers that stay alive from one task to the next.

    Args:
        folder: for the workers' logs.
    """

    def __init__(self, settings: LauncherSettings, jobs: int, folder: Path) -> None:
        self.workers, self.threads = divide_cores_among_jobs(settings, jobs)
        self._folder, self._numbers = folder.absolute(), itertools.count()
        self._idle: list[_WorkerProcess] = []
        self._busy: list[_WorkerProcess] = []

    def submit(self, task: WorkerTask) -> _ProcessHandle:
        worker = self._idle.pop() if self._idle else self._new_worker()
        try:
            future = worker.pool.submit(task)
        except BrokenProcessPool:  # it was killed while it was idle
            worker.pool.shutdown(wait=False)
            worker = self._new_worker()
            future = worker.pool.submit(task)
        self._busy.append(worker)
        return future, worker

    def done(self, handle: _ProcessHandle) -> bool:
        return handle[0].done()

    def result(self, handle: _ProcessHandle) -> JobResult:
        future, worker = handle
        self._busy.remove(worker)
        try:
            result = future.result()
        except BrokenProcessPool:
            worker.pool.shutdown(wait=False)
            printed = f"; it printed {worker.log}" if worker.log.exists() and worker.log.stat().st_size else ""
            raise WorkerDied(
                f"its process was killed, as the system does when memory is full, or it crashed{printed}"
            ) from None
        self._idle.append(worker)
        return result

    def cancel(self, handle: _ProcessHandle) -> None:
        """Every task has begun; it stops by itself."""

    def close(self, now: bool) -> None:
        for worker in self._busy if now else []:
            for process in list((worker.pool._processes or {}).values()):
                process.kill()
        if pools := [worker.pool for worker in (*self._idle, *self._busy)]:
            with ThreadPoolExecutor(len(pools)) as closing:  # a worker takes a second to end
                list(closing.map(ProcessPoolExecutor.shutdown, pools))

    def _new_worker(self) -> _WorkerProcess:
        log, context = self._folder / f"worker-{next(self._numbers)}.log", multiprocessing.get_context("spawn")
        started = log, worker_environment(self.threads)
        return _WorkerProcess(ProcessPoolExecutor(1, context, start_worker_process, started), log)


# ------------------------------------------------------------ Ray


class RayExecutor:
    """``launcher=ray``: tasks of Ray, on this machine or on a cluster.

    Raises:
        BackendUnavailable: nothing answers at the address, or no Ray.
        ConfigError: options that Ray refuses, or more threads than any of its machines has.
    """

    def __init__(self, settings: LauncherSettings, jobs: int, folder: Path) -> None:
        import ray  # an extra

        self._ray = ray
        self._refs: list[Any] = []
        self._connected = not ray.is_initialized()
        if self._connected:
            _connect_to_ray(ray, settings.address or os.environ.get("RAY_ADDRESS") or "local")
        try:
            self.workers, self.threads = _divide_ray_cluster_among_jobs(ray, settings, jobs)
            options = {"num_cpus": self.threads, **settings.options}
            self._call = ray.remote(WorkerTask.__call__).options(**options, max_retries=0)
        except (ValueError, TypeError) as error:
            self.close(True)
            raise ConfigError(f"launcher.options: Ray refuses them: {_job_error_line(error)}") from None
        except ConfigError:
            self.close(True)
            raise

    def submit(self, task: WorkerTask) -> Any:
        self._refs.append(self._call.remote(task))
        return self._refs[-1]

    def done(self, handle: Any) -> bool:
        return bool(self._ray.wait([handle], timeout=0)[0])

    def result(self, handle: Any) -> JobResult:
        self._refs.remove(handle)
        try:
            result: JobResult = self._ray.get(handle)
            return result
        except self._ray.exceptions.RayTaskError as error:  # the worker lacks a package; a job's errors are results
            return JobResult(
                "failed", line=f"the worker cannot do it: {_job_error_line(error.cause)}", trace=str(error)
            )
        except self._ray.exceptions.RayError as error:
            raise WorkerDied(_job_error_line(error)) from None

    def cancel(self, handle: Any) -> None:
        self._ray.cancel(handle, force=False)

    def close(self, now: bool) -> None:
        for ref in self._refs if now else []:
            self._ray.cancel(ref, force=True)
        if self._connected:
            self._ray.shutdown()


def _connect_to_ray(ray: Any, address: str) -> None:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    options: dict[str, Any] = {"num_cpus": machine_cores(), "include_dashboard": False}
    if address != "local":
        _check_ray_address(address)
        options = {"runtime_env": {"env_vars": worker_cache_variables()}}
    try:
        ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False, **options)
    except (ValueError, ConnectionError, RuntimeError, SystemExit) as error:
        raise BackendUnavailable(f"launcher.address={address}: no Ray there ({_job_error_line(error)})") from None


def _check_ray_address(address: str) -> None:
    """Raise BackendUnavailable where nothing listens at ``HOST:PORT`` or ``ray://HOST:PORT``."""
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
        socket.create_connection((host, port), _RAY_TIMEOUT).close()
    except OSError as error:
        raise BackendUnavailable(
            f"launcher.address={address}: nothing answers there ({error}); "
            "expected a machine where `ray start --head` runs"
        ) from None


def _divide_ray_cluster_among_jobs(ray: Any, settings: LauncherSettings, jobs: int) -> tuple[int, int]:
    """(jobs at once, threads of each); jobs that the cluster has no cores for wait in Ray's queue."""
    machines = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
    if len(machines) == 1 and settings.address is None:
        return divide_cores_among_jobs(settings, jobs)
    most, cores = int(max(machines, default=1)), int(sum(machines))
    workers = settings.workers or jobs
    threads = settings.threads or max(min(cores // workers, most), 1)
    if threads > most:
        raise ConfigError(
            f"launcher.threads={threads}: no machine of this Ray cluster has as many; expected at most {most}"
        )
    return workers, threads


# ------------------------------------------------------------ Slurm


class SlurmExecutor:
    """``launcher=slurm``: jobs of a Slurm cluster; submitit's local executor uses processes of this machine.

    Args:
        folder: where submitit keeps its files, which workers see.

    Raises:
        BackendUnavailable: there is no Slurm here.
        ConfigError: parameters that submitit does not know.
    """

    def __init__(self, settings: LauncherSettings, jobs: int, folder: Path) -> None:
        import submitit  # an extra

        address = settings.address or "slurm"
        if address not in ("slurm", "local"):
            raise ConfigError(f"launcher.address={address}: expected slurm or local")
        self.workers, self.threads = settings.workers or jobs, settings.threads or 1
        if address == "local":
            self.workers, self.threads = divide_cores_among_jobs(settings, jobs)
        folder.mkdir(parents=True, exist_ok=True)
        # results are pickles, which run code when they are read: only this user can write into the new folder
        self._folder, self._died = Path(tempfile.mkdtemp(prefix="submitit-", dir=folder.absolute())), False
        self._jobs: list[Any] = []
        defaults = {"name": "neuprim", "cpus_per_task": self.threads, "timeout_min": _SLURM_MINUTES}
        try:
            self._executor = submitit.AutoExecutor(self._folder, cluster=address)
            self._executor.update_parameters(**{**defaults, **settings.options})
        except (RuntimeError, NameError, TypeError, ValueError, AssertionError) as error:
            self.close(False)
            with suppress(OSError):  # it has other files
                folder.rmdir()
            if not isinstance(error, RuntimeError):
                raise ConfigError(f"launcher.options: submitit refuses them: {_job_error_line(error)}") from None
            raise BackendUnavailable(
                f"launcher=slurm: {_job_error_line(error)}; launcher.address=local does without a cluster"
            ) from None

    def submit(self, task: WorkerTask) -> Any:
        self._jobs.append(self._executor.submit(task))
        return self._jobs[-1]

    def done(self, handle: Any) -> bool:
        return bool(handle.done())

    def result(self, handle: Any) -> JobResult:
        from submitit.core.utils import FailedJobError, UncompletedJobError

        self._jobs.remove(handle)
        try:
            result: JobResult = handle.result()
            return result
        except FailedJobError as error:  # the worker lacks a package; a job's errors are results
            last = str(error).strip().splitlines()[-1]
            return JobResult("failed", line=f"the worker cannot do it: {last}", trace=str(error))
        except UncompletedJobError:
            self._died = True
            raise WorkerDied(
                f"job {handle.job_id} ended without a result ({handle.state}); it printed {handle.paths.stderr}"
            ) from None

    def cancel(self, handle: Any) -> None:
        handle.cancel()

    def close(self, now: bool) -> None:
        for job in self._jobs if now else []:
            job.cancel()
        if not self._died and not now:
            shutil.rmtree(self._folder, ignore_errors=True)


def _job_error_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
