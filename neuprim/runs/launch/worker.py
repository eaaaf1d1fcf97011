"""Where a job works that is not in the launcher's own process: its share of the cores, its status in a file, and an eye
on whether to stop.

Launcher and worker meet in a folder that both see. That works between processes, containers and machines alike, and
outlives either.
"""

from __future__ import annotations

import _thread
import os
import signal
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from neuprim.runs.launch.jobs import Job, Result
    from neuprim.runs.launch.status import Listener

__all__ = ["PASSED_ON", "THREADS", "Task", "at_work", "environment", "interrupt"]

PASSED_ON = ("NEUPRIM_CACHE_DIR", "NUMBA_CACHE_DIR")
"""Variables that a worker has from its launcher, as a cluster may not hand them on."""

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Variables that libraries read when they are loaded."""

_EVERY = 0.25
"""Seconds between two looks."""

_BEAT = 20
"""Looks between two signs of life where nothing else is new."""


_working = threading.Event()


def at_work() -> bool:
    """Whether this process has a task."""
    return _working.is_set()


def interrupt(blocked: bool = False) -> None:
    """As Ctrl-C in this process, called beside its main thread: a run finishes its step and writes a checkpoint.

    Args:
        blocked: whether the main thread lets no such signal through, as Ray has it; then what it waits for is waited
        for.
    """
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None and not blocked:
        signal.pthread_kill(main, signal.SIGINT)  # which also wakes it where it waits
    else:
        _thread.interrupt_main()


def _can_be_stopped() -> bool:
    """In the main thread: whether it lets Ctrl-C through. A process whose parent ignored it, as in the background of a
    script, heeds it again."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return not (hasattr(signal, "pthread_sigmask") and signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))


def environment(threads: int) -> dict[str, str]:
    """Variables of a worker with so many threads."""
    return {name: os.environ[name] for name in PASSED_ON if name in os.environ} | dict.fromkeys(THREADS, str(threads))


@dataclass(frozen=True)
class Task:
    """A job with everything that its worker must know; called there.

    Attributes:
        threads: its share of the cores.
        status: file for its status. stop: file whose presence asks it to stop.
        cwd: folder that relative paths mean.
        variables: of the environment, set before anything heavy is imported.
        attempt: how often its worker died before.
    """

    job: Job
    threads: int
    status: Path
    stop: Path
    cwd: Path
    variables: Mapping[str, str] = field(default_factory=dict)
    attempt: int = 0

    def again(self) -> Task:
        """The same after its worker died."""
        return replace(self, attempt=self.attempt + 1)

    def __call__(self) -> Result:
        os.environ.update(self.variables)
        os.chdir(self.cwd)
        import torch

        from neuprim.core.compute.threads import limit_process_threads
        from neuprim.runs.launch.jobs import Result, perform
        from neuprim.runs.launch.status import Listener

        torch.set_num_threads(self.threads)
        listener, result = Listener(self.attempt), None
        try:
            with limit_process_threads(self.threads), _Attendant(self, listener):
                result = perform(self.job, self.attempt, listener)
        except KeyboardInterrupt:  # asked to stop as it ended
            pass
        return result or Result("interrupted", attempts=self.attempt + 1)


class _Attendant:
    """Context manager: beside the job, a thread that writes its status and interrupts it when it shall stop."""

    def __init__(self, task: Task, listener: Listener) -> None:
        self._task, self._listener = task, listener
        self._over, self._blocked = threading.Event(), not _can_be_stopped()
        self._thread = threading.Thread(target=self._attend, name="attendant", daemon=True)

    def __enter__(self) -> Self:
        _working.set()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
        self._thread.join()
        _working.clear()

    def _attend(self) -> None:
        from neuprim.runs.launch.status import write_status

        written, looks, asked = None, 0, False
        while True:
            over = self._over.wait(_EVERY)
            status = self._listener.status
            if status != written or looks % _BEAT == 0 or over:
                write_status(self._task.status, replace(status, beat=looks))
                written = status
            if over:
                return
            looks += 1
            if not asked and self._task.stop.exists():
                asked = True
                interrupt(self._blocked)
