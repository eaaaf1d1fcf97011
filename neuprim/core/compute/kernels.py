"""Compile the CPU kernels with numba: compiler flags, and the cache folder of the compiled code.

numba's cache notices edits of a kernel's own file. The cache misses edits of other files whose functions or constants
were compiled into the kernel. Besides, the folder of installed packages may be read-only. So compiled code is stored in
the user's cache folder, under a hash of every source file that can be part of the kernel (:func:`kernel_sources`).
``NUMBA_CACHE_DIR``, if set, replaces the user's cache folder. Anyone who can change the folder controls what this
user's processes execute. So neuprim uses the folder only if this user owns it and no other user can change it.
Otherwise compiled code goes into a temporary folder of this process.
"""

from __future__ import annotations

import atexit
import functools
import hashlib
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from llvmlite import binding, ir
from numba import njit, types
from numba.core import caching
from numba.core.imputils import impl_ret_borrowed
from numba.extending import intrinsic, overload
from numba.np.arrayobj import make_array

from neuprim.core.errors import warn_once
from neuprim.core.io import files
from neuprim.version import __version__


def _prefer_wide_vectors() -> None:
    """Ask LLVM for 512-bit vectors, unless NUMBA_CPU_FEATURES is set. Call this before any kernel is compiled."""
    features = llvm.get_host_cpu_features()
    if features.get("avx512f") and numba.config.CPU_FEATURES is None:  # type: ignore[attr-defined]
        numba.config.CPU_FEATURES = features.flatten() + ",-prefer-256-bit"  # type: ignore[attr-defined]


def _forbid_llvm_interleaving() -> None:
    """Ask LLVM not to interleave several vectors in a loop, because loops with sums would need too many registers."""
    llvm.set_option("neuprim", "-force-vector-interleave=1")


_prefer_wide_vectors()
_forbid_llvm_interleaving()

FAST = {"nnan", "nsz", "arcp", "contract", "afn", "reassoc"}
"""LLVM fast-math flags of the pixel kernels. These flags let LLVM assume that no number is NaN. So the
preparation of a frame checks the numbers of all primitives before a pixel kernel runs."""


_ROOT = Path(__file__).parents[2]
_IMPORT = re.compile(r"^\s*from (neuprim[\w.]*) import (\([^)]*\)|[^\n]*)|^\s*import (neuprim[\w.]+)", re.M)


def kernel_sources(module: Path, package: Path = _ROOT) -> set[Path]:
    """Return the source files of a module's kernels: the module and all modules of the package that it imports.

    Imports are followed recursively, except those of this module.
    """
    found: set[Path] = set()
    todo = [module]
    while todo:
        file = todo.pop()
        if file not in found:
            found.add(file)
            if file != package / "core" / "compute" / "kernels.py":
                todo += _imported_sources(file, package)
    return found


@functools.cache
def _imported_sources(file: Path, package: Path) -> set[Path]:
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
    """Return a hash of neuprim's version and all :func:`kernel_sources` of a module: twelve hexadecimal digits."""
    digest = hashlib.sha256(f"{module.name} {__version__}".encode())
    for source in sorted(kernel_sources(module, package)):
        digest.update(source.name.encode() + b"\0" + source.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def cache_directory() -> Path:
    """Return the folder of compiled kernels, which no other user can write."""
    own = Path(os.environ.get("NUMBA_CACHE_DIR") or files.cache_directory() / "kernels")
    chosen = code_cache(own)
    if chosen != own.absolute():
        os.environ["NUMBA_CACHE_DIR"] = str(chosen)  # processes that this one starts use the private folder too
    return chosen


_cache_directory = functools.cache(cache_directory)  # cached: every kernel needs it
_sources_hash = functools.cache(sources_hash)


class KernelLocator(getattr(caching, "UserProvidedCacheLocator", object)):  # type: ignore[misc]
    """Locator of numba's cache: a kernel's folder name does not depend on where its sources lie."""

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        return Path(py_file).stem


def _jit(**options: Any) -> Callable[[Any], Any]:
    """Return a decorator like numba's ``njit(**options)`` that stores compiled code in neuprim's cache folder."""

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


_INLINE: Any = {"error_model": "numpy", "forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
"""Options of functions that only kernels call. Without wrappers for other callers, kernels compile faster."""

inline = njit(fastmath=FAST, **_INLINE)
"""Decorator of functions that pixel kernels call. ``forceinline`` makes results bit-identical whether the kernel comes
from the cache or was just compiled."""

inline_source = njit(fastmath=FAST, error_model="numpy", inline="always")
"""Decorator that inlines a function into its caller before LLVM compiles the caller. So results have the same bits as
if both were one function."""

_KERNEL: Any = {"error_model": "numpy", "nogil": True, "cache": True, "no_cfunc_wrapper": True}

kernel = _jit(fastmath=FAST, **_KERNEL)  # decorator of pixel kernels


def compile_dispatch_by_length(*functions: Any) -> Any:
    """Return a function of (tuple, *arguments) that calls ``functions[len(tuple)]``, chosen at compile time."""

    def choose(key: Any, *arguments: Any) -> Any: ...

    @overload(choose, jit_options={"fastmath": FAST, **_INLINE}, strict=False)
    def _choose(key: Any, *arguments: Any) -> Any:
        chosen = functions[len(key)]
        return lambda key, *arguments: chosen(*arguments)

    return choose


exact_kernel = _jit(**_KERNEL)
"""Decorator of kernels in strict IEEE arithmetic: per-primitive preparation, binning, sums whose order matters."""

strict = njit(**_INLINE)  # for functions that an exact_kernel calls


_COMPRESSES = 19 <= binding.llvm_version_info[0] <= 22
"""Whether to use LLVM's vector compress intrinsic. The intrinsic is experimental, so only these versions of LLVM use
it."""

_SIXTEEN = ir.VectorType(ir.FloatType(), 16)


def _borrow_kernel_array(context, array):  # type: ignore[no-untyped-def]
    """Define the numba intrinsic ``borrow_array``: return a view of an array without reference counting.

    Reference counting is atomic and slow. The caller must keep the array alive. For a kernel's own array, call
    :func:`release_array` after the last use.
    """

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        view = make_array(signature.return_type)(context, builder, value=arguments[0])
        view.meminfo = context.get_constant_null(types.MemInfoPointer(types.voidptr))
        return impl_ret_borrowed(context, builder, signature.return_type, view._getvalue())

    return array(array), code


def _borrow_kernel_arrays(context, arrays):  # type: ignore[no-untyped-def]
    """Define the numba intrinsic ``borrow_arrays``: return a NamedTuple with each array replaced by a borrowed view.

    See :func:`_borrow_kernel_array`. Fields that are not arrays stay as they are.
    """

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        parts = []
        for i, kind in enumerate(signature.return_type.types):
            part = builder.extract_value(arguments[0], i)
            if isinstance(kind, types.Array):
                view = make_array(kind)(context, builder, value=part)
                view.meminfo = context.get_constant_null(types.MemInfoPointer(types.voidptr))
                part = view._getvalue()
            parts.append(part)
        made = context.make_tuple(builder, signature.return_type, parts)
        return impl_ret_borrowed(context, builder, signature.return_type, made)

    return arrays(arrays), code


def _llvm_vector_pointer(context, builder, signature, arguments, array, index):  # type: ignore[no-untyped-def]
    """Return an LLVM pointer to 16 float32 of an array; ``array`` and ``index`` are positions in ``arguments``."""
    data = make_array(signature.args[array])(context, builder, value=arguments[array]).data
    return builder.bitcast(builder.gep(data, [arguments[index]]), _SIXTEEN.as_pointer())


def _llvm_copy16(context, target, at, source, first):  # type: ignore[no-untyped-def]
    """Define ``copy16``: copy source[first : first + 16] to target[at : at + 16], float32, as one vector."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        read, written = (
            _llvm_vector_pointer(context, builder, signature, arguments, *where) for where in ((2, 3), (0, 1))
        )
        builder.store(builder.load(read, align=4), written, align=4)
        return context.get_dummy_value()

    return types.void(target, types.intp, source, types.intp), code


def _llvm_compress16(context, array, at, first, flags):  # type: ignore[no-untyped-def]
    """Define ``compress16``: move the elements of array[first : first + 16] whose flag is not 0 to array[at:].

    ``compress16`` returns the number of moved elements, and writes zeros after them, up to 16 elements in total. The
    flag of element k is array[flags + k]. All 16 elements are read before any is written. If later elements of the
    array are still needed, ``at`` must be <= ``first``.
    """

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        zeros, i32, i64 = ir.Constant(_SIXTEEN, [0.0] * 16), ir.IntType(32), ir.IntType(64)
        value, flag = (
            builder.load(_llvm_vector_pointer(context, builder, signature, arguments, 0, index), align=4)
            for index in (2, 3)
        )
        kept = builder.fcmp_unordered("!=", flag, zeros)
        written = _llvm_vector_pointer(context, builder, signature, arguments, 0, 1)
        count = builder.zext(builder.ctpop(builder.bitcast(kept, ir.IntType(16))), i64)
        if _COMPRESSES:
            kind = ir.FunctionType(_SIXTEEN, [_SIXTEEN, kept.type, _SIXTEEN])
            compress = builder.module.declare_intrinsic("llvm.experimental.vector.compress.v16f32", (), kind)
            builder.store(builder.call(compress, [value, kept, zeros]), written, align=4)
            return count
        builder.store(zeros, written, align=4)
        to, moved = builder.bitcast(written, ir.FloatType().as_pointer()), ir.Constant(i64, 0)
        for lane in range(16):
            chosen = builder.extract_element(kept, i32(lane))
            place = builder.gep(to, [moved])
            builder.store(builder.select(chosen, builder.extract_element(value, i32(lane)), builder.load(place)), place)
            moved = builder.add(moved, builder.zext(chosen, i64))
        return count

    return types.intp(array, types.intp, types.intp, types.intp), code


def _release_kernel_array(context, array):  # type: ignore[no-untyped-def]
    """Define the intrinsic ``release_array``, which does nothing.

    A call after the last use of a borrowed view keeps numba from freeing the kernel's array earlier.
    """

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return context.get_dummy_value()

    return types.void(array), code


borrow_array: Any = intrinsic(_borrow_kernel_array)
borrow_arrays: Any = intrinsic(_borrow_kernel_arrays)
release_array: Any = intrinsic(_release_kernel_array)
copy16: Any = intrinsic(_llvm_copy16)
compress16: Any = intrinsic(_llvm_compress16)


def code_cache(folder: Path) -> Path:
    """Return ``folder``, created if missing.

    If other users can change the folder, or if it cannot be used, warn and return a private temporary folder.
    """
    folder = folder.absolute()
    try:
        made = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if made:
            folder.chmod(0o700)  # whatever the umask is
        why = folder_weakness(folder)
    except OSError as error:
        why = f"cannot be used ({error.strerror or error})"
    if not why:
        return folder
    warn_once(
        f"{folder}: {why}; compiled code in this folder is not trusted and kernels are compiled again. "
        "Expected a folder that only you can write to"
    )
    return _private_code_folder()


def folder_weakness(folder: Path) -> str:
    """Return a text that says which other users can change a folder; "" if no other user can.

    On Windows, the result is always "".
    """
    if not hasattr(os, "getuid"):
        return ""
    own = os.getuid()
    whole = folder.resolve()
    for place in (whole, *whole.parents):
        there = place.stat()
        if there.st_uid != own and (place == whole or there.st_uid != 0):
            return f"belongs to user {there.st_uid}" if place == whole else f"{place} belongs to user {there.st_uid}"
        shared = there.st_mode & stat.S_IWOTH or (
            there.st_mode & stat.S_IWGRP and not _is_own_cache_group(there.st_gid, own)
        )
        if shared and (
            place == whole or not there.st_mode & stat.S_ISVTX
        ):  # others cannot replace a sticky folder's entries
            return "other users may write to it" if place == whole else f"other users may write to {place}"
    return ""


def _is_own_cache_group(number: int, user: int) -> bool:
    """Return whether a group is the user's own: the user's primary group, with the same name and no other members."""
    import grp
    import pwd

    try:
        group, entry = grp.getgrgid(number), pwd.getpwuid(user)
    except KeyError:
        return False
    return entry.pw_gid == number and group.gr_name == entry.pw_name and not set(group.gr_mem) - {entry.pw_name}


@functools.cache
def _private_code_folder() -> Path:
    folder = tempfile.mkdtemp(prefix="neuprim-code-")  # only this user enters it
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
