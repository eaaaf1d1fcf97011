"""Depth images out of a light, read at points."""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import exact_kernel


@exact_kernel
def arriving_light(start, stop, points, view, near, focal, alphas, depths, bias, softness, found):  # type: ignore[no-untyped-def]
    """Visibility of points start:stop, see :mod:`neuprim.tasks.relight.visibility`.

    Args:
        points: (M, 3) float64. view: (3, 4) world to light camera, whose principal point is the middle of the images.
        alphas, depths: (slabs, S, S) float32 opacity and mean depth.
        bias, softness: scene units. found: (M,) float32, filled.
    """
    size = alphas.shape[1]
    for p in range(start, stop):
        x = view[0, 0] * points[p, 0] + view[0, 1] * points[p, 1] + view[0, 2] * points[p, 2] + view[0, 3]
        y = view[1, 0] * points[p, 0] + view[1, 1] * points[p, 1] + view[1, 2] * points[p, 2] + view[1, 3]
        z = view[2, 0] * points[p, 0] + view[2, 1] * points[p, 1] + view[2, 2] * points[p, 2] + view[2, 3]
        found[p] = 1.0
        if not z > near:  # behind the light's camera
            continue
        u, v = (
            focal * x / z + 0.5 * size - 0.5,
            focal * y / z + 0.5 * size - 0.5,
        )  # in pixels, 0 the middle of the first
        if not (-1.0 < u < size and -1.0 < v < size):
            continue
        i, j = int(np.floor(v)), int(np.floor(u))
        down, right = v - i, u - j
        arrives = 1.0
        for k in range(alphas.shape[0]):
            alpha, nearness = 0.0, 0.0
            for di in range(2):
                for dj in range(2):
                    if 0 <= i + di < size and 0 <= j + dj < size and alphas[k, i + di, j + dj] > 0.0:
                        own = np.float64(alphas[k, i + di, j + dj])
                        weight = (down if di else 1.0 - down) * (right if dj else 1.0 - right) * own
                        alpha += weight
                        nearness += weight / max(np.float64(depths[k, i + di, j + dj]), near)
            behind = z - alpha / max(nearness, 1e-30)
            s = min(max(0.5 + 0.5 * (behind - bias) / softness, 0.0), 1.0)
            arrives *= 1.0 - alpha * s * s * (3.0 - 2.0 * s)
        found[p] = arrives
