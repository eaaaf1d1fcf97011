"""Ranks that are threads of one process, so that a training of several takes a second."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from neuprim.core.train.process_group import ProcessGroup, TorchrunRank

T = TypeVar("T")


class Killed(Exception):
    """Ends a rank as a signal would: without a message."""


class _Exchange:
    """A place where ``size`` threads meet: by round of messages, what each has to say."""

    def __init__(self, size: int) -> None:
        self.size, self.store = size, dist.HashStore()
        self.changed, self.closed = threading.Condition(), False
        self.rounds: defaultdict[int, dict[int, Any]] = defaultdict(dict)


class ThreadGroup(ProcessGroup):
    """A rank whose messages go through memory instead of torch.distributed."""

    def __init__(self, rank: int, exchange: _Exchange) -> None:
        self._exchange, self.store, self._round = exchange, exchange.store, 0
        self.place = TorchrunRank(rank, exchange.size, rank, exchange.size, "here")
        self.rank, self.size = rank, exchange.size

    def gather(self, value: Any) -> list[Any]:
        meeting, self._round = self._exchange, self._round + 1
        with self._errors(), meeting.changed:
            values = meeting.rounds[self._round]
            values[self.rank] = value
            meeting.changed.notify_all()
            meeting.changed.wait_for(lambda: len(values) == self.size or meeting.closed, 60)
            if len(values) < self.size:
                raise RuntimeError("broken")
            return [values[rank] for rank in range(self.size)]

    def exchange(self, sent: Tensor, received: Tensor) -> None:
        torch.stack([rows[self.rank] for rows in self.gather(sent.clone())], out=received)

    def all_gather(self, received: Tensor, own: Tensor) -> None:
        torch.stack(self.gather(own.clone()), out=received)

    def close(self) -> None:
        with self._exchange.changed:
            self._exchange.closed = True
            self._exchange.changed.notify_all()


def run_ranks(size: int, work: Callable[[ProcessGroup], T]) -> list[T | Exception]:
    """What ``work`` returns or raises on each of ``size`` ranks; one that raises leaves, as a process would."""
    exchange = _Exchange(size)

    def one(rank: int) -> T | Exception:
        group = ThreadGroup(rank, exchange)
        try:
            return work(group)
        except Exception as error:
            if not isinstance(error, Killed):
                group.record_failure(str(error))
            group.close()
            return error

    with ThreadPoolExecutor(size) as pool:
        return list(pool.map(one, range(size)))


def results(found: list[T | Exception]) -> list[T]:
    """The results of ranks of which none may have raised."""
    for each in found:
        if isinstance(each, Exception):
            raise each
    return found  # type: ignore[return-value]
