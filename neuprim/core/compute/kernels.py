"""How numba compiles the kernels: flags, and where it keeps the result.

numba's cache notices edits of a kernel's own file, but not of others whose functions it inlined or whose constants it
froze; and site-packages may be read-only. So code lives in the user's cache folder, under a hash of every source that
can
end up in it (:func:`kernel_sources`). ``NUMBA_CACHE_DIR``, where set, wins.
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
from numba.core import caching
from numba.extending import overload

from neuprim.core.compute.code_cache import code_cache
from neuprim.core.io import files
from neuprim.version import __version__


def _prefer_wide_vectors() -> None:
    """Ask LLVM for 512-bit vectors, unless NUMBA_CPU_FEATURES is set; before anything is compiled."""
    features = llvm.get_host_cpu_features()
    if features.get("avx512f") and numba.config.CPU_FEATURES is None:  # type: ignore[attr-defined]
        numba.config.CPU_FEATURES = features.flatten() + ",-prefer-256-bit"  # type: ignore[attr-defined]


def _one_vector_at_a_time() -> None:
    """Ask LLVM not to compute several vectors at a time: loops that sum would spill registers."""
    llvm.set_option("neuprim", "-force-vector-interleave=1")


_prefer_wide_vectors()
_one_vector_at_a_time()

FAST = {"nnan", "nsz", "arcp", "contract", "afn", "reassoc"}
"""Floating-point freedom of the pixel kernels. NaN checks vanish under it: rows are checked before (``prepare``)."""


_ROOT = Path(__file__).parents[2]
_IMPORT = re.compile(r"^\s*from (neuprim[\w.]*) import (\([^)]*\)|[^\n]*)|^\s*import (neuprim[\w.]+)", re.M)


def kernel_sources(module: Path, package: Path = _ROOT) -> set[Path]:
    """Files whose text can end up in a module's kernels: its own and all of the package that it imports."""
    found: set[Path] = set()
    todo = [module]
    while todo:
        file = todo.pop()
        if file not in found:
            found.add(file)
            if file != package / "core" / "compute" / "kernels.py":
                todo += _imported(file, package)
    return found


@functools.cache
def _imported(file: Path, package: Path) -> set[Path]:
    names: set[str] = set()
    for base, imported, whole in _IMPORT.findall(file.read_text(encoding="utf-8")):
        words = re.findall(r"(\w+)(?: as \w+)?", re.sub(r"#.*", "", imported))
        names |= {whole} if whole else {f"{base}.{word}" for word in words}
    files = set()
    for name in names:
        _, *parts = name.split(".")
        # a name of a module, or of something in one
        paths = [package.joinpath(*parts), package.joinpath(*parts[:-1])]
        candidates = [file for path in paths for file in (path.with_suffix(".py"), path / "__init__.py")]
        files |= {next(file for file in candidates if file.exists())}
    return files


def sources_hash(module: Path, package: Path = _ROOT) -> str:
    """Twelve hexadecimal digits that change with the version and any of :func:`kernel_sources`."""
    digest = hashlib.sha256(f"{module.name} {__version__}".encode())
    for source in sorted(kernel_sources(module, package)):
        digest.update(source.name.encode() + b"\0" + source.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def cache_directory() -> Path:
    """Folder of the compiled kernels, which nobody else may write."""
    own = Path(os.environ.get("NUMBA_CACHE_DIR") or files.cache_directory() / "kernels")
    chosen = code_cache(own)
    if chosen != own.absolute():
        os.environ["NUMBA_CACHE_DIR"] = str(chosen)  # processes that this one starts use the private folder too
    return chosen


_cache_directory = functools.cache(cache_directory)  # once a process: every kernel asks
_sources_hash = functools.cache(sources_hash)


class KernelLocator(getattr(caching, "UserProvidedCacheLocator", object)):  # type: ignore[misc]
    """numba's own, but for a folder that does not depend on where the sources are."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        return Path(py_file).stem


def _jit(**options: Any) -> Callable[[Any], Any]:
    def decorate(function: Any) -> Any:
        config: Any = numba.config
        previous = config.CACHE_DIR, getattr(config, "CACHE_LOCATOR_CLASSES", "")
        config.CACHE_DIR = str(_cache_directory() / _sources_hash(Path(function.__code__.co_filename).resolve()))
        config.CACHE_LOCATOR_CLASSES = f"{__name__}.{KernelLocator.__name__}"
        try:
            return njit(**options)(function)
        finally:  # other packages keep their own cache
            config.CACHE_DIR, config.CACHE_LOCATOR_CLASSES = previous

    return decorate


inline = njit(fastmath=FAST, error_model="numpy", forceinline=True)
"""Building block of a pixel kernel; ``forceinline`` so that a cold and a cached process compute the same bits."""

inline_source = njit(fastmath=FAST, error_model="numpy", inline="always")
"""As if its text stood in the caller: LLVM sees both at once, and computes the bits that it would compute of one
function."""

kernel = _jit(fastmath=FAST, error_model="numpy", nogil=True, cache=True)  # A pixel kernel, called from worker threads


def dispatch_by_length(*functions: Any) -> Any:
    """One function of (tuple, *arguments) that calls ``functions[len(tuple)]``, chosen during compilation."""

    def choose(key: Any, *arguments: Any) -> Any: ...

    @overload(choose, jit_options={"forceinline": True, "fastmath": FAST, "error_model": "numpy"}, strict=False)
    def _choose(key: Any, *arguments: Any) -> Any:
        chosen = functions[len(key)]
        return lambda key, *arguments: chosen(*arguments)

    return choose


exact_kernel = _jit(error_model="numpy", nogil=True, cache=True)
"""A kernel in strict IEEE arithmetic: per-primitive preparation, binning, sums whose order matters."""

strict = njit(error_model="numpy", forceinline=True)  # building block of an :data:`exact_kernel`
