"""The kernels of :mod:`neuprim.core.volumes.points`: primitives one by one, each with the points of the cells that its
box meets."""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import inline, kernel


@inline
def _first(center, reach, low, step, count):  # type: ignore[no-untyped-def]
    """The lowest cell of an axis that a box meets; beyond the last if none."""
    return int(np.floor(min(max((center - reach - low) / step, 0.0), float(count))))


@inline
def _last(center, reach, low, step, count):  # type: ignore[no-untyped-def]
    """The highest one; -1 if none."""
    return int(np.floor(min(max((center + reach - low) / step, -1.0), float(count - 1))))


@inline
def _met(cells, reach, means, n):  # type: ignore[no-untyped-def]
    """First and last cell along each axis that the box of primitive n meets; along z none where the last comes before
    the first."""
    _, low, step, counts = cells
    x0, x1 = (
        _first(means[n, 0], reach[n, 0], low[0], step, counts[0]),
        _last(means[n, 0], reach[n, 0], low[0], step, counts[0]),
    )
    y0, y1 = (
        _first(means[n, 1], reach[n, 1], low[1], step, counts[1]),
        _last(means[n, 1], reach[n, 1], low[1], step, counts[1]),
    )
    z0, z1 = (
        _first(means[n, 2], reach[n, 2], low[2], step, counts[2]),
        _last(means[n, 2], reach[n, 2], low[2], step, counts[2]),
    )
    return x0, x1, y0, y1, z0, z1


@inline
def _inside(A, n, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Whitened coordinates of an offset from the mean."""
    y0 = A[n, 0, 0] * dx + A[n, 0, 1] * dy + A[n, 0, 2] * dz
    y1 = A[n, 1, 0] * dx + A[n, 1, 1] * dy + A[n, 1, 2] * dz
    y2 = A[n, 2, 0] * dx + A[n, 2, 1] * dy + A[n, 2, 2] * dz
    return y0, y1, y2


@inline
def _field(rate, phase, amplitude, offset, n, dx, dy, dz):  # type: ignore[no-untyped-def]
    """f/m at an offset from the mean."""
    f = offset[n]
    for k in range(phase.shape[1]):
        f += amplitude[n, k] * np.cos(phase[n, k] + rate[n, k, 0] * dx + rate[n, k, 1] * dy + rate[n, k, 2] * dz)
    return f


@kernel
def add_values(start, stop, points, cells, reach, prims, edge, chunk, sums):  # type: ignore[no-untyped-def]
    """Adds sigma and source of primitives start:stop to part ``start // chunk`` of ``sums`` (parts, M, 1 + C).

    Args:
        points: (M, 3) float64, cell by cell. cells: starts, low, step and counts of
        :class:`~neuprim.core.volumes.points.Cells`. reach: (N, 3) half sides of the primitives' boxes. prims: means (N,
        3), A (N, 3, 3), and what
            :func:`~neuprim.core.volumes.points_prepare.prepare_values` fills: rate, phase, amplitude, offset and
            colours.
    """
    starts, counts = cells[0], cells[3]
    means, A, rate, phase, amplitude, offset, colors = prims
    own = sums[start // chunk]
    C = colors.shape[1]
    for n in range(start, stop):
        x0, x1, y0, y1, z0, z1 = _met(cells, reach, means, n)
        if z0 > z1:
            continue
        for i in range(x0, x1 + 1):
            for j in range(y0, y1 + 1):
                row = (i * counts[1] + j) * counts[2]
                for p in range(starts[row + z0], starts[row + z1 + 1]):
                    dx, dy, dz = points[p, 0] - means[n, 0], points[p, 1] - means[n, 1], points[p, 2] - means[n, 2]
                    a, b, c = _inside(A, n, dx, dy, dz)
                    inner = 1.0 - (a * a + b * b + c * c)
                    if inner <= 0.0:
                        continue
                    f = _field(rate, phase, amplitude, offset, n, dx, dy, dz)
                    if f <= 0.0:
                        continue
                    sigma = f if edge == 0 else f * inner if edge == 1 else f * inner * inner
                    own[p, 0] += sigma
                    for q in range(C):
                        own[p, 1 + q] += sigma * colors[n, q]


@kernel
def pull_values(start, stop, points, cells, reach, prims, edge, pulled, error, gradients, shares):  # type: ignore[no-untyped-def]
    """Gradients of primitives start:stop, a tuple like ``prims``, from those of the sums, ``pulled`` (M, 1 + C), and
    the sums of sigma and sigma x error, ``shares`` (N, 2).
    """
    starts, counts = cells[0], cells[3]
    means, A, rate, phase, amplitude, offset, colors = prims
    g_means, g_A, g_rate, g_phase, g_amplitude, g_offset, g_colors = gradients
    K, C = phase.shape[1], colors.shape[1]
    for n in range(start, stop):
        x0, x1, y0, y1, z0, z1 = _met(cells, reach, means, n)
        if z0 > z1:
            continue
        m0, m1, m2, whole, weight, wrong = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        a00, a01, a02, a10, a11, a12, a20, a21, a22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(x0, x1 + 1):
            for j in range(y0, y1 + 1):
                row = (i * counts[1] + j) * counts[2]
                for p in range(starts[row + z0], starts[row + z1 + 1]):
                    dx, dy, dz = points[p, 0] - means[n, 0], points[p, 1] - means[n, 1], points[p, 2] - means[n, 2]
                    a, b, c = _inside(A, n, dx, dy, dz)
                    inner = 1.0 - (a * a + b * b + c * c)
                    if inner <= 0.0:
                        continue
                    f = _field(rate, phase, amplitude, offset, n, dx, dy, dz)
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


@kernel
def count_pairs(start, stop, points, cells, reach, means, A, found):  # type: ignore[no-untyped-def]
    """How many points primitives start:stop contain."""
    for n in range(start, stop):
        found[n] = _each(n, points, cells, reach, means, A, 0, found[:0])


@kernel
def fill_pairs(start, stop, points, cells, reach, means, A, begins, point):  # type: ignore[no-untyped-def]
    """Which they are, from ``begins[n]`` on."""
    for n in range(start, stop):
        _each(n, points, cells, reach, means, A, begins[n], point)


@inline
def _each(n, points, cells, reach, means, A, begin, point):  # type: ignore[no-untyped-def]
    starts, counts, found = cells[0], cells[3], 0
    x0, x1, y0, y1, z0, z1 = _met(cells, reach, means, n)
    if z0 > z1:
        return 0
    for i in range(x0, x1 + 1):
        for j in range(y0, y1 + 1):
            row = (i * counts[1] + j) * counts[2]
            for p in range(starts[row + z0], starts[row + z1 + 1]):
                a, b, c = _inside(
                    A, n, points[p, 0] - means[n, 0], points[p, 1] - means[n, 1], points[p, 2] - means[n, 2]
                )
                if a * a + b * b + c * c < 1.0:
                    if point.shape[0]:
                        point[begin + found] = p
                    found += 1
    return found
