# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Extinction on a regular grid on a GPU: the twin of the kernel in :mod:`neuprim.core.volumes.density_grid`.

A block adds up a tile of the grid, a thread a point, primitive by primitive in their order, float64 inside and float32
sums, as the CPU does it. No bit depends on the order of blocks, nor on how much of the grid or how many primitives are
taken at a time. Warp is imported with this module.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.warp import OPTIONS, array, launch_kernel, wp

d, f = wp.float64, wp.float32

_TILE = (4, 8, 8)
_THREADS = 256  # points of a tile

_POINTS = 1 << 26  # most points on the GPU at a time, 256 MiB
_PAIRS = 1 << 22  # most pairs of tiles and primitives that are listed at a time, but for those of one primitive


@functools.cache
def _density_grid_kernel() -> Any:
    across, deep = _TILE[1], _TILE[2]

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def add_primitives(
        starts: wp.array(dtype=wp.int32), ids: wp.array(dtype=wp.int32), tiles: wp.vec2i, first: int,
        P: wp.array(dtype=wp.vec4d),
        means: wp.array(dtype=wp.vec3d), whiten: wp.array(dtype=wp.mat33d), rate: wp.array2d(dtype=wp.vec3d),
        phase: wp.array2d(dtype=wp.float64), amplitude: wp.array2d(dtype=wp.float64),
        offset: wp.array(dtype=wp.float64), edge: int,
        grid: wp.array3d(dtype=wp.float32),
    ):  # fmt: skip
        """``tiles``: how many there are across and deep; ``first``: index of the grid's first plane; P: rows of (3, 4),
        indices to the scene."""
        tile, lane = wp.tid()
        begin, end = starts[tile], starts[tile + 1]
        i = tile // (tiles[0] * tiles[1]) * wp.static(_TILE[0]) + lane // wp.static(across * deep)
        j = tile // tiles[1] % tiles[0] * wp.static(across) + lane // wp.static(deep) % wp.static(across)
        k = tile % tiles[1] * wp.static(deep) + lane % wp.static(deep)
        if begin < end and i < grid.shape[0] and j < grid.shape[1] and k < grid.shape[2]:
            at = wp.vec4d(d(first + i), d(j), d(k), d(1.0))
            x = wp.vec3d(wp.dot(P[0], at), wp.dot(P[1], at), wp.dot(P[2], at))
            total = float(grid[i, j, k])
            for s in range(begin, end):
                n = ids[s]
                o = x - means[n]
                y = whiten[n] * o
                inner = d(1.0) - wp.dot(y, y)
                if inner > d(0.0):
                    value = d(offset[n])
                    for q in range(phase.shape[1]):
                        value += amplitude[n, q] * wp.cos(phase[n, q] + wp.dot(rate[n, q], o))
                    if edge > 0:
                        value *= inner
                    if edge > 1:
                        value *= inner
                    if value > d(0.0):
                        total += f(value)
            grid[i, j, k] = total

    return add_primitives


def _density_grid_tile_boxes(
    means: Tensor, scales: Tensor, rotations: Tensor, Q: Tensor, shape: tuple[int, ...]
) -> tuple[Tensor, Tensor]:
    """Tiles that the ellipsoids' boxes touch: (N, 3) int64 first ones, and ones behind the last, 0 without a point."""
    center = means @ Q[:, :3].T + Q[:, 3]
    reach = ((Q[:, :3] @ rotations) * scales[:, None, :]).norm(dim=2)
    limit, tile = (torch.tensor(x, device=means.device) for x in (shape, _TILE))
    low = (center - reach).nan_to_num(nan=1e9).clamp(-1e9, 1e9).ceil().long().clamp_min(0)
    high = ((center + reach).nan_to_num(nan=-1e9).clamp(-1e9, 1e9).floor().long() + 1).minimum(limit)
    last = (high - 1).div(tile, rounding_mode="floor") + 1
    return low.div(tile, rounding_mode="floor"), torch.where((low < high).all(1, keepdim=True), last, 0)


def _list_grid_tile_primitives(
    low: Tensor, wide: Tensor, counts: Tensor, tiles: tuple[int, ...], begin: int, end: int
) -> tuple[Tensor, Tensor]:
    """``starts`` (tiles + 1,) and ``ids``, int32: of every tile the primitives begin:end that reach it, in order."""
    own = counts[begin:end]
    prim = torch.repeat_interleave(torch.arange(begin, end, device=low.device), own)
    number = torch.arange(len(prim), device=low.device) - (own.cumsum(0) - own)[prim - begin]
    z, rest = number % wide[prim, 2], number.div(wide[prim, 2], rounding_mode="floor")
    y, x = rest % wide[prim, 1], rest.div(wide[prim, 1], rounding_mode="floor")
    tile = ((low[prim, 0] + x) * tiles[1] + low[prim, 1] + y) * tiles[2] + low[prim, 2] + z
    tile, order = torch.sort(tile, stable=True)
    starts = torch.searchsorted(tile, torch.arange(int(np.prod(tiles)) + 1, device=low.device))
    return starts.int(), prim[order].int()


def _density_grid_ranges(counts: Tensor) -> Iterator[tuple[int, int]]:
    """Ranges of primitives that reach at most ``_PAIRS`` tiles together, in order; those that reach none left out."""
    ends = np.cumsum(counts.cpu().numpy())
    begin = 0
    while begin < len(ends):
        before = int(ends[begin - 1]) if begin else 0
        end = max(begin + 1, int(np.searchsorted(ends, before + _PAIRS, side="right")))
        if int(ends[end - 1]) > before:
            yield begin, end
        begin = end


def fill_density_grid(
    ellipsoids: tuple[Tensor, Tensor, Tensor], neurons: tuple[Tensor, Tensor, Tensor, Tensor], omega0: float, edge: int,
    P: Tensor, Q: Tensor,
    shape: tuple[int, int, int], where: torch.device,
) -> np.ndarray:  # fmt: skip
    """(X, Y, Z) float32 extinction, computed on ``where``.

    Args:
        ellipsoids: means (N, 3), scales (N, 3) and rotations (N, 3, 3), float64, on the CPU.
        neurons: W1 (N, K, 3), b1 (N, K), w2 (N, K) and b2 (N,), the same.
        P: (3, 4) float64, indices to the scene. Q: (3, 4), back.
    """
    W1, b1, w2, b2 = (device.copy_to_device(x, where) for x in neurons)
    means, scales, rotations = (device.copy_to_device(x, where) for x in ellipsoids)
    m = scales.amax(1)
    whiten = (rotations / scales[:, None, :]).transpose(1, 2).contiguous()
    prims = (
        array(means.contiguous(), wp.vec3d), array(whiten.view(-1, 9), wp.mat33d),
        array((omega0 * W1 / m[:, None, None]).contiguous(), wp.vec3d), array((omega0 * b1).contiguous(), d),
        array((w2 / m[:, None]).contiguous(), d), array((b2 / m).contiguous(), d),
    )  # fmt: skip
    rows = array(device.copy_to_device(P.contiguous(), where), wp.vec4d)
    first_tile, end_tile = _density_grid_tile_boxes(
        means, scales, rotations, device.copy_to_device(Q.contiguous(), where), shape
    )
    tiles = tuple(-(-n // t) for n, t in zip(shape, _TILE, strict=True))
    planes = max(1, _POINTS // (_TILE[0] * shape[1] * shape[2]))
    grid = np.empty(shape, np.float32)
    for plane in range(0, tiles[0], planes):
        end = min(plane + planes, tiles[0])
        low, high = first_tile.clone(), end_tile.clone()  # counted from this plane of tiles
        low[:, 0], high[:, 0] = low[:, 0].clamp_min(plane) - plane, high[:, 0].clamp_max(end) - plane
        wide = (high - low).clamp_min(0)
        counts = wide.prod(1)
        first, last = plane * _TILE[0], min(end * _TILE[0], shape[0])
        part = torch.zeros((last - first, *shape[1:]), dtype=torch.float32, device=where)
        for some in _density_grid_ranges(counts):
            own = (end - plane, *tiles[1:])
            starts, ids = _list_grid_tile_primitives(low, wide, counts, own, *some)
            lists = array(starts, wp.int32), array(ids, wp.int32)
            launch_kernel(
                _density_grid_kernel(), (len(starts) - 1, _THREADS),
                (*lists, wp.vec2i(own[1], own[2]), first, rows, *prims, edge, array(part, f)), where,
                _THREADS,
            )  # fmt: skip
        grid[first:last] = part.cpu().numpy()
    return grid
