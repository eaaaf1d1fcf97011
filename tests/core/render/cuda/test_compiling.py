"""The kernels compile for a card where there is none: what only a card compiles, such as stores of 16 bytes, is checked
on every machine."""

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
from neuprim.core.render.cuda import binning, prepare, prepare_backward

BENCHMARKS = Path(__file__).parents[4] / "benchmarks"
ARCHS = (80, 89, 90)
needs_sm_90 = pytest.mark.skipif(
    90 not in wp.get_cuda_supported_archs(), reason="this build of Warp does not compile for sm_90"
)
needs_all = pytest.mark.skipif(
    not set(ARCHS) <= set(wp.get_cuda_supported_archs()),
    reason="this build of Warp does not compile for sm_80, sm_89 and sm_90",
)
KERNELS = {
    "prepare": prepare.prepare_kernel(False),
    "prepare of float64": prepare.prepare_kernel(True),
    "wide": prepare.wide_kernel(False),
    "emit": binning._kernels()[0],
    "list_pairs": binning._kernels()[1],
    "backward": prepare_backward._kernel(False),
}


@needs_sm_90
@pytest.mark.parametrize("name", KERNELS)
def test_it_compiles_for_sm_90(name: str, tmp_path: Path) -> None:
    kernel: Any = KERNELS[name]
    wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path, use_ptx=False)
    (cubin,) = tmp_path.glob("*.cubin")
    assert cubin.stat().st_size > 1000


# ---------------------------------------------------------------- what kernels take


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


def checked(forms: tuple[str, ...], archs: tuple[int, ...], record: dict[str, Any], *kernels: str) -> None:
    """In a process of its own, as kernels are compiled for blocks of their own sizes. Record what is meant:
    gpu_kernels.py --record."""
    if record["warp"] != wp.__version__:
        pytest.skip(f"recorded with Warp {record['warp']}, whose compiler is another one than that of {wp.__version__}")
    words = [
        sys.executable,
        str(BENCHMARKS / "gpu_kernels.py"),
        "--check",
        "--archs",
        *map(str, archs),
        "--forms",
        *forms,
    ]
    words += ["--kernels", *kernels] if kernels else []
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    own = [
        r
        for r in record["kernels"]
        if r["arch"] in archs and r["form"] in forms and (not kernels or r["kernel"] in kernels)
    ]
    assert (
        sum(line.startswith(tuple(f"| {form} |" for form in forms)) for line in done.stdout.splitlines())
        == len(own)
        > 5
    )


@needs_sm_90
@pytest.mark.parametrize("forms", [("K=8 p=0", "K=0 p=2"), ("every frame", "beside frames")])
def test_kernels_take_no_more_than_they_did(forms: tuple[str, ...], record: dict[str, Any]) -> None:
    checked(forms, (90,), record)


@needs_all
def test_nor_do_those_of_pixels_and_pairs_on_other_cards(record: dict[str, Any]) -> None:
    """With 8 neurons, the most registers that a frame needs without a stack."""
    checked(("K=8 p=0",), (80, 89), record, "forward", "pixels", "pairs")


@pytest.mark.slow
@pytest.mark.timeout(1800)
@needs_all
def test_nor_does_any(script: ModuleType, record: dict[str, Any]) -> None:
    checked((*script.FORMS, script.EVERY, script.BESIDE), ARCHS, record)


def test_what_has_grown_or_spills_is_named(script: ModuleType, record: dict[str, Any]) -> None:
    rows = record["kernels"]
    assert script.grown(rows, rows) == [] and script.spilled(rows) == []
    at = next(i for i, r in enumerate(rows) if (r["form"], r["kernel"], r["arch"]) == ("K=8 p=0", "forward", 90))
    more = [*rows[:at], {**rows[at], "registers": 99, "stack": 8}, *rows[at + 1 :]]
    assert script.grown(more, rows) == [
        f"K=8 p=0: forward on sm_90: registers {rows[at]['registers']} -> 99",
        "K=8 p=0: forward on sm_90: stack 0 -> 8",
    ]
    assert script.spilled(more) == ["K=8 p=0: forward spills on sm_90: 8 bytes of stack"]
    assert script.grown(rows, rows[:at] + rows[at + 1 :]) == ["K=8 p=0: forward on sm_90 is not recorded"]


def test_every_form_is_recorded_for_every_architecture(script: ModuleType, record: dict[str, Any]) -> None:
    rows = record["kernels"]
    wanted = {
        (form, name, arch)
        for form in (*script.FORMS, script.EVERY, script.BESIDE)
        for name, _, _ in script.kernels(form)
        for arch in script.ARCHS
    }
    assert {(r["form"], r["kernel"], r["arch"]) for r in rows} == wanted and len(rows) == len(wanted)
    page = script.PAGE.read_text(encoding="utf-8")
    assert f"<!-- gpu-kernels -->\n{script.document(record)}\n<!-- /gpu-kernels -->" in page


def test_a_file_that_is_no_cubin_is_refused(script: ModuleType, tmp_path: Path) -> None:
    cubins = importlib.import_module("shared.cubins")
    file = tmp_path / "a.cubin"
    file.write_bytes(b"MZ" * 50)
    with pytest.raises(ValueError, match="no 64-bit ELF file"):
        cubins.resources(file)
