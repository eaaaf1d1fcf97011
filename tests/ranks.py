"""Ranks that are threads of one process, so that trainings of several can be tried in a second: all is as between
processes, but for the wire."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from neuprim.core.errors import RankError
from neuprim.core.train.distributed.group import Group
from neuprim.core.train.distributed.place import Place

T = TypeVar("T")


class Threads:
    """The wires of ``size`` ranks."""

    def __init__(self, size: int) -> None:
        self.size, self.store = size, dist.HashStore()
        self._barrier = threading.Barrier(size, timeout=60)
        self._rows: list[Tensor] = [torch.empty(0)] * size
        self._parts: list[list[Tensor]] = [[]] * size

    def wire(self, rank: int) -> Any:
        return _Wire(self, rank)

    def swap(self, rank: int, rows: Tensor, found: Tensor) -> None:
        try:
            self._rows[rank] = rows.clone()
            self._barrier.wait()
            torch.stack([given[rank] for given in self._rows], out=found)
            self._barrier.wait()
        except threading.BrokenBarrierError:
            raise RankError("broken") from None

    def exchange(self, rank: int, rows: Tensor, found: Tensor, give: list[int], take: list[int]) -> None:
        try:
            self._parts[rank] = [part.clone() for part in rows.split(give)]
            self._barrier.wait()
            parts = [given[rank] for given in self._parts]
            assert [len(part) for part in parts] == take, "both ends of an exchange know its length"
            found.copy_(torch.cat(parts))
            self._barrier.wait()
        except threading.BrokenBarrierError:
            raise RankError("broken") from None

    def hang_up(self) -> None:
        self._barrier.abort()


class _Wire:
    hosted = False

    def __init__(self, threads: Threads, rank: int) -> None:
        self._threads, self.rank, self.store = threads, rank, threads.store

    def swap(self, rows: Tensor, found: Tensor) -> None:
        self._threads.swap(self.rank, rows, found)

    def exchange(self, rows: Tensor, found: Tensor, give: list[int], take: list[int]) -> None:
        self._threads.exchange(self.rank, rows, found, give, take)

    def close(self) -> None:
        self._threads.hang_up()


class Killed(Exception):
    """Ends a rank as a signal would: it says nothing."""


def together(size: int, work: Callable[[Group], T]) -> list[T | Exception]:
    """What ``work`` returns or raises on each of ``size`` ranks; one that raises leaves, as a process would."""
    threads = Threads(size)

    def one(rank: int) -> T | Exception:
        group = Group(Place(rank, size, rank, size, "here"), threads.wire(rank))
        try:
            found = work(group)
        except Exception as error:
            if not isinstance(error, Killed):
                group.fail(str(error), isinstance(error, RankError))
            group.close(failed=True)
            return error
        group.pulse.stop()
        return found

    with ThreadPoolExecutor(size) as pool:
        return list(pool.map(one, range(size)))


def done(found: list[T | Exception]) -> list[T]:
    """The same where no rank may have raised."""
    for each in found:
        if isinstance(each, Exception):
            raise each
    return found  # type: ignore[return-value]
