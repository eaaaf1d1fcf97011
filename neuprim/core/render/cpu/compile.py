"""How the kernels are compiled: flags, and where numba keeps the result.

numba's cache does not notice edits in *other* files that were inlined, and site-packages may be read-only, so the cache
lives in the user's own cache folder under a name made of the version and a hash of all kernel sources.
``NUMBA_CACHE_DIR``, where set, wins.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from numba import njit

import neuprim
from neuprim.core import files

__all__ = ["FAST", "cache_directory", "exact_kernel", "inline", "kernel"]


def _prefer_wide_vectors() -> None:
    """Ask LLVM for 512-bit vectors where the processor has them; it avoids them by default, at a cost in these kernels.

    Takes effect when nothing was compiled before; NUMBA_CPU_FEATURES, where set, wins.
    """
    features = llvm.get_host_cpu_features()
    if features.get("avx512f") and numba.config.CPU_FEATURES is None:  # type: ignore[attr-defined]
        numba.config.CPU_FEATURES = features.flatten() + ",-prefer-256-bit"  # type: ignore[attr-defined]


_prefer_wide_vectors()

FAST = {"nnan", "nsz", "arcp", "contract", "afn", "reassoc"}
"""Floating-point freedom of the pixel kernels. NaN checks vanish under it: rows are checked before (``prepare``)."""


def cache_directory() -> Path:
    """Folder of the compiled kernels for this version of the sources."""
    if os.environ.get("NUMBA_CACHE_DIR"):
        return Path(os.environ["NUMBA_CACHE_DIR"])
    digest = hashlib.sha256()
    core = Path(__file__).parents[2]
    for source in sorted([*core.glob("render/cpu/*.py"), *core.glob("**/*_cpu.py"), core / "train" / "optimizer.py"]):
        digest.update(source.read_bytes())
    return files.cache_directory() / "kernels" / f"{neuprim.__version__}-{digest.hexdigest()[:12]}"


def _jit(**options: Any) -> Callable[[Any], Any]:
    def decorate(function: Any) -> Any:
        previous = numba.config.CACHE_DIR  # type: ignore[attr-defined]
        numba.config.CACHE_DIR = str(cache_directory())  # type: ignore[attr-defined]
        try:
            return njit(**options)(function)
        finally:  # other packages keep their own cache
            numba.config.CACHE_DIR = previous  # type: ignore[attr-defined]

    return decorate


inline = njit(fastmath=FAST, error_model="numpy", forceinline=True)
"""Building block of a pixel kernel; ``forceinline`` so that a cold and a cached process compute the same bits."""

kernel = _jit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
"""A pixel kernel, called from worker threads."""

exact_kernel = _jit(error_model="numpy", nogil=True, cache=True)
"""A kernel in strict IEEE arithmetic: per-primitive preparation, binning, sums whose order matters."""
