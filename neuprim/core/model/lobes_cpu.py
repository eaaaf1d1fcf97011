"""Compiled CPU kernels of lobe colours, forward and backward, float64 inside: :mod:`neuprim.core.model.lobes`."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute.kernels import exact_kernel, strict
from neuprim.core.compute.threads import apply_kernel_operation, parallel_for
from neuprim.core.model.lobes_constants import LOG_LIMIT, SHORTEST
from neuprim.core.model.sh_constants import C0

_CHUNK = 8192  # primitives per unit of work


@strict
def _unit_or_zero(x, y, z):  # type: ignore[no-untyped-def]
    """A unit vector and the reciprocal of its length before; zeros where it has no direction."""
    length = np.sqrt(x * x + y * y + z * z)
    over = 1.0 / length if length > SHORTEST else 0.0
    return x * over, y * over, z * over, over


@strict
def _lobe_weight(nearness, log_sharpness):  # type: ignore[no-untyped-def]
    """Weight, nearness as clamped at 0, and sharpness. Comparisons are such that NaN stays NaN."""
    if log_sharpness > LOG_LIMIT:
        log_sharpness = LOG_LIMIT
    if log_sharpness < -LOG_LIMIT:
        log_sharpness = -LOG_LIMIT
    if nearness > 0.0:
        nearness = 0.0
    sharpness = np.exp(log_sharpness)
    return np.exp(sharpness * nearness), nearness, sharpness


@exact_kernel
def _lobe_colors(start, stop, means, dc, amplitude, axis, log_sharpness, origin, color):  # type: ignore[no-untyped-def]
    lobes, channels = amplitude.shape[1], amplitude.shape[2]
    weights = np.empty(lobes)
    for i in range(start, stop):
        dx, dy, dz, _ = _unit_or_zero(means[i, 0] - origin[0], means[i, 1] - origin[1], means[i, 2] - origin[2])
        for j in range(lobes):
            x, y, z, _ = _unit_or_zero(np.float64(axis[i, j, 0]), np.float64(axis[i, j, 1]), np.float64(axis[i, j, 2]))
            weights[j] = _lobe_weight(x * dx + y * dy + z * dz - 1.0, np.float64(log_sharpness[i, j]))[0]
        for c in range(channels):
            value = C0 * dc[i, c] + 0.5
            for j in range(lobes):
                value += weights[j] * amplitude[i, j, c]
            color[i, c] = 0.0 if value < 0.0 else value


@exact_kernel
def _lobe_colors_backward(  # type: ignore[no-untyped-def]
    start, stop, means, amplitude, axis, log_sharpness, origin, color, grad,
    g_means, g_dc, g_amplitude, g_axis, g_log_sharpness,
):  # fmt: skip
    lobes, channels = amplitude.shape[1], amplitude.shape[2]
    g_color = np.empty(channels)
    for i in range(start, stop):
        dx, dy, dz, near = _unit_or_zero(means[i, 0] - origin[0], means[i, 1] - origin[1], means[i, 2] - origin[2])
        for c in range(channels):
            g_color[c] = grad[i, c] if color[i, c] > 0 else 0.0
            g_dc[i, c] = C0 * g_color[c]
        gx, gy, gz = 0.0, 0.0, 0.0
        for j in range(lobes):
            x, y, z, over = _unit_or_zero(
                np.float64(axis[i, j, 0]), np.float64(axis[i, j, 1]), np.float64(axis[i, j, 2])
            )
            cosine, log = x * dx + y * dy + z * dz, np.float64(log_sharpness[i, j])
            weight, nearness, sharpness = _lobe_weight(cosine - 1.0, log)
            pull = 0.0
            for c in range(channels):
                g_amplitude[i, j, c] = weight * g_color[c]
                pull += amplitude[i, j, c] * g_color[c]
            pull *= weight * sharpness
            g_log_sharpness[i, j] = pull * nearness if abs(log) <= LOG_LIMIT else 0.0
            if cosine > 1.0:  # by rounding: the gradient across the direction is zero there
                pull = 0.0
            g_axis[i, j, 0] = pull * (dx - cosine * x) * over
            g_axis[i, j, 1] = pull * (dy - cosine * y) * over
            g_axis[i, j, 2] = pull * (dz - cosine * z) * over
            gx, gy, gz = gx + pull * x, gy + pull * y, gz + pull * z
        along = gx * dx + gy * dy + gz * dz
        g_means[i, 0] = (gx - along * dx) * near
        g_means[i, 1] = (gy - along * dy) * near
        g_means[i, 2] = (gz - along * dz) * near


class _LobeColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:  # type: ignore[override]
        means, dc, *lobes, origin = tensors
        ctx.arrays = [x.detach().contiguous().numpy() for x in (means, *lobes)]
        ctx.origin = origin.detach().double().numpy()
        ctx.color = np.empty(dc.shape, np.float32)
        args = (ctx.arrays[0], dc.detach().contiguous().numpy(), *ctx.arrays[1:], ctx.origin, ctx.color)
        parallel_for(_lobe_colors, len(ctx.color), _CHUNK, 0, *args)
        return torch.from_numpy(ctx.color)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        means, *lobes = ctx.arrays
        made = [np.empty_like(x) for x in (means, ctx.color, *lobes)]
        args = (*ctx.arrays, ctx.origin, ctx.color, grad.contiguous().numpy(), *made)
        parallel_for(_lobe_colors_backward, len(means), _CHUNK, 0, *args)
        view = torch.from_numpy(-made[0].sum(0, dtype=np.float64)) if ctx.needs_input_grad[-1] else None
        return (*map(torch.from_numpy, made), view)


def fused_lobe_colors(
    means: Tensor, dc: Tensor, amplitude: Tensor, axis: Tensor, log_sharpness: Tensor, origin: Tensor
) -> Tensor:
    """:func:`~neuprim.core.model.lobes.lobe_colors` of float32 CPU tensors, at least one lobe; differentiable."""
    result: Tensor = apply_kernel_operation(_LobeColors, means, dc, amplitude, axis, log_sharpness, origin)
    return result
