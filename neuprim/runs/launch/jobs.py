"""Jobs, which any process that has the package can do, their results, and how far they are.

A job names a function and has plain values for it. This module imports nothing heavy, so that a worker can set its
number of threads before libraries read it.
"""

from __future__ import annotations

import importlib
import json
import os
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.core.errors import ConfigError, one_line
from neuprim.core.io.plain import load_json
from neuprim.core.validation import validate_settings

if TYPE_CHECKING:
    from neuprim.runs.fit import Event, Events

ENDED = ("done", "failed", "interrupted")
"""States of a job that is over."""


@dataclass(frozen=True)
class LaunchJob:
    """One piece of work.

    Attributes:
        name: unique among those launched together, and valid as a file name.
        call: ``module:function``, which is called with ``data``, the number of times that its worker died before, and a
            listener of events. From the second time on it should continue where it was left.
        data: numbers, texts, lists, dictionaries and paths. Objects of plugins are named, not sent.
    """

    name: str
    call: str
    data: Any


@dataclass(frozen=True)
class JobResult:
    """How a job ended.

    Attributes:
        state: done, failed or interrupted.
        value: what its function returned.
        line: why it failed.
        trace: of a bug; empty where the input is at fault.
        seconds: from its start to its end in the worker.
        attempts: how often it was started.
    """

    state: str
    value: Any = None
    line: str = ""
    trace: str = ""
    seconds: float = 0.0
    attempts: int = 1


@dataclass(frozen=True)
class JobStatus:
    """How far a job is.

    Attributes:
        state: waiting, starting, preparing, training, finishing, or one of :data:`ENDED`.
        text: what it does, or why it ended.
        step, progress: of the training; the used fraction of its budget, 0..1.
        psnr: held out, the last point of the curve, dB.
        attempt: how often its worker died before.
    """

    state: str = "waiting"
    text: str = ""
    step: int = 0
    progress: float = 0.0
    psnr: float | None = None
    attempt: int = 0

    def end(self, result: JobResult) -> JobStatus:
        """The last status of a job with this result."""
        return replace(self, state=result.state, text=result.line, attempt=result.attempts - 1)


def perform_job(job: LaunchJob, attempt: int, events: Events) -> JobResult:
    """Do a job in this process. Nothing is raised: errors are in the result."""
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
    """Turns the events of a run into its status."""

    def __init__(self, attempt: int = 0) -> None:
        self.status = JobStatus("starting", attempt=attempt)

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


def write_status(file: Path, status: JobStatus) -> None:
    """Replace the file. Errors are ignored: a full disk must not end a run because of its display."""
    staged = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        staged.write_text(json.dumps(asdict(status)), encoding="utf-8")
        os.replace(staged, file)
    except OSError:
        staged.unlink(missing_ok=True)


def read_status(file: Path) -> JobStatus | None:
    """Return the status in a file; None where there is none that can be read."""
    try:
        data: Any = load_json(file.read_text(encoding="utf-8"))
        return validate_settings(JobStatus, {f.name: data[f.name] for f in fields(JobStatus)})
    except (OSError, ValueError, KeyError, TypeError, RecursionError, ConfigError):
        return None
