"""Executors, which run tasks in processes of this machine (concurrent.futures), on Ray, or under Slurm (submitit).

Every machine of a cluster needs neuprim, and access to the output directory under the same path.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import shutil
import socket
import tempfile
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from neuprim.config.command_settings import LauncherSettings
from neuprim.core.compute.threads import machine_cores
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.runs.launch.jobs import (
    JobResult,
    WorkerTask,
    start_worker_process,
    worker_cache_variables,
    worker_environment,
)

_RAY_TIMEOUT = 5.0
"""Seconds for a Ray cluster to answer; Ray itself would wait for minutes."""

_SLURM_MINUTES = 24 * 60
"""Time limit of a job, unless ``launcher.options.timeout_min`` says otherwise; submitit's default is five minutes."""


class WorkerDied(Exception):
    """The worker process of a task died. The message says what is known about the cause."""


def divide_cores_among_jobs(settings: LauncherSettings, jobs: int) -> tuple[int, int]:
    """Divide this machine's cores among jobs; return (parallel jobs, threads per job).

    Raises:
        ConfigError: the requested jobs and threads need more cores than this machine has.
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
            f"{names}: needs more than the {cores} core{'s' * (cores > 1)} of this machine; "
            f"expected at most {cores} threads in total"
        )
    return workers, threads


def count_parallel_jobs(settings: LauncherSettings, jobs: int) -> tuple[int, int]:
    """Return the expected (parallel jobs, threads per job) of a launcher; 0 threads means all cores.

    On a cluster, whose free resources are unknown, both numbers are the user's settings. The defaults are as many jobs
    as this machine has cores, and one thread per job. Raises the errors of :func:`divide_cores_among_jobs`.
    """
    if settings.name == "inline":
        return 1, settings.threads or 0
    here = {"processes": (None,), "ray": (None, "local"), "slurm": ("local",)}[settings.name]
    if settings.address in here:
        return divide_cores_among_jobs(settings, jobs)
    return min(settings.workers or machine_cores(), jobs), settings.threads or 1


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _cannot_begin(error: BaseException) -> JobResult:
    """Return the result of a job that a worker could not start, e.g. because it lacks a package."""
    return JobResult("failed", line=f"the worker cannot do it: {str(error).strip().splitlines()[-1]}", trace=str(error))


class ProcessExecutor:
    """Executor of ``launcher=processes``: worker processes that are reused from one task to the next.

    Each worker is a pool with one process. If the system kills the process, the other pools are not affected.

    Args:
        folder: folder for the workers' logs.

    Attributes:
        workers: number of parallel tasks.
        threads: number of threads per task.
    """

    def __init__(self, settings: LauncherSettings, jobs: int, folder: Path) -> None:
        self.workers, self.threads = divide_cores_among_jobs(settings, jobs)
        self._folder = folder.absolute()
        self._logs: dict[ProcessPoolExecutor, Path] = {}
        self._idle: list[ProcessPoolExecutor] = []
        self._busy: dict[Future[JobResult], ProcessPoolExecutor] = {}

    def submit(self, task: WorkerTask) -> Future[JobResult]:
        """Start a task in an idle worker, or in a new one."""
        pool = self._idle.pop() if self._idle else self._new_pool()
        try:
            future = pool.submit(task)
        except BrokenProcessPool:  # it was killed while it was idle
            pool = self._new_pool()
            future = pool.submit(task)
        self._busy[future] = pool
        return future

    def result(self, future: Future[JobResult]) -> JobResult:
        """Return the result of a finished task. Raises WorkerDied if the worker process crashed or was killed."""
        pool = self._busy.pop(future)
        try:
            result = future.result()
        except BrokenProcessPool:
            log = self._logs[pool]
            printed = f"; its output is in {log}" if log.exists() and log.stat().st_size else ""
            raise WorkerDied(
                f"its process crashed or was killed, for example because memory was full{printed}"
            ) from None
        self._idle.append(pool)
        return result

    def cancel(self, future: Future[JobResult]) -> None:
        """Remove a task that has not started from the queue. Does nothing here, because this executor has no queue."""

    def close(self, now: bool) -> None:
        """End all workers; ``now`` kills workers that still run a task."""
        for pool in self._busy.values() if now else ():
            for process in list((pool._processes or {}).values()):
                process.kill()
        if self._logs:
            with ThreadPoolExecutor(len(self._logs)) as closing:  # a worker takes a second to end
                list(closing.map(ProcessPoolExecutor.shutdown, self._logs))

    def _new_pool(self) -> ProcessPoolExecutor:
        log = self._folder / f"worker-{len(self._logs)}.log"
        started = log, worker_environment(self.threads)
        pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), start_worker_process, started)
        self._logs[pool] = log
        return pool


# ------------------------------------------------------------ Ray


class RayExecutor:
    """Executor of ``launcher=ray``: tasks of Ray, on this machine or on a cluster.

    Raises:
        BackendUnavailable: no Ray cluster answers at the address.
        ConfigError: Ray refuses an option, or a job needs more threads than any machine of the cluster has.
    """

    def __init__(self, settings: LauncherSettings, jobs: int, folder: Path) -> None:
        import ray  # an extra

        self._ray = ray
        self._futures: set[Any] = set()
        self._connected = not ray.is_initialized()
        if self._connected:
            _connect_to_ray(ray, settings.address or os.environ.get("RAY_ADDRESS") or "local")
        try:
            self.workers, self.threads = _divide_ray_cluster_among_jobs(ray, settings, jobs)
            options = {"num_cpus": self.threads, **settings.options}
            self._call = ray.remote(WorkerTask.__call__).options(**options, max_retries=0)
        except (ConfigError, ValueError, TypeError) as error:
            self.close(True)
            if isinstance(error, ConfigError):
                raise
            raise ConfigError(f"launcher.options: Ray refuses these options: {_one_line(error)}") from None

    def submit(self, task: WorkerTask) -> Any:
        future = self._call.remote(task).future()
        self._futures.add(future)
        return future

    def result(self, future: Any) -> JobResult:
        self._futures.remove(future)
        try:
            result: JobResult = future.result()
            return result
        except self._ray.exceptions.RayTaskError as error:
            return _cannot_begin(error)
        except self._ray.exceptions.RayError as error:
            raise WorkerDied(_one_line(error)) from None

    def cancel(self, future: Any) -> None:
        self._ray.cancel(future.object_ref, force=False)

    def close(self, now: bool) -> None:
        for future in self._futures if now else ():
            self._ray.cancel(future.object_ref, force=True)
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
        raise BackendUnavailable(f"launcher.address={address}: cannot connect to Ray ({_one_line(error)})") from None


def _check_ray_address(address: str) -> None:
    """Raise BackendUnavailable if nothing listens at the address ``HOST:PORT`` or ``ray://HOST:PORT``."""
    if address == "auto":
        return
    try:
        parts = urlsplit(address if "://" in address else f"ray://{address}")
        socket.create_connection((parts.hostname or "", parts.port or 0), _RAY_TIMEOUT).close()
    except (OSError, ValueError) as error:
        raise BackendUnavailable(
            f"launcher.address={address}: no answer from this address ({error}); expected auto, HOST:PORT or "
            f"ray://HOST:PORT of a machine where `ray start --head` runs"
        ) from None


def _divide_ray_cluster_among_jobs(ray: Any, settings: LauncherSettings, jobs: int) -> tuple[int, int]:
    """Return (parallel jobs, threads per job) on a Ray cluster. Jobs without free cores wait in Ray's queue."""
    machines = [node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"]]
    if len(machines) == 1 and settings.address is None:
        return divide_cores_among_jobs(settings, jobs)
    most, workers = int(max(machines, default=1)), settings.workers or jobs
    threads = settings.threads or max(min(int(sum(machines)) // workers, most), 1)
    if threads > most:
        raise ConfigError(
            f"launcher.threads={threads}: no machine of this Ray cluster has so many cores; expected at most {most}"
        )
    return workers, threads


# ------------------------------------------------------------ Slurm


class SlurmExecutor:
    """Executor of ``launcher=slurm``: Slurm jobs, or with ``launcher.address=local`` processes of this machine.

    Args:
        folder: folder for submitit's files; workers need access to it.

    Raises:
        BackendUnavailable: Slurm is not available on this machine.
        ConfigError: submitit does not know an option.
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
            if not isinstance(error, RuntimeError):
                raise ConfigError(f"launcher.options: submitit refuses these options: {_one_line(error)}") from None
            raise BackendUnavailable(
                f"launcher=slurm: {_one_line(error)}; launcher.address=local works without a cluster"
            ) from None

    def submit(self, task: WorkerTask) -> Any:
        self._jobs.append(self._executor.submit(task))
        return self._jobs[-1]

    def result(self, future: Any) -> JobResult:
        from submitit.core.utils import FailedJobError, UncompletedJobError

        self._jobs.remove(future)
        try:
            result: JobResult = future.result()
            return result
        except FailedJobError as error:
            return _cannot_begin(error)
        except UncompletedJobError:
            self._died = True
            raise WorkerDied(
                f"job {future.job_id} ended without a result ({future.state}); its output is in {future.paths.stderr}"
            ) from None

    def cancel(self, future: Any) -> None:
        future.cancel()

    def close(self, now: bool) -> None:
        for job in self._jobs if now else []:
            job.cancel()
        if not self._died and not now:
            shutil.rmtree(self._folder, ignore_errors=True)


LaunchExecutor = ProcessExecutor | RayExecutor | SlurmExecutor

EXECUTORS: dict[str, tuple[type[LaunchExecutor], str | None]] = {
    "processes": (ProcessExecutor, None),
    "ray": (RayExecutor, "ray"),
    "slurm": (SlurmExecutor, "submitit"),
}
"""Name of a launcher -> class of its executor, and the package that the executor needs; None for no package."""
