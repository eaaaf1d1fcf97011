"""What is asked of an engine that runs tasks elsewhere, and the loop that hands them over, looks after them and
collects what came out."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from neuprim.runs.interrupt import interruptible
from neuprim.runs.launch.jobs import Job, Result
from neuprim.runs.launch.status import Status, read_status
from neuprim.runs.launch.worker import Task, environment

__all__ = ["Ended", "Engine", "Hear", "WorkerDied", "finished", "through"]

Hear = Callable[[int, Status], None]
"""Told the number of a job and its status."""

Ended = Callable[[int, Result], None]
"""Told the number of a job and how it ended."""

_EVERY = 0.1
"""Seconds between two looks at what is done."""

_SILENT = 60.0
"""Seconds without a sign of life that are said."""


class WorkerDied(Exception):
    """The process that had a task is gone; the text says what is known of it."""


class Engine(Protocol):
    """Takes tasks and does them elsewhere.

    Attributes:
        workers: how many it shall have at once. threads: of each.
    """

    workers: int
    threads: int

    def submit(self, task: Task) -> Any:
        """A handle of the task, which is on its way."""

    def done(self, handle: Any) -> bool:
        """Whether nothing more will come of it."""

    def result(self, handle: Any) -> Result:
        """Of a handle that is done. Raises WorkerDied."""

    def cancel(self, handle: Any) -> None:
        """Let go of a task that may not have begun yet; it is done soon."""

    def close(self, now: bool) -> None:
        """Let go of everything; ``now``: what still works is killed."""


def through(
    engine: Engine, jobs: Sequence[Job], folder: Path, retries: int, hear: Hear, ended: Ended
) -> list[Result | None]:
    """Results in the order of the jobs; None of those that were not begun when Ctrl-C came.

    The first Ctrl-C has every run finish its step and write its checkpoint; the second ends their processes.

    Args:
        folder: for statuses; every worker sees it under this path.
        retries: how often a job is started again after its worker died.
    """
    folder.mkdir(parents=True, exist_ok=True)
    stop, results = folder.absolute() / "stop", list[Result | None]([None] * len(jobs))
    stop.unlink(missing_ok=True)
    variables = environment(engine.threads)
    tasks = [
        Task(job, engine.threads, folder.absolute() / f"{number}.json", stop, Path.cwd(), variables)
        for number, job in enumerate(jobs)
    ]
    watch = _Watch(hear)
    waiting = deque(enumerate(tasks))
    working: dict[int, tuple[Any, Task]] = {}
    clean = False
    try:
        with interruptible() as stopped:
            while waiting or working:
                if stopped.is_set() and not stop.exists():
                    stop.touch()
                    waiting.clear()
                    for handle, task in working.values():
                        if not task.status.exists():  # it waits in the engine's own queue
                            engine.cancel(handle)
                while waiting and len(working) < engine.workers:
                    number, task = waiting.popleft()
                    task.status.unlink(missing_ok=True)
                    working[number] = engine.submit(task), task
                    watch.tell(number, Status("starting", attempt=task.attempt))
                for number, (handle, task) in list(working.items()):
                    if not engine.done(handle):
                        watch.look(number, task)
                        continue
                    del working[number]
                    outcome = _outcome(engine, handle, task, retries, stop.exists())
                    if isinstance(outcome, Task):
                        watch.tell(number, Status("waiting", "its worker died", attempt=outcome.attempt))
                        waiting.appendleft((number, outcome))
                        continue
                    results[number] = outcome
                    ended(number, outcome)
                    watch.tell(number, finished(read_status(task.status) or Status(), outcome))
                time.sleep(_EVERY)
        clean = True
    finally:
        engine.close(not clean)
        _tidy(folder, tasks, stop)
    return results


def _outcome(engine: Engine, handle: Any, task: Task, retries: int, stopping: bool) -> Result | Task:
    """What came of a task that is over, or the task that takes its place."""
    try:
        return engine.result(handle)
    except WorkerDied as death:
        attempts = task.attempt + 1
        if stopping:
            return Result("interrupted", attempts=attempts)
        if task.attempt < retries:
            return task.again()
        often = f", {attempts} times" if attempts > 1 else ""
        return Result("failed", line=f"its worker died{often}: {death}", attempts=attempts)


def finished(status: Status, result: Result) -> Status:
    """The last status of a job."""
    return replace(status, state=result.state, text=result.line, attempt=result.attempts - 1)


class _Watch:
    """Tells what is new of each job, and of whom nothing was heard for long; by this machine's clock alone, as others
    may go differently."""

    def __init__(self, hear: Hear) -> None:
        self._hear = hear
        self._last: dict[int, tuple[Status, float]] = {}

    def tell(self, number: int, status: Status) -> None:
        self._last[number] = status, time.monotonic()
        self._hear(number, status)

    def look(self, number: int, task: Task) -> None:
        status = read_status(task.status)
        before, since = self._last[number]
        if status is not None and status.attempt >= task.attempt and status != before:
            self.tell(number, status)
        elif time.monotonic() - since > _SILENT:
            self._hear(number, replace(before, text=f"no sign of it for {time.monotonic() - since:.0f} s"))


def _tidy(folder: Path, tasks: Sequence[Task], stop: Path) -> None:
    """Logs with something in them stay."""
    for file in (*(task.status for task in tasks), stop):
        file.unlink(missing_ok=True)
    for log in folder.glob("*.log"):
        if not log.stat().st_size:
            log.unlink()
    try:
        folder.rmdir()
    except OSError:  # logs
        pass
