"""Do a job in a process of its own: with its share of the cores, its status in a file, and a way to stop it.

Launcher and worker meet in a folder that both see, which works between processes, containers and machines alike.
"""

from __future__ import annotations

import _thread
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import Any

from neuprim.runs.launch.jobs import JobResult, LaunchJob, StatusListener, perform_job, write_status

_CACHE_VARIABLES = ("NEUPRIM_CACHE_DIR", "NUMBA_CACHE_DIR")
"""A cluster may not pass them on."""

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Libraries read them when they are loaded."""

_INTERVAL = 0.25
"""Seconds between two looks at the status and at the file that stops the job."""

_GRACE = 60.0
"""Seconds that a worker has to write its checkpoint when its launcher is gone."""

_working = threading.Event()


def worker_cache_variables() -> dict[str, str]:
    """Environment variables that a worker gets from its launcher."""
    return {name: os.environ[name] for name in _CACHE_VARIABLES if name in os.environ}


def worker_environment(threads: int) -> dict[str, str]:
    """Environment variables of a worker with so many threads."""
    return worker_cache_variables() | dict.fromkeys(_THREAD_VARIABLES, str(threads))


@dataclass(frozen=True)
class WorkerTask:
    """A job with all that its worker needs; called in the worker.

    Attributes:
        threads: its share of the cores.
        status: file for its status. stop: file whose presence asks it to stop.
        cwd: folder that relative paths refer to.
        variables: of the environment, set before anything heavy is imported.
        attempt: how often its worker died before.
    """

    job: LaunchJob
    threads: int
    status: Path
    stop: Path
    cwd: Path
    variables: Mapping[str, str] = field(default_factory=dict)
    attempt: int = 0

    def retry(self) -> WorkerTask:
        """The same task after its worker died."""
        return replace(self, attempt=self.attempt + 1)

    def checkpoint(self) -> Any:
        """What submitit queues when Slurm takes the machine away or its time is up: the task, which continues."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self.retry())

    def __call__(self) -> JobResult:
        os.environ.update(self.variables)
        os.chdir(self.cwd)
        import torch

        from neuprim.core.compute.threads import limit_process_threads

        torch.set_num_threads(self.threads)
        listener, result = StatusListener(self.attempt), None
        try:
            with limit_process_threads(self.threads), _report_status(self, listener):
                result = perform_job(self.job, self.attempt, listener)
        except KeyboardInterrupt:  # it was asked to stop just as it ended
            pass
        return result or JobResult("interrupted", attempts=self.attempt + 1)


@contextmanager
def _report_status(task: WorkerTask, listener: StatusListener) -> Iterator[None]:
    """Have a thread write the task's status, and interrupt the main thread once the task shall stop."""
    over, blocked = threading.Event(), _worker_blocks_interrupts()

    def watch() -> None:
        written, stopped, last = None, False, False
        while not last:
            last = over.wait(_INTERVAL)
            if listener.status != written:
                written = listener.status
                write_status(task.status, written)
            if not last and not stopped and task.stop.exists():
                stopped = True
                _interrupt_worker_main_thread(blocked)

    thread = threading.Thread(target=watch, name="neuprim-status", daemon=True)
    _working.set()
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        _working.clear()


# ---------------------------------------------------------------- Ctrl-C


@contextmanager
def interruptible_run(terminated: bool = False) -> Iterator[threading.Event]:
    """Yield an event that the first Ctrl-C sets; the second one interrupts at once. Outside the main thread nothing
    changes.

    Args:
        terminated: whether SIGTERM counts as Ctrl-C: torchrun sends it when it is stopped, or one of its processes
            ended.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def handler(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    numbers = (signal.SIGINT, signal.SIGTERM) if terminated else (signal.SIGINT,)
    previous = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield stop
    finally:
        for number, before in previous.items():
            signal.signal(number, before)


def _interrupt_worker_main_thread(blocked: bool = False) -> None:
    """Interrupt the main thread as Ctrl-C does: a run finishes its step and writes a checkpoint.

    Args:
        blocked: whether the main thread blocks that signal, as under Ray; then a wait of it ends first.
    """
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None and not blocked:
        signal.pthread_kill(main, signal.SIGINT)  # this also ends a wait
    else:
        _thread.interrupt_main()


def _worker_blocks_interrupts() -> bool:
    """Whether the main thread, which calls this, blocks Ctrl-C. A process whose parent ignored it, as in the background
    of a script, listens to it again."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return hasattr(signal, "pthread_sigmask") and signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())


# ---------------------------------------------------------------- processes of this machine


def start_worker_process(log: Path, variables: Mapping[str, str]) -> None:
    """Prepare a new process: it ignores the terminal's Ctrl-C, which the launcher passes on, writes its output to a
    file, and ends when the launcher is gone."""
    os.environ.update(variables)
    if hasattr(os, "setsid"):
        os.setsid()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    with open(log, "ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    threading.Thread(target=_end_worker_without_launcher, name="neuprim-orphaned", daemon=True).start()


def _end_worker_without_launcher() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker has a launcher"
    parent.join()
    if _working.is_set():
        _interrupt_worker_main_thread()
    until = time.monotonic() + _GRACE
    while _working.is_set() and time.monotonic() < until:
        time.sleep(0.1)
    os._exit(1)
