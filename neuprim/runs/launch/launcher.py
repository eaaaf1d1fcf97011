"""Launch many jobs: in this process, in others, on a Ray cluster or under Slurm."""

from __future__ import annotations

import importlib
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.config.command_settings import LauncherSettings
from neuprim.core.compute.threads import limit_process_threads
from neuprim.core.errors import BackendUnavailable, NeuprimError
from neuprim.runs.launch.executors import (
    LaunchExecutor,
    ProcessExecutor,
    RayExecutor,
    SlurmExecutor,
    WorkerDied,
    divide_cores_among_jobs,
)
from neuprim.runs.launch.jobs import JobResult, JobStatus, LaunchJob, StatusListener, perform_job, read_status
from neuprim.runs.launch.worker import WorkerTask, interruptible_run, worker_environment

if TYPE_CHECKING:
    from neuprim.runs.fit import Event

LAUNCH_FOLDER = "launch"
"""In a sweep's directory: statuses while it works, and the logs of workers that printed something."""

OnStatus = Callable[[int, JobStatus], None]
"""Called with the number of a job and its status, whenever it is new."""

OnResult = Callable[[int, JobResult], None]
"""Called with the number of a job and its result, before its last status."""

_EXECUTORS: dict[str, Callable[[LauncherSettings, int, Path], LaunchExecutor]] = {
    "processes": ProcessExecutor,
    "ray": RayExecutor,
    "slurm": SlurmExecutor,
}
_PACKAGES = {"ray": "ray", "slurm": "submitit"}
"""Launcher -> the package that it needs."""

_INTERVAL = 0.1
"""Seconds between two looks at what is done."""


def ignore_status(number: int, status: JobStatus) -> None:
    """Do nothing."""


def ignore_job_result(number: int, result: JobResult) -> None:
    """Do nothing."""


def check_launcher(settings: LauncherSettings, jobs: int) -> None:
    """Refuse what cannot work, before anything is written.

    Raises:
        BackendUnavailable: the launcher needs a package that is not installed.
        ConfigError: more workers than this machine has cores.
    """
    if settings.name == "processes":
        divide_cores_among_jobs(settings, jobs)
    if (package := _PACKAGES.get(settings.name)) is None:
        return
    try:
        importlib.import_module(package)
    except ImportError as error:
        raise BackendUnavailable(
            f"launcher={settings.name} needs the package {package} ({error}): pip install 'neuprim[{settings.name}]'"
        ) from None


def use_launcher_threads_for_runs(settings: LauncherSettings) -> AbstractContextManager[None]:
    """Give this process the threads of ``launcher.threads`` where runs work in it; otherwise it keeps its own."""
    own = settings.name == "inline" and settings.threads is not None
    return limit_process_threads(settings.threads or 1) if own else nullcontext()


def launch_jobs(
    jobs: Sequence[LaunchJob],
    settings: LauncherSettings,
    folder: Path,
    on_status: OnStatus = ignore_status,
    on_result: OnResult = ignore_job_result,
    stop_at_failure: bool = False,
) -> list[JobResult | None]:
    """Do all jobs.

    The first Ctrl-C stops every job as it stops a run, which finishes its step and writes a checkpoint; the second ends
    their processes.

    Args:
        folder: where launcher and workers meet; every worker sees it under this path. It is removed afterwards, unless
            workers printed something.
        stop_at_failure: whether the first job that fails stops the others as Ctrl-C does.

    Returns:
        results in the order of the jobs; None for those that did not start.

    Raises:
        BackendUnavailable: the launcher needs a package that is not installed, or cannot be reached.
        ConfigError: more workers than this machine has cores, or an option that the launcher refuses.
    """
    check_launcher(settings, len(jobs))
    if settings.name == "inline":
        return _launch_inline(jobs, settings, on_status, on_result, stop_at_failure)
    if not jobs:
        return []
    try:
        executor = _EXECUTORS[settings.name](settings, len(jobs), folder)
    except NeuprimError:
        with suppress(OSError):  # there may be none
            folder.rmdir()
        raise
    return _JobLoop(executor, jobs, folder, settings.retries, on_status, on_result, stop_at_failure).run()


def _launch_inline(
    jobs: Sequence[LaunchJob],
    settings: LauncherSettings,
    on_status: OnStatus,
    on_result: OnResult,
    stop_at_failure: bool,
) -> list[JobResult | None]:
    """Do one job after the other in this process, up to the one that Ctrl-C or a failure ends."""
    results = list[JobResult | None]([None] * len(jobs))
    with use_launcher_threads_for_runs(settings):
        for number, job in enumerate(jobs):
            listener = StatusListener()

            def notify(event: Event, number: int = number, listener: StatusListener = listener) -> None:
                listener(event)
                on_status(number, listener.status)

            on_status(number, JobStatus("starting"))
            result = results[number] = perform_job(job, 0, notify)
            on_result(number, result)
            on_status(number, listener.status.end(result))
            if result.state == "interrupted" or (stop_at_failure and result.state == "failed"):
                break
    return results


class _JobLoop:
    """Hand jobs to an executor, follow them, and collect their results."""

    def __init__(
        self,
        executor: LaunchExecutor,
        jobs: Sequence[LaunchJob],
        folder: Path,
        retries: int,
        on_status: OnStatus,
        on_result: OnResult,
        stop_at_failure: bool,
    ) -> None:
        self._executor, self._retries, self._on_status, self._on_result = executor, retries, on_status, on_result
        self._stop_at_failure = stop_at_failure
        self._folder = folder.absolute()
        self._stop = self._folder / "stop"
        variables, threads = worker_environment(executor.threads), executor.threads
        self._tasks = [
            WorkerTask(job, threads, self._folder / f"{number}.json", self._stop, Path.cwd(), variables)
            for number, job in enumerate(jobs)
        ]
        self._waiting = deque(enumerate(self._tasks))
        self._running: dict[int, tuple[Any, WorkerTask]] = {}
        self._results = list[JobResult | None]([None] * len(jobs))
        self._statuses: dict[int, JobStatus] = {}

    def run(self) -> list[JobResult | None]:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._stop.unlink(missing_ok=True)
        finished = False
        try:
            with interruptible_run() as stopped:
                while self._waiting or self._running:
                    if stopped.is_set() and not self._stop.exists():
                        self._stop_all()
                    while self._waiting and len(self._running) < self._executor.workers:
                        number, task = self._waiting.popleft()
                        task.status.unlink(missing_ok=True)
                        self._running[number] = self._executor.submit(task), task
                        self._notify_status(number, JobStatus("starting", attempt=task.attempt))
                    for number, (handle, task) in list(self._running.items()):
                        if self._executor.done(handle):
                            del self._running[number]
                            self._finish_job(number, handle, task)
                            continue
                        status = read_status(task.status)
                        if status and status.attempt >= task.attempt and status != self._statuses[number]:
                            self._notify_status(number, status)
                    time.sleep(_INTERVAL)
            finished = True
        finally:
            self._executor.close(not finished)
            for file in (*(task.status for task in self._tasks), self._stop):
                file.unlink(missing_ok=True)
            for log in self._folder.glob("*.log"):
                if not log.stat().st_size:
                    log.unlink()
            with suppress(OSError):  # logs with something in them
                self._folder.rmdir()
        return self._results

    def _stop_all(self) -> None:
        self._stop.touch()
        self._waiting.clear()
        for handle, task in self._running.values():
            if not task.status.exists():  # it waits in the executor's queue
                self._executor.cancel(handle)

    def _finish_job(self, number: int, handle: Any, task: WorkerTask) -> None:
        try:
            result = self._executor.result(handle)
        except WorkerDied as death:
            attempts = task.attempt + 1
            if self._stop.exists():
                result = JobResult("interrupted", attempts=attempts)
            elif task.attempt < self._retries:
                self._notify_status(number, JobStatus("waiting", "its worker died", attempt=attempts))
                self._waiting.appendleft((number, task.retry()))
                return
            else:
                times = f", {attempts} times" if attempts > 1 else ""
                result = JobResult("failed", line=f"its worker died{times}: {death}", attempts=attempts)
        self._results[number] = result
        if self._stop_at_failure and result.state == "failed" and not self._stop.exists():
            self._stop_all()
        self._on_result(number, result)
        self._notify_status(number, (read_status(task.status) or JobStatus()).end(result))

    def _notify_status(self, number: int, status: JobStatus) -> None:
        self._statuses[number] = status
        self._on_status(number, status)
