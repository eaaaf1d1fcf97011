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
    """A run that waited for it finds on disk every kernel that training calls, for the types that training calls it with."""
    ahead = kernels.compiled_by("from neuprim.runs import compile; compile.main('cpu')")
    training = "t = tiny.trainer(tiny.two_primitives(True), 4, population={'strategy': 'relocate', 'every': 2})"
    needed = kernels.compiled_by(f"from tests.core import tiny; {training}; assert len(list(t.run())) == 4")
    assert len(needed) > 8
    missing = [f"{name}{types}" for name, signatures in needed.items() for types in signatures if types not in ahead.get(name, [])]
    assert missing == []


def test_it_says_so_once_it_is_done(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(ahead, "cache_directory", lambda: tmp_path / "kernels")
    assert not ahead.compiled("cpu")

    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(optimizer.RowAdam, "step", interrupted)  # the last that it compiles
        with pytest.raises(KeyboardInterrupt):
            ahead.main("cpu")
    assert not ahead.compiled("cpu"), "a run must not wait for less than all"
    ahead.main("cpu")
    assert ahead.compiled("cpu") and not ahead.compiled("cpu", "RayNet") and not ahead.compiled("reference")
    monkeypatch.setattr(ahead, "cache_directory", lambda: tmp_path / "other sources")
    assert not ahead.compiled("cpu")


def test_nothing_is_started_where_there_is_nothing_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead.subprocess, "Popen", lambda *a, **k: pytest.fail("a process was started"))
    monkeypatch.setattr(ahead, "compiled", lambda backend: True)
    with ahead.compiling("cpu") as started:
        assert not started.running
        started.wait()
    monkeypatch.setattr(ahead, "compiled", lambda backend: False)
    with ahead.compiling(None) as started:
        assert not started.running


def test_the_process_ends_with_the_block(monkeypatch: pytest.MonkeyPatch) -> None:
    genuine = ahead.subprocess.Popen
    monkeypatch.setattr(ahead, "compiled", lambda backend: False)
    monkeypatch.setattr(ahead.subprocess, "Popen", lambda *a, **k: genuine([sys.executable, "-c", "import time; time.sleep(60)"]))
    before = time.monotonic()
    with ahead.compiling("cpu") as started:
        assert started.running
    assert not started.running and time.monotonic() - before < 30
