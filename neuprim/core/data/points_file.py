"""Starting points from a PLY file: points with or without colours, or the Gaussians of 3D Gaussian splatting."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neuprim.core.data import PointCloud
from neuprim.core.errors import DataError
from neuprim.core.io import images
from neuprim.core.io.ply import PlyVertices, read_ply
from neuprim.core.model.colours.sh import C0
from neuprim.core.notices import warn_once

__all__ = ["read_points"]

_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_LARGEST = 1e6
_COARSE = 1e-3
"""Of the size of the cloud: what coordinates may be rounded to without a word."""

_FARTHEST = 1e8
"""From the origin of the file's coordinates: maps reach 1e7 metres."""


def read_points(path: Path, channels: int, color_space: str) -> PointCloud:
    """The vertices of a PLY file as starting points, in the file's own coordinates, float64.

    Properties ``x y z`` are required. Colours come from ``f_dc_0..2`` or from ``red green blue`` (bytes, or floats 0..1), both taken for
    sRGB; points without are mid-grey. ``scale_0..2`` (logarithms of standard deviations) with ``rot_0..3`` (wxyz) make Gaussians of them,
    and ``opacity`` (a logit) says how opaque they are. All else is ignored, view-dependent colour too.

    Args:
        channels: of the data set. color_space: "srgb" or "linear", what the colours become.

    Raises:
        DataError: a damaged file, one without points, or values that are not finite or out of all proportion.
    """
    found = read_ply(path)
    means = _means(found, path)
    if means is None:
        raise DataError(f"{path}: no properties x, y, z; expected points")
    if not len(means):
        raise DataError(f"{path}: no vertices; expected at least one point")
    colors = _colors(found, path)
    if color_space == "linear":
        colors = images.srgb_to_linear(colors)
    if channels != 3:
        colors = colors.mean(1, keepdim=True).expand(-1, channels)
    scales = _numbers(found, ("scale_0", "scale_1", "scale_2"), path)
    quats = _numbers(found, ("rot_0", "rot_1", "rot_2", "rot_3"), path)
    opacity = _numbers(found, ("opacity",), path)
    if scales is None or quats is None:
        deviations, quats = None, None
    else:
        if bool((scales.abs() > 50).any()) or bool((quats.norm(dim=1) < 1e-12).any()):
            raise DataError(f"{path}: scale or rot of a vertex is out of proportion; expected logarithms, and quaternions of some length")
        deviations = scales.double().exp().float()
    alphas = None if opacity is None else torch.sigmoid(opacity[:, 0])
    return PointCloud(means, colors.contiguous(), {}, None, quats, alphas, deviations)


def _colors(found: PlyVertices, path: Path) -> Tensor:
    """(N, 3) sRGB."""
    dc = _numbers(found, ("f_dc_0", "f_dc_1", "f_dc_2"), path)
    if dc is not None:
        return (dc * C0 + 0.5).clamp(0, 1)
    for names in _COLOURS:
        rgb = _numbers(found, names, path)
        if rgb is not None:
            kind = found.rows.dtype[names[0]]
            return (rgb / (np.iinfo(kind).max if kind.kind in "iu" else 1.0)).clamp(0, 1)
    return torch.full((len(found.rows), 3), 0.5)


def _means(found: PlyVertices, path: Path) -> Tensor | None:
    """(N, 3) float64, however far from the origin; None where the file has no points."""
    if not {"x", "y", "z"} <= set(found.names):
        return None
    values = found.columns(("x", "y", "z"))
    bad = ~(np.abs(values) <= _FARTHEST)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        raise DataError(f"{path}: {'xyz'[column]} of vertex {row} is {values[row, column]}; expected a number of at most {_FARTHEST:g}")
    size, step = np.ptp(values, axis=0).max() if len(values) else 0.0, np.spacing(np.abs(values).max(initial=0.0).astype(np.float32))
    if found.rows.dtype["x"].itemsize == 4 and step > _COARSE * size > 0:
        warn_once(
            f"{path}: x y z are float, which rounds coordinates as large as {np.abs(values).max():.7g} to {step:.2g}; expected double there"
        )
    return torch.from_numpy(values)


def _numbers(found: PlyVertices, names: tuple[str, ...], path: Path) -> Tensor | None:
    """(N, len(names)) float32; None if one of them is missing."""
    if not set(names) <= set(found.names):
        return None
    values = found.columns(names)
    bad = ~(np.abs(values) <= _LARGEST)
    if bad.any():
        row, column = (int(i) for i in np.argwhere(bad)[0])
        raise DataError(f"{path}: {names[column]} of vertex {row} is {values[row, column]}; expected a number of at most {_LARGEST:g}")
    return torch.from_numpy(values).float()
