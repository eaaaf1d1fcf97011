"""``launcher=processes``: processes of this machine.

Every worker is a pool of its own with one process (concurrent.futures): when the system kills one, its pool breaks and
no other's.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from neuprim.runs.launch.engine import WorkerDied
from neuprim.runs.launch.jobs import Result
from neuprim.runs.launch.worker import Task, at_work, environment, interrupt

__all__ = ["Processes"]

_GRACE = 60.0
"""Seconds that a worker has to write its checkpoint when its launcher is gone."""


@dataclass
class _Pool:
    """One worker. ``log`` has what its process printed."""

    executor: ProcessPoolExecutor
    log: Path


@dataclass
class _Handle:
    future: Future[Result]
    pool: _Pool


class Processes:
    """An engine; see :class:`~neuprim.runs.launch.engine.Engine`.

    Args:
        folder: for the workers' logs.
    """

    def __init__(self, workers: int, threads: int, folder: Path) -> None:
        self.workers, self.threads, self._folder = workers, threads, folder
        self._idle: list[_Pool] = []
        self._busy: list[_Pool] = []
        self._numbers = itertools.count()

    def submit(self, task: Task) -> _Handle:
        pool = self._idle.pop() if self._idle else self._new()
        with _set(environment(self.threads)):  # a process starts with the first task, and has the variables of then
            try:
                future = pool.executor.submit(task)
            except BrokenProcessPool:  # it was killed while it had nothing to do
                pool.executor.shutdown(wait=False)
                pool = self._new()
                future = pool.executor.submit(task)
        self._busy.append(pool)
        return _Handle(future, pool)

    def done(self, handle: _Handle) -> bool:
        return handle.future.done()

    def result(self, handle: _Handle) -> Result:
        self._busy.remove(handle.pool)
        try:
            result = handle.future.result()
        except BrokenProcessPool:
            handle.pool.executor.shutdown(wait=False)
            where = (
                f"; it printed {handle.pool.log}" if handle.pool.log.exists() and handle.pool.log.stat().st_size else ""
            )
            raise WorkerDied(
                f"its process was killed, as the system does when memory is full, or it crashed{where}"
            ) from None
        self._idle.append(handle.pool)
        return result

    def cancel(self, handle: _Handle) -> None:
        """Every task has begun: it sees by itself that it shall stop."""

    def close(self, now: bool) -> None:
        for pool in self._busy if now else []:
            for process in list((pool.executor._processes or {}).values()):
                process.kill()
        pools = [*self._idle, *self._busy]
        if pools:
            with ThreadPoolExecutor(len(pools)) as together:  # a worker takes a second to end
                list(together.map(lambda pool: pool.executor.shutdown(wait=True), pools))

    def _new(self) -> _Pool:
        log = self._folder.absolute() / f"worker-{next(self._numbers)}.log"
        context = multiprocessing.get_context("spawn")
        return _Pool(ProcessPoolExecutor(1, context, initializer=_begin, initargs=(log,)), log)


@contextmanager
def _set(variables: Mapping[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin(log: Path) -> None:
    """In a new worker: out of reach of the terminal's Ctrl-C, which the launcher hands on, its output in a file, and
    not left alone."""
    if hasattr(os, "setsid"):
        os.setsid()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    with open(log, "ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    threading.Thread(target=_orphaned, name="orphaned", daemon=True).start()


def _orphaned() -> None:
    """When the launcher was killed: stop as on Ctrl-C, and end."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    if at_work():
        interrupt()
    late = time.monotonic() + _GRACE
    while at_work() and time.monotonic() < late:
        time.sleep(0.1)
    os._exit(1)
