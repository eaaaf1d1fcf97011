"""``launcher=inline``: one after the other, in this process."""

from __future__ import annotations

from collections.abc import Sequence

from neuprim.config.launcher import LauncherSettings
from neuprim.runs.events import Event
from neuprim.runs.launch.engine import Ended, Hear, finished
from neuprim.runs.launch.jobs import Job, Result, perform
from neuprim.runs.launch.share import own_share
from neuprim.runs.launch.status import Listener, Status

__all__ = ["inline"]


def inline(jobs: Sequence[Job], settings: LauncherSettings, hear: Hear, ended: Ended) -> list[Result | None]:
    """Results in the order of the jobs; None of those after the one that Ctrl-C ended."""
    results = list[Result | None]([None] * len(jobs))
    with own_share(settings):
        for number, job in enumerate(jobs):
            listener = Listener()

            def tell(event: Event, number: int = number, listener: Listener = listener) -> None:
                listener(event)
                hear(number, listener.status)

            hear(number, Status("starting"))
            result = results[number] = perform(job, 0, tell)
            ended(number, result)
            hear(number, finished(listener.status, result))
            if result.state == "interrupted":
                break
    return results
