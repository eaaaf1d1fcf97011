"""Do a job in a process of its own: with its share of the cores, its status in a file, and a way to stop it.

Launcher and worker meet in a folder that both see, which works between processes, containers and machines alike.
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
from typing import Self

from neuprim.runs.launch.jobs import Job, Result, StatusListener, perform, write_status

CACHE_VARIABLES = ("NEUPRIM_CACHE_DIR", "NUMBA_CACHE_DIR")
"""Variables that a worker gets from its launcher, as a cluster may not pass them on."""

THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Variables that libraries read when they are loaded."""

_INTERVAL = 0.25
"""Seconds between two looks at the status and at the file that stops the job."""

_working = threading.Event()


def is_working() -> bool:
    """Whether this process does a task."""
    return _working.is_set()


def interrupt(blocked: bool = False) -> None:
    """Interrupt the main thread as Ctrl-C does: a run finishes its step and writes a checkpoint.

    Args:
        blocked: whether the main thread blocks that signal, as Ray has it; then a wait of it ends first.
    """
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None and not blocked:
        signal.pthread_kill(main, signal.SIGINT)  # this also ends a wait
    else:
        _thread.interrupt_main()


def worker_environment(threads: int) -> dict[str, str]:
    """Environment variables of a worker with so many threads."""
    passed = {name: os.environ[name] for name in CACHE_VARIABLES if name in os.environ}
    return passed | dict.fromkeys(THREAD_VARIABLES, str(threads))


@dataclass(frozen=True)
class Task:
    """A job with all that its worker needs; called in the worker.

    Attributes:
        threads: its share of the cores.
        status: file for its status. stop: file whose presence asks it to stop.
        cwd: folder that relative paths refer to.
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

    def retry(self) -> Task:
        """The same task after its worker died."""
        return replace(self, attempt=self.attempt + 1)

    def __call__(self) -> Result:
        os.environ.update(self.variables)
        os.chdir(self.cwd)
        import torch

        from neuprim.core.compute.threads import limit_process_threads

        torch.set_num_threads(self.threads)
        listener, result = StatusListener(self.attempt), None
        try:
            with limit_process_threads(self.threads), _StatusThread(self, listener):
                result = perform(self.job, self.attempt, listener)
        except KeyboardInterrupt:  # it was asked to stop just as it ended
            pass
        return result or Result("interrupted", attempts=self.attempt + 1)


class _StatusThread:
    """Context manager: a thread that writes a job's status and interrupts the job when it shall stop."""

    def __init__(self, task: Task, listener: StatusListener) -> None:
        self._task, self._listener = task, listener
        self._over, self._blocked = threading.Event(), _blocks_interrupts()
        self._thread = threading.Thread(target=self._watch, name="neuprim-status", daemon=True)

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

    def _watch(self) -> None:
        written, asked, over = None, False, False
        while not over:
            over = self._over.wait(_INTERVAL)
            status = self._listener.status
            if status != written:
                write_status(self._task.status, status)
                written = status
            if not over and not asked and self._task.stop.exists():
                asked = True
                interrupt(self._blocked)


def _blocks_interrupts() -> bool:
    """Whether the main thread, which calls this, blocks Ctrl-C. A process whose parent ignored it, as in the background
    of a script, listens to it again."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return hasattr(signal, "pthread_sigmask") and signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())
