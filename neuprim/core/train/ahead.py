"""The next view's pixels, made ready while a card still works on this one's, and kept there while there is room."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import copy_context

from neuprim.core.data import Pixels

__all__ = ["Ahead"]


class Ahead:
    """Reads pixels one view ahead, in a thread of its own; which views are looked at, and in which order, does not
    depend on it.

    Args:
        read: (index of a view) -> its pixels, where they are needed; the same every time.
        room: bytes of pixels that are kept instead of read again: decoding and copying a large view takes longer than a
        step.
    """

    def __init__(self, read: Callable[[int], Pixels], room: int) -> None:
        self._read, self._room = read, room
        self._kept: dict[int, Pixels] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._next: tuple[int, Future[Pixels]] | None = None

    def take(self, index: int, following: int | None) -> Pixels:
        """Pixels of a view, after which comes ``following``, if that is known; what went wrong in reading them is
        raised here."""
        found, self._next = self._next, None
        if index in self._kept:
            pixels = self._kept[index]
        else:
            pixels = found[1].result() if found is not None and found[0] == index else self._read(index)
            size = sum(x.nbytes for x in (pixels.rgb, pixels.alpha, pixels.mask) if x is not None)
            if size <= self._room:
                self._kept[index], self._room = pixels, self._room - size
        if following is not None and following not in self._kept:
            self._pool = self._pool or ThreadPoolExecutor(1, thread_name_prefix="neuprim-views")
            self._next = following, self._pool.submit(copy_context().run, self._read, following)
        return pixels
