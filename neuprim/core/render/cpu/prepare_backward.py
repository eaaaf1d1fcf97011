"""The chain rule of the per-primitive stage: from gradient rows to parameters, in float64."""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import borrow_arrays, exact_kernel, strict
from neuprim.core.model.rows import ellipsoid_rotation_backward, fill_ellipsoid_rotation
from neuprim.core.render import layout as P


@strict
def project_primitive_frame(mean, log_scale, quat, view, local, B, axes, c, anchor):  # type: ignore[no-untyped-def]
    """Fill camera-axes orientation B, axes s/m, centre c and anchor (depth, pixel x, y); returns (m, 1/|q|).

    The anchor is rounded to float32 *before* it is used, so that the pixel kernels subtract exactly the same number.
    """
    R, t = view.R, view.t
    n = fill_ellipsoid_rotation(quat, local)
    top = max(np.float64(log_scale[0]), np.float64(log_scale[1]), np.float64(log_scale[2]))
    m = np.exp(top)
    for i in range(3):
        axes[i] = np.exp(np.float64(log_scale[i]) - top)
        c[i] = R[i, 0] * mean[0] + R[i, 1] * mean[1] + R[i, 2] * mean[2] + t[i]
        for j in range(3):
            B[i, j] = R[i, 0] * local[0, j] + R[i, 1] * local[1, j] + R[i, 2] * local[2, j]
    fx, fy, cx, cy = view.fx, view.fy, view.cx, view.cy
    if c[2] > P.ANCHOR_RADII * m and c[2] + m > view.near:
        anchor[0] = m * np.float64(np.float32(c[2] / m))
        anchor[1] = np.float64(np.float32(fx * c[0] / c[2] + cx))
        anchor[2] = np.float64(np.float32(fy * c[1] / c[2] + cy))
    else:  # the centre is near or behind the camera, or nothing is seen of it: anchor at the camera itself
        anchor[0] = 0.0
        anchor[1] = np.float64(np.float32(cx))
        anchor[2] = np.float64(np.float32(cy))
    return m, n


@exact_kernel
def prepare_backward(start, stop, parameters, view, projected, grads, touched, out, g_view):  # type: ignore[no-untyped-def]
    """Chain rule from gradient rows to parameters, for the ``touched`` primitives among ``start:stop``.

    Fills ``out`` (:class:`PrimitiveArrays`, float32) and ``g_view`` (N, 3, 4), each one's part of dL/d(R | t); empty:
    unwanted.
    """
    view = borrow_arrays(view)
    means, log_scales, quats, W1, _, _, _ = borrow_arrays(parameters)
    g_means, g_log_scales, g_quats, g_W1, g_b1, g_w2, g_b2 = out
    rows, order, R, turns, K = projected.rows, projected.order, view.R, view.turns, W1.shape[1]
    local, B, A = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    gA, gB, gL = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    axes, c, anchor, ref, w = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    gc, gl, gq, q = np.empty(3), np.empty(3), np.empty(4), np.empty(4)
    fx, fy, cx, cy = view.fx, view.fy, view.cx, view.cy
    for i in range(start, stop):
        if not touched[i]:
            continue
        g = grads[i]
        m, inverse = project_primitive_frame(means[i], log_scales[i], quats[i], view, local, B, axes, c, anchor)
        tc = anchor[0] / m
        ref[0], ref[1], ref[2] = (anchor[1] - cx) / fx, (anchor[2] - cy) / fy, 1.0
        for j in range(3):
            w[j] = tc * ref[j] - c[j] / m
            gc[j] = 0.0
        for a in range(3):
            gx = np.float64(g[P.XA + a])
            row_sum = 0.0
            for j in range(3):
                A[a, j] = B[j, a] / axes[a]
                gA[a, j] = g[P.E0 + a] * ref[j] + gx * w[j]
            gA[a, 0] += g[P.EX + a] / fx
            gA[a, 1] += g[P.EY + a] / fy
            for j in range(3):
                gB[j, a] = gA[a, j] / axes[a]
                row_sum += gA[a, j] * A[a, j]
                gc[j] -= A[a, j] * gx / m
            gl[a] = -row_sum  # A scales with 1/s_a
        log_m = -np.float64(g[P.G_LOG_M])  # the density's own 1/m
        for a in range(3):
            for j in range(3):
                gL[a, j] = 0.0
        for n in range(K):
            k, o, og = order[i, n], P.NEURONS + P.PER_NEURON * n, P.G_NEURONS + P.PER_NEURON * n
            for j in range(3):
                gw = np.float64(g[og + P.WX + j])
                gl[j] += gw * rows[i, o + P.WX + j]  # W on whitened axes scales with s_j/m
                log_m -= gw * rows[i, o + P.WX + j]
                for a in range(3):
                    gL[a, j] += turns * axes[j] * W1[i, k, a] * gw
            for a in range(3):
                g_W1[i, k, a] = turns * (
                    g[og + P.WX] * axes[0] * local[a, 0]
                    + g[og + P.WY] * axes[1] * local[a, 1]
                    + g[og + P.WZ] * axes[2] * local[a, 2]
                )
            g_b1[i, k] = turns * g[og + P.PHASE]
            g_w2[i, k] = g[og + P.AMPLITUDE]
        g_b2[i] = g[P.G_OFFSET]
        first = 0
        for j in range(1, 3):
            if log_scales[i, j] > log_scales[i, first]:
                first = j
        gl[first] += log_m
        for a in range(3):
            g_log_scales[i, a] = gl[a]
            g_means[i, a] = R[0, a] * gc[0] + R[1, a] * gc[1] + R[2, a] * gc[2]
            for j in range(3):  # B = R local
                gL[a, j] += R[0, a] * gB[0, j] + R[1, a] * gB[1, j] + R[2, a] * gB[2, j]
        for j in range(4):
            q[j] = quats[i, j]
        ellipsoid_rotation_backward(q, inverse, gL, gq)
        for j in range(4):
            g_quats[i, j] = gq[j]
        if g_view.shape[0] > 0:
            for a in range(3):
                for j in range(3):
                    value = gc[a] * means[i, j]
                    for b in range(3):
                        value += gB[a, b] * local[j, b]
                    g_view[i, a, j] = value
                g_view[i, a, 3] = gc[a]
