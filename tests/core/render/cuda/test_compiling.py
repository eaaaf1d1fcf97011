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
from neuprim.core.render.cuda import prepare

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
    found: dict[str, Any] = json.loads(script.RESULTS.read_text(encoding="utf-8"))
    return found


def test_kernels_of_float64_parameters_compile(tmp_path: Path) -> None:
    """Which no record has."""
    if 90 not in wp.get_cuda_supported_archs():
        pytest.skip("this build of Warp does not compile for sm_90")
    module = prepare.prepare_kernel(True).module
    wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=False)
    (cubin,) = tmp_path.glob("*.cubin")
    assert cubin.stat().st_size > 1000


@pytest.mark.parametrize(
    ("forms", "archs", "kernels"),
    [
        (("K=8 p=0", "K=0 p=2"), (90,), ()),
        (("every frame", "beside frames"), (90,), ()),
        (("K=8 p=0",), (80, 89), ("forward", "pixels", "pairs")),
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


def test_what_has_grown_or_spills_is_named(script: ModuleType, record: dict[str, Any]) -> None:
    rows = record["kernels"]
    assert script.grown(rows, rows) == [] and script.spilled(rows) == []
    at = next(i for i, r in enumerate(rows) if (r["form"], r["kernel"], r["arch"]) == ("K=8 p=0", "forward", 90))
    more = [*rows[:at], {**rows[at], "registers": 99, "stack": 8}, *rows[at + 1 :]]
    found = script.grown(more, rows)
    assert len(found) == 2 and found[0].startswith("K=8 p=0: forward on sm_90: registers ")
    assert script.spilled(more) == ["K=8 p=0: forward spills on sm_90: 8 bytes of stack"]
    assert script.grown(rows, rows[:at] + rows[at + 1 :]) == ["K=8 p=0: forward on sm_90 is not recorded"]


def test_every_form_is_recorded_for_every_architecture(script: ModuleType, record: dict[str, Any]) -> None:
    wanted = {
        (form, name, arch)
        for form in (*script.FORMS, script.EVERY, script.BESIDE)
        for name, _, _ in script.kernels(form)
        for arch in script.ARCHS
    }
    assert {(r["form"], r["kernel"], r["arch"]) for r in record["kernels"]} == wanted
