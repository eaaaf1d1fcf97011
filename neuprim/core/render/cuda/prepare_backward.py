# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Compute gradients of parameters and camera from gradient rows, with one thread per primitive.

The formulas are those of :mod:`neuprim.core.render.cpu.prepare_backward`.
"""

import functools
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.warp import (
    Doubles,
    Doubles2d,
    Floats,
    Floats2d,
    Vec3s,
    Vec3s2d,
    Vec4s,
    array,
    launch_kernel,
    wp,
)
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.prepare import Frame, rasterizer_parameter_arrays
from neuprim.core.render.cuda.projection import EXACT, PER_BLOCK, load_projection_view, project_primitive, whiten_rays
from neuprim.core.render.layout import E0, EX, EY, XA

d, f = wp.float64, wp.float32
_E0, _EX, _EY, _XA = E0, EX, EY, XA
_G_OFFSET, _G_LOG_M, _G_WEIGHT, _G_NEURONS, _PER_NEURON = L.G_OFFSET, L.G_LOG_M, L.G_WEIGHT, L.G_NEURONS, L.PER_NEURON


@wp.func
def _load_gradient_vector(grads: Floats2d, i: int, column: int):
    return wp.vec3d(d(grads[i, column]), d(grads[i, column + 1]), d(grads[i, column + 2]))


@wp.func
def quaternion_gradient(q: wp.vec4d, n: wp.float64, g: wp.mat33d):
    """Return dL/dq of a quaternion q from ``g`` = dL/dR, R the rotation matrix of q; ``n`` is 1/|q|.

    The result is perpendicular to q, because R does not depend on the length of q.
    """
    two = d(2.0)
    w, x, y, z = q[0] * n, q[1] * n, q[2] * n, q[3] * n
    gw = two * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    gx = two * (
        w * (g[2, 1] - g[1, 2]) + y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) - two * x * (g[1, 1] + g[2, 2])
    )
    gy = two * (
        w * (g[0, 2] - g[2, 0]) + x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) - two * y * (g[0, 0] + g[2, 2])
    )
    gz = two * (
        w * (g[1, 0] - g[0, 1]) + x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) - two * z * (g[0, 0] + g[1, 1])
    )
    along = gw * w + gx * x + gy * y + gz * z
    return wp.vec4d((gw - along * w) * n, (gx - along * x) * n, (gy - along * y) * n, (gz - along * z) * n)


@functools.cache
def _prepare_backward_kernel(double: bool) -> Any:
    """Return the kernel of :func:`prepare_backward` for float64 (``double``) or float32 parameters."""
    real, vec3, vec4 = (wp.float64, wp.vec3d, wp.vec4d) if double else (wp.float32, wp.vec3, wp.vec4)

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def backward(
        means: wp.array(dtype=vec3), log_scales: wp.array(dtype=vec3), quats: wp.array(dtype=vec4),
        W1: wp.array2d(dtype=vec3), b1: wp.array2d(dtype=real), w2: wp.array2d(dtype=real), b2: wp.array(dtype=real),
        matrix: Doubles, intrinsics: wp.vec4d, near: wp.float64, turns: wp.float64, neurons: int, grads: Floats2d,
        g_means: Vec3s, g_log_scales: Vec3s, g_quats: Vec4s, g_W1: Vec3s2d, g_b1: Floats2d, g_w2: Floats2d,
        g_b2: Floats, g_view: Doubles2d,
    ):  # fmt: skip
        i = wp.tid()
        if grads[i, _G_WEIGHT] > f(0.0):
            v = load_projection_view(matrix, intrinsics, near)
            mean, logs, quat = wp.vec3d(means[i]), wp.vec3d(log_scales[i]), wp.vec4d(quats[i])
            p = project_primitive(mean, logs, quat, v)
            r = whiten_rays(p, v)
            gx = _load_gradient_vector(grads, i, _XA)
            gA = wp.outer(_load_gradient_vector(grads, i, _E0), r.ref) + wp.outer(gx, r.w)
            ge = _load_gradient_vector(grads, i, _EX) / v.focal[0]
            gy = _load_gradient_vector(grads, i, _EY) / v.focal[1]
            gB, gl = wp.mat33d(), wp.vec3d()  # dL/dB, dL/d log_scales
            for a in range(3):
                row = wp.vec3d(gA[a, 0] + ge[a], gA[a, 1] + gy[a], gA[a, 2])
                gl[a] = -wp.dot(row, wp.vec3d(r.A[a, 0], r.A[a, 1], r.A[a, 2]))  # A scales with 1/s_a
                for j in range(3):
                    gB[j, a] = row[j] / p.axes[a]
            gc = -(wp.transpose(r.A) * gx) / p.m
            log_m = -d(grads[i, _G_LOG_M])  # the density's own 1/m
            gL = wp.mat33d()  # dL/d rotation
            for k in range(neurons):
                column, W = _G_NEURONS + _PER_NEURON * k, wp.vec3d(W1[i, k])
                gw = turns * wp.cw_mul(_load_gradient_vector(grads, i, column), p.axes)
                gL += wp.outer(W, gw)
                scaled = wp.cw_mul(gw, wp.transpose(p.local) * W)  # W on whitened axes scales with s_j/m
                gl += scaled
                log_m -= scaled[0] + scaled[1] + scaled[2]
                g_W1[i, k] = wp.vec3(p.local * gw)
                g_b1[i, k] = f(turns * d(grads[i, column + 3]))
                g_w2[i, k] = grads[i, column + 4]
            if logs[2] > wp.max(logs[0], logs[1]):  # the first of the longest axes is m
                gl[2] += log_m
            elif logs[1] > logs[0]:
                gl[1] += log_m
            else:
                gl[0] += log_m
            g_means[i] = wp.vec3(wp.transpose(v.R) * gc)
            g_log_scales[i] = wp.vec3(gl)
            g_quats[i] = wp.vec4(quaternion_gradient(quat, p.inverse, gL + wp.transpose(v.R) * gB))  # B = R local
            g_b2[i] = grads[i, _G_OFFSET]
            if g_view:
                gR = wp.outer(gc, mean) + gB * wp.transpose(p.local)
                for a in range(3):
                    for j in range(3):
                        g_view[i, 4 * a + j] = gR[a, j]
                    g_view[i, 4 * a + 3] = gc[a]
        else:
            g_means[i] = wp.vec3()
            g_log_scales[i] = wp.vec3()
            g_quats[i] = wp.vec4()
            g_b2[i] = f(0.0)
            for k in range(neurons):
                g_W1[i, k] = wp.vec3()
                g_b1[i, k] = f(0.0)
                g_w2[i, k] = f(0.0)
            if g_view:
                for c in range(12):
                    g_view[i, c] = d(0.0)

    return backward


def prepare_backward(frame: Frame, grads: Tensor, want_view: bool = False) -> tuple[tuple[Tensor, ...], Tensor | None]:
    """Return float32 gradients of the parameters, and with ``want_view`` the (3, 4) float64 gradient of (R | t).

    (R | t) is the camera's rotation and translation. ``grads`` are the (N, gradient_width) float32 gradient rows that
    the pixel kernels write. A row whose column G_WEIGHT is 0 gives zero gradients.
    """
    out = tuple(torch.empty(x.shape, dtype=torch.float32, device=x.device) for x in frame.parameters)
    g_view = torch.empty(grads.shape[0], 12, dtype=torch.float64, device=grads.device) if want_view else None
    p = frame.projection
    launch_kernel(
        _prepare_backward_kernel(frame.double), grads.shape[0],
        (
            *frame.inputs, array(p.matrix, wp.float64), p.intrinsics, p.near, p.turns, frame.neurons,
            array(grads.contiguous(), wp.float32),
            *rasterizer_parameter_arrays(out), None if g_view is None else array(g_view, wp.float64),
        ), grads.device, PER_BLOCK,
    )  # fmt: skip
    return out, None if g_view is None else g_view.sum(0).view(3, 4)
