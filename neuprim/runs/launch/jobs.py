"""Jobs, their status and results, and the worker process that performs a job.

A job is the name of a function and plain values as its arguments. A worker communicates with its launcher by files in
a shared folder: one file has the status of a job, another one asks the worker to stop. Files work between processes,
containers and machines. This module imports no large library, so that a worker can set its number of threads before
such a library reads it.
"""

from __future__ import annotations

import _thread
import importlib
import json
import multiprocessing
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from neuprim.core.errors import ConfigError, one_line
from neuprim.core.io.json_reader import load_json
from neuprim.core.validation import validate_settings

if TYPE_CHECKING:
    from neuprim.runs.fit import Event, Events

ENDED = ("done", "failed", "interrupted")
"""States of a job that has ended."""

_CACHE_VARIABLES = ("NEUPRIM_CACHE_DIR", "NUMBA_CACHE_DIR")
"""Environment variables that the launcher passes to its workers, because a cluster may not pass them."""

_THREAD_VARIABLES = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Environment variables with the number of threads; libraries read them when they are loaded."""

_INTERVAL = 0.25
"""Seconds between two checks of the status and of the file that stops the job."""

_GRACE = 60.0
"""Seconds that a worker has to write its checkpoint after its launcher died."""

_working = threading.Event()


@dataclass(frozen=True)
class LaunchJob:
    """A function call that a worker performs.

    Attributes:
        name: unique name among the jobs launched together, valid as a file name.
        call: ``module:function``. The function has the parameters (data, attempt, events). ``attempt`` counts earlier
            calls whose worker died; the function should continue their work. ``events`` is called with events.
        data: numbers, texts, lists, dictionaries and paths. Plugins are passed by name.
    """

    name: str
    call: str
    data: Any


@dataclass(frozen=True)
class JobResult:
    """Result of a job.

    Attributes:
        state: done, failed or interrupted.
        value: return value of the job's function.
        line: one line that says why the job failed.
        trace: traceback of a bug; empty if the input is wrong.
        seconds: time from the job's start to its end in the worker.
        attempts: number of starts.
    """

    state: str
    value: Any = None
    line: str = ""
    trace: str = ""
    seconds: float = 0.0
    attempts: int = 1


@dataclass(frozen=True)
class JobStatus:
    """Status of a job: its state and progress while it runs.

    Attributes:
        state: waiting, starting, preparing, training, finishing, or one of :data:`ENDED`.
        text: what the job does now, or why it ended.
        step, progress: training step, and the used fraction of the training's budget, 0..1.
        psnr: PSNR at the last measurement of held-out views, dB.
        attempt: how often the job's worker died before.
    """

    state: str = "waiting"
    text: str = ""
    step: int = 0
    progress: float = 0.0
    psnr: float | None = None
    attempt: int = 0

    def end(self, result: JobResult) -> JobStatus:
        """Return the final status of the job, which ended with ``result``."""
        return replace(self, state=result.state, text=result.line, attempt=result.attempts - 1)


def perform_job(job: LaunchJob, attempt: int, events: Events) -> JobResult:
    """Perform a job in this process; return its result. Errors and Ctrl-C become a part of the result."""
    start = time.monotonic()

    def result(state: str, value: Any = None, line: str = "", trace: str = "") -> JobResult:
        return JobResult(state, value, line, trace, time.monotonic() - start, attempt + 1)

    try:
        module, _, name = job.call.partition(":")
        function: Callable[[Any, int, Events], Any] = getattr(importlib.import_module(module), name)
        return result("done", function(job.data, attempt, events))
    except KeyboardInterrupt:
        return result("interrupted")
    except Exception as error:
        line = one_line(error)
        if line is not None:
            return result("failed", line=line)
        text = " ".join(str(error).split())
        line = ": ".join(filter(None, (type(error).__name__, text)))
        return result("failed", line=line, trace=traceback.format_exc())


class StatusListener:
    """Function object that is called with a run's events, and calls ``on_status`` with the resulting job status."""

    def __init__(self, attempt: int = 0, on_status: Callable[[JobStatus], None] = lambda status: None) -> None:
        self.status, self._on_status = JobStatus("starting", attempt=attempt), on_status

    def __call__(self, event: Event) -> None:
        from neuprim.runs.fit import Evaluated, Finishing, Preparing, Step  # torch, see above

        status = self.status
        match event:
            case Preparing():
                share = f", {event.fraction:.0%}" if event.fraction > 0 else ""
                self.status = replace(status, state="preparing", text=f"{event.text}{share}")
            case Step():
                step = event.report.step
                self.status = replace(status, state="training", text="", step=step, progress=event.progress)
            case Evaluated():
                self.status = replace(status, psnr=event.psnr)
            case Finishing():
                self.status = replace(status, state="finishing", text=event.text)
        self._on_status(self.status)


def write_status(file: Path, status: JobStatus) -> None:
    """Write a status to a file. Errors are ignored, because a run must not end when its status cannot be written."""
    staged = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        staged.write_text(json.dumps(asdict(status)), encoding="utf-8")
        os.replace(staged, file)
    except OSError:
        staged.unlink(missing_ok=True)


def read_status(file: Path) -> JobStatus | None:
    """Return the status in a file; None if the file is missing or cannot be read."""
    try:
        data: Any = load_json(file.read_text(encoding="utf-8"))
        return validate_settings(JobStatus, {f.name: data[f.name] for f in fields(JobStatus)})
    except (OSError, ValueError, KeyError, TypeError, RecursionError, ConfigError):
        return None


# ---------------------------------------------------------------- worker


def worker_cache_variables() -> dict[str, str]:
    """Return the environment variables that set cache folders; a launcher passes them to its workers."""
    return {name: os.environ[name] for name in _CACHE_VARIABLES if name in os.environ}


def worker_environment(threads: int) -> dict[str, str]:
    """Return a worker's environment variables: cache folders, and the number of threads of numerical libraries."""
    return worker_cache_variables() | dict.fromkeys(_THREAD_VARIABLES, str(threads))


@dataclass(frozen=True)
class WorkerTask:
    """A job with the settings of its worker. The worker calls the task to perform the job.

    Attributes:
        threads: number of threads that the job may use.
        status: file for the job's status.
        stop: file whose existence makes the job stop, like Ctrl-C.
        cwd: folder that relative paths refer to.
        variables: environment variables, set before large libraries are imported.
        attempt: how often the job's worker died before.
    """

    job: LaunchJob
    threads: int
    status: Path
    stop: Path
    cwd: Path
    variables: Mapping[str, str] = field(default_factory=dict)
    attempt: int = 0

    def checkpoint(self) -> Any:
        """Return a submission that continues this task.

        submitit calls this method when Slurm preempts the job or the job's time is up, and queues the submission.
        """
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(replace(self, attempt=self.attempt + 1))

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
    """Context manager that runs a thread beside the task.

    The thread writes the task's status to a file, and interrupts the main thread when the stop file appears.
    """
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
    """Yield an event that the first Ctrl-C sets; a second Ctrl-C raises KeyboardInterrupt. Outside the main thread the
    handling of Ctrl-C does not change.

    Args:
        terminated: whether SIGTERM acts like Ctrl-C. torchrun sends SIGTERM when it is stopped or one of its processes
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
    """Interrupt the main thread like Ctrl-C: a run finishes its step and writes a checkpoint.

    Args:
        blocked: whether the main thread blocks SIGINT, as under Ray; a wait in progress is then finished first.
    """
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None and not blocked:
        signal.pthread_kill(main, signal.SIGINT)  # this also ends a wait
    else:
        _thread.interrupt_main()


def _worker_blocks_interrupts() -> bool:
    """Return whether the main thread blocks SIGINT; call it from the main thread. If SIGINT is ignored, as in a
    background job of a script, the default handler is restored first."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return hasattr(signal, "pthread_sigmask") and signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())


# ---------------------------------------------------------------- processes of this machine


def start_worker_process(log: Path, variables: Mapping[str, str]) -> None:
    """Prepare a new worker process: ignore the terminal's Ctrl-C (the launcher forwards it), append the output to the
    file ``log``, and end when the launcher has ended. ``variables`` are environment variables to set."""
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
