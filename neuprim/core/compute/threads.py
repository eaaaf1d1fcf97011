"""Run CPU kernels in parallel over a range of items, and run autograd operations without autograd where possible.

The kernels must release the GIL. Each chunk of the range writes its own output, so results do not depend on the number
of threads.
"""

from __future__ import annotations

import itertools
import os
import platform
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

_limit: ContextVar[int] = ContextVar("threads", default=0)
_pools: dict[int, ThreadPoolExecutor] = {}
_lock = threading.Lock()
_share = 0


def cpu_name() -> str:
    """Return the CPU's name as the operating system reports it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass  # not Linux
    return platform.processor() or platform.machine() or "unknown"


def machine_cores() -> int:
    """Return the number of cores that the operating system lets this process use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every platform
        return os.cpu_count() or 1


def core_count() -> int:
    """Return the number of cores that this process may use, at most the limit set by :func:`limit_process_threads`."""
    cores = machine_cores()
    return min(cores, _share) if _share else cores


@contextmanager
def limit_process_threads(threads: int) -> Iterator[None]:
    """Limit the whole process to ``threads`` cores inside the block; 0 means all. Blocks must not overlap."""
    global _share
    before, _share = _share, threads
    try:
        yield
    finally:
        _share = before


@contextmanager
def limit_threads(threads: int) -> Iterator[None]:
    """Make calls inside the block that ask for 0 threads ("all cores") use ``threads`` threads (0: all cores)."""
    token = _limit.set(threads)
    try:
        yield
    finally:
        _limit.reset(token)


def resolve_threads(threads: int) -> int:
    """Return how many threads :func:`parallel_for` uses if it is asked for ``threads``.

    0 asks for the number set by :func:`limit_threads`, or else for all cores.
    """
    return threads or _limit.get() or core_count()


def chunk_size(count: int, least: int, threads: int) -> int:
    """Return a good chunk size for :func:`parallel_for` over ``count`` items.

    Eight chunks per thread balance the work; at least ``least`` items per chunk amortise the cost of a call. A single
    thread gets all items in one chunk.
    """
    threads = resolve_threads(threads)
    return max(count, 1) if threads == 1 else max(least, count // (8 * threads))


def _thread_pool(threads: int) -> ThreadPoolExecutor:
    with _lock:
        if threads not in _pools:
            _pools[threads] = ThreadPoolExecutor(threads, thread_name_prefix="neuprim")
        return _pools[threads]


def parallel_for(function: Callable[..., Any], count: int, chunk: int, threads: int, *args: Any) -> list[Any]:
    """Call ``function(start, stop, *args)`` for chunks of ``range(count)``; returns the results in chunk order.

    ``threads`` 0 means all cores, or the number set by :func:`limit_threads`.
    """
    threads = resolve_threads(threads)
    chunks = -(-count // chunk) if count else 0
    if threads == 1 or chunks <= 1:
        return [function(c * chunk, min(count, (c + 1) * chunk), *args) for c in range(chunks)]
    results: list[Any] = [None] * chunks
    ticket = itertools.count()  # next() is atomic under the GIL

    def work() -> None:
        while (c := next(ticket)) < chunks:
            results[c] = function(c * chunk, min(count, (c + 1) * chunk), *args)

    futures = [_thread_pool(threads).submit(work) for _ in range(min(threads, chunks) - 1)]
    work()
    for future in futures:
        future.result()
    return results


class _ForwardKernelContext:
    """Replacement of an autograd context if no backward pass follows; ignores what the forward pass saves."""

    def save_for_backward(self, *tensors: Tensor) -> None:
        pass

    def set_materialize_grads(self, value: bool) -> None:
        pass


def kernel_needs_grad(*arguments: Any) -> bool:
    """Return whether a gradient with respect to one of the arguments is needed."""
    return torch.is_grad_enabled() and any(isinstance(x, Tensor) and x.requires_grad for x in arguments)


def apply_kernel_operation(operation: type[torch.autograd.Function], *arguments: Any) -> Any:
    """Return ``operation.apply(*arguments)``; if no gradient is needed, run only its forward pass, without autograd."""
    if kernel_needs_grad(*arguments):
        return operation.apply(*arguments)
    return operation.forward(_ForwardKernelContext(), *arguments)
