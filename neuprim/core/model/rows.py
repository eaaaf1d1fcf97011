"""Rows of many tensors as one differentiable operation. Rows ascend, so that a gradient is written in one pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.kernels import exact_kernel, strict
from neuprim.core.compute.threads import apply_kernel_operation, kernel_needs_grad, parallel_for

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
def fill_ellipsoid_rotation(q, out):  # type: ignore[no-untyped-def]
    w, x, y, z = (
        np.float64(q[0]),
        np.float64(q[1]),
        np.float64(q[2]),
        np.float64(q[3]),
    )  # float32 squares would scale the rotation
    n = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * n, x * n, y * n, z * n
    out[0, 0] = 1 - 2 * (y * y + z * z)
    out[0, 1] = 2 * (x * y - w * z)
    out[0, 2] = 2 * (x * z + w * y)
    out[1, 0] = 2 * (x * y + w * z)
    out[1, 1] = 1 - 2 * (x * x + z * z)
    out[1, 2] = 2 * (y * z - w * x)
    out[2, 0] = 2 * (x * z - w * y)
    out[2, 1] = 2 * (y * z + w * x)
    out[2, 2] = 1 - 2 * (x * x + y * y)
    return n


@strict
def ellipsoid_rotation_backward(q, n, g, out):  # type: ignore[no-untyped-def]
    """dL/dq from dL/dR; the normalisation projects out the radial part."""
    w, x, y, z = q[0] * n, q[1] * n, q[2] * n, q[3] * n
    gw = 2 * (x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]))
    gx = 2 * (w * (g[2, 1] - g[1, 2]) + y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) - 2 * x * (g[1, 1] + g[2, 2]))
    gy = 2 * (w * (g[0, 2] - g[2, 0]) + x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) - 2 * y * (g[0, 0] + g[2, 2]))
    gz = 2 * (w * (g[1, 0] - g[0, 1]) + x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) - 2 * z * (g[0, 0] + g[1, 1]))
    dot = gw * w + gx * x + gy * y + gz * z
    out[0] = (gw - dot * w) * n
    out[1] = (gx - dot * x) * n
    out[2] = (gy - dot * y) * n
    out[3] = (gz - dot * z) * n


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
