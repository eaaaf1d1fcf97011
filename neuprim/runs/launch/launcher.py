"""Launch many jobs: in this process, in other processes, on a Ray cluster or under Slurm."""

from __future__ import annotations

import importlib
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from neuprim.config.command_settings import LauncherSettings
from neuprim.core.compute.threads import limit_process_threads
from neuprim.core.errors import BackendUnavailable, NeuprimError
from neuprim.runs.launch.executors import EXECUTORS, LaunchExecutor, WorkerDied, divide_cores_among_jobs
from neuprim.runs.launch.jobs import (
    JobResult,
    JobStatus,
    LaunchJob,
    StatusListener,
    WorkerTask,
    interruptible_run,
    perform_job,
    read_status,
    worker_environment,
)

LAUNCH_FOLDER = "launch"
"""Folder in a sweep's directory for status files during the work, and for logs of workers that printed something."""

OnStatus = Callable[[int, JobStatus], None]
"""Function that is called with the index of a job and its status, whenever the status changes."""

OnResult = Callable[[int, JobResult], None]
"""Function that is called with the index of a job and its result, before the final status of the job."""

_INTERVAL = 0.1
"""Seconds between two checks of the running jobs."""


def ignore_status(number: int, status: JobStatus) -> None:
    """Do nothing: the default of ``on_status`` arguments, functions that are called with a job's new status."""


def check_launcher(settings: LauncherSettings, jobs: int) -> None:
    """Check that the launcher can run ``jobs`` jobs here, before any file is written.

    Raises:
        BackendUnavailable: the launcher needs a package that is not installed.
        ConfigError: the workers need more cores than this machine has.
    """
    if settings.name == "processes":
        divide_cores_among_jobs(settings, jobs)
    _, package = EXECUTORS.get(settings.name, (None, None))
    if package is None:
        return
    try:
        importlib.import_module(package)
    except ImportError as error:
        raise BackendUnavailable(
            f"launcher={settings.name} needs the package {package} ({error}): pip install 'neuprim[{settings.name}]'"
        ) from None


def use_launcher_threads_for_runs(settings: LauncherSettings) -> AbstractContextManager[None]:
    """Context manager that limits this process to ``launcher.threads`` threads, if it runs the jobs (``inline``)."""
    own = settings.name == "inline" and settings.threads is not None
    return limit_process_threads(settings.threads or 1) if own else nullcontext()


def launch_jobs(
    jobs: Sequence[LaunchJob],
    settings: LauncherSettings,
    folder: Path,
    on_status: OnStatus = ignore_status,
    on_result: OnResult = lambda number, result: None,
    stop_at_failure: bool = False,
) -> list[JobResult | None]:
    """Perform all jobs with a launcher.

    At the first Ctrl-C every run finishes its step and writes a checkpoint. A second Ctrl-C ends the processes.
    ``on_status`` and ``on_result`` are called with (index of a job, its status or result).

    Args:
        folder: shared folder of launcher and workers, under the same path on all machines. The folder is removed
            afterwards, unless workers printed something.
        stop_at_failure: whether the first job that fails stops all other jobs, as Ctrl-C does.

    Returns:
        Results in the order of the jobs; None for jobs that did not start.

    Raises:
        BackendUnavailable: the launcher needs a package that is not installed, or cannot be reached.
        ConfigError: the workers need more cores than this machine has, or the launcher refuses an option.
    """
    check_launcher(settings, len(jobs))
    if not jobs:
        return []
    if settings.name == "inline":
        with use_launcher_threads_for_runs(settings):
            return _launch_inline(jobs, on_status, on_result, stop_at_failure)
    try:
        executor = EXECUTORS[settings.name][0](settings, len(jobs), folder)
    except NeuprimError:
        with suppress(OSError):  # there may be none
            folder.rmdir()
        raise
    folder, threads = folder.absolute(), executor.threads
    variables = worker_environment(threads)
    tasks = [
        WorkerTask(job, threads, folder / f"{number}.json", folder / "stop", Path.cwd(), variables)
        for number, job in enumerate(jobs)
    ]
    return _JobLoop(executor, tasks, settings.retries, on_status, on_result, stop_at_failure).run()


def _launch_inline(
    jobs: Sequence[LaunchJob], on_status: OnStatus, on_result: OnResult, stop_at_failure: bool
) -> list[JobResult | None]:
    """Perform the jobs one after the other in this process, until Ctrl-C or, with ``stop_at_failure``, a failure."""
    results = list[JobResult | None]([None] * len(jobs))
    for number, job in enumerate(jobs):
        listener = StatusListener(on_status=partial(on_status, number))
        on_status(number, listener.status)
        result = results[number] = perform_job(job, 0, listener)
        on_result(number, result)
        on_status(number, listener.status.end(result))
        if result.state == "interrupted" or (stop_at_failure and result.state == "failed"):
            break
    return results


@dataclass
class _JobLoop:
    """Loop that submits jobs to an executor, follows their status, and collects results; see :func:`launch_jobs`."""

    executor: LaunchExecutor
    tasks: Sequence[WorkerTask]
    retries: int
    on_status: OnStatus
    on_result: OnResult
    stop_at_failure: bool

    def __post_init__(self) -> None:
        self.folder, self.stop = self.tasks[0].status.parent, self.tasks[0].stop
        self.waiting = deque(enumerate(self.tasks))
        self.running: dict[int, tuple[Any, WorkerTask]] = {}
        self.results = list[JobResult | None]([None] * len(self.tasks))
        self.statuses: dict[int, JobStatus] = {}

    def run(self) -> list[JobResult | None]:
        self.folder.mkdir(parents=True, exist_ok=True)
        self.stop.unlink(missing_ok=True)
        finished = False
        try:
            with interruptible_run() as stopped:
                while self.waiting or self.running:
                    if stopped.is_set() and not self.stop.exists():
                        self._stop_all()
                    self._step()
                    time.sleep(_INTERVAL)
            finished = True
        finally:
            self.executor.close(not finished)
            for file in (*(task.status for task in self.tasks), self.stop):
                file.unlink(missing_ok=True)
            for log in self.folder.glob("*.log"):
                if not log.stat().st_size:
                    log.unlink()
            with suppress(OSError):  # logs with something in them
                self.folder.rmdir()
        return self.results

    def _step(self) -> None:
        """Submit waiting tasks to free workers, and check the status of running tasks."""
        while self.waiting and len(self.running) < self.executor.workers:
            number, task = self.waiting.popleft()
            task.status.unlink(missing_ok=True)
            self.running[number] = self.executor.submit(task), task
            self._notify(number, JobStatus("starting", attempt=task.attempt))
        for number, (future, task) in list(self.running.items()):
            if future.done():
                del self.running[number]
                self._finish_job(number, future, task)
                continue
            status = read_status(task.status)
            if status and status.attempt >= task.attempt and status != self.statuses[number]:
                self._notify(number, status)

    def _stop_all(self) -> None:
        self.stop.touch()
        self.waiting.clear()
        for future, task in self.running.values():
            if not task.status.exists():  # it waits in the executor's queue
                self.executor.cancel(future)

    def _finish_job(self, number: int, future: Any, task: WorkerTask) -> None:
        try:
            result = self.executor.result(future)
        except WorkerDied as death:
            attempts = task.attempt + 1
            if self.stop.exists():
                result = JobResult("interrupted", attempts=attempts)
            elif task.attempt < self.retries:
                self._notify(number, JobStatus("waiting", "its worker died", attempt=attempts))
                self.waiting.appendleft((number, replace(task, attempt=attempts)))
                return
            else:
                times = f", {attempts} times" if attempts > 1 else ""
                result = JobResult("failed", line=f"its worker died{times}: {death}", attempts=attempts)
        self.results[number] = result
        if self.stop_at_failure and result.state == "failed" and not self.stop.exists():
            self._stop_all()
        self.on_result(number, result)
        self._notify(number, (read_status(task.status) or JobStatus()).end(result))

    def _notify(self, number: int, status: JobStatus) -> None:
        self.statuses[number] = status
        self.on_status(number, status)
