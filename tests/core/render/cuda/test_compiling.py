"""The kernels compile for GPUs on a machine without one, and take no more registers, stack or shared memory than
recorded."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.compute.warp import wp

BENCHMARKS = Path(__file__).parents[4] / "benchmarks"
ARCHS = (80, 89, 90)


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """benchmarks/gpu_kernels.py"""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return importlib.import_module("gpu_kernels")


@pytest.fixture
def record(script: ModuleType) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(script.RECORD.read_text(encoding="utf-8"))
    return found


@pytest.mark.parametrize(
    ("forms", "archs", "kernels"),
    [
        (("K=8 p=0", "K=0 p=2"), (90,), ()),
        pytest.param(None, ARCHS, (), marks=[pytest.mark.slow, pytest.mark.timeout(1800)]),
    ],
)
def test_kernels_take_no_more_than_recorded(
    forms: tuple[str, ...] | None, archs: tuple[int, ...], kernels: tuple[str, ...], script: Any, record: dict[str, Any]
) -> None:
    """In a process of its own, as kernels are compiled for blocks of their own sizes. ``gpu_kernels.py --record``
    records what is meant."""
    if not set(archs) <= set(wp.get_cuda_supported_archs()):
        pytest.skip(f"this build of Warp does not compile for {archs}")
    if record["warp"] != wp.__version__:
        pytest.skip(f"recorded with Warp {record['warp']}, whose compiler is another one than that of {wp.__version__}")
    forms = forms or (*script.FORMS, script.EVERY, script.BESIDE)
    options = ["--archs", *map(str, archs), "--forms", *forms, *(["--kernels", *kernels] if kernels else [])]
    command = [sys.executable, str(BENCHMARKS / "gpu_kernels.py"), "--check", *options]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
