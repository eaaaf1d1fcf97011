"""Build a frame's medium (extinction and radiance per voxel) from OpenVDB grids; add the light that it scatters."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.errors import DataError, nearest
from neuprim.core.io.vdb import DENSE_LIMIT, Bounds, VdbGrid
from neuprim.tasks.dynamic.scattering import octaves_of_light, phase_factor, scattered_light
from neuprim.tasks.dynamic.volume.medium import (
    EDGE,
    Bricks,
    Medium,
    bricks_with_voxels,
    grid_boxes,
    pad_voxels,
    read_bricks,
)
from neuprim.tasks.dynamic.volume.optics import Light, Optics, black_body_rgb
from neuprim.tasks.dynamic.volume.raymarch import light_transmittance, point_transmittance, render_medium

_DENSE_VOXELS = 2**25  # of a box that is always stored densely; 512 MB
_VOXEL_BYTES = 16  # four numbers
_BLACK_BODY_STEPS = 1024  # entries of the table of black bodies; linear between them


def build_medium(grids: Mapping[str, VdbGrid], optics: Optics, scene_from_world: np.ndarray) -> Medium:
    """Build the medium of one frame on the voxels of its extinction grid, without the light ``optics.light``.

    Other grids are sampled at the centres of these voxels: directly if the other grid has the same transform, else
    trilinearly. If flames absorb, the voxels are extended to contain all flames. An empty frame gives an empty medium.

    Args:
        grids: meaning -> grid; grids that the optics do not use are ignored.
        scene_from_world: (4, 4) float64.

    Raises:
        DataError: no extinction grid exists, a grid has a wrong number of channels, the box is too large, or an
            extinction overflows.
    """
    flames = grids.get(optics.flame_grid) if optics.uses_flames else None
    base = next((grids[name] for name in optics.extinction_grids if name in grids), None)
    if base is None and flames is not None and optics.flame_extinction > 0.0:  # flames absorb by themselves
        base = VdbGrid.from_dense(
            optics.extinction_grids[0], np.zeros((0, 0, 0), np.float32), transform=flames.transform
        )
    if base is None:
        wanted = " or ".join(repr(n) for n in optics.extinction_grids)
        raise DataError(f"no grid {wanted}, needed for the extinction{nearest(optics.extinction_grids[0], grids)}")
    box = base.bounds
    if flames is not None and optics.flame_extinction > 0.0:
        box = _unite_medium_boxes(box, _transform_medium_bounds(flames, base.transform))
    if box is None:
        return Medium.without_voxels()
    absorbing = [base] if flames is None or optics.flame_extinction == 0.0 else [base, flames]
    voxels = _MediumGrid.of(absorbing, base.transform, box)
    sigma_s = voxels.sample(base) * np.float32(optics.extinction)
    flame = None if flames is None else voxels.sample(flames)
    sigma = sigma_s if flame is None else sigma_s + flame * np.float32(optics.flame_extinction)
    values = np.zeros((*sigma.shape, 4), np.float32)
    values[..., 0] = sigma
    scene_from_index = scene_from_world @ base.transform
    scene_from_index[:3, 3] += scene_from_index[:3, :3] @ voxels.first
    scattered = sigma_s[..., None] * _scattering_albedo(grids, optics, voxels, scene_from_index)
    for c, ambient in enumerate(optics.ambient):
        values[..., 1 + c] = scattered[..., c] * np.float32(ambient)
    mixed = sigma_s if optics.mixes(grids) else None
    glow = None
    if flame is not None and optics.emission > 0.0:
        glow = sigma[..., None] * _flame_radiance(flame, optics)
        values[..., 1:] += glow
    lit_by_fire = glow is not None and optics.fire_lights > 0
    kept = scattered if optics.light is not None or lit_by_fire else None
    medium = Medium(values, scene_from_index, voxels.bricks, mixed, kept).padded()
    if glow is None or not lit_by_fire:
        return medium
    medium = light_by_fire(medium, pad_voxels(glow, voxels.bricks), optics)
    return medium if optics.light is not None else replace(medium, scattered=None)


def _transform_medium_bounds(grid: VdbGrid, transform: np.ndarray) -> Bounds | None:
    """Return the box of active voxels of ``grid`` in voxels of another grid; None if there are no active voxels.

    ``transform`` is the index-to-world matrix of the other grid. The result contains the voxels of the other grid whose
    centres are inside the active box.
    """
    if grid.bounds is None or _same_voxels(grid.transform, transform):
        return grid.bounds
    ends = np.array(grid.bounds, np.float64) - 0.5  # faces of the outermost voxels, not centres
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), -1).reshape(-1, 3)
    chain = np.linalg.inv(transform) @ grid.transform
    index = corners @ chain[:3, :3].T + chain[:3, 3]
    return _make_medium_bounds(np.ceil(index.min(0) - 1e-6), np.floor(index.max(0) + 1e-6) + 1)


def _unite_medium_boxes(a: Bounds | None, b: Bounds | None) -> Bounds | None:
    if a is None or b is None:
        return b if a is None else a
    return _make_medium_bounds(np.minimum(a[0], b[0]), np.maximum(a[1], b[1]))


def _make_medium_bounds(low: np.ndarray, high: np.ndarray) -> Bounds:
    (a, b, c), (d, e, f) = low.astype(int).tolist(), high.astype(int).tolist()
    return (a, b, c), (d, e, f)


def _same_voxels(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two index-to-world matrices define the same voxels, to a millionth of a voxel."""
    scale = float(np.abs(b[:3, :3]).max())
    shift = np.linalg.inv(b) @ a[:, 3]  # not a difference, as the world's origin may be far away
    same_axes = np.allclose(a[:3, :3], b[:3, :3], rtol=0, atol=1e-9 * scale)
    return same_axes and np.allclose(shift, [0, 0, 0, 1], rtol=0, atol=1e-6)


@dataclass(frozen=True, eq=False)
class _MediumGrid:
    """The voxels of a medium without padding: the extinction grid's voxels in a box, stored densely or in bricks.

    Attributes:
        transform: (4, 4) matrix from indices of the extinction grid to the world.
        box: first voxel of the box, and one more than the last; outside the box, all values are 0.
        first: (3,) int64 index, in the extinction grid, of the first voxel of ``bricks``.
    """

    transform: np.ndarray
    box: Bounds
    first: np.ndarray
    bricks: Bricks

    @staticmethod
    def of(absorbing: Sequence[VdbGrid], transform: np.ndarray, box: Bounds) -> _MediumGrid:
        """Return the voxels of a box: in bricks if the box is large and the absorbing grids almost empty, else densely.

        Raises:
            DataError: the bricks take more memory than :data:`DENSE_LIMIT`, or are too many.
        """
        low, high = np.array(box, np.int64)
        x, y, z = (high - low).tolist()
        dense = _MediumGrid(transform, box, low, Bricks.whole((x, y, z)))
        if x * y * z <= _DENSE_VOXELS or any(grid.background.any() for grid in absorbing):
            return dense
        sparse = _MediumGrid.in_bricks(absorbing, transform, box)
        bricks = sparse.bricks
        size = len(bricks.origins) * math.prod(bricks.block) * _VOXEL_BYTES
        if size > x * y * z * _VOXEL_BYTES:
            return dense
        if size > DENSE_LIMIT:
            found = f"{len(bricks.origins)} blocks of voxels that are not empty, which take {size} bytes"
            raise DataError(f"grid {absorbing[0].name!r} has {found}; at most {DENSE_LIMIT} are allowed")
        return sparse

    @staticmethod
    def in_bricks(grids: Sequence[VdbGrid], transform: np.ndarray, box: Bounds) -> _MediumGrid:
        """Return bricks that contain all values of the grids in a box."""
        low, high = np.array(box, np.int64)
        first = (low - 1) // EDGE * EDGE
        boxes = [_transform_boxes(grid_boxes(grid), grid.transform, transform) - first for grid in grids]
        return _MediumGrid(transform, box, first, Bricks.at(bricks_with_voxels(boxes, high - first)))

    def axes(self) -> list[np.ndarray]:
        """Return the indices of all voxels relative to ``first``, one array per axis, broadcastable to (B, x, y, z)."""
        result = []
        for a, n in enumerate(self.bricks.block):
            along = np.arange(n).reshape([-1 if a == b else 1 for b in range(3)])
            result.append(self.bricks.origins[:, a].reshape(-1, 1, 1, 1) + along)
        return result

    def sample(self, grid: VdbGrid, channels: int = 1) -> np.ndarray:
        """Sample a grid at the voxels' centres, trilinearly unless the grid has the same voxels.

        The result is (B, x, y, z) float32, or (B, x, y, z, 3) for three channels. Values that are not finite and
        negative scalars become 0.
        """
        if grid.channels != channels:
            raise DataError(f"grid {grid.name!r} has {grid.channels} channels; expected {channels}")
        if self.bricks.dense:
            values = self._sample_densely(grid)[None]
        else:
            values = self._sample_bricks(grid)
            for a, index in enumerate(self.axes()):
                outside = (index + self.first[a] < self.box[0][a]) | (index + self.first[a] >= self.box[1][a])
                values[np.broadcast_to(outside, values.shape[:4])] = 0.0
        return np.maximum(values, 0.0) if channels == 1 else values

    def _sample_densely(self, grid: VdbGrid) -> np.ndarray:
        limit = DENSE_LIMIT // 4 * grid.channels  # the medium has four numbers per voxel
        shape = self.bricks.shape
        if _same_voxels(grid.transform, self.transform):
            return grid.to_dense(self.box, limit, 0.0)
        level = _finite_background(grid)
        if grid.bounds is None:
            return np.full((*shape, 3)[: 2 + min(grid.channels, 2)], level, np.float32)
        around = _make_medium_bounds(np.array(grid.bounds[0]) - 1, np.array(grid.bounds[1]) + 1)
        own = grid.to_dense(around, limit, 0.0)
        matrix = np.linalg.inv(grid.transform) @ self.transform
        offset = matrix[:3, :3] @ np.array(self.box[0], np.float64) + matrix[:3, 3] - np.array(around[0])
        planes = [own] if grid.channels == 1 else list(np.moveaxis(own, -1, 0))
        sampled = [
            ndimage.affine_transform(plane, matrix[:3, :3], offset, shape, order=1, mode="grid-constant", cval=outside)
            for plane, outside in zip(planes, np.atleast_1d(level), strict=True)
        ]
        return sampled[0] if grid.channels == 1 else np.stack(sampled, -1)

    def _sample_bricks(self, grid: VdbGrid) -> np.ndarray:
        own, (grid, level) = self, _subtract_background(grid)
        found = np.zeros((len(self.bricks.origins), *self.bricks.block, *grid.values.shape[4:]), np.float32)
        if not _same_voxels(grid.transform, self.transform):
            if grid.bounds is None:
                found += level
                return found
            own = _MediumGrid.in_bricks([grid], grid.transform, grid.bounds)
        values = read_bricks(grid, own.first, own.bricks)
        values[~np.isfinite(values)] = 0.0
        if own is self:
            values += level
            return values
        matrix = np.linalg.inv(grid.transform) @ self.transform
        inside = np.indices(self.bricks.block).reshape(3, -1).T @ matrix[:3, :3].T
        origins = (self.bricks.origins + self.first) @ matrix[:3, :3].T + matrix[:3, 3] - own.first
        for brick, origin in enumerate(origins):
            for c in np.ndindex(values.shape[4:]):
                sampled = own.bricks.sample(values[(..., *c)], inside + origin)
                found[(brick, ..., *c)] = sampled.reshape(self.bricks.block)
        found += level
        return found


def _finite_background(grid: VdbGrid) -> np.ndarray:
    """Return the background of a grid, () or (3,) float32, with 0 for numbers that are not finite."""
    return np.where(np.isfinite(grid.background), grid.background, np.float32(0.0))


def _subtract_background(grid: VdbGrid) -> tuple[VdbGrid, np.ndarray]:
    """Return a grid minus its background, so that it is 0 where nothing is stored, and the background, () or (3,)."""
    level = _finite_background(grid)
    if not level.any():
        return grid, level
    tiles = replace(grid.tiles, values=grid.tiles.values - level)
    return replace(grid, values=grid.values - level, tiles=tiles, background=np.zeros_like(level)), level


def vdb_grid_sampler(grid: VdbGrid) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function (points (M, 3), world coordinates) -> (M, C) float32 values of a grid.

    Values are trilinear between voxels. They are the background where no voxel is stored or a value is not finite. In a
    staggered grid, component a of a voxel is the value half a voxel before the voxel's centre along axis a.
    """
    grid, level = _subtract_background(grid)
    level = np.broadcast_to(level, grid.channels)
    if grid.bounds is None:
        return lambda points: np.tile(level, (len(points), 1))
    try:
        own = _MediumGrid.in_bricks([grid], grid.transform, grid.bounds)
    except DataError as error:
        raise DataError(f"grid {grid.name!r}: {error}") from None
    values = read_bricks(grid, own.first, own.bricks)
    values = values.reshape(*values.shape[:4], grid.channels)
    values[~np.isfinite(values)] = 0.0
    back, channels = np.linalg.inv(grid.transform), range(grid.channels)
    shifts = 0.5 * np.eye(3) if grid.kind == "staggered" else np.zeros((grid.channels, 3))
    parts = [np.ascontiguousarray(values[..., c]) for c in channels]

    def sample(points: np.ndarray) -> np.ndarray:
        index = points @ back[:3, :3].T + back[:3, 3] - own.first
        return np.stack([own.bricks.sample(parts[c], index + shifts[c]) for c in channels], -1) + level

    return sample


def _transform_boxes(boxes: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Convert boxes (M, 2, 3) of :func:`grid_boxes` to voxels of another grid, with a margin of one voxel.

    ``source`` and ``target`` are the index-to-world matrices of the two grids. Boxes do not change if both grids have
    the same voxels.
    """
    if _same_voxels(source, target):
        return boxes
    chain = np.linalg.inv(target) @ source
    ends = np.stack([boxes[:, 0] - 1, boxes[:, 1]], 1).astype(np.float64)
    corners = np.stack([ends[:, [a, b, c], [0, 1, 2]] for a, b, c in np.ndindex(2, 2, 2)], 1)
    index = corners @ chain[:3, :3].T + chain[:3, 3]
    return np.stack([np.floor(index.min(1)), np.ceil(index.max(1)) + 1], 1).astype(np.int64)


def _scattering_albedo(
    grids: Mapping[str, VdbGrid], optics: Optics, voxels: _MediumGrid, scene_from_index: np.ndarray
) -> np.ndarray:
    """Return the albedo, times the colour grid or else the colour gradient; broadcastable to (B, x, y, z, 3).

    ``scene_from_index`` (4, 4) maps voxel indices to the scene; index 0 is the first of ``voxels``.
    """
    albedo = np.array(optics.albedo, np.float32)
    if optics.color_grid is not None and optics.color_grid in grids:
        return albedo * np.clip(voxels.sample(grids[optics.color_grid], 3), 0.0, 1.0)
    if optics.gradient is None:
        return albedo
    axis = "xyz".index(optics.up)
    height = (
        sum(scene_from_index[axis, a] * index for a, index in enumerate(voxels.axes()))
        + scene_from_index[axis, 3]
        + 0.5
    )
    stops = np.linspace(0.0, 1.0, len(optics.gradient))
    colours = [np.interp(height, stops, [stop[c] for stop in optics.gradient]) for c in range(3)]
    return albedo * np.stack(colours, -1).astype(np.float32)


def _flame_radiance(flame: np.ndarray, optics: Optics) -> np.ndarray:
    """Return the (B, x, y, z, 3) float32 black-body radiance of flames: emission · B(K(flame)), see :class:`Optics`."""
    low, high = optics.flame_range
    table = black_body_rgb(np.linspace(*optics.kelvin, _BLACK_BODY_STEPS), optics.kelvin[1]) * optics.emission
    where = np.clip((flame - low) / (high - low), 0.0, 1.0) * (_BLACK_BODY_STEPS - 1)
    entries = np.arange(_BLACK_BODY_STEPS)
    return np.stack([np.interp(where, entries, table[:, c]) for c in range(3)], -1).astype(np.float32)


# ---------------------------------------------------------------- light

_FAINT = 1e-3  # glow of a voxel as a fraction of the brightest; fainter voxels light nothing

_LOWEST = math.radians(10.0)  # lowest elevation of random lights


def draw_lights(optics: Optics, count: int, *key: int) -> list[Light | None]:
    """Draw ``count`` random directional lights with the irradiance of ``optics.light``; ``key`` is the seed.

    Directions are uniform over the sky above an elevation of 10 degrees. Without ``optics.light``, all lights are None.
    """
    own = optics.light
    if own is None:
        return [None] * count
    lights: list[Light | None] = []
    for across, up in np.random.default_rng([20261126, *key]).random((count, 2)).tolist():
        height = math.sin(_LOWEST) + (1 - math.sin(_LOWEST)) * up
        around = math.sqrt(1 - height * height)
        x, y = around * math.cos(2 * math.pi * across), around * math.sin(2 * math.pi * across)
        lights.append(Light((x, y, height) if optics.up == "z" else (y, height, x), own.irradiance))
    return lights


def light_medium(medium: Medium, light: Light | None, optics: Optics, reuse: bool = False) -> Medium:
    """Return the medium with scattered light of ``light``, with shadows, added to its radiance.

    The added radiance is the mean over all view directions, so ``optics.anisotropy`` has no effect. With ``reuse``, the
    result overwrites the values of ``medium``, which saves memory.
    """
    if light is None or medium.empty or medium.scattered is None:
        return medium
    found = scattered_light(light_transmittance(medium, light.direction), optics.octaves, optics.octave_share)
    return _add_scattered(medium, found, light, medium.values if reuse else medium.values.copy())


def _add_scattered(medium: Medium, scattered: np.ndarray, light: Light, values: np.ndarray) -> Medium:
    """Add the light that ``medium`` scatters to ``values``, in place; return the medium with these values.

    ``scattered`` (B, x, y, z) is the sum of the octaves, or one octave, of :mod:`neuprim.tasks.dynamic.scattering`.
    """
    assert medium.scattered is not None
    arriving = np.array(light.irradiance, np.float32) / np.float32(4.0 * math.pi)
    for c in range(3):
        values[..., 1 + c] += medium.scattered[..., c] * (scattered * arriving[c])
    return replace(medium, values=values, scattered=None).require_finite()


@dataclass(frozen=True, eq=False)
class LitMedium:
    """A medium under a light, ready to be rendered from many cameras.

    Attributes:
        medium: the medium with all radiance that does not depend on the view direction.
        beams: pairs (medium, anisotropy), one per octave of anisotropic scattering; empty if scattering is isotropic.
            The radiance of such a medium is the octave's light, averaged over all view directions.
        direction: towards the light, on the scene's axes, of any length.
    """

    medium: Medium
    beams: tuple[tuple[Medium, float], ...] = ()
    direction: tuple[float, ...] = (0.0, 0.0, 1.0)

    @staticmethod
    def of(medium: Medium, light: Light | None, optics: Optics) -> LitMedium:
        """Light a medium; raise DataError if a radiance overflows."""
        if not optics.anisotropy or light is None or medium.empty or medium.scattered is None:
            return LitMedium(light_medium(medium, light, optics))
        dark = medium.values * np.array([1, 0, 0, 0], np.float32)
        found = octaves_of_light(light_transmittance(medium, light.direction), optics.octaves, optics.octave_share)
        beams = ((_add_scattered(medium, t, light, dark.copy()), optics.anisotropy / 2**o) for o, t in enumerate(found))
        return LitMedium(medium, tuple(beams), light.direction)

    @property
    def mean(self) -> Medium:
        """The medium whose radiance is the mean over all view directions."""
        if not self.beams:
            return self.medium
        values = self.medium.values.copy()
        for beam, _ in self.beams:
            values[..., 1:] += beam.values[..., 1:]
        return replace(self.medium, values=values)

    def render(self, camera: Camera, samples: int) -> Tensor:
        """Render to (H, W, 4), see :func:`~neuprim.tasks.dynamic.volume.raymarch.render_medium`.

        The angle between view and light is constant along a ray, as the light is at infinity. The angle at the pixel's
        centre is used.
        """
        image = render_medium(self.medium, camera, samples)
        if self.beams:
            towards = camera.viewmat[:3, :3].double().numpy() @ np.array(self.direction, np.float64)
            x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
            y = (np.arange(camera.height)[:, None] + 0.5 - camera.cy) / camera.fy
            length = np.linalg.norm(towards) * np.sqrt(x * x + y * y + 1)
            cosine = torch.from_numpy((x * towards[0] + y * towards[1] + towards[2]) / length)
            for medium, anisotropy in self.beams:
                factor = phase_factor(cosine, anisotropy).to(image)
                image[..., :3] += render_medium(medium, camera, samples)[..., :3] * factor[..., None]
        return image


def light_by_fire(medium: Medium, glow: np.ndarray, optics: Optics) -> Medium:
    """Return the medium with the light of its flames, scattered by its smoke, added to its radiance.

    The glowing voxels are divided into at most ``optics.fire_lights`` clusters, each of which lights the smoke as one
    point light at its centre: σ_s albedo S(T) I/(4π (r² + ρ²)). σ_s is the smoke's part of the extinction. I is the sum
    of ``glow`` over the cluster times the volume of a voxel. T is the transmittance to the centre, and S is
    :func:`~neuprim.tasks.dynamic.scattering.scattered_light`. r is the distance to the centre. ρ is the root mean
    square distance of the cluster's voxels from the centre, plus half the edge of a voxel.

    Args:
        medium: a medium with ``scattered``.
        glow: (B, x, y, z, 3) σ times the emitted radiance.
    """
    assert medium.scattered is not None
    points, glowing = medium.voxels(glow.max(-1) > _FAINT * glow.max(initial=0.0))
    if not len(points):
        return medium
    volume = abs(np.linalg.det(medium.scene_from_index[:3, :3]))
    light = glow[glowing].astype(np.float64) * volume
    lit = np.nonzero(medium.scattered.max(-1) > 0)
    places = medium.centers(lit)
    arriving = np.zeros((len(places), 3))
    for cluster in split_lights(points, light.sum(1), optics.fire_lights):
        weights = light[cluster].sum(1) / light[cluster].sum()
        center = weights @ points[cluster]
        radius = math.sqrt(weights @ np.square(points[cluster] - center).sum(1)) + 0.5 * volume ** (1 / 3)
        found = scattered_light(point_transmittance(medium, center.tolist())[lit], optics.octaves, optics.octave_share)
        arriving += (found / (np.square(places - center).sum(1) + radius**2))[:, None] * light[cluster].sum(0)
    values = medium.values.copy()
    values[..., 1:][lit] += medium.scattered[lit] * (arriving / (4 * math.pi)).astype(np.float32)
    return replace(medium, values=values).require_finite()


def split_lights(points: np.ndarray, weights: np.ndarray, most: int) -> list[np.ndarray]:
    """Divide ``points`` (M, 3) with positive ``weights`` (M,) into at most ``most`` clusters.

    Return the indices of the points of each cluster. In each step, the cluster with the largest weighted variance is
    split at its mean, along its axis of largest variance.
    """
    clusters = [np.arange(len(points))]
    while len(clusters) < most:
        variances = []
        for rows in clusters:
            share = weights[rows, None]
            variances.append((share * np.square(points[rows] - (share * points[rows]).sum(0) / share.sum())).sum(0))
        widest = int(np.argmax([variance.sum() for variance in variances]))
        rows, axis = clusters[widest], int(np.argmax(variances[widest]))
        along = points[rows, axis]
        low = along < np.average(along, weights=weights[rows])
        if not low.any() or low.all():
            break
        clusters[widest : widest + 1] = [rows[low], rows[~low]]
    return clusters
