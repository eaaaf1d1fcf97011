"""Queue of drawing jobs for the one thread that may use the model."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass


@dataclass(frozen=True)
class _Job:
    due: float  # earliest start, time.monotonic()
    run: Callable[[], None]
    on_error: Callable[[Exception], None]


class RenderQueue:
    """Jobs by key. A new job replaces a waiting job of the same key, so a moving camera leaves no backlog.

    All methods are thread-safe. Jobs run on the thread that calls :meth:`work`.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._jobs: dict[Hashable, _Job] = {}

    def submit(
        self,
        key: Hashable,
        run: Callable[[], None],
        on_error: Callable[[Exception], None],
        delay: float = 0.0,
        replace: bool = True,
    ) -> None:
        """Queue a job.

        Args:
            key: (client, kind of work).
            on_error: called with the exception that ends the job.
            delay: seconds to wait at least.
            replace: False keeps a waiting job of the same key instead.
        """
        with self._changed:
            if replace or key not in self._jobs:
                self._jobs[key] = _Job(time.monotonic() + delay, run, on_error)
                self._changed.notify_all()

    def drop_client(self, client: Hashable) -> None:
        """Remove all jobs of a client."""
        with self._changed:
            for key in [key for key in self._jobs if isinstance(key, tuple) and key[0] == client]:
                del self._jobs[key]

    @property
    def pending(self) -> bool:
        """Whether any job waits, due or not."""
        return bool(self._jobs)

    def work(self, timeout: float) -> bool:
        """Run one due job, waiting up to ``timeout`` seconds for it; return whether there was one."""
        job = self._take(timeout)
        if job is None:
            return False
        try:
            job.run()
        except Exception as error:  # a failed image must end neither a training nor the drawing thread
            job.on_error(error)
        return True

    def _take(self, timeout: float) -> _Job | None:
        """Remove and return the job that has been due longest."""
        end = time.monotonic() + timeout
        with self._changed:
            while True:
                now = time.monotonic()
                key = min(self._jobs, key=lambda k: self._jobs[k].due, default=None)
                if key is not None and self._jobs[key].due <= now:
                    return self._jobs.pop(key)
                if now >= end:
                    return None
                self._changed.wait(min(end, self._jobs[key].due if key is not None else end) - now)
