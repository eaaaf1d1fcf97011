"""A voxel medium: extinction and source radiance, and the layout of its voxels in memory.

A medium is stored as one block with all voxels of its box. If the box is large and almost empty, the medium is stored
as bricks instead, and empty bricks take no memory, as in .vdb files. A cell is the cube between eight voxel centres. A
brick has 8 x 8 x 8 cells, so 9 x 9 x 9 voxels: neighbouring bricks share their outer voxels, so that all voxels of a
cell are in one brick.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from neuprim.core.compute.kernels import inline, kernel
from neuprim.core.compute.threads import parallel_for
from neuprim.core.errors import DataError
from neuprim.core.io.vdb import DENSE_LIMIT, VdbGrid

_NEGLIGIBLE = 1e-7  # optical depth across a cell, and share of the strongest source, below which a voxel is empty


@dataclass(frozen=True, eq=False)
class Medium:
    """Extinction and source of a medium at voxel centres, trilinear in between. A medium may have no voxels.

    The radiance along a ray is L = ∫ T(s) σ(s) c(s) ds with T(s) = exp(-∫₀ˢ σ), and alpha = 1 - T at the ray's end.
    Voxels are stored in the B blocks of ``bricks``, most often in one block for the whole box. σ = σ_s + σ_f: σ_s comes
    from the extinction grid and σ_f from the flames, see :class:`~neuprim.tasks.dynamic.volume.optics.Optics`.

    Attributes:
        values: (B, x, y, z, 4) float32, C-contiguous: σ in 1/scene unit, and σ times the source radiance in linear RGB.
            The outermost voxels of the box are zero, so that the field is continuous; :meth:`padded` adds such voxels.
        scene_from_index: (4, 4) float64, affine and invertible; maps (i, j, k, 1) to the centre of voxel (i, j, k).
        bricks: layout of the voxels.
        scattering: (B, x, y, z) float32, σ_s; None unless the extinction grid and the flames both absorb.
        scattered: (B, x, y, z, 3) float32, σ_s times the albedo, while a light must still be added; else None.
    """

    values: np.ndarray
    scene_from_index: np.ndarray
    bricks: Bricks
    scattering: np.ndarray | None = None
    scattered: np.ndarray | None = None

    @staticmethod
    def dense(values: np.ndarray, scene_from_index: np.ndarray) -> Medium:
        """Return the medium of (X, Y, Z, 4) ``values``, whose outermost voxels are zero."""
        x, y, z = values.shape[:3]
        return Medium(values[None], scene_from_index, Bricks.whole((x, y, z)))

    @staticmethod
    def without_voxels() -> Medium:
        return Medium.dense(np.zeros((0, 0, 0, 4), np.float32), np.eye(4))

    def padded(self) -> Medium:
        """Return this medium; a dense one is surrounded by a layer of empty voxels, which bricks already have.

        Raises:
            DataError: a value is not finite.
        """
        self.require_finite()
        if not self.bricks.dense:
            return self
        shift = np.eye(4)
        shift[:3, 3] = -1.0
        x, y, z = (n + 2 for n in self.bricks.shape)
        parts = (None if part is None else pad_voxels(part, self.bricks) for part in (self.scattering, self.scattered))
        values = pad_voxels(self.values, self.bricks)
        return Medium(values, self.scene_from_index @ shift, Bricks.whole((x, y, z)), *parts)

    def require_finite(self) -> Medium:
        """Return this medium; raise DataError if a value is not finite."""
        ends = self.values.min(initial=0.0), self.values.max(initial=0.0)  # NaN if a value is, and without a copy
        if not np.isfinite(ends).all():
            raise DataError("medium: some voxels are NaN or infinite; expected finite values (check scene.optics)")
        return self

    @property
    def empty(self) -> bool:
        """Whether the medium has no cell: fewer than two voxels along some axis, or no brick."""
        return min(self.bricks.shape) < 2 or not len(self.values)

    def voxels(self, chosen: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """Return the centres of chosen voxels, and their places in arrays of voxels; see :meth:`Bricks.select`."""
        places = self.bricks.select(chosen)
        return self.centers(places), places

    def centers(self, places: tuple[np.ndarray, ...]) -> np.ndarray:
        """Return the (M, 3) float64 centres of voxels, scene units; ``places`` come from :meth:`Bricks.select`."""
        return self.bricks.index(places) @ self.scene_from_index[:3, :3].T + self.scene_from_index[:3, 3]

    @cached_property
    def index_from_scene(self) -> np.ndarray:
        """(4, 4) float64 inverse of ``scene_from_index``."""
        return np.linalg.inv(self.scene_from_index)

    @cached_property
    def skips(self) -> np.ndarray:
        """(B, x-1, y-1, z-1) uint8 distance of each cell to the nearest non-empty cell.

        A ray in a cell with distance d crosses the cube around the cell, 2d - 1 cells wide, in one step. Distances are
        chessboard distances, at most 255 in a dense medium and at most 1 in bricks.
        """
        if self.empty:
            return np.zeros((0, 0, 0, 0), np.uint8)
        diagonal = float(np.abs(self.scene_from_index[:3, :3]).sum())
        source = np.abs(self.values[..., 1])
        for channel in (2, 3):
            np.maximum(source, np.abs(self.values[..., channel]), out=source)
        filled = (self.values[..., 0] * diagonal > _NEGLIGIBLE) | (source > _NEGLIGIBLE * float(source.max()))
        for axis in (1, 2, 3):  # a cell holds something if one of its eight corners does
            filled = np.delete(filled, -1, axis) | np.delete(filled, 0, axis)
        if not self.bricks.dense:
            return (~filled).astype(np.uint8)
        if not filled.any():
            return np.full(filled.shape, 255, np.uint8)
        return np.minimum(ndimage.distance_transform_cdt(~filled[0], "chessboard"), 255).astype(np.uint8)[None]


def pad_voxels(values: np.ndarray, bricks: Bricks) -> np.ndarray:
    """Return ``values`` (B, x, y, z, ...), surrounded by one layer of zeros if the layout is dense."""
    around = [(0, 0), (1, 1), (1, 1), (1, 1), *[(0, 0)] * (values.ndim - 4)]
    return np.pad(values, around) if bricks.dense else values


# ---------------------------------------------------------------- layout

EDGE = 8
"""Cells of a brick along each axis; a leaf of a .vdb file has as many voxels."""

_SHIFT, _WHOLE = 3, 31  # binary logarithms of the edges of a brick, and of the block of a dense layout
_MOST_BRICKS = 2**25  # of a box, empty ones included: 128 MB
_POINTS_PER_JOB = 1 << 14


@dataclass(frozen=True, eq=False)
class Bricks:
    """Layout of a box of voxels, which is stored as B blocks. Arrays of voxels have the shape (B, x, y, z, ...).

    Attributes:
        shape: voxels of the box along each axis.
        table: int32, one entry per brick of the box: the number of the brick's block, or -d for an empty brick. Every
            cell within a chessboard distance below d of any cell of the empty brick is empty, too.
        dense: whether one block has all voxels of the box.
    """

    shape: tuple[int, int, int]
    table: np.ndarray
    dense: bool = False

    @staticmethod
    def whole(shape: tuple[int, int, int]) -> Bricks:
        """Return the dense layout: one block with all voxels of the box."""
        return Bricks(shape, np.zeros((1, 1, 1), np.int32), dense=True)

    @staticmethod
    def at(used: np.ndarray) -> Bricks:
        """Return the layout with the bricks that ``used`` names, a bool array with an entry per brick of the box."""
        table = np.zeros(used.shape, np.int32)
        if used.any():
            distance = ndimage.distance_transform_cdt(~used, "chessboard")
            table = np.where(used, 0, -((distance - 1) * EDGE + 1)).astype(np.int32)
        else:
            table[:] = -max(used.shape) * EDGE
        table[used] = np.arange(np.count_nonzero(used))
        x, y, z = (n * EDGE + 1 for n in used.shape)
        return Bricks((x, y, z), table)

    @property
    def block(self) -> tuple[int, int, int]:
        """Voxels (x, y, z) of a block."""
        return self.shape if self.dense else (EDGE + 1,) * 3

    @property
    def shift(self) -> int:
        """Binary logarithm of the number of cells from one entry of the table to the next."""
        return _WHOLE if self.dense else _SHIFT

    @property
    def cells(self) -> np.ndarray:
        """(3,) int64: cells of the box along each axis."""
        return np.array(self.shape, np.int64) - 1

    @cached_property
    def origins(self) -> np.ndarray:
        """(B, 3) int64: indices of the first voxel of each block."""
        return np.argwhere(self.table >= 0) * (0 if self.dense else EDGE)

    def select(self, chosen: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the places of voxels in arrays (B, x, y, z, ...), each voxel only once although bricks share voxels.

        ``chosen`` is a bool array (B, x, y, z), False for the outermost voxels of the box.
        """
        return np.nonzero(self.without_shared(chosen))

    def without_shared(self, values: np.ndarray) -> np.ndarray:
        """Return a view of ``values`` (B, x, y, z, ...) without the voxels that also belong to the next brick."""
        return values if self.dense else values[:, :EDGE, :EDGE, :EDGE]

    def copy_shared(self, values: np.ndarray) -> None:
        """Fill the last voxels of each brick, in place, from the next bricks, which share these voxels.

        Where the next brick is empty, the voxels become 0.
        """
        if self.dense:
            return
        table, places = np.pad(self.table, (0, 1), constant_values=-1), self.origins // EDGE
        for step in np.ndindex(2, 2, 2):
            if any(step):
                numbers = table[tuple((places + step).T)]
                x, y, z = (slice(EDGE, None) if s else slice(EDGE) for s in step)
                a, b, c = (slice(1) if s else slice(EDGE) for s in step)
                used = np.flatnonzero(numbers >= 0)
                values[:, x, y, z] = 0
                values[used, x, y, z] = values[numbers[used], a, b, c]

    def index(self, places: tuple[np.ndarray, ...]) -> np.ndarray:
        """Return the (M, 3) int64 indices of voxels in the box, from their places in arrays of voxels."""
        return self.origins[places[0]] + np.stack(places[1:], -1)

    def sample(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return (M,) float32: ``values`` (B, x, y, z) trilinearly at (M, 3) float64 indices; 0 outside the box."""
        found = np.zeros(len(points), np.float32)
        if min(self.shape) > 1 and len(values):
            arrays = (values, self.table, self.shift, self.cells, np.ascontiguousarray(points, np.float64), found)
            parallel_for(_sample_points, len(points), _POINTS_PER_JOB, 0, *arrays)
        return found


def bricks_with_voxels(boxes: list[np.ndarray], shape: np.ndarray) -> np.ndarray:
    """Return a bool array with an entry per brick of a volume: whether the brick's cells touch a voxel in ``boxes``.

    ``shape`` is the number of voxels of the volume along each axis. Each array in ``boxes`` is (M, 2, 3): the first
    voxel of each box, and one more than the last voxel.

    Raises:
        DataError: the volume has too many bricks, even if all are empty.
    """
    counts = -(-shape // EDGE)
    if math.prod(counts.tolist()) > _MOST_BRICKS:
        found = f"the box has {' x '.join(map(str, shape.tolist()))} voxels"
        raise DataError(f"{found}; expected at most {_MOST_BRICKS} bricks of {EDGE} x {EDGE} x {EDGE} voxels")
    used = np.zeros(counts, bool)
    for box in boxes:
        low = np.clip((box[:, 0] - 1) // EDGE, 0, counts)
        high = np.clip((box[:, 1] - 1) // EDGE + 1, 0, counts)
        for (a, b, c), (d, e, f) in zip(low.tolist(), high.tolist(), strict=True):
            used[a:d, b:e, c:f] = True
    return used


def grid_boxes(grid: VdbGrid) -> np.ndarray:
    """Return (M, 2, 3) int64 boxes, in voxel indices: one around the non-zero values of each leaf or tile of a grid."""
    filled = np.asarray(grid.values != 0)
    filled = filled if grid.channels == 1 else np.asarray(filled.any(-1))
    used = np.asarray(filled.any((1, 2, 3)))
    axes = [np.asarray(filled[used].any(other)) for other in ((2, 3), (1, 3), (1, 2))]
    first = np.stack([axis.argmax(1) for axis in axes], 1)
    last = EDGE - np.stack([axis[:, ::-1].argmax(1) for axis in axes], 1)
    leaves = grid.origins[used].astype(np.int64)
    tiles = grid.tiles.values.reshape(-1, grid.channels).any(1)
    origins, sizes = grid.tiles.origins[tiles].astype(np.int64), grid.tiles.sizes[tiles, None]
    low, high = np.concatenate([leaves + first, origins]), np.concatenate([leaves + last, origins + sizes])
    return np.stack([low, high], 1)


def read_bricks(grid: VdbGrid, first: np.ndarray, layout: Bricks) -> np.ndarray:
    """Return (B, 9, 9, 9) float32, or (B, 9, 9, 9, 3): the values of a grid in the bricks of a layout.

    ``first`` is the index, in the grid, of the layout's first voxel, a multiple of 8 along each axis. Raises DataError
    if the result would be larger than :data:`~neuprim.core.io.vdb.DENSE_LIMIT`.
    """
    leaves = np.full(layout.table.shape, -1, np.int32)  # number of the leaf of the grid, or -1
    where = (grid.origins.astype(np.int64) - first) // EDGE
    inside = ((where >= 0) & (where < leaves.shape)).all(1)
    leaves[tuple(where[inside].T)] = np.flatnonzero(inside)
    numbers = leaves[layout.table >= 0]
    size = len(numbers) * math.prod(layout.block) * 4 * grid.channels
    if size > DENSE_LIMIT:
        problem = f"{len(numbers)} blocks of voxels that are not empty, which take {size} bytes"
        raise DataError(f"grid {grid.name!r} has {problem}; at most {DENSE_LIMIT} are allowed")
    used = np.flatnonzero(numbers >= 0)
    found = np.zeros((len(numbers), *layout.block, *grid.values.shape[4:]), np.float32)
    layout.without_shared(found)[used] = grid.values[numbers[used]]
    tiles = grid.tiles
    for origin, size, value in zip(tiles.origins.astype(np.int64), tiles.sizes.tolist(), tiles.values, strict=True):
        low, high = (origin - first - 1) // EDGE, (origin - first + size - 1) // EDGE + 1
        x, y, z = (slice(a, b) for a, b in zip(low.clip(0).tolist(), high.clip(0).tolist(), strict=True))
        near = layout.table[x, y, z]
        for brick in near[near >= 0].tolist():
            x, y, z = (slice(max(a, 0), max(a + size, 0)) for a in (origin - first - layout.origins[brick]).tolist())
            found[brick, x, y, z] = value
    layout.copy_shared(found)
    return found


@inline
def find_brick(table, shift, i, j, k):  # type: ignore[no-untyped-def]
    """Return the entry of :attr:`Bricks.table` for cell (i, j, k)."""
    return table[np.uint64(i >> shift), np.uint64(j >> shift), np.uint64(k >> shift)]


@inline
def trilinear_sample(v, i, j, k, x, y, z):  # type: ignore[no-untyped-def]
    """Interpolate a block ``v`` trilinearly in its cell (i, j, k), at the fractions x, y, z (0..1) of the cell."""
    a = v[i, j, k] + z * (v[i, j, k + 1] - v[i, j, k])
    b = v[i, j + 1, k] + z * (v[i, j + 1, k + 1] - v[i, j + 1, k])
    c = v[i + 1, j, k] + z * (v[i + 1, j, k + 1] - v[i + 1, j, k])
    d = v[i + 1, j + 1, k] + z * (v[i + 1, j + 1, k + 1] - v[i + 1, j + 1, k])
    a += y * (b - a)
    c += y * (d - c)
    return a + x * (c - a)


@kernel
def _sample_points(start, stop, values, table, shift, cells, points, found):  # type: ignore[no-untyped-def]
    """Write the trilinear values at ``points[start:stop]`` to ``found``; see :meth:`Bricks.sample`."""
    mask = (1 << shift) - 1
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        if not (0 <= x <= cells[0] and 0 <= y <= cells[1] and 0 <= z <= cells[2]):
            continue
        i, j, k = min(int(x), cells[0] - 1), min(int(y), cells[1] - 1), min(int(z), cells[2] - 1)
        brick = find_brick(table, shift, i, j, k)
        if brick < 0:
            continue
        x, y, z = x - i, y - j, z - k
        found[n] = trilinear_sample(values[brick], i & mask, j & mask, k & mask, x, y, z)
