"""The hand-written backward pass of the per-primitive stage, in float64."""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.model.rotation import rotation_backward
from neuprim.core.render import layout as P
from neuprim.core.render.cpu.prepare import borrow_parameters, borrow_view, camera_frame


@exact_kernel
def prepare_backward(start, stop, parameters, view, projected, grads, touched, out, g_view):  # type: ignore[no-untyped-def]
    """Chain rule from gradient rows to parameters, for the ``touched`` primitives among ``start:stop``.

    Fills ``out`` (:class:`Parameters`, float32) and ``g_view`` (N, 3, 4), each one's part of dL/d(R | t); empty:
    unwanted.
    """
    view = borrow_view(view)
    means, log_scales, quats, W1, _, _, _ = borrow_parameters(parameters)
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
        m, inverse = camera_frame(means[i], log_scales[i], quats[i], view, local, B, axes, c, anchor)
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
        rotation_backward(q, inverse, gL, gq)
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
