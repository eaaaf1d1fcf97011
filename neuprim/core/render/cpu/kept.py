"""What a forward pass keeps for its backward pass: the optical depth of every lane that it evaluated, 4 bytes each.

With them the backward pass composites before it has evaluated a single neuron. Its lanes have to be the forward pass's
own, which depend on the rows that were alive: 2 bytes per pair say which, and 4 where the pair's lanes begin among
those of its chunk of tiles.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from neuprim.core.compute.kernels import inline
from neuprim.core.render.cpu import layout as L

__all__ = ["Kept", "alive", "most_lanes", "room"]


@dataclass
class Kept:
    """Of one frame.

    Attributes:
        live: (pairs,) bit y is set where row y of the tile was alive when the pair was drawn; no pairs where nothing is
        kept. found: (pairs,) first lane of each pair in the depths of its chunk.
        depths: per chunk of tiles (lanes,) optical depth of each evaluated lane.
    """

    live: NDArray[np.uint16]
    found: NDArray[np.int32]
    depths: list[NDArray[np.float32]] = field(default_factory=list)

    @classmethod
    def of(cls, pairs: int) -> Kept:
        """Room for this many pairs; 0: nothing will be kept."""
        return cls(np.empty(pairs, np.uint16), np.empty(pairs, np.int32))


@inline
def alive(rows_live):  # type: ignore[no-untyped-def]
    """The rows that are alive as bits."""
    bits = np.int64(0)
    for y in range(L.TILE):
        bits |= np.int64(rows_live[y] > np.float32(0)) << y
    return np.uint16(bits)


@inline
def room(floats):  # type: ignore[no-untyped-def]
    """Floats that begin a cache line; as :func:`~neuprim.core.render.cpu.tiles.aligned`, but not zero: memory is taken
    where it is written."""
    block = np.empty(floats + 16, np.float32)
    shift = -(np.int64(block.ctypes.data) // 4) % 16
    return block[shift : shift + floats]


@inline
def most_lanes(start, stop, across, boxes, starts, ids):  # type: ignore[no-untyped-def]
    """Lanes that the pairs of tiles ``start:stop`` have at most: pixels of their boxes, in whole vectors."""
    lanes = 0
    for t in range(start, stop):
        tx, ty = (t % across) * L.TILE, (t // across) * L.TILE
        for q in range(starts[t], starts[t + 1]):
            box = boxes[ids[q]]
            wide = min(box[2] - tx, L.TILE) - max(box[0] - tx, 0)
            high = min(box[3] - ty, L.TILE) - max(box[1] - ty, 0)
            lanes += (max(wide, 0) * max(high, 0) + 15) // 16 * 16
    return lanes
