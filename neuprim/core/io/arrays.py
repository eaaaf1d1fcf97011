"""Read arrays from an untrusted ``.npz`` file, checked before memory is allocated for them."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from neuprim.core.errors import DataError

ArrayType = tuple[Any, tuple[int | None, ...]]  # dtype and shape; None for any length


def read_arrays(path: Path, wanted: Mapping[str, ArrayType]) -> dict[str, np.ndarray]:
    """Read the named arrays of an uncompressed file of ``numpy.savez``; raises DataError before memory is allocated."""
    damaged = (OSError, ValueError, KeyError, EOFError, RuntimeError, SyntaxError, TokenError, zipfile.BadZipFile)
    try:
        size = path.stat().st_size
        with zipfile.ZipFile(path) as archive:
            entries = {entry.filename: entry for entry in archive.infolist()}
            return {
                name: _read_array(archive, entries.get(f"{name}.npy"), name, array_type, size)
                for name, array_type in wanted.items()
            }
    except damaged as error:
        raise DataError(f"{path}: damaged ({' '.join(str(error).split()) or type(error).__name__})") from error


def _read_array(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo | None, name: str, array_type: ArrayType, size: int
) -> np.ndarray:
    dtype, shape = array_type
    if entry is None:
        raise ValueError(f"no array {name!r}")
    if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > size:
        raise ValueError(f"{name} claims {entry.file_size} bytes of a file of {size}")
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        actual, _, kind = read(file)
        fits = len(actual) == len(shape) and all(w is None or n == w for n, w in zip(actual, shape, strict=True))
        if kind != np.dtype(dtype) or not fits:
            expected = f"{np.dtype(dtype)} of {str(shape).replace('None', 'N')}"
            raise ValueError(f"{name} is {kind} of shape {actual}; expected {expected}")
        if math.prod(actual) * kind.itemsize > entry.file_size:
            raise ValueError(f"{name} claims shape {actual}, and has {entry.file_size} bytes")
    with archive.open(entry) as file:
        result: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
    return result
