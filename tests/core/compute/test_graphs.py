"""CUDA graphs, with stand-ins for torch's graphs: when they are captured, replayed and freed."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import pytest
import torch

from neuprim.core.compute.graphs import GraphRecorder


class Graph:
    """Stands for torch.cuda.CUDAGraph."""

    made: ClassVar[list[Graph]] = []

    def __init__(self) -> None:
        self.pool: Any = None
        self.replays, self.freed = 0, False
        self.made.append(self)

    def replay(self) -> None:
        assert not self.freed
        self.replays += 1

    def reset(self) -> None:
        self.freed = True


@contextmanager
def captured(graph: Graph, pool: Any, stream: Any, **settings: Any) -> Iterator[None]:
    assert settings == {"capture_error_mode": "thread_local"}
    assert not gc.isenabled(), "freeing a graph now would end the capture"
    graph.pool = pool
    yield


def test_graphs_are_captured_once_and_freed_together(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, stand_in in (("CUDAGraph", Graph), ("graph", captured), ("Stream", lambda where: None)):
        monkeypatch.setattr(torch.cuda, name, stand_in)
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", object)
    monkeypatch.setattr(Graph, "made", [])
    recorder, calls = GraphRecorder(torch.device("cuda"), "steps"), list[str]()
    recorder._tried = True  # the first function has run, without a graph
    functions = [recorder.record(lambda name=name: calls.append(name)) for name in "ab"]
    for _ in range(3):
        for function in functions:
            function()
    assert calls == ["a", "b"] and [graph.replays for graph in Graph.made] == [3, 3] and gc.isenabled()
    first, second = Graph.made
    assert first.pool is second.pool
    recorder.clear()
    assert first.freed and second.freed
    recorder.record(lambda: calls.append("c"))()
    assert calls[-1] == "c" and Graph.made[-1].pool is not first.pool, "torch frees a pool with its last graph"

    def fail() -> None:
        raise ValueError("no frame")

    with pytest.raises(ValueError, match="no frame"):
        recorder.record(fail)()
    assert gc.isenabled()
