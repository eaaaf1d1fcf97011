"""Pieces of work that do not depend on each other, in threads; NumPy and embree let go of the interpreter while they
compute."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

__all__ = ["THREADS", "side_by_side"]

T = TypeVar("T")

THREADS = 4
"""At most; images in work at once need memory."""


def side_by_side(work: Callable[[T], object], jobs: Sequence[T], progress: Callable[[float], None]) -> None:
    """Do the work for every job; ``progress`` is told the fraction done after each, in their order.

    What a piece of work or ``progress`` raises ends it all, once the pieces already begun are done.
    """
    pool = ThreadPoolExecutor(min(THREADS, os.cpu_count() or 1))
    try:
        for done, _ in enumerate(pool.map(work, jobs), start=1):
            progress(done / len(jobs))
    finally:
        pool.shutdown(cancel_futures=True)  # on an interrupt, wait for the running ones only
