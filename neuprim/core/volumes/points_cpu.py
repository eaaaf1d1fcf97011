"""CPU path of :mod:`neuprim.core.volumes.points`: sort points into cells, and sum cosine densities by kernels."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute.kernels import exact_kernel, inline, kernel
from neuprim.core.compute.threads import parallel_for
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.rows import ellipsoid_rotation_backward, fill_ellipsoid_rotation

_PARTIAL_SUMS = 8  # groups of primitives with separate sums, so that results do not depend on the thread count
_ROWS_PER_JOB, _PREPARED_ROWS_PER_JOB = 64, 1024
_POINTS_PER_CELL = 0.3  # if points filled the grid; usually they fill a small part of it
_MAX_CELLS = 64  # along the longest side
NOT_FINITE = "extinction at points: a product of finite parameters is not finite"


class PointCells(NamedTuple):
    """Points sorted into the cells of a uniform grid.

    Attributes:
        order: (M,) int64 indices of the points before sorting, listed cell by cell.
        points: (M, 3) float64 sorted points, in the sequence of ``order``.
        starts: (X Y Z + 1,) int64 position in ``points`` of each cell's first point.
        low: (3,) float64 lowest corner of the grid.
        step: edge length of a cell.
        counts: (3,) int64 numbers of cells X, Y and Z along the axes.
    """

    order: np.ndarray
    points: np.ndarray
    starts: np.ndarray
    low: np.ndarray
    step: float
    counts: np.ndarray


def sort_points_into_cells(points: np.ndarray) -> PointCells:
    """Sort (M, 3) points into the cells of a grid that is fine enough for few points per cell."""
    if len(points) == 0:
        points, low, step, counts = np.zeros((0, 3)), np.zeros(3), 1.0, np.ones(3, np.int64)
    else:
        low, high = points.min(0), points.max(0)
        across = min(_MAX_CELLS, max(1, round((len(points) / _POINTS_PER_CELL) ** (1 / 3))))
        step = float((high - low).max()) / across or 1.0
        counts = np.floor((high - low) / step).astype(np.int64) + 1
    starts = np.zeros(int(counts.prod()) + 1, np.int64)
    order, placed = np.empty(len(points), np.int64), np.empty((len(points), 3))
    _sort_density_points(points, low, step, counts, starts, order, placed)
    return PointCells(order, placed, starts, low, step, counts)


class CosinePointValues(torch.autograd.Function):
    """Autograd function for sums of cosine densities at M points; the result is (M, 1 + C) float32.

    Column 0 is the extinction, the sum of sigma_i over primitives i. Column 1 + c is the sum of sigma_i times
    weights[i, c]. ``cells`` has the points, and ``edge`` is the exponent p of (1 - |y|^2)^p. The backward pass fills
    ``shares``, a PointShares. The arguments with a gradient are (means, log_scales, quats, W1, b1, w2, b2, weights),
    each with one row per primitive.
    """

    @staticmethod
    def forward(
        ctx: Any, cells: PointCells, omega0: float, edge: int, shares: Any, threads: int, *tensors: Tensor
    ) -> Tensor:  # type: ignore[override]
        params = [np.ascontiguousarray(x.detach().numpy()) for x in tensors]
        if len({x.dtype for x in params}) > 1:  # a mix would compile more kernels
            params = [x.astype(np.float64, copy=False) for x in params]
        count, K, width = len(params[0]), params[3].shape[1], 1 + params[7].shape[1]
        shapes = ((count, 3), (count, 3, 3), (count,), (count, 3))
        centers, whiten, m, reach = axes = tuple(np.empty(shape) for shape in shapes)
        finite = parallel_for(_prepare_point_axes, count, _PREPARED_ROWS_PER_JOB, threads, *params[:3], *axes)
        neuron_shapes = ((count, K, 3), (count, K), (count, K), (count,), (count, width - 1))
        neurons = tuple(np.empty(shape) for shape in neuron_shapes)
        values = (*params[3:], omega0, m, *neurons)
        finite += parallel_for(_prepare_point_neurons, count, _PREPARED_ROWS_PER_JOB, threads, *values)
        if not all(finite):
            raise NonFiniteError(NOT_FINITE)
        chunk = max(1, -(-count // _PARTIAL_SUMS))
        parts = np.zeros((max(1, -(-count // chunk)), len(cells.points), width))
        prims = (centers, whiten, *neurons)
        parallel_for(_add_density_point_values, count, chunk, threads, cells, reach, prims, edge, chunk, parts)
        merged = np.empty((len(cells.points), width), np.float32)
        parallel_for(
            _merge_density_point_sums, len(merged), _PREPARED_ROWS_PER_JOB, threads, parts, cells.order, merged
        )
        ctx.params, ctx.prims, ctx.axes, ctx.cells, ctx.shares = params, prims, (m, reach), cells, shares
        ctx.settings, ctx.dtypes = (omega0, edge, threads), [x.dtype for x in tensors]
        return torch.from_numpy(merged)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        (omega0, edge, threads), cells, shares = ctx.settings, ctx.cells, ctx.shares
        (m, reach), count = ctx.axes, len(ctx.params[0])
        pulled = gradient.numpy()[cells.order].astype(np.float64)
        error = np.zeros(len(pulled)) if shares.error is None else shares.error.double().numpy()[cells.order]
        p_prims = tuple(np.zeros_like(x) for x in ctx.prims)
        sums = np.zeros((count, 2))
        places = (cells, reach, ctx.prims, edge)
        parallel_for(
            _density_point_values_backward, count, _ROWS_PER_JOB, threads, *places, pulled, error, p_prims, sums
        )
        shares.weight, shares.error_weight = (torch.from_numpy(sums[:, i]).float() for i in range(2))
        own = tuple(np.empty(x.shape, x.dtype) for x in ctx.params[1:7])
        rest = (omega0, m, ctx.prims[1:6], p_prims[1:6], own)
        parallel_for(_density_parameters_backward, count, _PREPARED_ROWS_PER_JOB, threads, *ctx.params[1:3], *rest)
        gradients = zip((p_prims[0], *own, p_prims[6]), ctx.dtypes, strict=True)
        return (None,) * 5 + tuple(torch.from_numpy(x).to(dtype) for x, dtype in gradients)


# ---------------------------------------------------------------- kernels


@exact_kernel
def _prepare_point_axes(start, stop, means, log_scales, quats, centers, A, m, reach):  # type: ignore[no-untyped-def]
    """Fill ``centers``, ``A``, ``m`` and ``reach`` of primitives start:stop; return whether all numbers are finite.

    The matrix A (N, 3, 3) maps an offset from the centre (N, 3) to whitened space, where the ellipsoid is the unit
    ball. m (N,) is the longest semi-axis, ``reach`` (N, 3) has half the sides of the ellipsoid's axis-aligned box.
    """
    R, s, total = np.empty((3, 3)), np.empty(3), 0.0
    for n in range(start, stop):
        fill_ellipsoid_rotation(quats[n], R)
        for a in range(3):
            s[a] = np.exp(np.float64(log_scales[n, a]))
        m[n] = max(s[0], s[1], s[2])
        for j in range(3):
            centers[n, j] = means[n, j]
            reach[n, j] = np.sqrt((R[j, 0] * s[0]) ** 2 + (R[j, 1] * s[1]) ** 2 + (R[j, 2] * s[2]) ** 2)
            total += centers[n, j] + reach[n, j]
            for a in range(3):
                A[n, a, j] = R[j, a] / s[a]
                total += A[n, a, j]
    return np.isfinite(total)


@exact_kernel
def _prepare_point_neurons(start, stop, W1, b1, w2, b2, colors, omega0, m, rate, phase, amplitude, offset, shown):  # type: ignore[no-untyped-def]
    """Fill the coefficients of the networks of primitives start:stop; return whether all numbers are finite.

    The output f of a primitive's network at a point x is given by f/m = offset + sum over its K neurons of amplitude
    cos(phase + rate . (x - mu)), with centre mu and longest semi-axis m. Shapes: rate (N, K, 3), phase and amplitude
    (N, K), offset (N,). ``shown`` gets a float64 copy of ``colors``.
    """
    total = 0.0
    for n in range(start, stop):
        for k in range(W1.shape[1]):
            for j in range(3):
                rate[n, k, j] = omega0 * W1[n, k, j] / m[n]
                total += rate[n, k, j]
            phase[n, k], amplitude[n, k] = omega0 * b1[n, k], w2[n, k] / m[n]
            total += phase[n, k] + amplitude[n, k]
        offset[n] = b2[n] / m[n]
        total += offset[n]
        for c in range(colors.shape[1]):
            shown[n, c] = colors[n, c]
            total += shown[n, c]
    return np.isfinite(total)


@exact_kernel
def _density_parameters_backward(start, stop, log_scales, quats, omega0, m, prims, pulled, gradients):  # type: ignore[no-untyped-def]
    """Fill ``gradients`` of (log_scales, quats, W1, b1, w2, b2) from ``pulled``, the gradients of ``prims``.

    ``prims`` has A, rate, phase, amplitude and offset, see :func:`_prepare_point_axes` and
    :func:`_prepare_point_neurons`.
    """
    A, rate, phase, amplitude, offset = prims
    p_A, p_rate, p_phase, p_amplitude, p_offset = pulled
    g_log_scales, g_quats, g_W1, g_b1, g_w2, g_b2 = gradients
    R, gR, q, gq = np.empty((3, 3)), np.empty((3, 3)), np.empty(4), np.empty(4)
    for n in range(start, stop):
        for j in range(4):
            q[j] = quats[n, j]
        inverse = fill_ellipsoid_rotation(q, R)
        longest, first = p_offset[n] * offset[n], 0
        for k in range(phase.shape[1]):
            longest += p_amplitude[n, k] * amplitude[n, k]
            for j in range(3):
                longest += p_rate[n, k, j] * rate[n, k, j]
                g_W1[n, k, j] = omega0 * p_rate[n, k, j] / m[n]
            g_b1[n, k], g_w2[n, k] = omega0 * p_phase[n, k], p_amplitude[n, k] / m[n]
        g_b2[n] = p_offset[n] / m[n]
        for a in range(3):
            if log_scales[n, a] > log_scales[n, first]:  # of equals the first, as in Geometry.log_length_scale
                first = a
        for a in range(3):
            s, total = np.exp(np.float64(log_scales[n, a])), 0.0
            for j in range(3):
                total += p_A[n, a, j] * A[n, a, j]
                gR[j, a] = p_A[n, a, j] / s
            g_log_scales[n, a] = -total - (longest if a == first else 0.0)
        ellipsoid_rotation_backward(q, inverse, gR, gq)
        for j in range(4):
            g_quats[n, j] = gq[j]


@exact_kernel
def _sort_density_points(points, low, step, counts, starts, order, placed):  # type: ignore[no-untyped-def]
    """Sort points by cell (counting sort): fill ``starts`` (given as zeros), ``order`` and the sorted ``placed``."""
    cells = np.empty(points.shape[0], np.int64)
    for p in range(points.shape[0]):
        cell = 0
        for j in range(3):
            cell = cell * counts[j] + min(max(np.int64(np.floor((points[p, j] - low[j]) / step)), 0), counts[j] - 1)
        cells[p] = cell
        starts[cell + 1] += 1
    for c in range(starts.shape[0] - 1):
        starts[c + 1] += starts[c]
    fill = starts[:-1].copy()
    for p in range(points.shape[0]):
        at = fill[cells[p]]
        fill[cells[p]] = at + 1
        order[at] = p
        for j in range(3):
            placed[at, j] = points[p, j]


@exact_kernel
def _merge_density_point_sums(start, stop, parts, order, merged):  # type: ignore[no-untyped-def]
    """Add up ``parts`` (P, M, W) for sorted points p in start:stop; write row order[p] of ``merged`` (M, W)."""
    for p in range(start, stop):
        for q in range(parts.shape[2]):
            total = 0.0
            for part in range(parts.shape[0]):
                total += parts[part, p, q]
            merged[order[p], q] = total


@inline
def _density_point_cell_span(center, reach, low, step, count):  # type: ignore[no-untyped-def]
    """Return the first and last grid cell, along one axis, that the interval ``center`` +- ``reach`` meets.

    If the interval misses the grid, the first cell is ``count`` or the last cell is -1, which gives an empty range.
    """
    first = int(np.floor(min(max((center - reach - low) / step, 0.0), float(count))))
    return first, int(np.floor(min(max((center + reach - low) / step, -1.0), float(count - 1))))


@inline
def _point_cells_of_primitive(cells, reach, means, n):  # type: ignore[no-untyped-def]
    """Return the first and last cell along x, y and z, (x0, x1, y0, y1, z0, z1), that the box of primitive n meets."""
    low, step, counts = cells.low, cells.step, cells.counts
    x0, x1 = _density_point_cell_span(means[n, 0], reach[n, 0], low[0], step, counts[0])
    y0, y1 = _density_point_cell_span(means[n, 1], reach[n, 1], low[1], step, counts[1])
    z0, z1 = _density_point_cell_span(means[n, 2], reach[n, 2], low[2], step, counts[2])
    return x0, x1, y0, y1, z0, z1


@inline
def _whiten_density_point_offset(A, n, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the offset (dx, dy, dz) from primitive n's centre in whitened space (see _prepare_point_axes)."""
    y0 = A[n, 0, 0] * dx + A[n, 0, 1] * dy + A[n, 0, 2] * dz
    y1 = A[n, 1, 0] * dx + A[n, 1, 1] * dy + A[n, 1, 2] * dz
    y2 = A[n, 2, 0] * dx + A[n, 2, 1] * dy + A[n, 2, 2] * dz
    return y0, y1, y2


@inline
def _density_at_point_offset(rate, phase, amplitude, offset, n, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return f/m, the network's output over the longest semi-axis, at offset (dx, dy, dz) from primitive n's centre."""
    f = offset[n]
    for k in range(phase.shape[1]):
        f += amplitude[n, k] * np.cos(phase[n, k] + rate[n, k, 0] * dx + rate[n, k, 1] * dy + rate[n, k, 2] * dz)
    return f


@kernel
def _add_density_point_values(start, stop, cells, reach, prims, edge, chunk, sums):  # type: ignore[no-untyped-def]
    """Add extinctions of primitives start:stop at M points to part ``start // chunk`` of ``sums`` (parts, M, 1 + C).

    Column 0 gets a primitive's extinction sigma. Column 1 + c gets sigma times the primitive's weight ``colors[n, c]``.

    Args:
        reach, prims: filled by :func:`_prepare_point_axes` and :func:`_prepare_point_neurons`, for all primitives.
    """
    points, starts, counts = cells.points, cells.starts, cells.counts
    means, A, rate, phase, amplitude, offset, colors = prims
    own = sums[start // chunk]
    C = colors.shape[1]
    for n in range(start, stop):
        x0, x1, y0, y1, z0, z1 = _point_cells_of_primitive(cells, reach, means, n)
        if z0 > z1:
            continue
        for i in range(x0, x1 + 1):
            for j in range(y0, y1 + 1):
                row = (i * counts[1] + j) * counts[2]
                for p in range(starts[row + z0], starts[row + z1 + 1]):
                    dx, dy, dz = points[p, 0] - means[n, 0], points[p, 1] - means[n, 1], points[p, 2] - means[n, 2]
                    a, b, c = _whiten_density_point_offset(A, n, dx, dy, dz)
                    inner = 1.0 - (a * a + b * b + c * c)
                    if inner <= 0.0:
                        continue
                    f = _density_at_point_offset(rate, phase, amplitude, offset, n, dx, dy, dz)
                    if f <= 0.0:
                        continue
                    sigma = f if edge == 0 else f * inner if edge == 1 else f * inner * inner
                    own[p, 0] += sigma
                    for q in range(C):
                        own[p, 1 + q] += sigma * colors[n, q]


@kernel
def _density_point_values_backward(start, stop, cells, reach, prims, edge, pulled, error, gradients, shares):  # type: ignore[no-untyped-def]
    """Fill ``gradients``, given as zeros, of ``prims`` from ``pulled`` (M, 1 + C), the gradients of the sums at points.

    ``pulled`` and ``error`` (M,) are in the order of the sorted points in ``cells``. ``shares`` (N, 2) gets two sums
    over the points for each primitive: of its extinction sigma, and of sigma x ``error``.
    """
    points, starts, counts = cells.points, cells.starts, cells.counts
    means, A, rate, phase, amplitude, offset, colors = prims
    g_means, g_A, g_rate, g_phase, g_amplitude, g_offset, g_colors = gradients
    K, C = phase.shape[1], colors.shape[1]
    for n in range(start, stop):
        x0, x1, y0, y1, z0, z1 = _point_cells_of_primitive(cells, reach, means, n)
        if z0 > z1:
            continue
        m0, m1, m2, whole, weight, wrong = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        a00, a01, a02, a10, a11, a12, a20, a21, a22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(x0, x1 + 1):
            for j in range(y0, y1 + 1):
                row = (i * counts[1] + j) * counts[2]
                for p in range(starts[row + z0], starts[row + z1 + 1]):
                    dx, dy, dz = points[p, 0] - means[n, 0], points[p, 1] - means[n, 1], points[p, 2] - means[n, 2]
                    a, b, c = _whiten_density_point_offset(A, n, dx, dy, dz)
                    inner = 1.0 - (a * a + b * b + c * c)
                    if inner <= 0.0:
                        continue
                    f = _density_at_point_offset(rate, phase, amplitude, offset, n, dx, dy, dz)
                    if f <= 0.0:
                        continue
                    fade = 1.0 if edge == 0 else inner if edge == 1 else inner * inner
                    sigma = f * fade
                    weight += sigma
                    wrong += sigma * error[p]
                    g = pulled[p, 0]
                    for q in range(C):
                        g += pulled[p, 1 + q] * colors[n, q]
                        g_colors[n, q] += pulled[p, 1 + q] * sigma
                    gf = g * fade
                    whole += gf
                    for k in range(K):
                        angle = phase[n, k] + rate[n, k, 0] * dx + rate[n, k, 1] * dy + rate[n, k, 2] * dz
                        g_amplitude[n, k] += gf * np.cos(angle)
                        turn = -gf * amplitude[n, k] * np.sin(angle)
                        g_phase[n, k] += turn
                        g_rate[n, k, 0] += turn * dx
                        g_rate[n, k, 1] += turn * dy
                        g_rate[n, k, 2] += turn * dz
                        m0 -= turn * rate[n, k, 0]
                        m1 -= turn * rate[n, k, 1]
                        m2 -= turn * rate[n, k, 2]
                    if edge == 0:
                        continue
                    s = -2.0 * g * f if edge == 1 else -4.0 * g * f * inner  # dL/d|y|^2, twice
                    a, b, c = s * a, s * b, s * c
                    a00 += a * dx
                    a01 += a * dy
                    a02 += a * dz
                    a10 += b * dx
                    a11 += b * dy
                    a12 += b * dz
                    a20 += c * dx
                    a21 += c * dy
                    a22 += c * dz
                    m0 -= a * A[n, 0, 0] + b * A[n, 1, 0] + c * A[n, 2, 0]
                    m1 -= a * A[n, 0, 1] + b * A[n, 1, 1] + c * A[n, 2, 1]
                    m2 -= a * A[n, 0, 2] + b * A[n, 1, 2] + c * A[n, 2, 2]
        g_means[n, 0], g_means[n, 1], g_means[n, 2], g_offset[n] = m0, m1, m2, whole
        g_A[n, 0, 0], g_A[n, 0, 1], g_A[n, 0, 2] = a00, a01, a02
        g_A[n, 1, 0], g_A[n, 1, 1], g_A[n, 1, 2] = a10, a11, a12
        g_A[n, 2, 0], g_A[n, 2, 1], g_A[n, 2, 2] = a20, a21, a22
        shares[n, 0], shares[n, 1] = weight, wrong
