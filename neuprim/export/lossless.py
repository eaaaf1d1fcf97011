"""Export formats ``npz`` and ``ply``: every parameter of the model, bit for bit. ``neuprim import`` reads both.

Both formats contain a JSON header with three parts: the model's header, the shapes of the parameters, and the text of
the run's ``config.yaml``. The model's header has the task, the field classes and their settings, the background and the
colour space. ``config.yaml`` includes paths to the data. If the parameters are not in the coordinates of the run's
data, "world" in the model's header has ``scene_from_world``.

``npz``: ``numpy.load(FILE, allow_pickle=False)`` gives one float32 array (N, ...) per parameter under the parameter's
name, and the text ``header``.

``ply``: binary little-endian, one vertex per primitive. The first properties are ``x y z``, the centre in the
coordinates of the run's data, ``double`` where these differ from the model's coordinates. Then come all parameters as
stored, ``float``, in the model's coordinates: logarithms of semi-axes, unnormalised quaternions wxyz, SH coefficients.
These properties are named PARAMETER_INDEX, and the index counts row by row: ``means_0`` to ``means_2``, ``W1_0`` to
``W1_23``. The header is one line ``comment neuprim {...}``.
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
from neuprim.core.io.json_reader import load_json
from neuprim.core.io.ply import read_ply, write_ply
from neuprim.core.task import API_VERSION

_FORMAT = 1
_HEADER_BYTES = 4 * 2**20 * 4  # numpy stores text as four bytes per character
_ARRAY_HEADER = 4096
_PLY_MARK = "neuprim "
_NOTE = "holds the text of config.yaml with paths to the run's data; `neuprim import` makes a run directory of it"


def _pack_export_header(job: ExportJob) -> str:
    """Return one line of JSON: the model's header, its parameters' shapes, and the text of ``config.yaml``."""
    run = job.run
    path = run.directory / "config.yaml"
    try:
        config = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error})") from error
    shapes = {spec.name: list(spec.shape) for spec in run.model.specs}
    record = {"format": _FORMAT, "model": dict(run.header), "parameters": shapes, "config": config}
    return json.dumps(record, allow_nan=False)


def _unpack_export_header(text: str, path: Path) -> tuple[dict[str, Any], dict[str, tuple[int, ...]], str]:
    """Parse and check a line of :func:`_pack_export_header`; return model header, parameter shapes, configuration."""
    try:
        record = load_json(text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: the neuprim header is not valid JSON ({error})") from error
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        found = record.get("format") if isinstance(record, dict) else type(record).__name__
        raise DataError(f"{path}: the neuprim header has format {found!r}, but this neuprim reads {_FORMAT}")
    header, shapes, config = record.get("model"), record.get("parameters"), record.get("config")
    if not isinstance(header, dict) or not isinstance(shapes, dict) or not isinstance(config, str):
        raise DataError(f"{path}: the neuprim header lacks model, parameters or config; expected all three")
    for name, shape in shapes.items():
        valid = isinstance(shape, list) and len(shape) <= 4 and all(type(n) is int and 0 <= n <= 10_000 for n in shape)
        if not valid or math.prod(shape) > 10_000:
            raise DataError(f"{path}: parameter {name[:40]!r} has shape {str(shape)[:60]}; expected up to 4 integers")
    return header, {name: tuple(shape) for name, shape in shapes.items()}, config


# ---------------------------------------------------------------- npz


def _write_npz_export(job: ExportJob) -> ExportReport:
    arrays = {name: value.detach().float().contiguous().numpy() for name, value in job.run.model.params.items()}
    with atomic_path(job.out) as temporary, open(temporary, "wb") as file:
        np.savez(file, header=np.array(_pack_export_header(job)), **arrays)  # type: ignore[arg-type]
    return ExportReport((job.out,), True, notes=(_NOTE,))


def _read_npz_export(path: Path) -> StoredModel:
    try:
        with zipfile.ZipFile(path) as archive:
            entries = {i.filename: i for i in archive.infolist()}
            if len(entries) != len(archive.infolist()) or len(entries) > 1000:
                raise DataError(f"{path}: has repeated or more than 1000 entries; expected an export of neuprim")
            if "header.npy" not in entries:
                raise DataError(f"{path}: no array 'header'; expected a file written by `neuprim export --format npz`")
            text = _read_npz_export_array(archive, entries["header.npy"], path, _HEADER_BYTES)
            if text.dtype.kind != "U" or text.shape != ():
                raise DataError(f"{path}: array 'header' is not one string; expected a neuprim export")
            header, shapes, config = _unpack_export_header(str(text), path)
            tensors = {}
            for name, shape in shapes.items():
                if (entry := entries.get(f"{name}.npy")) is None:
                    raise DataError(f"{path}: no array {name!r}; expected this array, because the header names it")
                # arrays are stored uncompressed, so none is larger than the file
                value = _read_npz_export_array(archive, entry, path, path.stat().st_size)
                if value.dtype != np.float32 or value.ndim != len(shape) + 1 or value.shape[1:] != shape:
                    found = f"{value.dtype} of shape {value.shape}"
                    raise DataError(f"{path}: {name} is {found}; expected float32 of (N, {str(shape)[1:]}")
                tensors[name] = np.ascontiguousarray(value)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, NotImplementedError, RuntimeError) as error:
        raise DataError(f"{path}: not a readable .npz ({' '.join(str(error).split())[:120]})") from error
    if len({len(value) for value in tensors.values()}) > 1:
        raise DataError(f"{path}: arrays have different numbers of primitives; expected the same number in all")
    return StoredModel(header, tensors, config)


def _read_npz_export_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path, limit: int) -> np.ndarray:
    """Read one array of an .npz file; refuse more than ``limit`` bytes before memory is allocated."""
    if entry.file_size > limit + _ARRAY_HEADER:
        raise DataError(f"{path}: {entry.filename} claims {entry.file_size} bytes; expected at most {limit}")
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        if dtype.hasobject or math.prod(shape) * dtype.itemsize > entry.file_size:
            claim = f"{entry.filename} claims {dtype} of shape {shape}"
            raise DataError(f"{path}: {claim}; expected numbers that fit its {entry.file_size} bytes")
    with archive.open(entry) as file:
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False))


# ---------------------------------------------------------------- ply


def _write_ply_export(job: ExportJob) -> ExportReport:
    model = job.run.model
    centers = job.run.world.world_points(model.params["means"].detach())
    columns = {axis: centers[:, i].numpy() for i, axis in enumerate("xyz")}
    for name, value in model.params.items():
        flat = value.detach().float().reshape(model.count, -1).numpy()
        columns |= {f"{name}_{i}": flat[:, i] for i in range(flat.shape[1])}
    rows = np.empty(model.count, [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    write_ply(job.out, rows, [_PLY_MARK + _pack_export_header(job)])
    return ExportReport((job.out,), True, notes=(_NOTE,))


def _read_ply_export(path: Path) -> StoredModel:
    found = read_ply(path)
    headers = [c.removeprefix(_PLY_MARK) for c in found.comments if c.startswith(_PLY_MARK + "{")]
    if len(headers) != 1:
        hint = "; a PLY of 3D Gaussians or points can start a model: neuprim run ... model.init.points=FILE.ply"
        expected = f"expected one{'' if headers else hint}"
        raise DataError(f"{path}: found {len(headers)} comments with a neuprim header; {expected}")
    header, shapes, config = _unpack_export_header(headers[0], path)
    tensors = {}
    for name, shape in shapes.items():
        columns = [f"{name}_{i}" for i in range(math.prod(shape))]
        for column in columns:
            if column not in found.names or found.rows.dtype[column].str[1:] != "f4":
                expected = f"expected float, because the header has {name} of shape {shape}"
                raise DataError(f"{path}: property {column} is missing or not float; {expected}")
        flat = np.stack([found.rows[c] for c in columns], -1) if columns else np.zeros((len(found.rows), 0), np.float32)
        tensors[name] = np.ascontiguousarray(flat.reshape(len(found.rows), *shape), np.float32)
    return StoredModel(header, tensors, config)


NPZ = Exporter(
    API_VERSION,
    "npz",
    "the whole model as numpy arrays; lossless, `neuprim import` reads it",
    _write_npz_export,
    read=_read_npz_export,
    default="model.npz",
    suffixes=(".npz",),
)
PLY = Exporter(
    API_VERSION,
    "ply",
    "the whole model, one vertex per primitive; lossless, `neuprim import` reads it",
    _write_ply_export,
    read=_read_ply_export,
    default="model.ply",
    suffixes=(".ply",),
)
