"""How the kernels are compiled: flags, and where numba keeps the result.

numba's cache notices edits of the file a kernel is in, but not of *other* files whose functions it inlined or whose
constants it froze; and site-packages may be read-only. So the cache lives in the user's own cache folder, under a name
made of the version and a hash of every source that can end up in compiled code: see :func:`kernel_sources`.
``NUMBA_CACHE_DIR``, where set, wins.
"""

from __future__ import annotations

import functools
import hashlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from numba import njit
from numba.extending import overload

from neuprim.core.compute.code_cache import code_cache
from neuprim.core.io import files
from neuprim.version import __version__

__all__ = [
    "FAST",
    "dispatch_by_length",
    "cache_directory",
    "exact_kernel",
    "inline",
    "kernel",
    "kernel_sources",
    "sources_hash",
    "strict",
    "inline_source",
]


def _prefer_wide_vectors() -> None:
    """Ask LLVM for 512-bit vectors where the processor has them; it avoids them by default, at a cost in these kernels.

    Takes effect when nothing was compiled before; NUMBA_CPU_FEATURES, where set, wins.
    """
    features = llvm.get_host_cpu_features()
    if features.get("avx512f") and numba.config.CPU_FEATURES is None:  # type: ignore[attr-defined]
        numba.config.CPU_FEATURES = features.flatten() + ",-prefer-256-bit"  # type: ignore[attr-defined]


def _one_vector_at_a_time() -> None:
    """Ask LLVM not to compute several vectors at a time, for the whole process.

    In loops that sum it would, without counting what the loop already holds in registers: it spills, and leaves up to
    three vectors over to a loop of half the width. Lanes come in whole vectors, so that one at a time leaves nothing
    over.
    """
    llvm.set_option("neuprim", "-force-vector-interleave=1")


_prefer_wide_vectors()
_one_vector_at_a_time()

FAST = {"nnan", "nsz", "arcp", "contract", "afn", "reassoc"}
"""Floating-point freedom of the pixel kernels. NaN checks vanish under it: rows are checked before (``prepare``)."""


_COMPILED = re.compile(
    rb"\bnumba\b|\bcompute\.kernels import [^\n]*\b(?:exact_kernel|kernel|inline|strict|inline_source)\b"
)


def kernel_sources(package: Path) -> list[Path]:
    """Files of a package that can end up in compiled code: all of ``core/render/cpu``, and those that use its
    decorators or name numba.

    A module of constants for kernels outside that folder says "numba" in its text, and is found by that; the tests
    compare this list with all that the kernels refer to.
    """
    own = package / "core" / "render" / "cpu"
    return [
        file for file in sorted(package.rglob("*.py")) if own in file.parents or _COMPILED.search(file.read_bytes())
    ]


@functools.cache
def sources_hash(package: Path) -> str:
    """Twelve hexadecimal digits that change with any of :func:`kernel_sources`."""
    digest = hashlib.sha256()
    for source in kernel_sources(package):
        digest.update(source.relative_to(package).as_posix().encode() + b"\0" + source.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def cache_directory() -> Path:
    """Folder of the compiled kernels for this version of the sources, which nobody else may write."""
    if os.environ.get("NUMBA_CACHE_DIR"):
        return code_cache(Path(os.environ["NUMBA_CACHE_DIR"]))
    own = files.cache_directory() / "kernels" / f"{__version__}-{sources_hash(Path(__file__).parents[2])}"
    chosen = code_cache(own)
    if chosen != own.absolute():
        os.environ["NUMBA_CACHE_DIR"] = str(chosen)  # processes that this one starts use the private folder too
    return chosen


_cache_directory = functools.cache(cache_directory)  # once a process: every kernel asks


def _jit(**options: Any) -> Callable[[Any], Any]:
    def decorate(function: Any) -> Any:
        previous = numba.config.CACHE_DIR  # type: ignore[attr-defined]
        numba.config.CACHE_DIR = str(_cache_directory())  # type: ignore[attr-defined]
        try:
            return njit(**options)(function)
        finally:  # other packages keep their own cache
            numba.config.CACHE_DIR = previous  # type: ignore[attr-defined]

    return decorate


inline = njit(fastmath=FAST, error_model="numpy", forceinline=True)
"""Building block of a pixel kernel; ``forceinline`` so that a cold and a cached process compute the same bits."""

inline_source = njit(fastmath=FAST, error_model="numpy", inline="always")
"""As if its text stood in the caller: LLVM sees both at once, and computes the bits that it would compute of one
function."""

kernel = _jit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)
"""A pixel kernel, called from worker threads."""


def dispatch_by_length(*functions: Any) -> Any:
    """One function of (tuple, *arguments) for use in kernels, which calls ``functions[len(tuple)]`` of the arguments.

    A tuple's length belongs to its type: the choice is made while a kernel is compiled, and what is not chosen leaves
    no trace in it.
    """

    def choose(key: Any, *arguments: Any) -> Any: ...

    @overload(choose, jit_options={"forceinline": True, "fastmath": FAST, "error_model": "numpy"}, strict=False)
    def _choose(key: Any, *arguments: Any) -> Any:
        chosen = functions[len(key)]
        return lambda key, *arguments: chosen(*arguments)

    return choose


exact_kernel = _jit(error_model="numpy", nogil=True, cache=True)
"""A kernel in strict IEEE arithmetic: per-primitive preparation, binning, sums whose order matters."""

strict = njit(error_model="numpy", forceinline=True)
"""Building block of an :data:`exact_kernel`."""
