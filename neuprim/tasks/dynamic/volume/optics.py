"""How grids become light: which grid absorbs, scatters and glows, and how much."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from scipy import ndimage

from neuprim.core.compute import device
from neuprim.core.errors import DataError, nearest
from neuprim.core.io.vdb import DENSE_LIMIT, Bounds, Grid
from neuprim.core.validation import Accepts, Range, Unbounded, validate_fields
from neuprim.tasks.dynamic.volume.blackbody import black_body_rgb
from neuprim.tasks.dynamic.volume.medium import Medium
from neuprim.tasks.dynamic.volume.normalise import Normalisation
from neuprim.tasks.dynamic.volume.rig import AXES
from neuprim.tasks.dynamic.volume.settings import GRIDS, Axis, Meaning
from neuprim.tasks.dynamic.volume.transmittance import transmittance

__all__ = ["FOLLOWING", "Light", "Look", "medium_of"]

NotNegative = Annotated[float, Range(at_least=0)]
RGB = Annotated[
    tuple[NotNegative, NotNegative, NotNegative],
    Accepts(lambda colour: True, "three numbers of at least 0, as [1, 0.5, 0]"),
]
Coordinate = Annotated[float, Unbounded("any direction, of any length")]
Level = Annotated[float, Unbounded("values of a grid, in whatever unit its files have")]
Kelvin = Annotated[float, Range(above=0, at_most=1e5)]
Direction = Annotated[
    tuple[Coordinate, Coordinate, Coordinate], Accepts(any, "three numbers that are not all 0, as [0, 0, 1]")
]


def _absorbing(names: tuple[str, ...]) -> bool:
    return bool(names) and set(names) <= set(GRIDS)


FOLLOWING = ("extinction", "flame_extinction", "flame_range")
"""Settings of a look that follow the values of given files, unless the user sets them."""

_STEPS = 1024
"""Entries of the table of black bodies over a look's range of temperatures; linear between them."""


@dataclass(frozen=True)
class Light:
    """A light at infinity.

    Attributes:
        direction: towards the light, scene axes, any length.
        irradiance: RGB on a plane facing it, in the unit of radiance times steradian.
    """

    direction: Direction
    irradiance: RGB

    def __post_init__(self) -> None:
        validate_fields(self, "scene.optics.light")


@dataclass(frozen=True)
class Look:
    """Everything that turns grids into extinction σ and source radiance c.

    With d the value of the extinction grid and f that of the flame grid, at every voxel

        σ_s = extinction · d                               scatters and absorbs
        σ_f = flame_extinction · f                         soot that only glows
        σ   = σ_s + σ_f
        σ c = σ_s · albedo · (ambient + T_light · irradiance / 4π) + σ · emission · B(K(f))

    B is the radiance of a black body relative to the hottest of the look, whose largest channel is 1; K maps
    ``flame_range`` linearly to ``kelvin`` and clamps. T_light is the transmittance to the light: single scattering,
    isotropic phase function 1/4π, with shadows. Extinctions are per scene unit, and a scene unit is the longest side of
    the sequence's box; radiances are linear sRGB in one arbitrary unit. Negative, NaN and infinite voxels count as 0.

    Attributes:
        extinction_grids: names in order of preference; the first that a file has is d.
        extinction: σ per unit of d, 1/scene unit.
        albedo: scattered part of the light that hits σ_s; ``color_grid`` or ``gradient`` multiply it.
        ambient: radiance that arrives from everywhere, unshadowed.
        light: one directional light, or none.
        flame_grid: f; a file without it does not glow.
        flame_range: values of f that mean ``kelvin``'s ends.
        kelvin: temperatures of the ends.
        emission: strength of the glow, radiance of the hottest flame; 0 for none.
        flame_extinction: σ per unit of f, 1/scene unit.
        color_grid: a vec3s grid that multiplies the albedo, clamped to 0..1.
        gradient: RGB from the bottom to the top of the unit box, where a file has no ``color_grid``.
        up: 'y' or 'z', for the gradient.
    """

    extinction_grids: Annotated[
        tuple[str, ...], Accepts(_absorbing, f"a list of {', '.join(GRIDS)} (scene.grids says which grid that is)")
    ] = (
        "density",
        "temperature",
    )
    extinction: NotNegative = 10.0
    albedo: RGB = (1.0, 1.0, 1.0)
    ambient: RGB = (0.0, 0.0, 0.0)
    light: Light | None = None
    flame_grid: Meaning = "flames"
    flame_range: Annotated[
        tuple[Level, Level], Accepts(lambda ends: ends[0] < ends[1], "two rising numbers, as [0, 1]")
    ] = (0.0, 1.0)
    kelvin: Annotated[
        tuple[Kelvin, Kelvin], Accepts(lambda k: k[0] <= k[1], "two rising numbers within 0..1e5, as [1000, 2000]")
    ] = (
        1000.0,
        2000.0,
    )
    emission: NotNegative = 0.0
    flame_extinction: NotNegative = 0.0
    color_grid: Meaning | None = None
    gradient: (
        Annotated[tuple[RGB, ...], Accepts(bool, "colours from bottom to top, as [[1, 0, 0], [0, 0, 1]]")] | None
    ) = None
    up: Axis = "z"

    def __post_init__(self) -> None:
        validate_fields(self, "scene.optics")

    @property
    def grids(self) -> tuple[str, ...]:
        """Names of all grids that the look reads where a file has them."""
        return tuple(dict.fromkeys(n for n in (*self.extinction_grids, self.flame_grid, self.color_grid) if n))

    def mixes(self, names: Container[str]) -> bool:
        """Whether two grids of ``names`` make the extinction: flames add to that of the extinction grid."""
        return self.extinction > 0 and self.flame_extinction > 0 and self.flame_grid in names

    def turned(self, up: Axis) -> Look:
        """The same look for sequences whose up axis is ``up``; the light turns along."""
        if up == self.up or up not in AXES or self.light is None:
            return replace(self, up=up)
        x, y, z = self.light.direction
        return replace(self, up=up, light=replace(self.light, direction=(y, z, x) if up == "y" else (z, x, y)))


def medium_of(
    grids: Mapping[str, Grid],
    look: Look,
    normalisation: Normalisation,
    threads: int = 0,
    where: torch.device = device.HOST,
) -> Medium:
    """The medium of one frame on the voxels of its extinction grid.

    Other grids are sampled at those voxels' centres: as they are where their transform is the same, trilinearly where
    not.
    Where flames absorb, the medium reaches to all of them. An empty frame gives an empty medium.
    :attr:`Medium.non_finite` counts the NaN and infinite voxels of all grids that were used.

    Args:
        grids: by name; those that the look does not name are ignored.
        where: the device that computes how much of a light arrives.

    Raises:
        DataError: none of the extinction grids is there, one has the wrong number of channels, or the box is too large.
    """
    flames = grids.get(look.flame_grid) if look.emission > 0.0 or look.flame_extinction > 0.0 else None
    base = next((grids[name] for name in look.extinction_grids if name in grids), None)
    if base is None and flames is not None and look.flame_extinction > 0.0:  # flames absorb by themselves
        base = Grid.from_dense(look.extinction_grids[0], np.zeros((0, 0, 0), np.float32), transform=flames.transform)
    if base is None:
        wanted = " or ".join(repr(n) for n in look.extinction_grids)
        raise DataError(f"no grid {wanted} to take the extinction from{nearest(look.extinction_grids[0], grids)}")
    box = base.bounds
    if flames is not None and look.flame_extinction > 0.0:
        box = _union(box, _bounds_in(flames, base.transform))
    if box is None:
        return Medium.nothing()
    density, bad = _scalars(base, base.transform, box)
    sigma_s = density * np.float32(look.extinction)
    flame, more = (None, 0) if flames is None else _scalars(flames, base.transform, box)
    bad += more
    sigma = sigma_s if flame is None else sigma_s + flame * np.float32(look.flame_extinction)
    values = np.zeros((*sigma.shape, 4), np.float32)
    values[..., 0] = sigma
    scene_from_index = normalisation.matrix() @ base.transform
    scene_from_index[:3, 3] += scene_from_index[:3, :3] @ np.array(box[0], np.float64)
    arriving: np.ndarray = np.array(look.ambient, np.float32)
    if look.light is not None:
        lit = transmittance(Medium.padded(values, scene_from_index), look.light.direction, threads, where)[
            1:-1, 1:-1, 1:-1
        ]
        arriving = arriving + lit[..., None] * (
            np.array(look.light.irradiance, np.float32) / np.float32(4.0 * math.pi)
        ).astype(np.float32)
    albedo, more = _albedo(grids, look, base.transform, box, scene_from_index)
    values[..., 1:] = sigma_s[..., None] * (albedo * arriving)
    if flame is not None and look.emission > 0.0:
        values[..., 1:] += sigma[..., None] * _glow(flame, look)
    return Medium.padded(values, scene_from_index, bad + more, sigma_s if look.mixes(grids) else None)


def _bounds_in(grid: Grid, transform: np.ndarray) -> Bounds | None:
    """Bounds, under another index-to-world map, of the voxels whose centres lie in the box of a grid's active ones."""
    if grid.bounds is None or _aligned(grid.transform, transform):
        return grid.bounds
    ends = np.array(grid.bounds, np.float64) - 0.5  # of the voxels' own extent
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), -1).reshape(-1, 3)
    chain = np.linalg.inv(transform) @ grid.transform
    index = corners @ chain[:3, :3].T + chain[:3, 3]
    low, high = (
        np.ceil(index.min(0) - 1e-6).astype(int).tolist(),
        (np.floor(index.max(0) + 1e-6).astype(int) + 1).tolist(),
    )
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def _union(a: Bounds | None, b: Bounds | None) -> Bounds | None:
    if a is None or b is None:
        return b if a is None else a
    low, high = np.minimum(a[0], b[0]).tolist(), np.maximum(a[1], b[1]).tolist()
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


def _aligned(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two index-to-world maps have the same voxels, to a millionth of one; the offset from the world's origin
    may be large."""
    return np.allclose(a[:3, :3], b[:3, :3], rtol=0, atol=1e-9 * float(np.abs(b[:3, :3]).max())) and np.allclose(
        np.linalg.inv(b) @ a[:, 3], [0, 0, 0, 1], rtol=0, atol=1e-6
    )


def _sampled(grid: Grid, transform: np.ndarray, box: Bounds, channels: int) -> tuple[np.ndarray, int]:
    """The grid at the voxel centres of ``box`` under ``transform``, and how many of its own voxels were not finite."""
    if grid.channels != channels:
        raise DataError(f"grid {grid.name!r} has {grid.channels} channels; expected {channels}")
    limit = DENSE_LIMIT // 4  # the medium has four numbers per voxel
    if _aligned(grid.transform, transform):
        return _repaired(grid.to_dense(box, limit * channels))
    if grid.bounds is None:
        return np.zeros((*(h - l for l, h in zip(*box, strict=True)), *((3,) * (channels == 3))), np.float32), 0
    low, high = (tuple(v + pad for v in corner) for corner, pad in zip(grid.bounds, (-1, 1), strict=True))
    own, bad = _repaired(grid.to_dense(((low[0], low[1], low[2]), (high[0], high[1], high[2])), limit * channels))
    matrix = np.linalg.inv(grid.transform) @ transform
    offset = matrix[:3, :3] @ np.array(box[0], np.float64) + matrix[:3, 3] - np.array(low)
    shape = tuple(h - l for l, h in zip(*box, strict=True))
    planes = [own] if channels == 1 else [own[..., c] for c in range(channels)]
    found = [ndimage.affine_transform(p, matrix[:3, :3], offset, shape, order=1, mode="grid-constant") for p in planes]
    return (found[0] if channels == 1 else np.stack(found, -1)), bad


def _repaired(dense: np.ndarray) -> tuple[np.ndarray, int]:
    wrong = ~np.isfinite(dense)
    bad = int(np.count_nonzero(wrong.any(-1) if dense.ndim == 4 else wrong))
    if bad:
        dense[wrong] = 0.0
    return dense, bad


def _scalars(grid: Grid, transform: np.ndarray, box: Bounds) -> tuple[np.ndarray, int]:
    found, bad = _sampled(grid, transform, box, 1)
    return np.maximum(found, 0.0), bad


def _albedo(
    grids: Mapping[str, Grid], look: Look, transform: np.ndarray, box: Bounds, scene_from_index: np.ndarray
) -> tuple[np.ndarray, int]:
    """An array that broadcasts to (X, Y, Z, 3)."""
    albedo = np.array(look.albedo, np.float32)
    if look.color_grid is not None and look.color_grid in grids:
        color, bad = _sampled(grids[look.color_grid], transform, box, 3)
        return albedo * np.clip(color, 0.0, 1.0), bad
    if look.gradient is None:
        return albedo, 0
    axis = "xyz".index(look.up)
    sizes = [h - l for l, h in zip(*box, strict=True)]
    indices = np.meshgrid(*(np.arange(n) for n in sizes), indexing="ij", sparse=True)
    height = sum(scene_from_index[axis, a] * indices[a] for a in range(3)) + scene_from_index[axis, 3] + 0.5
    stops = np.linspace(0.0, 1.0, len(look.gradient))
    return albedo * np.stack([np.interp(height, stops, [s[c] for s in look.gradient]) for c in range(3)], -1).astype(
        np.float32
    ), 0


def _glow(flame: np.ndarray, look: Look) -> np.ndarray:
    """(X, Y, Z, 3) float32 emission · B(K(flame))."""
    low, high = look.flame_range
    table = black_body_rgb(np.linspace(*look.kelvin, _STEPS), look.kelvin[1]) * look.emission
    where = np.clip((flame - low) / (high - low), 0.0, 1.0) * (_STEPS - 1)
    return np.stack([np.interp(where, np.arange(_STEPS), table[:, c]) for c in range(3)], -1).astype(np.float32)
