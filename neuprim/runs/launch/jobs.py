"""What is launched: the name of a function and plain values for it, so that any process that has the package can do
it."""

from __future__ import annotations

import importlib
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from neuprim.core.errors import one_line

if TYPE_CHECKING:  # which loads torch, that a worker may not have told its threads yet
    from neuprim.runs.events import Events

__all__ = ["Job", "Result", "perform"]


@dataclass(frozen=True)
class Job:
    """One piece of work.

    Attributes:
        name: unique among those launched together, and good as a file's name.
        call: ``module:function``, which is called with ``data``, the number of times that its worker died before, and a
        listener of events.
            From the second time on it should go on where it was left.
        data: values that another process can have: numbers, texts, lists, dictionaries, paths. Objects of plugins are
        named, not sent.
    """

    name: str
    call: str
    data: Any


@dataclass(frozen=True)
class Result:
    """How a job ended.

    Attributes:
        state: done, failed or interrupted.
        value: what its function returned.
        line: why it failed.
        trace: of a bug; empty where the input is at fault.
        seconds: from its start to its end where it worked.
        attempts: how often it was started.
    """

    state: str
    value: Any = None
    line: str = ""
    trace: str = ""
    seconds: float = 0.0
    attempts: int = 1


def perform(job: Job, attempt: int, events: Events) -> Result:
    """Do a job here. Nothing is raised: what goes wrong is in the result."""
    begun = time.monotonic()

    def result(state: str, value: Any = None, line: str = "", trace: str = "") -> Result:
        return Result(state, value, line, trace, time.monotonic() - begun, attempt + 1)

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
        said = " ".join(str(error).split())
        return result(
            "failed", line=": ".join(filter(None, (type(error).__name__, said))), trace=traceback.format_exc()
        )
