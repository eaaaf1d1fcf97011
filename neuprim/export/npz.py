"""``npz``: the model itself as numpy arrays; lossless.

``numpy.load(FILE, allow_pickle=False)`` gives one float32 array (N, ...) per parameter under its own name, and
``header``, a text of
JSON: the model's header (where "world" has ``scene_from_world``, if the arrays are in other coordinates than the run's
data), the shapes of the parameters and the text of the run's ``config.yaml``, paths to its data included. ``neuprim
import`` reads it back bit for bit.
"""

from __future__ import annotations

import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from neuprim.core.errors import CheckpointError, DataError
from neuprim.core.extensions import Exporter, ExportJob, ExportReport, StoredModel
from neuprim.core.io.files import atomic_path
from neuprim.core.io.plain import load_json
from neuprim.core.task import API_VERSION

_HEADER_BYTES = 4 * 2**20 * 4  # numpy stores text as four bytes per character
_ARRAY_HEADER = 4096
LOSSLESS_NOTE = (
    "holds the text of config.yaml with paths to the run's data; `neuprim import` makes a run directory of it"
)


def _write(job: ExportJob) -> ExportReport:
    arrays = {name: value.detach().float().contiguous().numpy() for name, value in job.run.model.params.items()}
    with atomic_path(job.out) as temporary, open(temporary, "wb") as file:
        np.savez(file, header=np.array(pack_header(job)), **arrays)  # type: ignore[arg-type]
    return ExportReport((job.out,), True, notes=(LOSSLESS_NOTE,))


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
                        f"{path}: {name} is {value.dtype} of shape {value.shape}; expected float32 of (N, "
                        f"{str(shape)[1:]}"
                    )
                tensors[name] = np.ascontiguousarray(value)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise DataError(f"{path}: not a readable .npz ({' '.join(str(error).split())[:120]})") from error
    if len({len(value) for value in tensors.values()}) > 1:
        raise DataError(f"{path}: arrays have different numbers of primitives")
    return StoredModel(header, tensors, config)


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path, most: int) -> np.ndarray:
    """Read one array. A size beyond ``most`` bytes, packed or not, is refused before memory is allocated."""
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


# ---------------------------------------------------------------- the header, which ply has too

_FORMAT = 1


def pack_header(job: ExportJob) -> str:
    """Return one line of JSON: the model's header, its parameters' shapes, and the text of ``config.yaml``."""
    run = job.run
    path = run.directory / "config.yaml"
    try:
        config = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error})") from error
    record = {
        "format": _FORMAT,
        "model": dict(run.header),
        "parameters": {spec.name: list(spec.shape) for spec in run.model.specs},
        "config": config,
    }
    return json.dumps(record, allow_nan=False)


def unpack_header(text: str, path: Path) -> tuple[dict[str, Any], dict[str, tuple[int, ...]], str]:
    """Read model header, parameter shapes and configuration from an untrusted :func:`pack_header` line.

    Raises:
        DataError: it is something else.
    """
    try:
        record = load_json(text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: the neuprim header is not valid JSON ({error})") from error
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        found = record.get("format") if isinstance(record, dict) else type(record).__name__
        raise DataError(f"{path}: the neuprim header has format {found!r}; this neuprim reads {_FORMAT}")
    header, shapes, config = record.get("model"), record.get("parameters"), record.get("config")
    if not isinstance(header, dict) or not isinstance(shapes, dict) or not isinstance(config, str):
        raise DataError(f"{path}: the neuprim header lacks model, parameters or config")
    for name, shape in shapes.items():
        whole = isinstance(shape, list) and len(shape) <= 4 and all(type(n) is int and 0 <= n <= 10_000 for n in shape)
        if not whole or math.prod(shape) > 10_000:
            raise DataError(f"{path}: parameter {name[:40]!r} has shape {str(shape)[:60]}; expected up to 4 sizes")
    return header, {name: tuple(shape) for name, shape in shapes.items()}, config


EXPORTER = Exporter(
    API_VERSION,
    "npz",
    "the whole model as numpy arrays; lossless, `neuprim import` reads it",
    _write,
    read=_read,
    default="model.npz",
    suffixes=(".npz",),
)
