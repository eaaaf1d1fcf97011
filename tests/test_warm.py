"""Kernels compiled beside a run's preparations."""

from __future__ import annotations

import sys
import time

import pytest

from neuprim import warm


def test_what_is_compiled_is_what_training_needs() -> None:
    warm.main()
    assert warm.compiled()


def test_nothing_is_started_where_there_is_nothing_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm.subprocess, "Popen", lambda *a, **k: pytest.fail("a process was started"))
    monkeypatch.setattr(warm, "compiled", lambda: True)
    with warm.compiling() as started:
        assert not started.running
        started.wait()
    monkeypatch.setattr(warm, "compiled", lambda: False)
    with warm.compiling(wanted=False) as started:
        assert not started.running


def test_the_process_ends_with_the_block(monkeypatch: pytest.MonkeyPatch) -> None:
    genuine = warm.subprocess.Popen
    monkeypatch.setattr(warm, "compiled", lambda: False)
    monkeypatch.setattr(warm.subprocess, "Popen", lambda *a, **k: genuine([sys.executable, "-c", "import time; time.sleep(60)"]))
    before = time.monotonic()
    with warm.compiling() as started:
        assert started.running
    assert not started.running and time.monotonic() - before < 30
