"""The model's extinction on a regular grid: sigma(x) = sum over primitives of max(0, f(x~)) / m, inside their ellipsoids.

A primitive's f may be negative in places, where it is clamped at 0; a renderer clamps the integral along a ray instead.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import ConfigError
from neuprim.core.fields import Conditions, Cosine
from neuprim.core.primitives import Primitives
from neuprim.core.render.cpu.compile import exact_kernel
from neuprim.core.render.cpu.threads import parallel_for

__all__ = ["RESOLUTION", "agreement", "density_grid", "lattice"]

RESOLUTION = 96
"""Points along the longest side of the box that a model's extinction is compared on."""

_SLAB = 4  # planes per unit of work; fixed, and the result does not depend on it


def density_grid(
    model: Primitives, conditions: Conditions, scene_from_index: Tensor, shape: tuple[int, int, int], threads: int = 0
) -> Tensor:
    """(X, Y, Z) float32 extinction, 1/scene unit, at the points ``scene_from_index @ (i, j, k, 1)``.

    Args:
        conditions: of the frame, e.g. ``{"time": tensor(0.5)}``.
        scene_from_index: (4, 4) float64 affine map.
        threads: 0 for all cores; the result does not depend on it.

    Raises:
        ConfigError: the density is not a cosine network.
    """
    with torch.no_grad():
        geometry, form = model.lower_density(conditions)
        if not isinstance(form, Cosine):
            raise ConfigError(f"a {type(form).__name__} density cannot be put on a grid; expected Cosine")
        wide = [x.detach().double().numpy() for x in (geometry.means, geometry.scales, geometry.rotations, form.W1, form.b1, form.w2)]
        offset = form.b2.detach().double().reshape(-1).numpy()
    forward = scene_from_index.detach().double().numpy()
    back = np.linalg.inv(forward)
    grid = np.zeros(shape, np.float32)
    arguments = [np.ascontiguousarray(x) for x in (*wide, offset, forward[:3], back[:3])]
    parallel_for(_fill, shape[0], _SLAB, threads, *arguments, form.omega0, grid)
    return torch.from_numpy(grid)


def lattice(bounds: np.ndarray, resolution: int = RESOLUTION) -> tuple[Tensor, tuple[int, int, int]]:
    """(4, 4) scene_from_index and shape of a regular grid of cell centres that fills a (2, 3) box."""
    low, high = np.asarray(bounds, np.float64)
    step = float((high - low).max()) / resolution
    x, y, z = (max(1, round(float(side) / step)) for side in high - low)
    matrix = torch.eye(4, dtype=torch.float64) * step
    matrix[3, 3] = 1.0
    matrix[:3, 3] = torch.from_numpy(low + step / 2)
    return matrix, (x, y, z)


def agreement(truth: np.ndarray, found: np.ndarray) -> tuple[float, float] | None:
    """Pearson correlation and relative L2 error of ``found`` against ``truth``, of one shape; None where the truth is all the same."""
    truth, found = truth.astype(np.float64), found.astype(np.float64)
    if truth.std() == 0:
        return None
    correlation = float(np.corrcoef(truth.ravel(), found.ravel())[0, 1]) if found.std() > 0 else 0.0
    return correlation, float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


@exact_kernel
def _fill(
    start: int, stop: int, means: Any, scales: Any, R: Any, W1: Any, b1: Any, w2: Any, b2: Any, P: Any, Q: Any, omega0: float, grid: Any
) -> None:
    """Planes start:stop. P (3, 4) maps indices to the scene, Q (3, 4) back."""
    K = W1.shape[1]
    x, y, low, high = np.empty(3), np.empty(3), np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(means.shape[0]):
        for a in range(3):  # the ellipsoid's box in indices
            center, reach = Q[a, 3], 0.0
            for j in range(3):
                center += Q[a, j] * means[n, j]
                side = (Q[a, 0] * R[n, 0, j] + Q[a, 1] * R[n, 1, j] + Q[a, 2] * R[n, 2, j]) * scales[n, j]
                reach += side * side
            reach = np.sqrt(reach)
            low[a] = max(int(np.ceil(max(center - reach, -1e9))), 0)
            high[a] = min(int(np.floor(min(center + reach, 1e9))) + 1, grid.shape[a])
        low[0], high[0] = max(low[0], start), min(high[0], stop)
        m = max(scales[n, 0], scales[n, 1], scales[n, 2])
        for i in range(low[0], high[0]):
            for j in range(low[1], high[1]):
                for k in range(low[2], high[2]):
                    radius = 0.0
                    for a in range(3):
                        x[a] = P[a, 0] * i + P[a, 1] * j + P[a, 2] * k + P[a, 3] - means[n, a]
                    for a in range(3):
                        y[a] = (R[n, 0, a] * x[0] + R[n, 1, a] * x[1] + R[n, 2, a] * x[2]) / scales[n, a]
                        radius += y[a] * y[a]
                    if radius >= 1.0:
                        continue
                    f = b2[n]
                    for q in range(K):
                        f += w2[n, q] * np.cos(omega0 * ((W1[n, q, 0] * x[0] + W1[n, q, 1] * x[1] + W1[n, q, 2] * x[2]) / m + b1[n, q]))
                    if f > 0.0:
                        grid[i, j, k] += np.float32(f / m)
