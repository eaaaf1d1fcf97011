"""How the kernels are compiled: flags, and where numba keeps the result.

numba's cache does not notice edits in *other* files that were inlined, and site-packages may be read-only, so the cache
lives in the user's own cache folder under a name made of the version and a hash of all kernel sources.
``NUMBA_CACHE_DIR``, where set, wins.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba import njit

import neuprim

__all__ = ["FAST", "cache_directory", "exact_kernel", "inline", "kernel"]

FAST = {"nnan", "nsz", "arcp", "contract", "afn", "reassoc"}
"""Floating-point freedom of the pixel kernels. NaN checks vanish under it: rows are checked before (``prepare``)."""


def cache_directory() -> Path:
    """Folder of the compiled kernels for this version of the sources."""
    if os.environ.get("NUMBA_CACHE_DIR"):
        return Path(os.environ["NUMBA_CACHE_DIR"])
    digest = hashlib.sha256()
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "neuprim" / f"{neuprim.__version__}-{digest.hexdigest()[:12]}"


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
