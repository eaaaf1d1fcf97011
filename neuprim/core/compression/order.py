"""Places along a Z curve (Morton 1966), on which neighbours in space are mostly neighbours in the file."""

from __future__ import annotations

import numpy as np

__all__ = ["morton", "unmorton"]


def morton(cells: np.ndarray, bits: int) -> np.ndarray:
    """(N,) uint64 whose bit 3 b + axis is bit b of ``cells`` (N, 3); ``bits`` of each count, at most 21."""
    wide = cells.astype(np.uint64)
    keys = np.zeros(len(wide), np.uint64)
    for bit in range(bits):
        for axis in range(3):
            keys |= ((wide[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return keys


def unmorton(keys: np.ndarray, bits: int) -> np.ndarray:
    """(N, 3) int64, the inverse of :func:`morton`."""
    cells = np.zeros((len(keys), 3), np.uint64)
    for bit in range(bits):
        for axis in range(3):
            cells[:, axis] |= ((keys >> np.uint64(3 * bit + axis)) & np.uint64(1)) << np.uint64(bit)
    return cells.astype(np.int64)
