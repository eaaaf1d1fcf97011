"""Square pinhole images of the solids, a band of rows at a time, and the averaging of their rays into pixels."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

__all__ = ["bands", "pixel_means"]

RAYS_AT_ONCE = 1 << 15
"""Small enough for the arrays to stay in the processor's cache."""


def bands(pose: NDArray[np.float64], field_of_view: float, size: int, samples: int) -> Iterator[NDArray[np.float64]]:
    """(N, 3) unit directions in the scene, whole rows of pixels at a time from the top, row by row of rays.

    Args:
        pose: (4, 4) camera to world, OpenGL axes.
        field_of_view: radians, along both axes.
        size: width and height in pixels.
        samples: rays per pixel along each axis, through the middles of its cells.
    """
    fine = size * samples
    plane = ((np.arange(fine) + 0.5) / fine * 2 - 1) * math.tan(field_of_view / 2)  # at distance 1
    rows = max(1, RAYS_AT_ONCE // (fine * samples)) * samples
    for top in range(0, fine, rows):
        x, y = np.meshgrid(plane, -plane[top : top + rows])
        local = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3)
        local /= np.sqrt(np.einsum("nc,nc->n", local, local))[:, None]
        yield local @ pose[:3, :3].T


def pixel_means(values: NDArray[np.float32], size: int, samples: int) -> NDArray[np.float32]:
    """(rows, size, C) means over the rays of each pixel, of the (N, C) values of one of :func:`bands`."""
    channels = values.shape[1]
    rows = len(values) // (size * samples * samples)
    across = values.reshape(rows, samples, size, samples * channels).mean(axis=1)
    return across.reshape(rows, size, samples, channels).mean(axis=2)
