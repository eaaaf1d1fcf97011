"""A sparse volume in memory: blocks of 8 x 8 x 8 voxels, larger constant tiles, and the transform to world space."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from neuprim.core.errors import DataError

TILE_SIZES = (8, 128, 4096)  # edges of a constant tile in voxels: in a lower node, in an upper node, in the root

DENSE_LIMIT = 2 * 2**30
"""Most bytes of an array that :meth:`VdbGrid.to_dense` returns by default: 2 GiB."""

Bounds = tuple[tuple[int, int, int], tuple[int, int, int]]
"""A box of voxels: the lowest index and one more than the highest index, per axis."""


@dataclass(frozen=True, eq=False)
class VdbTiles:
    """T constant tiles of a sparse volume: cubes in which all voxels have the same value."""

    origins: np.ndarray  # (T, 3) int32, the lowest voxel index of each tile
    sizes: np.ndarray  # (T,) int32, edge lengths in voxels, all in TILE_SIZES
    values: np.ndarray  # (T,) or (T, 3) float32
    active: np.ndarray  # (T,) bool

    @staticmethod
    def none(channels: int = 1) -> VdbTiles:
        """Return an empty set of tiles."""
        shape = (0,) if channels == 1 else (0, channels)
        return VdbTiles(
            np.zeros((0, 3), np.int32), np.zeros(0, np.int32), np.zeros(shape, np.float32), np.zeros(0, bool)
        )

    def __len__(self) -> int:
        return len(self.sizes)


def vdb_scale_transform(
    voxel_size: float | Sequence[float] = 1.0, translation: Sequence[float] = (0.0, 0.0, 0.0)
) -> np.ndarray:
    """Return a (4, 4) index-to-world transform that puts the centre of voxel (0, 0, 0) at ``translation``.

    Args:
        voxel_size: edge length of a voxel in world units, one number or one per axis.
    """
    matrix = np.eye(4)
    matrix[range(3), range(3)] = voxel_size
    matrix[:3, 3] = translation
    return matrix


@dataclass(frozen=True, eq=False)
class VdbGrid:
    """A sparse grid of numbers (float) or vectors (vec3s): leaves of 8 x 8 x 8 voxels, and constant tiles.

    A voxel with index (i, j, k) has its *centre* at ``transform @ (i, j, k, 1)``. Voxels outside leaves and tiles have
    the background value and are not active. NaN and infinite values are allowed; :attr:`non_finite` counts them.
    """

    name: str
    transform: np.ndarray  # (4, 4) float64, index to world, acting on column vectors
    background: np.ndarray  # () or (3,) float32
    origins: np.ndarray  # (L, 3) int32, the lowest index of each leaf, multiples of 8, all different
    values: np.ndarray  # (L, 8, 8, 8) or (L, 8, 8, 8, 3) float32, indexed x, y, z
    masks: np.ndarray  # (L, 8, 8, 8) bool, which voxels are active
    tiles: VdbTiles  # constant tiles; no tile overlaps a leaf
    kind: str = "fog volume"  # "fog volume", "staggered", "unknown" or, if level sets are read, "level set"
    half: bool = False  # store as 16-bit floats when written
    metadata: Mapping[str, Any] = field(default_factory=dict)

    @staticmethod
    def from_dense(
        name: str,
        array: np.ndarray,
        *,
        lower: Sequence[int] = (0, 0, 0),
        transform: np.ndarray | None = None,
        background: float = 0.0,
        half: bool = False,
        metadata: Mapping[str, Any] | None = None,
    ) -> VdbGrid:
        """Convert a dense array to a fog volume; voxels that differ from ``background`` become active.

        Raises DataError for a wrong shape or range.

        Args:
            array: (X, Y, Z) or (X, Y, Z, 3) values of any real type; stored as float32.
            lower: index of ``array[0, 0, 0]``.
            transform: (4, 4) index to world, see :func:`vdb_scale_transform`; None for voxels of edge 1.
        """
        array = np.asarray(array, np.float32)
        if array.ndim not in (3, 4) or array.shape[3:] not in ((), (3,)):
            raise DataError(f"grid {name!r}: array of shape {array.shape}; expected (X, Y, Z) or (X, Y, Z, 3)")
        channels = array.shape[3:]
        low = np.array(lower, np.int64)
        if (low < -(2**31) + 8).any() or (low + array.shape[:3] > 2**31 - 8).any():
            raise DataError(f"grid {name!r}: voxel indices start at {low.tolist()}; expected indices that fit 32 bits")
        base = low & ~7
        counts = -(-(low + array.shape[:3] - base) // 8)
        padded = np.full((*(counts * 8), *channels), background, np.float32)
        inside = tuple(slice(a, a + n) for a, n in zip(low - base, array.shape[:3], strict=True))
        padded[inside] = array
        blocks = _vdb_leaf_blocks(padded)
        active = blocks != np.float32(background)
        active = active.any(-1) if channels else active
        kept = np.argwhere(active.any((3, 4, 5)))
        chosen = tuple(kept.T)
        return VdbGrid(
            name,
            np.eye(4) if transform is None else np.array(transform, np.float64),
            np.full(channels, background, np.float32),
            (kept * 8 + base).astype(np.int32),
            blocks[chosen],
            active[chosen],
            VdbTiles.none(3 if channels else 1),
            half=half,
            metadata=dict(metadata or {}),
        )

    def fog(self) -> VdbGrid:
        """Convert a level set to a fog volume: 0 at and outside the surface, 1 at the depth ``background`` and deeper.

        Depths are distances inside the surface, in world units; the value is linear in depth, as OpenVDB's
        ``sdfToFogVolume`` makes it. NaN becomes 0. Raises DataError if the background is not a positive number.
        """
        width = float(self.background) if self.channels == 1 else 0.0
        if not 0 < width < math.inf:
            found = f"a background of {self.background.tolist()}"
            raise DataError(f"level set {self.name!r} has {found}; expected its largest distance, a number above 0")
        values, tile_values = (
            np.nan_to_num(np.clip(distances / np.float32(-width), 0, 1))
            for distances in (self.values, self.tiles.values)
        )
        tiles = replace(self.tiles, values=tile_values, active=tile_values > 0)
        background = np.zeros((), np.float32)
        return replace(self, background=background, values=values, masks=values > 0, tiles=tiles, kind="fog volume")

    @property
    def channels(self) -> int:
        """Number of values per voxel: 1 or 3."""
        return 3 if self.values.ndim == 5 else 1

    @property
    def voxel_size(self) -> tuple[float, float, float]:
        """Edge lengths (x, y, z) of a voxel in world units."""
        x, y, z = np.linalg.norm(self.transform[:3, :3], axis=0).tolist()
        return x, y, z

    @cached_property
    def active_voxels(self) -> int:
        """Number of active voxels, including those of active tiles."""
        return int(np.count_nonzero(self.masks)) + sum(s**3 for s in self.tiles.sizes[self.tiles.active].tolist())

    @cached_property
    def bounds(self) -> Bounds | None:
        """Box around all active voxels, in voxel indices; None if no voxel is active."""
        lows, highs = [], []
        used = np.asarray(self.masks.any((1, 2, 3)))
        if used.any():
            masks, origins = self.masks[used], self.origins[used].astype(np.int64)
            axes = [np.asarray(masks.any(other)) for other in ((2, 3), (1, 3), (1, 2))]
            lows.append((origins + np.stack([a.argmax(1) for a in axes], 1)).min(0))
            highs.append((origins + 8 - np.stack([a[:, ::-1].argmax(1) for a in axes], 1)).max(0))
        if self.tiles.active.any():
            origins = self.tiles.origins[self.tiles.active].astype(np.int64)
            lows.append(origins.min(0))
            highs.append((origins + self.tiles.sizes[self.tiles.active, None]).max(0))
        if not lows:
            return None
        low, high = np.min(lows, 0).tolist(), np.max(highs, 0).tolist()
        return (low[0], low[1], low[2]), (high[0], high[1], high[2])

    def world_bounds(self) -> np.ndarray | None:
        """Return the (2, 3) float64 box of all active voxels with their edges, in world units; None for no voxels."""
        if self.bounds is None:
            return None
        corners = np.stack(np.meshgrid(*np.array(self.bounds, float).T - 0.5, indexing="ij"), -1).reshape(-1, 3)
        world = corners @ self.transform[:3, :3].T + self.transform[:3, 3]
        return np.stack([world.min(0), world.max(0)])

    def active_values(self) -> np.ndarray:
        """Return (M,) or (M, 3) float32: one value per active leaf voxel, then one per active tile."""
        return np.concatenate([self.values[self.masks], self.tiles.values[self.tiles.active]])

    @cached_property
    def range(self) -> tuple[float, float] | None:
        """Smallest and largest finite active value, over all channels; None if there is none."""
        values = self.active_values()
        values = values[np.isfinite(values)]
        return (float(values.min()), float(values.max())) if values.size else None

    @cached_property
    def non_finite(self) -> int:
        """Number of active leaf voxels and active tiles with NaN or infinity."""
        bad = ~np.isfinite(self.active_values())
        return int(np.count_nonzero(bad.any(-1) if self.channels == 3 else bad))

    @property
    def sparse_bytes(self) -> int:
        return self.values.nbytes + self.masks.nbytes + self.origins.nbytes

    @property
    def dense_bytes(self) -> int:
        """Bytes of :meth:`to_dense` for the box of all active voxels."""
        return (
            0
            if self.bounds is None
            else math.prod(h - l for l, h in zip(*self.bounds, strict=True)) * 4 * self.channels
        )

    def to_dense(
        self, bounds: Bounds | None = None, max_bytes: int = DENSE_LIMIT, non_finite: float | None = None
    ) -> np.ndarray:
        """Return all voxels of a box, active or not, as a dense (X, Y, Z) or (X, Y, Z, 3) float32 array.

        Args:
            bounds: the box, in voxel indices; None for :attr:`bounds` (an empty array if no voxel is active).
            max_bytes: memory limit for the box and up to 7 more voxels on each side; DataError beyond.
            non_finite: value that replaces NaN and infinity; None keeps NaN and infinity.
        """
        box = self.bounds if bounds is None else bounds
        channels = (3,) if self.channels == 3 else ()
        if box is None:
            return np.zeros((0, 0, 0, *channels), np.float32)
        low, high = ([int(v) for v in corner] for corner in box)
        if any(h < l for l, h in zip(low, high, strict=True)):
            raise DataError(f"grid {self.name!r}: bounds from {low} to {high}; expected the lower corner first")
        base, top = [v & ~7 for v in low], [-(-v // 8) * 8 for v in high]
        shape = [t - b for t, b in zip(top, base, strict=True)]
        size = shape[0] * shape[1] * shape[2] * 4 * self.channels
        if size > max_bytes:
            found = f"{' x '.join(map(str, shape))} voxels take {size} bytes when dense"
            raise DataError(f"grid {self.name!r}: {found}; at most {max_bytes} are allowed")
        padded = np.empty((*shape, *channels), np.float32)
        padded[...] = self.background
        first, last = np.array(base, np.int64), np.array(top, np.int64)
        self._fill_tiles(padded, first, last)
        inside = ((self.origins >= first) & (self.origins < last)).all(1)
        _vdb_leaf_blocks(padded)[tuple(((self.origins[inside] - first) // 8).T)] = self.values[inside]
        cut = tuple(slice(l - b, h - b) for l, h, b in zip(low, high, base, strict=True))
        dense = np.ascontiguousarray(padded[cut])
        if non_finite is not None:
            dense[~np.isfinite(dense)] = non_finite
        return dense

    def _fill_tiles(self, padded: np.ndarray, first: np.ndarray, last: np.ndarray) -> None:
        tiles = self.tiles
        origins = tiles.origins.astype(np.int64)
        meets = ((origins < last) & (origins + tiles.sizes[:, None] > first)).all(1)
        small = meets & (tiles.sizes == 8)  # often many, and each of them one whole block
        repeated = tiles.values[small].reshape(-1, 1, 1, 1, *tiles.values.shape[1:])
        _vdb_leaf_blocks(padded)[tuple(((origins[small] - first) // 8).T)] = repeated
        for i in np.flatnonzero(meets & ~small):
            begin, stop = np.maximum(origins[i] - first, 0), np.minimum(origins[i] + tiles.sizes[i], last) - first
            padded[begin[0] : stop[0], begin[1] : stop[1], begin[2] : stop[2]] = tiles.values[i]


def _vdb_leaf_blocks(padded: np.ndarray) -> np.ndarray:
    """View an (X, Y, Z, …) array, edges multiples of 8, as blocks of 8 x 8 x 8 voxels: (X/8, Y/8, Z/8, 8, 8, 8, …)."""
    x, y, z = (n // 8 for n in padded.shape[:3])
    split = padded.reshape(x, 8, y, 8, z, 8, *padded.shape[3:])
    return split.transpose(0, 2, 4, 1, 3, 5, *range(6, split.ndim))
