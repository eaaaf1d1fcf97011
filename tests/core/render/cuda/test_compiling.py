"""The kernels compile for a card where there is none: what only a card compiles, such as stores of 16 bytes, is checked on every machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.compute.warp import wp
from neuprim.core.render.cuda import binning, prepare, prepare_backward

KERNELS = {
    "prepare": prepare.prepare_kernel(False),
    "prepare of float64": prepare.prepare_kernel(True),
    "wide": prepare.wide_kernel(False),
    "emit": binning._kernels()[0],
    "list_pairs": binning._kernels()[1],
    "backward": prepare_backward._kernel(False),
}


@pytest.mark.skipif(90 not in wp.get_cuda_supported_archs(), reason="this build of Warp does not compile for sm_90")
@pytest.mark.parametrize("name", KERNELS)
def test_it_compiles_for_sm_90(name: str, tmp_path: Path) -> None:
    kernel: Any = KERNELS[name]
    wp.compile_aot_module(kernel.module, arch=90, module_dir=tmp_path, use_ptx=False)
    (cubin,) = tmp_path.glob("*.cubin")
    assert cubin.stat().st_size > 1000
