"""Which ranks live: each counts in the shared store, and one that stands still is gone.

A broken connection says that *some* rank is gone, and that may be one that left because of another. So whoever finds
one broken looks who failed and said so, and else whose count stands still.
"""

from __future__ import annotations

import threading
import time
from typing import Any

__all__ = ["Pulse"]

BEAT = 0.25
"""Seconds between two counts."""

SILENCE = 4.0
"""Seconds without a count after which a rank is gone, where one surely is: a busy processor delays a thread, but not
for so long."""

LONG_SILENCE = 60.0
"""The same where there is no other sign of it: compiled code that does not let go of Python may hold up a thread for a
while."""


class Pulse:
    """This rank's count, in a thread of its own, and a look at those of the others.

    Args:
        store: shared by all ranks, used by this thread alone: waiting for one thread's word would delay another's.
    """

    def __init__(self, store: Any, rank: int, size: int) -> None:
        self._store, self.rank, self.size = store, rank, size
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="neuprim-pulse", daemon=True)
        self._store.set(f"pulse/{rank}", "0")
        self._thread.start()

    def _beat(self) -> None:
        count = 0
        while not self._stop.wait(BEAT):
            count += 1
            try:
                self._store.set(f"pulse/{self.rank}", str(count))
            except RuntimeError:  # the store is gone: so is torchrun, or the rank that held it
                return

    def gone(self, store: Any, silence: float) -> list[int]:
        """Ranks whose count stands still for that many seconds; those that never counted among them. ``store`` is the
        caller's own.

        Raises:
            RuntimeError: the store is gone.
        """

        def counts() -> list[bytes]:
            return [store.get(f"pulse/{r}") if store.check([f"pulse/{r}"]) else b"" for r in range(self.size)]

        before, until = counts(), time.monotonic() + silence
        silent = set(range(self.size)) - {self.rank}
        while silent and time.monotonic() < until:
            time.sleep(BEAT)
            now = counts()
            silent -= {r for r in silent if now[r] != before[r]}
        return sorted(silent)

    def stop(self) -> None:
        """Count no more."""
        self._stop.set()
        self._thread.join(timeout=5 * BEAT)
