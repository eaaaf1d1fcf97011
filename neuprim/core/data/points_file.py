"""Starting points from a PLY or SPZ file: points with or without colours, or Gaussians of Gaussian splatting."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.lib.recfunctions import unstructured_to_structured
from torch import Tensor

from neuprim.core.data import PointCloud
from neuprim.core.errors import DataError, warn_once
from neuprim.core.io import images
from neuprim.core.io.ply import PlyVertices, read_ply
from neuprim.core.io.spz import SPZ_FROM_DATA, read_spz
from neuprim.core.model.sh import C0

READABLE = (".ply", ".spz")
COMPRESSED = (".splat", ".ksplat", ".sog", ".sogs", ".lcc")  # refused by name

LINEAR = "colours are linear light"
"""Comment that marks PLY files with linear, not sRGB, colours; ``neuprim export --format gaussian-ply`` writes it."""

_COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_SCALES = ("scale_0", "scale_1", "scale_2")
_ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")

_LARGEST_LOG = 50.0  # largest valid logarithm of a size; below its negative, a size counts as missing
_FLATNESS = 0.1  # thickness of a Gaussian without a size along an axis, over its smallest size
_FARTHEST = 1e4  # distance from the median point, over the median of these distances, beyond which a point is dropped
_COARSE = 1e-3  # coarsest rounding of coordinates without a warning, over the size of the cloud


def read_points(path: Path, channels: int, color_space: str) -> PointCloud:
    """Read the vertices of a PLY file as starting points, in the file's own coordinates, ``means`` in float64.

    An SPZ file counts as the PLY file that other tools convert it to.

    Colours (``f_dc_0..2``, or ``red green blue``) are sRGB, unless a comment in the file says that colours are linear.
    Colours are converted to ``color_space`` and ``channels`` channels.
    Vertices with ``scale_0..2``, ``rot_0..3`` (wxyz) and ``opacity`` (a logit) are Gaussians. With only two scales, a
    Gaussian is a disc, with one scale a ball. Vertices that are no valid points are left out with a warning. Raises
    DataError for a damaged or compressed file, or a file without usable points.
    """
    if path.suffix.lower() in COMPRESSED:
        raise _compressed_start_points_error(path, f"{path.suffix} is a compressed format of Gaussians")
    found = _read_spz_vertices(path) if path.suffix.lower() == ".spz" else read_ply(path)
    if "packed_position" in found.names:
        raise _compressed_start_points_error(path, "a compressed PLY (property packed_position)")
    if "f_anchor_feat_0" in found.names:
        what = "anchors of Scaffold-GS (property f_anchor_feat_0), whose colours come from a network"
        raise DataError(f"{path}: {what}; expected Gaussians or points")
    means = _starting_point_columns(found, ("x", "y", "z"))
    if means is None:
        raise DataError(f"{path}: the vertices have no properties x, y, z; expected a position for each vertex")
    if not len(means):
        raise DataError(f"{path}: no vertices; expected at least one point")
    scales, opacity = _starting_point_log_sizes(found, path), _starting_point_columns(found, ("opacity",))
    filters = _starting_point_columns(found, ("filter_3D",))
    if scales is not None and filters is not None:
        scales, opacity = _filter_gaussians(scales, opacity, filters)
    quats = _starting_point_columns(found, _ROTATION) if "scale_1" in found.names else None
    colors = _starting_point_colors(found, path)
    faults = {"position": ~(np.abs(means) < 1e30).all(1), "colour": ~np.isfinite(colors).all(1)}
    if scales is not None:
        faults["size"] = ~(scales <= _LARGEST_LOG).all(1) | ~(scales >= -_LARGEST_LOG).any(1)
        if quats is not None:
            faults["rotation"] = ~(np.isfinite(quats).all(1) & (np.abs(quats).max(1) > 1e-12))
    if opacity is not None:
        faults["opacity"] = np.isnan(opacity[:, 0])
    kept = ~np.any(list(faults.values()), axis=0)
    if kept.any():
        away = np.linalg.norm(np.where(kept[:, None], means, np.nan) - np.median(means[kept], axis=0), axis=1)
        faults["position"] |= kept & (away > _FARTHEST * np.median(away[kept])) & (np.median(away[kept]) > 0)
        kept &= ~faults["position"]
    if not kept.all():
        parts = [
            f"{rows.sum()} with bad {what}, e.g. vertex {rows.argmax()}" for what, rows in faults.items() if rows.any()
        ]
        text = f"{path}: {(~kept).sum()} of {len(kept)} vertices are not usable as points ({'; '.join(parts)})"
        if not kept.any():
            raise DataError(f"{text}; expected at least one with finite numbers")
        warn_once(f"{text}; left out")
    _warn_of_rounded_starting_points(found, means[kept], path)
    rgb = _convert_starting_point_colors(torch.from_numpy(colors[kept]).float(), LINEAR in found.comments, color_space)
    if channels != 3:
        rgb = rgb.mean(1, keepdim=True).expand(-1, channels)
    deviations = rotations = None
    if scales is not None:
        sizes = np.exp(scales[kept])
        flat = sizes < np.exp(-_LARGEST_LOG)
        thickness = _FLATNESS * np.where(flat, np.inf, sizes).min(1, keepdims=True)
        deviations = torch.from_numpy(np.where(flat, thickness, sizes)).float()
        rotations = torch.tensor([1.0, 0, 0, 0]).repeat(len(sizes), 1)
    if scales is not None and quats is not None:
        rotations = torch.from_numpy(quats[kept] / np.linalg.norm(quats[kept], axis=1, keepdims=True)).float()
    alphas = None if opacity is None else torch.sigmoid(torch.from_numpy(opacity[kept, 0]).float())
    return PointCloud(torch.from_numpy(means[kept]), rgb.contiguous(), {}, None, rotations, alphas, deviations)


def _read_spz_vertices(path: Path) -> PlyVertices:
    """Return the Gaussians of an SPZ file as vertices, with y and z negated, as other tools convert them."""
    found = read_spz(path, degree=0)
    w, x, y, z = found.quats.T
    quats = np.stack([-x, w, -z, y], 1)  # half turn around x
    with np.errstate(divide="ignore"):
        logits = np.log(found.opacities) - np.log1p(-found.opacities)
    means = found.means * np.diag(SPZ_FROM_DATA)[:3]
    table = np.concatenate([means, found.harmonics[:, 0], logits[:, None], found.log_scales, quats], 1)
    names = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *_SCALES, *_ROTATION)
    return PlyVertices(unstructured_to_structured(table, np.dtype([(name, "f8") for name in names])))


def _compressed_start_points_error(path: Path, what: str) -> DataError:
    return DataError(
        f"{path}: {what}, which is not supported; expected an uncompressed PLY or SPZ. "
        "Convert it with SuperSplat (export as PLY) or splat-transform FILE OUT.ply"
    )


def _starting_point_columns(found: PlyVertices, names: tuple[str, ...]) -> np.ndarray | None:
    """Return the properties ``names`` as (N, len(names)) float64; None if one is missing."""
    return found.columns(names) if set(names) <= set(found.names) else None


def _starting_point_log_sizes(found: PlyVertices, path: Path) -> np.ndarray | None:
    """Return (N, 3) logarithms of the Gaussians' sizes, -inf for a disc's third size; None without usable sizes."""
    there = [name for name in _SCALES if name in found.names]
    if not there:
        return None
    if there != list(_SCALES[: len(there)]) or (len(there) > 1 and not set(_ROTATION) <= set(found.names)):
        lacking = [name for name in (*_SCALES, *_ROTATION) if name not in found.names]
        what = f"has {', '.join(there)}, but no {', '.join(lacking)}"
        warn_once(f"{path}: {what}; its sizes are ignored, and distances between points give the sizes instead")
        return None
    scales = found.columns(there)
    if len(there) == 1:
        return np.repeat(scales, 3, axis=1)
    return np.pad(scales, ((0, 0), (0, 3 - len(there))), constant_values=-np.inf)


def _filter_gaussians(
    scales: np.ndarray, logits: np.ndarray | None, filters: np.ndarray
) -> tuple[np.ndarray, np.ndarray | None]:
    """Apply the 3D filter of Mip-Splatting (Yu et al. 2024), which its files store beside unfiltered Gaussians.

    ``scales`` (N, 3) are logarithms of standard deviations, ``filters`` (N, 1) the standard deviations of the filters.
    A filtered Gaussian is wider and, in proportion, fainter.
    """
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        wider = 0.5 * np.log(np.exp(2 * scales) + filters**2)
        if logits is not None:
            alphas = np.exp((scales - wider).sum(1, keepdims=True)) / (1 + np.exp(-logits))
            logits = np.log(alphas) - np.log1p(-alphas)
    return wider, logits


def _starting_point_colors(found: PlyVertices, path: Path) -> np.ndarray:
    """Return the vertices' (N, 3) colours in the file's own colour space, 0..1, or above 1 for brighter light."""
    dc = _starting_point_columns(found, ("f_dc_0", "f_dc_1", "f_dc_2"))
    if dc is not None:
        return dc * C0 + 0.5
    for names in _COLOURS:
        rgb = _starting_point_columns(found, names)
        if rgb is not None:
            return rgb / found.white(names, path)
    return np.full((len(found.rows), 3), 0.5)


def _warn_of_rounded_starting_points(found: PlyVertices, means: np.ndarray, path: Path) -> None:
    """Warn if a file's float32 coordinates lie so far from the origin that rounding distorts the point cloud."""
    largest = np.abs(means).max(initial=0.0)
    size, step = np.ptp(means, axis=0).max(), np.spacing(np.float32(largest))
    if found.rows.dtype["x"].itemsize == 4 and step > _COARSE * size > 0:
        what = f"x, y, z are float, which rounds coordinates near {largest:.7g} to steps of {step:.2g}"
        warn_once(f"{path}: {what}; expected double")


def _convert_starting_point_colors(colors: Tensor, linear: bool, color_space: str) -> Tensor:
    if linear:
        colors = colors.clamp_min(0)
        return colors if color_space == "linear" else images.linear_to_srgb(colors.clamp_max(1))
    colors = colors.clamp(0, 1)
    return images.srgb_to_linear(colors) if color_space == "linear" else colors
