"""The voxel medium of a frame: how its grids become extinction, single scattering and the glow of flames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache

import numpy as np
import torch
from scipy import ndimage

from neuprim.core.compute import device
from neuprim.core.errors import DataError, nearest
from neuprim.core.io.vdb import DENSE_LIMIT, Bounds, Grid
from neuprim.tasks.dynamic.volume.optics import Optics
from neuprim.tasks.dynamic.volume.raymarch import Medium, light_transmittance

_BLACK_BODY_STEPS = 1024  # entries of the table of black bodies; linear between them


def build_medium(
    grids: Mapping[str, Grid], optics: Optics, scene_from_world: np.ndarray, where: torch.device = device.HOST
) -> Medium:
    """Build the medium of one frame on the voxels of its extinction grid.

    Other grids are sampled at those voxels' centres, trilinearly unless their transform is the same. If flames absorb,
    the medium contains all of them. An empty frame gives an empty medium.

    Args:
        grids: by meaning; those that the optics do not use are ignored.
        scene_from_world: (4, 4) float64.
        where: device for the light's transmittance.

    Raises:
        DataError: none of the extinction grids is there, one has the wrong number of channels, the box is too large, or
            an extinction overflows.
    """
    flames = grids.get(optics.flame_grid) if optics.emission > 0.0 or optics.flame_extinction > 0.0 else None
    base = next((grids[name] for name in optics.extinction_grids if name in grids), None)
    if base is None and flames is not None and optics.flame_extinction > 0.0:  # flames absorb by themselves
        base = Grid.from_dense(optics.extinction_grids[0], np.zeros((0, 0, 0), np.float32), transform=flames.transform)
    if base is None:
        wanted = " or ".join(repr(n) for n in optics.extinction_grids)
        raise DataError(f"no grid {wanted} to take the extinction from{nearest(optics.extinction_grids[0], grids)}")
    box = base.bounds
    if flames is not None and optics.flame_extinction > 0.0:
        box = _unite_boxes(box, _transform_bounds(flames, base.transform))
    if box is None:
        return Medium.without_voxels()
    sigma_s = _sample_grid(base, base.transform, box) * np.float32(optics.extinction)
    flame = None if flames is None else _sample_grid(flames, base.transform, box)
    sigma = sigma_s if flame is None else sigma_s + flame * np.float32(optics.flame_extinction)
    values = np.zeros((*sigma.shape, 4), np.float32)
    values[..., 0] = sigma
    scene_from_index = scene_from_world @ base.transform
    scene_from_index[:3, 3] += scene_from_index[:3, :3] @ np.array(box[0], np.float64)
    arriving: np.ndarray = np.array(optics.ambient, np.float32)
    if optics.light is not None:
        padded = Medium.padded(values, scene_from_index)
        lit = light_transmittance(padded, optics.light.direction, where)[1:-1, 1:-1, 1:-1]
        irradiance = np.array(optics.light.irradiance, np.float32) / np.float32(4.0 * math.pi)
        arriving = arriving + lit[..., None] * irradiance.astype(np.float32)
    albedo = _scattering_albedo(grids, optics, base.transform, box, scene_from_index)
    values[..., 1:] = sigma_s[..., None] * (albedo * arriving)
    if flame is not None and optics.emission > 0.0:
        values[..., 1:] += sigma[..., None] * _flame_radiance(flame, optics)
    return Medium.padded(values, scene_from_index, sigma_s if optics.mixes(grids) else None)


def _transform_bounds(grid: Grid, transform: np.ndarray) -> Bounds | None:
    """Bounds, under another index-to-world map, of the voxels whose centres lie in the box of a grid's active ones."""
    if grid.bounds is None or _same_voxels(grid.transform, transform):
        return grid.bounds
    ends = np.array(grid.bounds, np.float64) - 0.5  # of the voxels' own extent
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), -1).reshape(-1, 3)
    chain = np.linalg.inv(transform) @ grid.transform
    index = corners @ chain[:3, :3].T + chain[:3, 3]
    return _make_bounds(np.ceil(index.min(0) - 1e-6), np.floor(index.max(0) + 1e-6) + 1)


def _unite_boxes(a: Bounds | None, b: Bounds | None) -> Bounds | None:
    if a is None or b is None:
        return b if a is None else a
    return _make_bounds(np.minimum(a[0], b[0]), np.maximum(a[1], b[1]))


def _make_bounds(low: np.ndarray, high: np.ndarray) -> Bounds:
    (a, b, c), (d, e, f) = low.astype(int).tolist(), high.astype(int).tolist()
    return (a, b, c), (d, e, f)


def _same_voxels(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two index-to-world maps have the same voxels, to a millionth of one."""
    scale = float(np.abs(b[:3, :3]).max())
    shift = np.linalg.inv(b) @ a[:, 3]  # not a difference, as the world's origin may be far away
    same_axes = np.allclose(a[:3, :3], b[:3, :3], rtol=0, atol=1e-9 * scale)
    return same_axes and np.allclose(shift, [0, 0, 0, 1], rtol=0, atol=1e-6)


def _sample_grid(grid: Grid, transform: np.ndarray, box: Bounds, channels: int = 1) -> np.ndarray:
    """The grid at the voxel centres of ``box`` under ``transform``; 0 where it is not finite, or a scalar negative."""
    if grid.channels != channels:
        raise DataError(f"grid {grid.name!r} has {grid.channels} channels; expected {channels}")
    limit = DENSE_LIMIT // 4 * channels  # the medium has four numbers per voxel
    shape = tuple(h - l for l, h in zip(*box, strict=True))
    if _same_voxels(grid.transform, transform):
        values = grid.to_dense(box, limit, 0.0)
    elif grid.bounds is None:
        values = np.zeros((*shape, 3)[: 2 + min(channels, 2)], np.float32)
    else:
        around = _make_bounds(np.array(grid.bounds[0]) - 1, np.array(grid.bounds[1]) + 1)
        own = grid.to_dense(around, limit, 0.0)
        matrix = np.linalg.inv(grid.transform) @ transform
        offset = matrix[:3, :3] @ np.array(box[0], np.float64) + matrix[:3, 3] - np.array(around[0])
        planes = [own] if channels == 1 else list(np.moveaxis(own, -1, 0))
        settings = (matrix[:3, :3], offset, shape)
        sampled = [ndimage.affine_transform(p, *settings, order=1, mode="grid-constant") for p in planes]
        values = sampled[0] if channels == 1 else np.stack(sampled, -1)
    return np.maximum(values, 0.0) if channels == 1 else values


def _scattering_albedo(
    grids: Mapping[str, Grid], optics: Optics, transform: np.ndarray, box: Bounds, scene_from_index: np.ndarray
) -> np.ndarray:
    """An array that broadcasts to (X, Y, Z, 3)."""
    albedo = np.array(optics.albedo, np.float32)
    if optics.color_grid is not None and optics.color_grid in grids:
        return albedo * np.clip(_sample_grid(grids[optics.color_grid], transform, box, 3), 0.0, 1.0)
    if optics.gradient is None:
        return albedo
    axis = "xyz".index(optics.up)
    sizes = [h - l for l, h in zip(*box, strict=True)]
    indices = np.meshgrid(*(np.arange(n) for n in sizes), indexing="ij", sparse=True)
    height = sum(scene_from_index[axis, a] * indices[a] for a in range(3)) + scene_from_index[axis, 3] + 0.5
    stops = np.linspace(0.0, 1.0, len(optics.gradient))
    colours = [np.interp(height, stops, [stop[c] for stop in optics.gradient]) for c in range(3)]
    return albedo * np.stack(colours, -1).astype(np.float32)


def _flame_radiance(flame: np.ndarray, optics: Optics) -> np.ndarray:
    """(X, Y, Z, 3) float32 emission · B(K(flame))."""
    low, high = optics.flame_range
    table = black_body_rgb(np.linspace(*optics.kelvin, _BLACK_BODY_STEPS), optics.kelvin[1]) * optics.emission
    where = np.clip((flame - low) / (high - low), 0.0, 1.0) * (_BLACK_BODY_STEPS - 1)
    entries = np.arange(_BLACK_BODY_STEPS)
    return np.stack([np.interp(where, entries, table[:, c]) for c in range(3)], -1).astype(np.float32)


# ---------------------------------------------------------------- black bodies

_WAVELENGTHS = np.arange(360.0, 831.0, 1.0)
_SECOND_RADIATION_CONSTANT = 1.438776877e7  # h c / k in nm K
_SRGB_FROM_XYZ = np.array(
    [[3.2406255, -1.5372080, -0.4986286], [-0.9689307, 1.8757561, 0.0415175], [0.0557101, -0.2040211, 1.0569959]]
)  # IEC 61966-2-1 with the white of D65 at (1, 1, 1)


def _observer_lobe(mean: float, below: float, above: float) -> np.ndarray:
    off = _WAVELENGTHS - mean
    return np.exp(-0.5 * (off * np.where(off < 0, below, above)) ** 2)


@cache
def _standard_observer() -> np.ndarray:
    """(3, L) colour matching functions, CIE 1931 2° observer: the fit of Wyman, Sloan and Shirley (JCGT 2013)."""
    x = 0.362 * _observer_lobe(442.0, 0.0624, 0.0374) + 1.056 * _observer_lobe(599.8, 0.0264, 0.0323)
    x -= 0.065 * _observer_lobe(501.1, 0.0490, 0.0382)
    y = 0.821 * _observer_lobe(568.8, 0.0213, 0.0247) + 0.286 * _observer_lobe(530.9, 0.0613, 0.0322)
    z = 1.217 * _observer_lobe(437.0, 0.0845, 0.0278) + 0.681 * _observer_lobe(459.0, 0.0385, 0.0725)
    return np.stack([x, y, z])


def black_body_xyz(kelvin: np.ndarray) -> np.ndarray:
    """(…, 3) CIE XYZ of black bodies in one unit of radiance: ∫ B(λ, T) (x̄, ȳ, z̄) dλ, B ∝ λ⁻⁵ / (exp(hc/λkT) - 1)."""
    exponent = _SECOND_RADIATION_CONSTANT / (_WAVELENGTHS * np.asarray(kelvin, np.float64)[..., None])
    spectrum = (_WAVELENGTHS / 560.0) ** -5.0 / np.expm1(np.minimum(exponent, 700.0))
    return spectrum @ _standard_observer().T


def black_body_rgb(kelvin: np.ndarray, hottest: float) -> np.ndarray:
    """(…, 3) linear sRGB radiance relative to a body of ``hottest`` kelvin (largest channel 1), clipped at 0."""
    top = np.maximum(black_body_xyz(np.array(hottest)) @ _SRGB_FROM_XYZ.T, 0.0).max()
    return np.maximum(black_body_xyz(kelvin) @ _SRGB_FROM_XYZ.T, 0.0) / top
