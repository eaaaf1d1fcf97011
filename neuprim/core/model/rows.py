"""Compiled CPU work per primitive: rows of many tensors, rotations, gains and spherical-harmonics colours.

Rows ascend, so that a gradient is written in one pass.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.kernels import exact_kernel, strict
from neuprim.core.compute.threads import apply_kernel_operation, kernel_needs_grad, parallel_for
from neuprim.core.model.sh_constants import C0, C1, C2, C3

_FEW = 4096  # below, without a gradient, torch is done before a kernel would have begun with the last tensor


def take_primitive_rows(tensors: Mapping[str, Tensor], rows: Tensor) -> dict[str, Tensor]:
    """Rows (M,) int64, ascending, of ``tensors`` (N, ...), float32 or float64; differentiable, once. Not checked."""
    if not device.on_numba(rows, *tensors.values()) or (len(rows) < _FEW and not kernel_needs_grad(*tensors.values())):
        return {name: value.index_select(0, rows) for name, value in tensors.items()}
    return dict(zip(tensors, apply_kernel_operation(_PrimitiveRows, rows, *tensors.values()), strict=True))


@exact_kernel
def _take_primitive_rows_kernel(rows, whole, taken):  # type: ignore[no-untyped-def]
    for n in range(rows.shape[0]):
        for j in range(whole.shape[1]):
            taken[n, j] = whole[rows[n], j]


@exact_kernel
def _put_primitive_rows_kernel(rows, taken, whole):  # type: ignore[no-untyped-def]
    """Writes every row of ``whole``: zeros where there is none of ``taken``."""
    row = 0
    for n in range(rows.shape[0]):
        while row < rows[n]:
            for j in range(whole.shape[1]):
                whole[row, j] = 0.0
            row += 1
        for j in range(whole.shape[1]):
            whole[row, j] = taken[n, j]
        row += 1
    whole[row:] = 0.0


def _each_primitive_table(
    kernel: Callable[..., None], rows: np.ndarray, pairs: list[tuple[np.ndarray, np.ndarray]]
) -> None:
    """The kernel on each of ``pairs`` as tables, which are shared out among the threads."""
    tables = [tuple(x.reshape(len(x), -1) for x in pair) for pair in pairs if pair[0].size and pair[1].size]

    def share(start: int, stop: int) -> None:
        for source, target in tables[start:stop]:
            kernel(rows, source, target)

    parallel_for(share, len(tables), 1, 0)


class _PrimitiveRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        ctx.set_materialize_grads(False)
        ctx.rows, ctx.shapes = rows.numpy(), [x.shape for x in tensors]
        taken = [torch.empty((len(rows), *x.shape[1:]), dtype=x.dtype) for x in tensors]
        _each_primitive_table(
            _take_primitive_rows_kernel,
            ctx.rows,
            [(x.detach().contiguous().numpy(), y.numpy()) for x, y in zip(tensors, taken, strict=True)],
        )
        return tuple(taken)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        made = [
            None if g is None else torch.empty(shape, dtype=g.dtype)
            for g, shape in zip(gradients, ctx.shapes, strict=True)
        ]
        known = [
            (g.contiguous(), whole)
            for g, whole in zip(gradients, made, strict=True)
            if g is not None and whole is not None
        ]
        for g, whole in known:
            if not g.numel():
                whole.zero_()  # nothing lives, or nothing is there
        _each_primitive_table(_put_primitive_rows_kernel, ctx.rows, [(g.numpy(), whole.numpy()) for g, whole in known])
        return (None, *made)


@strict
def ellipsoid_rotation(w, x, y, z):  # type: ignore[no-untyped-def]
    """Return 1/|q| and the rotation of a float64 quaternion, row by row: float32 squares would scale it."""
    n = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * n, x * n, y * n, z * n
    return (
        n, 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@strict
def fill_ellipsoid_rotation(q, out):  # type: ignore[no-untyped-def]
    """The same into ``out`` (3, 3); returns 1/|q|."""
    n, xx, xy, xz, yx, yy, yz, zx, zy, zz = ellipsoid_rotation(
        np.float64(q[0]), np.float64(q[1]), np.float64(q[2]), np.float64(q[3])
    )
    out[0, 0], out[0, 1], out[0, 2], out[1, 0], out[1, 1], out[1, 2] = xx, xy, xz, yx, yy, yz
    out[2, 0], out[2, 1], out[2, 2] = zx, zy, zz
    return n


@strict
def quaternion_gradient(w, x, y, z, n, g):  # type: ignore[no-untyped-def]
    """dL/dq from dL/dR, row by row, and 1/|q|; the normalisation projects out the radial part."""
    g00, g01, g02, g10, g11, g12, g20, g21, g22 = g
    w, x, y, z = w * n, x * n, y * n, z * n
    gw = 2 * (x * (g21 - g12) + y * (g02 - g20) + z * (g10 - g01))
    gx = 2 * (w * (g21 - g12) + y * (g01 + g10) + z * (g02 + g20) - 2 * x * (g11 + g22))
    gy = 2 * (w * (g02 - g20) + x * (g01 + g10) + z * (g12 + g21) - 2 * y * (g00 + g22))
    gz = 2 * (w * (g10 - g01) + x * (g02 + g20) + y * (g12 + g21) - 2 * z * (g00 + g11))
    dot = gw * w + gx * x + gy * y + gz * z
    return (gw - dot * w) * n, (gx - dot * x) * n, (gy - dot * y) * n, (gz - dot * z) * n


@strict
def ellipsoid_rotation_backward(q, n, g, out):  # type: ignore[no-untyped-def]
    """The same of ``g`` (3, 3) into ``out`` (4,)."""
    rows = g[0, 0], g[0, 1], g[0, 2], g[1, 0], g[1, 1], g[1, 2], g[2, 0], g[2, 1], g[2, 2]
    out[0], out[1], out[2], out[3] = quaternion_gradient(q[0], q[1], q[2], q[3], n, rows)


@exact_kernel
def cosine_gain_backward(w2, b2, factor, p_w2, p_b2, g_w2, g_b2, pulled):  # type: ignore[no-untyped-def]
    """Gradients of (w2, b2), (N, K) and (N, 1), times ``factor`` (N, 1), and of the factor, ``pulled``."""
    for n in range(b2.shape[0]):
        total = np.float64(p_b2[n, 0]) * b2[n, 0]
        g_b2[n, 0] = p_b2[n, 0] * factor[n, 0]
        for k in range(w2.shape[1]):
            total += np.float64(p_w2[n, k]) * w2[n, k]
            g_w2[n, k] = p_w2[n, k] * factor[n, 0]
        pulled[n, 0] = total


class _CosineGain(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, w2: Tensor, b2: Tensor, log_gain: Tensor, limit: float) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        gain = log_gain.clamp(-limit, limit).exp()
        ctx.save_for_backward(w2, b2, log_gain, gain)
        ctx.limit = limit
        return w2 * gain, b2 * gain

    @staticmethod
    def backward(ctx: Any, p_w2: Tensor, p_b2: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        w2, b2, log_gain, gain = ctx.saved_tensors
        g_w2, g_b2, pulled = (torch.empty(x.shape, dtype=x.dtype) for x in (w2, b2, gain))
        given = (x.detach().contiguous().numpy() for x in (w2, b2, gain, p_w2, p_b2))
        cosine_gain_backward(*given, g_w2.numpy(), g_b2.numpy(), pulled.numpy())
        return g_w2, g_b2, (pulled * gain).masked_fill_(log_gain.abs() > ctx.limit, 0.0), None


def fused_cosine_gain(w2: Tensor, b2: Tensor, log_gain: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """(w2, b2), (N, K) and (N, 1), times exp(log_gain), (N, 1), clamped to ``limit``; one dtype."""
    if not device.on_numba(w2, b2, log_gain):
        gain = log_gain.clamp(-limit, limit).exp()
        return w2 * gain, b2 * gain
    result: tuple[Tensor, Tensor] = apply_kernel_operation(_CosineGain, w2, b2, log_gain, limit)
    return result


_CHUNK = 8192  # primitives per unit of work: a quarter of a millisecond, beside what waking a thread takes


@strict
def _basis(x, y, z, degree, Y):  # type: ignore[no-untyped-def]
    """Bands 1..degree of sh.basis at a unit direction, into Y[0:15]."""
    Y[0], Y[1], Y[2] = -C1 * y, C1 * z, -C1 * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        Y[3], Y[4], Y[5], Y[6], Y[7] = (
            C2[0] * x * y,
            C2[1] * y * z,
            C2[2] * (2 * zz - xx - yy),
            C2[3] * x * z,
            C2[4] * (xx - yy),
        )
        if degree >= 3:
            Y[8], Y[9] = C3[0] * y * (3 * xx - yy), C3[1] * x * y * z
            Y[10], Y[11], Y[12] = (
                C3[2] * y * (4 * zz - xx - yy),
                C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
                C3[4] * x * (4 * zz - xx - yy),
            )
            Y[13], Y[14] = C3[5] * z * (xx - yy), C3[6] * x * (xx - 3 * yy)


@strict
def _basis_gradient(x, y, z, degree, g, out):  # type: ignore[no-untyped-def]
    """out = sum_k g[k] dY_k/d(x, y, z), the basis taken as polynomials of a free direction."""
    gx, gy, gz = -C1 * g[2], -C1 * g[0], C1 * g[1]
    if degree >= 2:
        a, b, c, d, e = C2[0] * g[3], C2[1] * g[4], C2[2] * g[5], C2[3] * g[6], C2[4] * g[7]
        gx += a * y - 2 * c * x + d * z + 2 * e * x
        gy += a * x + b * z - 2 * c * y - 2 * e * y
        gz += b * y + 4 * c * z + d * x
        if degree >= 3:
            xx, yy, zz = x * x, y * y, z * z
            a, b, c, d = C3[0] * g[8], C3[1] * g[9], C3[2] * g[10], C3[3] * g[11]
            e, f, h = C3[4] * g[12], C3[5] * g[13], C3[6] * g[14]
            gx += (
                6 * a * x * y
                + b * y * z
                - 2 * c * x * y
                - 6 * d * x * z
                + e * (4 * zz - 3 * xx - yy)
                + 2 * f * x * z
                + 3 * h * (xx - yy)
            )
            gy += (
                3 * a * (xx - yy)
                + b * x * z
                + c * (4 * zz - xx - 3 * yy)
                - 6 * d * y * z
                - 2 * e * x * y
                - 2 * f * y * z
                - 6 * h * x * y
            )
            gz += b * x * y + 8 * c * y * z + d * (6 * zz - 3 * xx - 3 * yy) + 8 * e * x * z + f * (xx - yy)
    out[0], out[1], out[2] = gx, gy, gz


@exact_kernel
def _harmonic_colors(start, stop, means, dc, rest, origin, degree, color):  # type: ignore[no-untyped-def]
    bands = (degree + 1) * (degree + 1) - 1
    C = dc.shape[1]
    Y = np.empty(15)
    for i in range(start, stop):
        x, y, z = means[i, 0] - origin[0], means[i, 1] - origin[1], means[i, 2] - origin[2]
        n = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-30)
        _basis(x * n, y * n, z * n, degree, Y)
        for c in range(C):
            value = C0 * dc[i, c] + 0.5
            for k in range(bands):
                value += Y[k] * rest[i, k, c]
            color[i, c] = max(value, 0.0)


@exact_kernel
def _harmonic_colors_backward(start, stop, means, rest, origin, degree, color, grad, g_means, g_dc, g_rest):  # type: ignore[no-untyped-def]
    bands = (degree + 1) * (degree + 1) - 1
    C = color.shape[1]
    Y, gY, gd = np.empty(15), np.empty(15), np.empty(3)
    for i in range(start, stop):
        x, y, z = means[i, 0] - origin[0], means[i, 1] - origin[1], means[i, 2] - origin[2]
        n = 1.0 / max(np.sqrt(x * x + y * y + z * z), 1e-30)
        x, y, z = x * n, y * n, z * n
        _basis(x, y, z, degree, Y)
        gY[:] = 0.0
        g_rest[i, bands:] = 0.0
        for c in range(C):
            g = np.float64(grad[i, c]) if color[i, c] > 0 else 0.0
            g_dc[i, c] = C0 * g
            for k in range(bands):
                g_rest[i, k, c] = Y[k] * g
                gY[k] += g * rest[i, k, c]
        _basis_gradient(x, y, z, degree, gY, gd)
        radial = gd[0] * x + gd[1] * y + gd[2] * z
        g_means[i, 0], g_means[i, 1], g_means[i, 2] = (
            (gd[0] - radial * x) * n,
            (gd[1] - radial * y) * n,
            (gd[2] - radial * z) * n,
        )


class _HarmonicColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, dc: Tensor, rest: Tensor, origin: Tensor, degree: int) -> Tensor:  # type: ignore[override]
        ctx.arrays = [x.detach().contiguous().numpy() for x in (means, rest)]
        ctx.origin, ctx.degree = origin.detach().double().numpy(), degree
        color = np.empty(dc.shape, np.float32)
        parallel_for(
            _harmonic_colors,
            len(color),
            _CHUNK,
            0,
            ctx.arrays[0],
            dc.detach().contiguous().numpy(),
            ctx.arrays[1],
            ctx.origin,
            degree,
            color,
        )
        ctx.color = color
        return torch.from_numpy(color)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        means, rest = ctx.arrays
        g_means, g_dc, g_rest = np.empty_like(means), np.empty_like(ctx.color), np.empty_like(rest)
        args = (means, rest, ctx.origin, ctx.degree, ctx.color, grad.contiguous().numpy(), g_means, g_dc, g_rest)
        parallel_for(_harmonic_colors_backward, len(means), _CHUNK, 0, *args)
        view = torch.from_numpy(-g_means.sum(0, dtype=np.float64)) if ctx.needs_input_grad[3] else None
        return torch.from_numpy(g_means), torch.from_numpy(g_dc), torch.from_numpy(g_rest), view, None


def fused_harmonic_colors(means: Tensor, dc: Tensor, rest: Tensor, origin: Tensor, degree: int) -> Tensor:
    """:func:`~neuprim.core.model.sh.sh_colors` of float32 CPU tensors, degree 1..3; differentiable."""
    result: Tensor = apply_kernel_operation(_HarmonicColors, means, dc, rest, origin, degree)
    return result
