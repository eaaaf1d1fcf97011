"""``launcher=inline``: one after the other, in this process."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext

from neuprim.core.compute.threads import sharing
from neuprim.runs.events import Event, Events
from neuprim.runs.launch.engine import Hear, finished
from neuprim.runs.launch.jobs import Job, Result, perform
from neuprim.runs.launch.status import Listener, Status

__all__ = ["inline"]


def inline(jobs: Sequence[Job], threads: int | None, hear: Hear, also: Events) -> list[Result | None]:
    """Results in the order of the jobs; None of those after the one that Ctrl-C ended.

    Args:
        threads: of each; None: all cores.
        also: told the events themselves.
    """
    results = list[Result | None]([None] * len(jobs))
    with nullcontext() if threads is None else sharing(threads):
        for number, job in enumerate(jobs):
            listener = Listener()

            def tell(event: Event, number: int = number, listener: Listener = listener) -> None:
                listener(event)
                hear(number, listener.status)
                also(event)

            hear(number, Status("starting"))
            result = results[number] = perform(job, 0, tell)
            hear(number, finished(listener.status, result))
            if result.state == "interrupted":
                break
    return results
