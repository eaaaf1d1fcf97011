"""Ctrl-C as a wish that work looks for when it can stop, instead of an exception anywhere."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def interruptible(terminated: bool = False) -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; the second interrupts at once. Outside the main thread Ctrl-C is not ours.

    Args:
        terminated: whether SIGTERM counts as Ctrl-C does: torchrun sends it when it is stopped, or another process of
        it ended.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    numbers = (signal.SIGINT, signal.SIGTERM) if terminated else (signal.SIGINT,)
    previous = {number: signal.getsignal(number) for number in numbers}

    def handler(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    for number in numbers:
        signal.signal(number, handler)
    try:
        yield stop
    finally:
        for number, before in previous.items():
            signal.signal(number, before)
