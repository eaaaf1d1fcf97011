"""CUDA graphs: a function's kernel launches are recorded once; a replay takes the host a few microseconds."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import torch

from neuprim.core.compute import device
from neuprim.core.errors import warn_once


class GraphRecorder:
    """Records functions that work on a GPU as CUDA graphs; on other devices, the functions are just called.

    A function's tensors must stay at the same addresses, because the replayed graph uses these addresses. The first
    call of a recorder runs its function without recording, which loads kernels. If an operation of this function waits
    for the GPU, which a graph cannot do, the function stops there and ``failed`` becomes true. The caller must then
    stop using the recorder.

    Args:
        where: device of the functions.
        what: text that says what the functions do, for the warning that a function waits for the GPU.

    Attributes:
        failed: whether an operation waited for the GPU; the function that contains this operation stopped there.
    """

    def __init__(self, where: torch.device, what: str) -> None:
        self.failed, self._where, self._what = False, where, what
        self._on_gpu = where.type == device.CUDA
        self._tried = not self._on_gpu
        self._stream = torch.cuda.Stream(where) if self._on_gpu else None
        self._graphs: list[torch.cuda.CUDAGraph] = []
        self._pool: Any = None

    def record(self, function: Callable[[], None]) -> Callable[[], None]:
        """Return a function with the effect of ``function``.

        One call of the returned function records a graph, which later calls replay.
        """
        if not self._on_gpu:
            return function
        replay: list[Callable[[], None]] = []

        def run() -> None:
            if replay:
                replay[0]()
            elif self._tried:
                graph = self._capture(function)
                replay.append(graph.replay)
                graph.replay()
            else:
                self._tried = True
                self._call(function)

        return run

    def clear(self) -> None:
        """Free all graphs. Functions that :meth:`record` returned must not be called any more.

        Without this method, Python's collector would free them at any time. One graph alone cannot be freed: some
        versions of torch free memory with it that the other graphs of the stream use.
        """
        for graph in self._graphs:
            graph.reset()
        self._graphs.clear()
        self._pool = None

    def _capture(self, function: Callable[[], None]) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        self._pool = self._pool or torch.cuda.graph_pool_handle()
        collects = gc.isenabled()
        gc.disable()  # a graph of another recorder that the collector frees now would end the capture
        try:
            # "thread_local": other threads may use the GPU meanwhile
            with torch.cuda.graph(graph, self._pool, self._stream, capture_error_mode="thread_local"):
                function()
        finally:
            if collects:
                gc.enable()
        self._graphs.append(graph)
        return graph

    def _call(self, function: Callable[[], None]) -> None:
        stream, current = self._stream, torch.cuda.current_stream(self._where)
        assert stream is not None
        stream.wait_stream(current)
        mode = torch.cuda.get_sync_debug_mode()
        torch.cuda.set_sync_debug_mode("error")
        try:
            with torch.cuda.stream(stream):
                function()
        except RuntimeError as error:
            if "synchronizing" not in str(error):
                raise
            self.failed = True
            warn_once(f"{self._what} are not recorded as CUDA graphs, because one of them waits for the GPU: {error}")
        finally:
            torch.cuda.set_sync_debug_mode(mode)
            current.wait_stream(stream)
