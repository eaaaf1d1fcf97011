"""What the kernels of :mod:`neuprim.core.volumes.points` need of each primitive, in float64, its gradient, and points
sorted into cells."""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.model.rotation import rotation, rotation_backward


@exact_kernel
def prepare_axes(start, stop, means, log_scales, quats, centers, A, m, reach):  # type: ignore[no-untyped-def]
    """Ellipsoids start:stop: ``centers`` (N, 3), A (N, 3, 3) with y = A (x - mu), longest semi-axes m (N,), and half
    sides of their boxes,
    ``reach`` (N, 3). Returns whether all of that is finite.
    """
    R, s, total = np.empty((3, 3)), np.empty(3), 0.0
    for n in range(start, stop):
        rotation(quats[n], R)
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
def prepare_values(start, stop, W1, b1, w2, b2, colors, omega0, m, rate, phase, amplitude, offset, shown):  # type: ignore[no-untyped-def]
    """Of each neuron of primitives start:stop rate (N, K, 3), phase and amplitude (N, K), and offset (N,), so that
    f/m = offset + sum of amplitude cos(phase + rate . (x - mu)); and the colours in float64. Returns whether all are
    finite.
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
def pull_parameters(start, stop, log_scales, quats, omega0, m, prims, pulled, gradients):  # type: ignore[no-untyped-def]
    """Gradients of (log_scales, quats, W1, b1, w2, b2) of primitives start:stop from those of ``prims``, (A, rate,
    phase, amplitude, offset)."""
    A, rate, phase, amplitude, offset = prims
    p_A, p_rate, p_phase, p_amplitude, p_offset = pulled
    g_log_scales, g_quats, g_W1, g_b1, g_w2, g_b2 = gradients
    R, gR, q, gq = np.empty((3, 3)), np.empty((3, 3)), np.empty(4), np.empty(4)
    for n in range(start, stop):
        for j in range(4):
            q[j] = quats[n, j]
        inverse = rotation(q, R)
        longest, first = p_offset[n] * offset[n], 0
        for k in range(phase.shape[1]):
            longest += p_amplitude[n, k] * amplitude[n, k]
            for j in range(3):
                longest += p_rate[n, k, j] * rate[n, k, j]
                g_W1[n, k, j] = omega0 * p_rate[n, k, j] / m[n]
            g_b1[n, k], g_w2[n, k] = omega0 * p_phase[n, k], p_amplitude[n, k] / m[n]
        g_b2[n] = p_offset[n] / m[n]
        for a in range(3):
            if (
                log_scales[n, a] > log_scales[n, first]
            ):  # of equals the first is the longest, as in Geometry.log_length_scale
                first = a
        for a in range(3):
            s, total = np.exp(np.float64(log_scales[n, a])), 0.0
            for j in range(3):
                total += p_A[n, a, j] * A[n, a, j]
                gR[j, a] = p_A[n, a, j] / s
            g_log_scales[n, a] = -total - (longest if a == first else 0.0)
        rotation_backward(q, inverse, gR, gq)
        for j in range(4):
            g_quats[n, j] = gq[j]


@exact_kernel
def sort_points(points, low, step, counts, starts, order, placed):  # type: ignore[no-untyped-def]
    """A counting sort by cell: fills ``starts`` (X Y Z + 1,), zeros before, ``order`` (M,), and ``placed`` (M, 3), the
    points in that order."""
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
def merge_parts(start, stop, parts, order, merged):  # type: ignore[no-untyped-def]
    """Sums over the ``parts`` (P, M, W) of points start:stop, one after the other, to where ``order`` says that they
    came from."""
    for p in range(start, stop):
        for q in range(parts.shape[2]):
            total = 0.0
            for part in range(parts.shape[0]):
                total += parts[part, p, q]
            merged[order[p], q] = total
