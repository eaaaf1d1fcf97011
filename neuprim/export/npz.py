"""``npz``: the model itself as numpy arrays; lossless.

``numpy.load(FILE, allow_pickle=False)`` gives one float32 array (N, ...) per parameter under its own name, and
``header``, a text of
JSON: the model's header (where "world" has ``scene_from_world``, if the arrays are in other coordinates than the run's
data), the shapes of the parameters and the text of the run's ``config.yaml``, paths to its data included. ``neuprim
import`` reads it back bit for bit.
"""

from __future__ import annotations

import math
import zipfile
from pathlib import Path

import numpy as np

from neuprim.core.errors import DataError
from neuprim.core.extensions import Exporter, ExportJob, ExportReport, StoredModel
from neuprim.core.io.files import atomic_path
from neuprim.core.task import API_VERSION
from neuprim.export.common import pack_header, unpack_header

__all__ = ["EXPORTER"]

_HEADER_BYTES = 4 * 2**20 * 4  # numpy stores text as four bytes per character
_ARRAY_HEADER = 4096


def _write(job: ExportJob) -> ExportReport:
    arrays = {name: value.detach().float().contiguous().numpy() for name, value in job.run.model.params.items()}
    with atomic_path(job.out) as temporary, open(temporary, "wb") as file:
        np.savez(file, header=np.array(pack_header(job)), **arrays)  # type: ignore[arg-type]
    note = (
        "holds the text of config.yaml, paths to the run's data included; `neuprim import` makes a run directory of it"
    )
    return ExportReport((job.out,), True, notes=(note,))


def _read(path: Path) -> StoredModel:
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {i.filename: i for i in archive.infolist()}
            if len(entries) != len(archive.infolist()) or len(entries) > 1000:
                raise DataError(f"{path}: entries repeat, or more than 1000 of them")
            if "header.npy" not in entries:
                raise DataError(f"{path}: no array 'header'; expected a file written by `neuprim export --format npz`")
            text = _array(archive, entries["header.npy"], path, _HEADER_BYTES)
            if text.dtype.kind != "U" or text.shape != ():
                raise DataError(f"{path}: header is {text.dtype} of shape {text.shape}; expected one text")
            header, shapes, config = unpack_header(str(text), path)
            tensors = {}
            for name, shape in shapes.items():
                entry = entries.get(f"{name}.npy")
                if entry is None:
                    raise DataError(f"{path}: no array {name!r}, which the header names")
                value = _array(
                    archive, entry, path, path.stat().st_size
                )  # arrays are stored as they are, so no file is smaller
                if value.dtype != np.float32 or value.ndim != len(shape) + 1 or value.shape[1:] != shape:
                    raise DataError(
                        f"{path}: {name} is {value.dtype} of shape {value.shape}; expected float32 of (N, {str(shape)[1:]}"
                    )
                tensors[name] = np.ascontiguousarray(value)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise DataError(f"{path}: not a readable .npz ({' '.join(str(error).split())[:120]})") from error
    if len({len(value) for value in tensors.values()}) > 1:
        raise DataError(f"{path}: arrays have different numbers of primitives")
    return StoredModel(header, tensors, config)


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path, most: int) -> np.ndarray:
    """One array; a claim beyond ``most`` bytes, packed or not, is refused before anything is taken for it."""
    if entry.file_size > most + _ARRAY_HEADER:
        raise DataError(f"{path}: {entry.filename} claims {entry.file_size} bytes; expected at most {most}")
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        if dtype.hasobject or math.prod(shape) * dtype.itemsize > entry.file_size:
            raise DataError(
                f"{path}: {entry.filename} claims {dtype} of shape {shape}; the entry has {entry.file_size} bytes"
            )
    with archive.open(entry) as file:
        result: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
    return result


EXPORTER = Exporter(
    API_VERSION,
    "npz",
    "the whole model as numpy arrays; lossless, `neuprim import` reads it",
    _write,
    read=_read,
    default="model.npz",
    suffixes=(".npz",),
)
