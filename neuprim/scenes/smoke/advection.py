"""Semi-Lagrangian transport: a cell's new value is the old one at the place its gas comes from."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

__all__ = ["Stencil", "advect_field", "stencil"]

Job = TypeVar("Job")

SLAB = 1 << 15
"""Cells worked on at once: their stencils stay in a processor's cache, which is worth a factor of two."""

NOTHING = 1e-4
"""Values that nobody sees; most of a box holds no more, and need not be corrected."""


class Stencil(NamedTuple):
    """Where N points read: rows of a table (X * Y * Z, C) that holds all channels of a cell in one row.

    A point is a weighted sum of eight rows, for which torch has a fast kernel under the name ``embedding_bag``: several
    times faster than ``grid_sample`` in three dimensions, and with the same result for any number of threads, since
    each sum is one thread's.

    Attributes:
        rows: (N, 8) int32, the cells around each point; the first is the lowest corner.
        weights: (N, 8) float32, trilinear.
    """

    rows: Tensor
    weights: Tensor

    def read(self, table: Tensor) -> Tensor:
        """(N, C) interpolated values of a contiguous table (X * Y * Z, C)."""
        return embedding_bag(self.rows, table, per_sample_weights=self.weights, mode="sum")


def stencil(points: list[Tensor], shape: tuple[int, int, int]) -> Stencil:
    """Of points given as three tensors (N,) in cells, the first centre at 0; those outside are moved to the nearest
    centre."""
    lower, parts = [], []
    for along, count in zip(points, shape, strict=True):
        inside = along.clamp(0, count - 1)
        corner = inside.floor().clamp_max_(count - 2)
        parts.append(inside.sub_(corner))
        lower.append(corner)
    _, y_count, z_count = shape
    # Floats hold these integers exactly below 2^24 cells, and are faster.
    base = lower[0].mul_(y_count).add_(lower[1]).mul_(z_count).add_(lower[2]).int()
    x, y, z = parts
    weights = torch.empty(len(x), 8)
    both = x * y
    for pair, edge in enumerate(
        (1 - x - y + both, y - both, x - both, both)
    ):  # (0, 0), (0, 1), (1, 0), (1, 1) along x and y
        upper = torch.mul(edge, z, out=weights[:, 2 * pair + 1])
        torch.sub(edge, upper, out=weights[:, 2 * pair])
    return Stencil(base[:, None] + torch.tensor(_corners(shape), dtype=torch.int32), weights)


def advect_field(fields: Tensor, velocity: Tensor, time: float, cell: float, blurred: int = 0) -> Tensor:
    """(C, X, Y, Z) fields, carried for ``time`` seconds by a velocity (3, X, Y, Z) in world units per second at the
    centres.

    Traces back with the midpoint rule, then corrects the interpolation's blur (MacCormack; Selle, Fedkiw, Kim, Liu and
    Rossignac 2008, "An unconditionally stable MacCormack method"): carry forward, carry back, add half the difference
    to what it started as,

        q1 = A(q),   q2 = A^-1(q1),   q' = q1 + (q - q2) / 2,

    limited to the values of the eight cells that ``q1`` is made of, so that no new extremum can appear.

    Args:
        blurred: the first so many fields are left uncorrected, as are cells with next to nothing in the others.
    """
    shape = (fields.shape[1], fields.shape[2], fields.shape[3])
    table, winds = _table(fields), _table(velocity)
    sharp = table[:, blurred:].contiguous()
    scale, cells = time / cell, _indices(shape)
    carried, behind, place = (
        torch.empty_like(table),
        torch.empty_like(winds),
        torch.empty(len(table), dtype=torch.int32),
    )

    def carry(rows: slice) -> None:
        here = [axis[rows] for axis in cells]
        wind = winds[rows]
        behind[rows] = stencil([p - (0.5 * scale) * wind[:, k] for k, p in enumerate(here)], shape).read(winds)
        back = stencil([p - scale * behind[rows, k] for k, p in enumerate(here)], shape)
        carried[rows] = back.read(table)
        place[rows] = back.rows[:, 0]

    _on_all_cores(carry, [slice(first, min(first + SLAB, len(table))) for first in range(0, len(table), SLAB)])
    blurry = carried[:, blurred:].contiguous()

    def correct(at: Tensor) -> None:
        # The wind half a step ahead is not sampled but extrapolated: as much more than here as the one behind is less.
        step = scale * (2 * winds.index_select(0, at) - behind.index_select(0, at))
        ahead = [axis.index_select(0, at) + step[:, k] for k, axis in enumerate(cells)]
        gone = sharp.index_select(0, at) - stencil(ahead, shape).read(blurry)
        lowest, highest = _corner_range(sharp, place.index_select(0, at), shape)
        better = blurry.index_select(0, at) + 0.5 * gone
        carried[at, blurred:] = torch.minimum(torch.maximum(better, lowest), highest)

    _on_all_cores(correct, (blurry.abs() > NOTHING).any(1).nonzero().squeeze(1).split(SLAB))
    return carried.T.reshape(fields.shape)


def _table(fields: Tensor) -> Tensor:
    return fields.reshape(len(fields), -1).T.contiguous()


def _on_all_cores(work: Callable[[Job], None], jobs: Iterable[Job]) -> None:
    """Calls that write to different places, in threads of our own.

    torch's threads wait for each other in a busy loop after every operation, which on a machine with other things to do
    takes many times longer than the work; these meet once. The jobs are the same for any number of threads, and so is
    the result.
    """
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        list(pool.map(work, jobs))


@lru_cache(maxsize=2)
def _indices(shape: tuple[int, int, int]) -> tuple[Tensor, ...]:
    """Indices along each axis of the cells in a table's rows, three of (X * Y * Z,) float32."""
    axes = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in shape), indexing="ij")
    return tuple(axis.reshape(-1) for axis in axes)


def _corner_range(table: Tensor, lowest_corner: Tensor, shape: tuple[int, int, int]) -> tuple[Tensor, Tensor]:
    """(N, C) least and greatest values of the eight cells that a stencil reads."""
    low = high = table.index_select(0, lowest_corner)
    for offset in _corners(shape)[1:]:
        values = table.index_select(0, lowest_corner + offset)
        low, high = torch.minimum(low, values), torch.maximum(high, values)
    return low, high


def _corners(shape: tuple[int, int, int]) -> list[int]:
    """How many rows of a table the eight cells of a stencil lie after the first."""
    return [(a * shape[1] + b) * shape[2] + c for a in (0, 1) for b in (0, 1) for c in (0, 1)]
