"""Export format ``gaussian-glb``: one Gaussian per primitive in glTF's extension KHR_gaussian_splatting; lossy.

The file has one primitive of mode POINTS with these attributes, all float32 (K stands for ``KHR_gaussian_splatting``):

* ``POSITION``: centres, relative to the node's translation, which keeps large coordinates exact
* ``K:ROTATION``: quaternions xyzw; ``K:SCALE``: standard deviations; ``K:OPACITY``: 0 to 1
* ``K:SH_DEGREE_d_COEF_n``: SH coefficients of degrees 0 to 3, RGB
* ``COLOR_0``: colour of degree 0 and opacity, for viewers that show only points

Coordinates are those of the run's data, rotated about x to glTF's y up, unless the data have y up. The colour space
is ``lin_rec709_display`` for models of linear images, else ``srgb_rec709_display``. The Gaussians are fitted, and their
error is measured, as in :mod:`neuprim.export.gaussian_ply`.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import torch

from neuprim.core.cameras.world import World
from neuprim.core.extensions import Exporter, ExportJob, ExportReport
from neuprim.core.io.files import atomic_path
from neuprim.core.model import sh
from neuprim.core.task import API_VERSION
from neuprim.export.gaussian_ply import OPTIONS, ExportedGaussians, fit_exported_gaussians
from neuprim.export.shared import AXES_TO_GLTF, closest_up_axis, gltf_up_notes

_NAME = "KHR_gaussian_splatting"
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def _write_gaussian_glb(job: ExportJob) -> ExportReport:
    fitted = fit_exported_gaussians(job)
    matrix = job.run.world.world_from_scene.double()
    up = closest_up_axis(matrix[:3, :3] @ job.run.world.up)
    matrix = torch.from_numpy(AXES_TO_GLTF[up]) @ matrix
    attributes, offset = _gaussian_attributes(fitted, matrix)
    linear = job.run.channels.color_space == "linear"
    data = _pack_glb(attributes, offset, "lin_rec709_display" if linear else "srgb_rec709_display")
    with atomic_path(job.out) as temporary:
        temporary.write_bytes(data)
    notes = [*fitted.notes, f"glTF extension {_NAME}; degree 3 harmonics", *gltf_up_notes(up)]
    return ExportReport((job.out,), False, fitted.errors, tuple(notes))


def _gaussian_attributes(fitted: ExportedGaussians, matrix: torch.Tensor) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return name -> (M, k) float32 attribute, and the (3,) offset to add to the positions.

    ``matrix`` (4, 4) float64 maps scene coordinates to the coordinates of the file.
    """
    means, scales, quats, opacity, harmonics = fitted.placed(World(matrix))
    offset, opacity = matrix[:3, 3].numpy(), opacity[:, None]
    found = {
        "POSITION": means - offset,
        "COLOR_0": np.concatenate([np.clip(sh.C0 * harmonics[:, 0] + 0.5, 0, 1), opacity], 1),
        f"{_NAME}:ROTATION": quats[:, [1, 2, 3, 0]],
        f"{_NAME}:SCALE": scales,
        f"{_NAME}:OPACITY": opacity,
    }
    for degree in range(4):
        for n in range(2 * degree + 1):
            found[f"{_NAME}:SH_DEGREE_{degree}_COEF_{n}"] = harmonics[:, degree * degree + n]
    return {name: values.astype("<f4") for name, values in found.items()}, offset


def _pack_glb(attributes: dict[str, np.ndarray], offset: np.ndarray, space: str) -> bytes:
    """Return the bytes of a binary glTF 2.0 file with one node: points with ``attributes``, moved by ``offset``."""
    accessors: list[dict[str, Any]] = []
    views, at = [], 0
    for name, values in attributes.items():
        views.append({"buffer": 0, "byteOffset": at, "byteLength": values.nbytes, "target": 34962})
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": 5126, "count": len(values), "type": _TYPES[values.shape[1]]}
        )
        if name == "POSITION":
            accessors[-1] |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        at += values.nbytes
    primitive = {
        "attributes": {name: i for i, name in enumerate(attributes)},
        "mode": 0,
        "extensions": {_NAME: {"kernel": "ellipse", "colorSpace": space}},
    }
    description = {
        "asset": {"version": "2.0", "generator": "neuprim"},
        "extensionsUsed": [_NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **({"translation": offset.tolist()} if offset.any() else {})}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json.dumps(description).encode()
    text += b" " * (-len(text) % 4)
    body = b"".join(values.tobytes() for values in attributes.values())  # float32: always multiples of 4 bytes
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(body))
    return head + struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body


EXPORTER = Exporter(
    API_VERSION,
    "gaussian-glb",
    "one fitted Gaussian per primitive, as glTF with KHR_gaussian_splatting; lossy",
    _write_gaussian_glb,
    OPTIONS,
    conditions=True,
    sequence=True,
    default="gaussians.glb",
    suffixes=(".glb",),
)
