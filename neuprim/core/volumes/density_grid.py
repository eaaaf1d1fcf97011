"""The model's extinction on a regular grid, in 1/scene unit.

The extinction at x is sigma(x) = sum of (1 - |y|^2)^p max(0, f(x~)) / m over the primitives whose ellipsoid contains x.
An ellipsoid has centre mu, longest semi-axis m and edge exponent p (how density fades at the boundary). y is x in
coordinates where the ellipsoid is the unit ball, x~ = (x - mu) / m, and f is the primitive's cosine network. A negative
f is clamped to 0 at every point; a renderer clamps the integral of f along a ray instead.

A neuron's phase is linear in the grid index along each axis. So the neuron's cosine at a grid point is the real part of
a product of three complex numbers, one per axis. A primitive that spans n^3 points therefore needs only 3 n sines and
cosines per neuron, and two multiplications per neuron and point.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.compute.threads import parallel_for
from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import Conditions, Cosine
from neuprim.core.model.primitives import Primitives

__all__ = ["box_lattice", "density_at", "density_grid"]

_PLANES_PER_JOB = 8
_PAIRS = 1 << 17  # pairs (point, primitive) that torch code evaluates at once

POINTS_LIMIT = 2**30
"""Largest number of points of a grid, 4 GiB of float32."""


def box_lattice(bounds: np.ndarray | Tensor, resolution: int) -> tuple[Tensor, tuple[int, int, int]]:
    """Return a regular grid of cell centres that fills the box ``bounds``, (2, 3) lower and upper corner.

    The longest side has ``resolution`` cells. The grid is given by matrix scene_from_index (4, 4) and shape (X, Y, Z).
    """
    low, high = np.asarray(bounds, np.float64)
    step = float((high - low).max()) / resolution
    x, y, z = (max(1, round(float(side) / step)) for side in high - low)
    matrix = torch.diag(torch.tensor([step, step, step, 1.0], dtype=torch.float64))
    matrix[:3, 3] = torch.from_numpy(low + step / 2)
    return matrix, (x, y, z)


def voxels_in_box(bounds: np.ndarray | Tensor, scene_from_index: np.ndarray) -> tuple[Tensor, tuple[int, int, int]]:
    """Return the part of a grid whose voxel centres lie in a box, as a matrix scene_from_index (4, 4) and a shape.

    ``scene_from_index`` is the matrix of the whole grid. ``bounds`` (2, 3) is the box, in scene units. If the grid is
    rotated, the part is the block of voxels that contains the box.
    """
    corners = np.stack(np.meshgrid(*np.asarray(bounds, np.float64).T, indexing="ij"), -1).reshape(-1, 3)
    back = np.linalg.inv(scene_from_index)
    index = corners @ back[:3, :3].T + back[:3, 3]
    low, high = np.ceil(index.min(0) - 1e-6).astype(np.int64), np.floor(index.max(0) + 1e-6).astype(np.int64) + 1
    matrix = np.array(scene_from_index, np.float64)
    matrix[:3, 3] += matrix[:3, :3] @ low
    x, y, z = (int(n) for n in np.maximum(high - low, 1))
    return torch.from_numpy(matrix), (x, y, z)


def density_grid(
    model: Primitives, conditions: Conditions, scene_from_index: Tensor, shape: tuple[int, int, int], threads: int = 0
) -> Tensor:
    """Return (X, Y, Z) float32 extinctions, 1/scene unit, at ``scene_from_index @ (i, j, k, 1)``; on the CPU.

    Compiled code on all cores evaluates a density with the closed form :class:`~neuprim.core.model.fields.Cosine`;
    torch code evaluates any other density in blocks. Both need a few MB of memory in addition to the grid.

    Args:
        conditions: conditions of the frame, e.g. ``{"time": tensor(0.5)}``.
        scene_from_index: (4, 4) float64 affine map, invertible.
        threads: number of threads, 0 for all cores; the result does not depend on it.

    Raises:
        ConfigError: more than :data:`POINTS_LIMIT` points, or a map that is singular or not finite.
    """
    forward = scene_from_index.detach().double().numpy()
    if np.prod(np.array(shape, np.float64)) > POINTS_LIMIT:
        raise ConfigError(f"a grid of {' x '.join(map(str, shape))} points: expected at most {POINTS_LIMIT}")
    if not np.isfinite(forward).all() or abs(np.linalg.det(forward[:3, :3])) == 0:
        raise ConfigError(f"scene_from_index {forward.tolist()}: expected a finite, invertible affine map")
    back = np.linalg.inv(forward)
    model = model.to(device.HOST)
    with torch.no_grad():
        geometry, form = model.lower_density(conditions)
        ellipsoids = (geometry.means.double(), geometry.scales.double(), geometry.rotations.double())
        grid = np.zeros(shape, np.float32)
        if not isinstance(form, Cosine):
            _add_to_density_grid(model, conditions, ellipsoids, forward, back, grid)
            return torch.from_numpy(grid)
        neurons = (form.W1.double(), form.b1.double(), form.w2.double(), form.b2.reshape(-1).double())
        tensors = [x.detach().numpy() for x in (*ellipsoids, *neurons)]
    arguments = [np.ascontiguousarray(x) for x in (*tensors, forward[:3], back[:3])]
    parallel_for(_fill_density_planes, shape[0], _PLANES_PER_JOB, threads, *arguments, form.omega0, form.edge, grid)
    return torch.from_numpy(grid)


def density_at(model: Primitives, conditions: Conditions, points: Tensor) -> Tensor:
    """Return the model's (M,) float64 extinctions, 1/scene unit, at (M, 3) points.

    The function is slow, because it tests every point against every primitive.
    """
    with torch.no_grad():
        active = model.to(device.HOST).active(conditions, torch.float64)
        geometry = active.geometry
        total = torch.zeros(len(points), dtype=torch.float64)
        whiten = geometry.rotations / geometry.scales[:, None, :]
        for part in torch.arange(len(points)).split(max(1, _PAIRS // max(geometry.count, 1))):
            x = points[part].double()
            y = torch.einsum("mna,nab->mnb", x[:, None, :] - geometry.means, whiten)
            row, prim = (y.square().sum(-1) < 1.0).nonzero(as_tuple=True)
            total.index_add_(0, part[row], active.sigma(prim, x[row]).clamp_min(0))
    return total


def _add_to_density_grid(
    model: Primitives, conditions: Conditions, ellipsoids: Any, P: np.ndarray, Q: np.ndarray, grid: np.ndarray
) -> None:
    """Add the extinction of all primitives to ``grid``, by torch code.

    The order of the primitives is fixed, so that the sums are reproducible. ``ellipsoids`` has centres, semi-axes and
    rotations. P (4, 4) maps grid indices to the scene, Q (4, 4) maps the scene to grid indices.
    """
    active = model.active(conditions, torch.float64)
    for n, (mean, scale, R) in enumerate(zip(*(x.detach().numpy() for x in ellipsoids), strict=True)):
        center = Q[:3, :3] @ mean + Q[:3, 3]
        reach = np.linalg.norm((Q[:3, :3] @ R) * scale, axis=1)
        low = np.clip(np.ceil(np.clip(center - reach, -1e9, 1e9)), 0, grid.shape).astype(int)
        high = np.clip(np.floor(np.clip(center + reach, -1e9, 1e9)) + 1, 0, grid.shape).astype(int)
        if (high <= low).any():
            continue
        planes = max(1, _PAIRS // int((high - low)[1:].prod()))
        for start in range(low[0], high[0], planes):
            block = (slice(start, min(start + planes, high[0])), slice(low[1], high[1]), slice(low[2], high[2]))
            index = np.stack(np.meshgrid(*(np.arange(s.start, s.stop) for s in block), indexing="ij"), -1)
            x = index @ P[:3, :3].T + P[:3, 3]
            inside = (np.square(((x - mean) @ R) / scale).sum(-1) < 1.0).nonzero()
            points = torch.from_numpy(x[inside])
            sigma = active.sigma(torch.full((len(points),), n), points).clamp_min(0).numpy()
            grid[block][inside] += sigma.astype(np.float32)


@exact_kernel
def _fill_density_planes(
    start: int, stop: int, means: Any, scales: Any, R: Any, W1: Any, b1: Any, w2: Any, b2: Any, P: Any, Q: Any,
    omega0: float, edge: int,
    grid: Any,
) -> None:  # fmt: skip
    """Add the extinction of all primitives (cosine networks) to planes start:stop of ``grid``.

    P (3, 4) maps grid indices to the scene, Q (3, 4) back. ``edge`` is the exponent p of the fade (1 - |y|^2)^p.
    """
    K = W1.shape[1]
    longest = max(grid.shape[1], grid.shape[2], stop - start)
    low, high, steps, y = np.empty(3, np.int64), np.empty(3, np.int64), np.empty((3, 3)), np.empty(3)
    cosines, sines = np.empty((3, K, longest)), np.empty((3, K, longest))
    row, origin = np.empty(grid.shape[2]), np.empty(3)
    for n in range(means.shape[0]):
        empty = False
        for a in range(3):  # the ellipsoid's box in indices
            center, reach = Q[a, 3], 0.0
            for j in range(3):
                center += Q[a, j] * means[n, j]
                side = (Q[a, 0] * R[n, 0, j] + Q[a, 1] * R[n, 1, j] + Q[a, 2] * R[n, 2, j]) * scales[n, j]
                reach += side * side
            reach = np.sqrt(reach)
            low[a] = max(int(np.ceil(max(center - reach, -1e9))), 0)
            high[a] = min(int(np.floor(min(center + reach, 1e9))) + 1, grid.shape[a])
            if a == 0:
                low[0], high[0] = max(low[0], start), min(high[0], stop)
            empty = empty or low[a] >= high[a]
        if empty:
            continue
        m = max(scales[n, 0], scales[n, 1], scales[n, 2])
        for a in range(3):
            origin[a] = P[a, 0] * low[0] + P[a, 1] * low[1] + P[a, 2] * low[2] + P[a, 3] - means[n, a]
            for j in range(3):  # a step along grid axis a, on the whitened axes j
                steps[a, j] = (R[n, 0, j] * P[0, a] + R[n, 1, j] * P[1, a] + R[n, 2, j] * P[2, a]) / scales[n, j]
        for q in range(K):
            for a in range(3):
                rate = omega0 * (W1[n, q, 0] * P[0, a] + W1[n, q, 1] * P[1, a] + W1[n, q, 2] * P[2, a]) / m
                first = 0.0
                if a == 0:
                    first = omega0 * (
                        (W1[n, q, 0] * origin[0] + W1[n, q, 1] * origin[1] + W1[n, q, 2] * origin[2]) / m + b1[n, q]
                    )
                for i in range(high[a] - low[a]):
                    cosines[a, q, i] = np.cos(first + rate * i)
                    sines[a, q, i] = np.sin(first + rate * i)
        length = high[2] - low[2]
        square = steps[2, 0] ** 2 + steps[2, 1] ** 2 + steps[2, 2] ** 2
        for i in range(high[0] - low[0]):
            for j in range(high[1] - low[1]):
                half, rest = 0.0, -1.0  # |y + k step|^2 = 1 at the ends of the row inside the ellipsoid
                for a in range(3):
                    y[a] = (R[n, 0, a] * origin[0] + R[n, 1, a] * origin[1] + R[n, 2, a] * origin[2]) / scales[n, a]
                    y[a] += steps[0, a] * i + steps[1, a] * j
                    half -= y[a] * steps[2, a]
                    rest += y[a] * y[a]
                inner = half * half - square * rest
                if not inner > 0.0:
                    continue
                root = np.sqrt(inner)
                first_k = max(int(np.ceil(max((half - root) / square, -1.0))), 0)
                last_k = min(int(np.ceil(min((half + root) / square, 1e9))), length)
                if first_k >= last_k:
                    continue
                f = row[: last_k - first_k]  # slices, as the compiler only vectorises these
                f[:] = b2[n]
                for q in range(K):
                    c = cosines[0, q, i] * cosines[1, q, j] - sines[0, q, i] * sines[1, q, j]
                    s = sines[0, q, i] * cosines[1, q, j] + cosines[0, q, i] * sines[1, q, j]
                    c, s = c * w2[n, q], s * w2[n, q]
                    cos_k, sin_k = cosines[2, q, first_k:last_k], sines[2, q, first_k:last_k]
                    for k in range(len(f)):
                        f[k] += c * cos_k[k] - s * sin_k[k]
                if edge > 0:
                    for k in range(len(f)):
                        at = first_k + k
                        fade = max((2.0 * half - square * at) * at - rest, 0.0)  # 1 - |y + k step|^2
                        f[k] *= fade if edge == 1 else fade * fade
                sums = grid[low[0] + i, low[1] + j, low[2] + first_k : low[2] + last_k]
                for k in range(len(f)):
                    if f[k] > 0.0:
                        sums[k] += np.float32(f[k] / m)
