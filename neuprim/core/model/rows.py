"""Compiled CPU kernels that run per primitive: gather rows of tensors, convert quaternions, multiply by gains.

A row holds the values of one primitive. Row indices must ascend, so that the backward pass can fill a gradient in one
run from the first row to the last.
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

_FEW = 4096  # for fewer rows without a gradient, torch is faster than starting the kernels


def take_primitive_rows(tensors: Mapping[str, Tensor], rows: Tensor) -> dict[str, Tensor]:
    """Return, by name, the rows with the indices ``rows`` (M,) of each of the ``tensors`` (N, ...).

    Differentiable once. Tensors are float32 or float64. ``rows`` must be ascending int64, which is not checked.
    """
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
    """Copy row n of ``taken`` (M, C) to row ``rows[n]`` of ``whole`` (N, C); all other rows become zero."""
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
    """Call kernel(rows, source, target) for each (source, target) in ``pairs``; the pairs are divided among threads.
    Arrays are reshaped to 2D, one row per primitive. Pairs with an empty array are skipped."""
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
                whole.zero_()  # no primitive is active, or the tensor is empty
        _each_primitive_table(_put_primitive_rows_kernel, ctx.rows, [(g.numpy(), whole.numpy()) for g, whole in known])
        return (None, *made)


@strict
def ellipsoid_rotation(w, x, y, z):  # type: ignore[no-untyped-def]
    """Return 1/|q| and the nine entries, row by row, of the rotation matrix of the float64 quaternion q = (w, x, y, z).
    In float32, rounding of the squares would change the scale of the matrix."""
    n = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * n, x * n, y * n, z * n
    return (
        n, 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@strict
def fill_ellipsoid_rotation(q, out):  # type: ignore[no-untyped-def]
    """Write the rotation matrix of a quaternion (4,) into ``out`` (3, 3); return 1/|q|."""
    n, xx, xy, xz, yx, yy, yz, zx, zy, zz = ellipsoid_rotation(
        np.float64(q[0]), np.float64(q[1]), np.float64(q[2]), np.float64(q[3])
    )
    out[0, 0], out[0, 1], out[0, 2], out[1, 0], out[1, 1], out[1, 2] = xx, xy, xz, yx, yy, yz
    out[2, 0], out[2, 1], out[2, 2] = zx, zy, zz
    return n


@strict
def quaternion_gradient(w, x, y, z, n, g):  # type: ignore[no-untyped-def]
    """Return the gradient dL/dq, four numbers, of a loss L by a quaternion q = (w, x, y, z).

    R is the rotation matrix of q. ``g`` holds the nine entries of dL/dR row by row, and ``n`` is 1/|q|. The result is
    perpendicular to q, because R does not depend on |q|.
    """
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
    """Write the gradient dL/dq of a loss L by the quaternion ``q`` (4,) into ``out`` (4,).

    ``g`` (3, 3) is the gradient dL/dR of the same loss by the rotation matrix R of ``q``, and ``n`` is 1/|q|.
    """
    rows = g[0, 0], g[0, 1], g[0, 2], g[1, 0], g[1, 1], g[1, 2], g[2, 0], g[2, 1], g[2, 2]
    out[0], out[1], out[2], out[3] = quaternion_gradient(q[0], q[1], q[2], q[3], n, rows)


@exact_kernel
def cosine_gain_backward(w2, b2, factor, p_w2, p_b2, g_w2, g_b2, pulled):  # type: ignore[no-untyped-def]
    """Run the backward pass of the products w2 * factor and b2 * factor, with w2 (N, K), b2 (N, 1), factor (N, 1).

    ``p_w2`` and ``p_b2`` are the gradients of the products. The kernel writes the gradients of w2, b2 and factor into
    ``g_w2``, ``g_b2`` and ``pulled``.
    """
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
    """Return amplitudes ``w2`` (N, K) and offsets ``b2`` (N, 1) of cosine densities, multiplied by exp(``log_gain``).
    ``log_gain`` (N, 1) is clamped to -``limit``..``limit``. All tensors have the same dtype."""
    if not device.on_numba(w2, b2, log_gain):
        gain = log_gain.clamp(-limit, limit).exp()
        return w2 * gain, b2 * gain
    result: tuple[Tensor, Tensor] = apply_kernel_operation(_CosineGain, w2, b2, log_gain, limit)
    return result
