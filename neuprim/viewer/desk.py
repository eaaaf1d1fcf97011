"""Work that pages ask for, done one at a time by whoever has the model: a thread of its own, or the training between
two steps."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass

__all__ = ["Desk"]


@dataclass(frozen=True)
class _Job:
    """To be done at ``due`` (:func:`time.monotonic`) or later."""

    due: float
    do: Callable[[], None]
    failed: Callable[[Exception], None]


class Desk:
    """Jobs by key: a newer one takes the place of an older one that nobody began, so that a camera that moves leaves no
    queue behind it.

    Every method may be called from any thread; jobs run on the thread that calls :meth:`work`.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._jobs: dict[Hashable, _Job] = {}

    def ask(
        self,
        key: Hashable,
        do: Callable[[], None],
        failed: Callable[[Exception], None],
        after: float = 0.0,
        soft: bool = False,
    ) -> None:
        """Have something done, ``after`` seconds from now at the earliest.

        Args:
            key: (who, what).
            failed: told the exception that it ended with.
            soft: leave a job of the same key that is waiting already.
        """
        with self._changed:
            if soft and key in self._jobs:
                return
            self._jobs[key] = _Job(time.monotonic() + after, do, failed)
            self._changed.notify_all()

    def forget(self, who: Hashable) -> None:
        """Drop what somebody asked for."""
        with self._changed:
            for key in [key for key in self._jobs if isinstance(key, tuple) and key[0] == who]:
                del self._jobs[key]

    @property
    def waiting(self) -> bool:
        """Whether anything was asked for, due or not; costs nothing."""
        return bool(self._jobs)

    def work(self, patience: float) -> bool:
        """Do one job that is due, waiting for at most so many seconds; whether there was one. What it raises goes to
        its ``failed``."""
        job = self._take(patience)
        if job is None:
            return False
        try:
            job.do()
        except Exception as error:  # a picture that fails must not end a training of hours, nor the thread that draws
            job.failed(error)
        return True

    def _take(self, patience: float) -> _Job | None:
        """The job that has been due for longest; a wait ends early when something changes."""
        end = time.monotonic() + patience
        with self._changed:
            while True:
                now = time.monotonic()
                key = min(self._jobs, key=lambda k: self._jobs[k].due, default=None)
                if key is not None and self._jobs[key].due <= now:
                    return self._jobs.pop(key)
                left = min(end, self._jobs[key].due if key is not None else end) - now
                if now >= end:
                    return None
                self._changed.wait(left)
