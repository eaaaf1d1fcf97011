"""Arrays from an ``.npz`` file, checked before memory is taken for them."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from neuprim.core.errors import DataError

__all__ = ["read_arrays"]

Wanted = tuple[Any, tuple[int | None, ...]]
"""dtype and shape; None where any length will do."""


def read_arrays(path: Path, wanted: Mapping[str, Wanted]) -> dict[str, np.ndarray]:
    """The arrays of these names, as ``numpy.savez`` writes them; others in the file are not looked at.

    What a header claims is held against the bytes that are there first.

    Raises:
        DataError: no such file, a damaged one, a missing array, or one of another dtype or shape.
    """
    try:
        size = path.stat().st_size
        with zipfile.ZipFile(path) as archive:
            entries = {entry.filename: entry for entry in archive.infolist()}
            return {
                name: _array(archive, entries.get(f"{name}.npy"), name, *asked, size) for name, asked in wanted.items()
            }
    except (
        OSError,
        ValueError,
        KeyError,
        EOFError,
        RuntimeError,
        SyntaxError,
        TokenError,
        zipfile.BadZipFile,
    ) as error:
        raise DataError(f"{path}: damaged ({' '.join(str(error).split()) or type(error).__name__})") from error


def _array(
    archive: zipfile.ZipFile,
    entry: zipfile.ZipInfo | None,
    name: str,
    dtype: Any,
    shape: tuple[int | None, ...],
    size: int,
) -> np.ndarray:
    if entry is None:
        raise ValueError(f"no array {name!r}")
    if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > size:
        raise ValueError(f"{name} claims {entry.file_size} bytes of a file of {size}")
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        found, _, kind = read(file)
        fits = len(found) == len(shape) and all(w is None or n == w for n, w in zip(found, shape, strict=True))
        if kind != np.dtype(dtype) or not fits:
            raise ValueError(f"{name} is {kind} of shape {found}; expected {np.dtype(dtype)} of {_said(shape)}")
        if math.prod(found) * kind.itemsize > entry.file_size:
            raise ValueError(f"{name} claims shape {found}, and has {entry.file_size} bytes")
    with archive.open(entry) as file:
        result: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
    return result


def _said(shape: tuple[int | None, ...]) -> str:
    return "(" + ", ".join("N" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
