"""Kernels compiled beside a run's preparations."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

from neuprim.core.train import optimizer
from neuprim.runs import compile as ahead
from tests import kernels


def test_what_is_compiled_is_what_training_needs() -> None:
    """A run that waited for it finds on disk every kernel that training calls, for the types that training calls it
    with."""
    ahead = kernels.compiled_by("from neuprim.runs import compile; compile.main('cpu')")
    training = "t = tiny.trainer(tiny.two_primitives(True), 4, population={'strategy': 'relocate', 'every': 2})"
    needed = kernels.compiled_by(f"from tests.core import tiny; {training}; assert len(list(t.run())) == 4")
    assert len(needed) > 8
    missing = [
        f"{name}{types}"
        for name, signatures in needed.items()
        for types in signatures
        if types not in ahead.get(name, [])
    ]
    assert missing == []


@pytest.mark.parametrize(("edge", "key"), [(0, "Tuple(())"), (2, "UniTuple(int64, 2)")])
def test_only_the_edge_that_a_run_draws_is_compiled(edge: int, key: str) -> None:
    found = kernels.compiled_by(f"from neuprim.runs import compile; compile.main('cpu', {edge})")
    tiles = [
        types for name, types in found.items() if name.endswith(("forward.composite_tiles", "backward.backward_tiles"))
    ]
    assert len(tiles) == 2 and all(len(types) == 1 and types[0].endswith(f"{key})") for types in tiles)


def test_it_says_so_once_it_is_done(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(ahead, "cache_directory", lambda: tmp_path / "kernels")
    constant = ahead.kernel_variant("Constant", 0)
    assert not ahead.is_compiled("cpu", constant)

    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(optimizer.RowAdam, "step", interrupted)  # the last that it compiles
        with pytest.raises(KeyboardInterrupt):
            ahead.main("cpu")
    assert not ahead.is_compiled("cpu", constant), "a run must not wait for less than all"
    ahead.main("cpu")
    others = [
        ("cpu", ahead.kernel_variant("RayNet", 0)),
        ("cpu", ahead.kernel_variant("Constant", 2)),
        ("reference", constant),
    ]
    assert ahead.is_compiled("cpu", constant) and not any(ahead.is_compiled(*other) for other in others)
    monkeypatch.setattr(ahead, "cache_directory", lambda: tmp_path / "other sources")
    assert not ahead.is_compiled("cpu", constant)


def test_nothing_is_started_where_there_is_nothing_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead.subprocess, "Popen", lambda *a, **k: pytest.fail("a process was started"))
    monkeypatch.setattr(ahead, "is_compiled", lambda *a: True)
    with ahead.compile_in_background("cpu") as started:
        assert not started.running
        started.wait()
    monkeypatch.setattr(ahead, "is_compiled", lambda *a: False)
    with ahead.compile_in_background(None) as started:
        assert not started.running


def test_the_process_ends_with_the_block(monkeypatch: pytest.MonkeyPatch) -> None:
    genuine = ahead.subprocess.Popen
    monkeypatch.setattr(ahead, "is_compiled", lambda *a: False)
    monkeypatch.setattr(
        ahead.subprocess, "Popen", lambda *a, **k: genuine([sys.executable, "-c", "import time; time.sleep(60)"])
    )
    before = time.monotonic()
    with ahead.compile_in_background("cpu") as started:
        assert started.running
    assert not started.running and time.monotonic() - before < 30
