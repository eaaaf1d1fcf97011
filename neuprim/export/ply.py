"""``ply``: the model itself, every parameter as a vertex property; lossless.

A binary little-endian PLY of one vertex per primitive. Properties: ``x y z``, the centres in the coordinates of the
run's data for programs that show points, ``double`` where these differ from the model's own; then, all ``float`` and in
the model's own coordinates, every number of every parameter, as stored (logarithms of semi-axes, unnormalised
quaternions wxyz, SH
coefficients), named PARAMETER_INDEX with the index counted row by row: ``means_0`` to ``means_2``, ``W1_0`` to
``W1_23``. One line
``comment neuprim {...}`` of JSON holds the model's header (task, field classes and their settings, background, colour
space), the shapes of the parameters and the text of the run's ``config.yaml``, paths to its data included. ``neuprim
import`` reads it back bit for bit.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from neuprim.core.errors import DataError
from neuprim.core.extensions import Exporter, ExportJob, ExportReport, StoredModel
from neuprim.core.io.ply import read_ply, write_ply
from neuprim.core.task import API_VERSION
from neuprim.export.npz import LOSSLESS_NOTE, pack_header, unpack_header

_MARK = "neuprim "


def _write(job: ExportJob) -> ExportReport:
    centers = job.run.world.world_points(job.run.model.params["means"].detach())
    columns = {axis: centers[:, i].numpy() for i, axis in enumerate("xyz")}
    for name, value in job.run.model.params.items():
        flat = value.detach().float().reshape(job.run.model.count, -1).numpy()
        columns |= {f"{name}_{i}": flat[:, i] for i in range(flat.shape[1])}
    rows = np.empty(job.run.model.count, [(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    write_ply(job.out, rows, [_MARK + pack_header(job)])
    return ExportReport((job.out,), True, notes=(LOSSLESS_NOTE,))


def _read(path: Path) -> StoredModel:
    found = read_ply(path)
    headers = [c.removeprefix(_MARK) for c in found.comments if c.startswith(_MARK + "{")]
    if len(headers) != 1:
        hint = (
            "; a PLY of 3D Gaussians or points can start a model: neuprim run ... model.init.points=FILE.ply"
            if not headers
            else ""
        )
        raise DataError(f"{path}: {len(headers)} comments hold a neuprim header; expected one{hint}")
    header, shapes, config = unpack_header(headers[0], path)
    tensors = {}
    for name, shape in shapes.items():
        columns = [f"{name}_{i}" for i in range(math.prod(shape))]
        for column in columns:
            if column not in found.names or found.rows.dtype[column].str[1:] != "f4":
                raise DataError(
                    f"{path}: property {column} is missing or not float; the header has {name} of shape {shape}"
                )
        flat = np.stack([found.rows[c] for c in columns], -1) if columns else np.zeros((len(found.rows), 0), np.float32)
        tensors[name] = np.ascontiguousarray(flat.reshape(len(found.rows), *shape), np.float32)
    return StoredModel(header, tensors, config)


EXPORTER = Exporter(
    API_VERSION,
    "ply",
    "the whole model, one vertex per primitive; lossless, `neuprim import` reads it",
    _write,
    read=_read,
    default="model.ply",
    suffixes=(".ply",),
)
