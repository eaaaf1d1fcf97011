"""Backward pass of projection: compute parameter gradients from gradient rows, in float64, for 32 primitives at a time.

A gradient row holds the gradients with respect to the numbers of a primitive's row. A block is 32 primitives.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import borrow_array, borrow_arrays, exact_kernel, release_array, strict
from neuprim.core.model.rows import quaternion_gradient
from neuprim.core.render import layout as P
from neuprim.core.render.cpu.blocks import (
    ANCHOR_Z,
    AXES,
    BLOCK,
    CENTRE,
    COLUMNS,
    INVERSE,
    LOCAL,
    LOG_SCALES,
    QUATS,
    UX,
    UY,
    B,
    M,
    column,
    dot3,
    load3,
    load9,
    load_block,
    project_block,
    store3,
)

# Columns after those of a block: dL/d(E0, EX, EY, XA), as in a gradient row, then dL/d of the named quantities
_RAYS = column(COLUMNS)
_G_B, _G_LOCAL, _G_LOG_SCALES, _G_CENTRE, _G_LOG_M = (column(COLUMNS + n) for n in (12, 21, 30, 33, 36))
_G_MEANS, _G_QUATS = (column(COLUMNS + n) for n in (37, 40))
_WAVE, _WEIGHT, _G_WAVE, _G_WEIGHT = (column(COLUMNS + n) for n in (44, 47, 50, 53))  # of one neuron at a time
_COLUMNS = COLUMNS + 56


@strict
def _axis_gradient(b, s, g, reference, w, fx, fy):  # type: ignore[no-untyped-def]
    """Return dL/d(column of B), dL/d(log semi-axis s) and the part of -m dL/d(centre) for one axis of an ellipsoid.

    B is the orientation in camera axes, m the longest semi-axis. ``g`` is dL/d(E0, EX, EY, XA) along the axis, the
    gradient by the numbers of the rays. ``b`` is the axis's column of B, and ``s`` the semi-axis divided by m.
    ``reference`` is the anchor on the image plane z = 1, ``w`` the vector from the centre to the anchor, divided by m.
    """
    a = b[0] / s, b[1] / s, b[2] / s
    gx = g[3]
    g_a0, g_a1 = g[0] * reference[0] + gx * w[0] + g[1] / fx, g[0] * reference[1] + gx * w[1] + g[2] / fy
    g_a2 = g[0] + gx * w[2]
    # A scales with 1/s
    return (g_a0 / s, g_a1 / s, g_a2 / s), -dot3((g_a0, g_a1, g_a2), a), (a[0] * gx, a[1] * gx, a[2] * gx)


@strict
def _rays_backward(S, view):  # type: ignore[no-untyped-def]
    """Fill dL/d(orientation B, log scales, centre in camera axes) of a block from dL/d(E0, EX, EY, XA)."""
    fx, fy, cx, cy = view.fx, view.fy, view.cx, view.cy
    for k in range(BLOCK):
        m, c, s = S[M + k], load3(S, CENTRE, k), load3(S, AXES, k)
        b00, b01, b02, b10, b11, b12, b20, b21, b22 = load9(S, B, k)
        e, ex = load3(S, _RAYS + BLOCK * P.E0, k), load3(S, _RAYS + BLOCK * P.EX, k)
        ey, x = load3(S, _RAYS + BLOCK * P.EY, k), load3(S, _RAYS + BLOCK * P.XA, k)
        tc, reference = S[ANCHOR_Z + k] / m, ((S[UX + k] - cx) / fx, (S[UY + k] - cy) / fy)
        w = tc * reference[0] - c[0] / m, tc * reference[1] - c[1] / m, tc - c[2] / m
        g0, l0, p = _axis_gradient((b00, b10, b20), s[0], (e[0], ex[0], ey[0], x[0]), reference, w, fx, fy)
        g1, l1, q = _axis_gradient((b01, b11, b21), s[1], (e[1], ex[1], ey[1], x[1]), reference, w, fx, fy)
        g2, l2, r = _axis_gradient((b02, b12, b22), s[2], (e[2], ex[2], ey[2], x[2]), reference, w, fx, fy)
        store3(S, _G_LOG_SCALES, k, (l0, l1, l2))
        for j in range(3):
            store3(S, _G_B + 3 * j * BLOCK, k, (g0[j], g1[j], g2[j]))
        store3(
            S, _G_CENTRE, k,
            (-p[0] / m - q[0] / m - r[0] / m, -p[1] / m - q[1] / m - r[1] / m, -p[2] / m - q[2] / m - r[2] / m),
        )  # fmt: skip


@strict
def _neuron_backward(S, turns):  # type: ignore[no-untyped-def]
    """Fill dL/dW1 of one neuron of a block of primitives; add the neuron's part of dL/d(log scales, LOCAL, log m).

    LOCAL is the orientation in scene axes, m the longest semi-axis. ``turns`` is omega0 / 2 pi.
    """
    for k in range(BLOCK):
        wave, W, g, s = load3(S, _WAVE, k), load3(S, _WEIGHT, k), load3(S, _G_WAVE, k), load3(S, AXES, k)
        l00, l01, l02, l10, l11, l12, l20, l21, l22 = load9(S, LOCAL, k)
        by_wave = g[0] * wave[0], g[1] * wave[1], g[2] * wave[2]
        g_log = load3(S, _G_LOG_SCALES, k)  # W on whitened axes scales with s_j/m
        store3(S, _G_LOG_SCALES, k, (g_log[0] + by_wave[0], g_log[1] + by_wave[1], g_log[2] + by_wave[2]))
        S[_G_LOG_M + k] = S[_G_LOG_M + k] - by_wave[0] - by_wave[1] - by_wave[2]
        t = turns * s[0], turns * s[1], turns * s[2]
        for a in range(3):
            before = load3(S, _G_LOCAL + 3 * a * BLOCK, k)
            own = before[0] + t[0] * W[a] * g[0], before[1] + t[1] * W[a] * g[1], before[2] + t[2] * W[a] * g[2]
            store3(S, _G_LOCAL + 3 * a * BLOCK, k, own)
        v = g[0] * s[0], g[1] * s[1], g[2] * s[2]
        weight = turns * dot3(v, (l00, l01, l02)), turns * dot3(v, (l10, l11, l12)), turns * dot3(v, (l20, l21, l22))
        store3(S, _G_WEIGHT, k, weight)


@strict
def _geometry_backward(S, R):  # type: ignore[no-untyped-def]
    """Fill dL/d(means, log scales, quaternions) of a block of primitives from the gradients that are already complete.

    The inputs are dL/dB, dL/dLOCAL (B and LOCAL: orientation in camera and scene axes), dL/d log m (m: longest
    semi-axis) and dL/d(centre in camera axes). R is the camera's rotation.
    """
    x, y, z = (R[0, 0], R[1, 0], R[2, 0]), (R[0, 1], R[1, 1], R[2, 1]), (R[0, 2], R[1, 2], R[2, 2])
    for k in range(BLOCK):
        logs, g_log, log_m, c = (
            load3(S, LOG_SCALES, k),
            load3(S, _G_LOG_SCALES, k),
            S[_G_LOG_M + k],
            load3(S, _G_CENTRE, k),
        )
        second = logs[1] > logs[0]  # of equal axes, the first counts as the longest
        third = logs[2] > (logs[1] if second else logs[0])
        store3(
            S, _G_LOG_SCALES, k,
            (
                g_log[0] + (0.0 if second | third else log_m),
                g_log[1] + (log_m if second & (not third) else 0.0),
                g_log[2] + (log_m if third else 0.0),
            ),
        )  # fmt: skip
        store3(S, _G_MEANS, k, (dot3(x, c), dot3(y, c), dot3(z, c)))
        b00, b01, b02, b10, b11, b12, b20, b21, b22 = load9(S, _G_B, k)  # B = R local
        l00, l01, l02, l10, l11, l12, l20, l21, l22 = load9(S, _G_LOCAL, k)
        p, q, r = (b00, b10, b20), (b01, b11, b21), (b02, b12, b22)
        g = (
            l00 + dot3(x, p), l01 + dot3(x, q), l02 + dot3(x, r), l10 + dot3(y, p), l11 + dot3(y, q), l12 + dot3(y, r),
            l20 + dot3(z, p), l21 + dot3(z, q), l22 + dot3(z, r),
        )  # fmt: skip
        q0, q1, q2 = load3(S, QUATS, k)
        g0, g1, g2, g3 = quaternion_gradient(q0, q1, q2, S[QUATS + 3 * BLOCK + k], S[INVERSE + k], g)
        store3(S, _G_QUATS, k, (g0, g1, g2))
        S[_G_QUATS + 3 * BLOCK + k] = g3


@strict
def _backward_block(which, n, parameters, view, projected, grads, out, g_view, S):  # type: ignore[no-untyped-def]
    """Compute the gradients ``out`` and ``g_view`` of a block of primitives, ``which[:n]``, from gradient rows."""
    W1, rows, order, turns = parameters.W1, projected.rows, projected.order, view.turns
    load_block(which, n, parameters, S)
    project_block(S, view)
    for k in range(BLOCK):
        i = which[min(k, n - 1)]
        for j in range(12):
            S[_RAYS + j * BLOCK + k] = grads[i, j]
        S[_G_LOG_M + k] = -np.float64(grads[i, P.G_LOG_M])  # the density's own 1/m
    _rays_backward(S, view)
    for k in range(9 * BLOCK):
        S[_G_LOCAL + k] = 0.0
    for neuron in range(W1.shape[1]):
        o, og = P.NEURONS + P.PER_NEURON * neuron, P.G_NEURONS + P.PER_NEURON * neuron
        for k in range(BLOCK):
            i = which[min(k, n - 1)]
            for j in range(3):
                S[_WAVE + j * BLOCK + k], S[_G_WAVE + j * BLOCK + k] = rows[i, o + P.WX + j], grads[i, og + P.WX + j]
                S[_WEIGHT + j * BLOCK + k] = W1[i, order[i, neuron], j]
        _neuron_backward(S, turns)
        for k in range(n):
            i = which[k]
            own = order[i, neuron]
            for j in range(3):
                out.W1[i, own, j] = S[_G_WEIGHT + j * BLOCK + k]
            out.b1[i, own], out.w2[i, own] = turns * grads[i, og + P.PHASE], grads[i, og + P.AMPLITUDE]
    _geometry_backward(S, view.R)
    for k in range(n):
        i = which[k]
        out.b2[i] = grads[i, P.G_OFFSET]
        for j in range(3):
            out.means[i, j], out.log_scales[i, j] = S[_G_MEANS + j * BLOCK + k], S[_G_LOG_SCALES + j * BLOCK + k]
        for j in range(4):
            out.quats[i, j] = S[_G_QUATS + j * BLOCK + k]
        if g_view.shape[0] > 0:
            for a in range(3):
                centre = S[_G_CENTRE + a * BLOCK + k]
                for j in range(3):
                    value = centre * parameters.means[i, j]
                    for b in range(3):
                        value += S[_G_B + (3 * a + b) * BLOCK + k] * S[LOCAL + (3 * j + b) * BLOCK + k]
                    g_view[i, a, j] = value
                g_view[i, a, 3] = centre


@exact_kernel
def prepare_backward(start, stop, parameters, view, projected, grads, touched, out, g_view):  # type: ignore[no-untyped-def]
    """Compute parameter gradients of primitives ``start:stop`` from gradient rows ``grads``; zeros if not ``touched``.

    (R | t) is the camera's rotation and translation. The kernel fills ``out`` (:class:`PrimitiveArrays`, float32) and
    ``g_view`` (N, 3, 4), each primitive's part of dL/d(R | t). The caller passes ``g_view`` as zeros, or as an empty
    array if dL/d(R | t) is not needed.
    """
    parameters, view, projected = borrow_arrays(parameters), borrow_arrays(view), borrow_arrays(projected)
    grads, out, g_view = borrow_array(grads), borrow_arrays(out), borrow_array(g_view)
    memory, block = np.zeros(_COLUMNS * BLOCK), np.empty(BLOCK, np.int64)
    S, which = borrow_array(memory), borrow_array(block)
    n = 0
    for i in range(start, stop):
        if touched[i]:
            which[n] = i
            n += 1
        else:
            out.b2[i] = 0.0
            for j in range(3):
                out.means[i, j], out.log_scales[i, j] = 0.0, 0.0
            for j in range(4):
                out.quats[i, j] = 0.0
            for k in range(out.b1.shape[1]):
                out.W1[i, k, 0], out.W1[i, k, 1], out.W1[i, k, 2], out.b1[i, k], out.w2[i, k] = 0.0, 0.0, 0.0, 0.0, 0.0
        if n == BLOCK or (i + 1 == stop and n > 0):
            _backward_block(which, n, parameters, view, projected, grads, out, g_view, S)
            n = 0
    release_array(memory)
    release_array(block)
