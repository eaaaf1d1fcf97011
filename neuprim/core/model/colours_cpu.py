"""Compiled CPU kernels of view-dependent colours, forward and backward, with float64 arithmetic.

Colours are spherical harmonics (:mod:`neuprim.core.model.sh`) or lobes (:mod:`neuprim.core.model.lobes`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute.kernels import exact_kernel, strict
from neuprim.core.compute.threads import apply_kernel_operation, parallel_for
from neuprim.core.model.colour_constants import C0, C1, C2, C3, LOG_LIMIT, SHORTEST

_CHUNK = 8192  # primitives per unit of work: a quarter of a millisecond, long compared with waking a thread


@strict
def _basis(x, y, z, degree, Y):  # type: ignore[no-untyped-def]
    """Write the spherical harmonics of bands 1 to ``degree`` at the unit vector (x, y, z) into ``Y`` (15,)."""
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
    """Write sum_k g[k] dY_k/d(x, y, z) into ``out`` (3,), with Y the spherical harmonics that :func:`_basis` writes.

    The Y_k are differentiated as polynomials in x, y and z, as if the vector (x, y, z) could have any length.
    """
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
    """Fill ``color`` (N, C) of primitives ``start:stop``; see :func:`~neuprim.core.model.sh.sh_colors`."""
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
    """Return the (N, C) colours of :func:`~neuprim.core.model.sh.sh_colors`, computed by CPU kernels; differentiable.
    ``means``, ``dc`` and ``rest`` are float32 on the CPU; ``degree`` is 1 to 3."""
    result: Tensor = apply_kernel_operation(_HarmonicColors, means, dc, rest, origin, degree)
    return result


# ---------------------------------------------------------------- lobes


@strict
def _unit_or_zero(x, y, z):  # type: ignore[no-untyped-def]
    """Return the unit vector of (x, y, z) and 1/length, four numbers; all are 0 for a length of at most 1e-24."""
    length = np.sqrt(x * x + y * y + z * z)
    over = 1.0 / length if length > SHORTEST else 0.0
    return x * over, y * over, z * over, over


@strict
def lobe_weight(nearness, log_sharpness):  # type: ignore[no-untyped-def]
    """Return three numbers of a spherical Gaussian lobe: its weight exp(s n), the clamped nearness n, its sharpness s.

    ``nearness`` is the cosine between the lobe's axis and a direction, minus 1; n is ``nearness`` clamped to at most 0.
    The sharpness s is exp(``log_sharpness``), with the logarithm clamped to -20..20. NaN stays NaN.
    """
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
    """Fill ``color`` (N, C) of primitives ``start:stop``; see :func:`~neuprim.core.model.lobes.lobe_colors`."""
    lobes, channels = amplitude.shape[1], amplitude.shape[2]
    weights = np.empty(lobes)
    for i in range(start, stop):
        dx, dy, dz, _ = _unit_or_zero(means[i, 0] - origin[0], means[i, 1] - origin[1], means[i, 2] - origin[2])
        for j in range(lobes):
            x, y, z, _ = _unit_or_zero(np.float64(axis[i, j, 0]), np.float64(axis[i, j, 1]), np.float64(axis[i, j, 2]))
            weights[j] = lobe_weight(x * dx + y * dy + z * dz - 1.0, np.float64(log_sharpness[i, j]))[0]
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
            weight, nearness, sharpness = lobe_weight(cosine - 1.0, log)
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
    """Return the (N, C) colours of :func:`~neuprim.core.model.lobes.lobe_colors`, computed by CPU kernels;
    differentiable. All tensors except ``origin`` are float32 on the CPU. Each primitive has at least one lobe."""
    result: Tensor = apply_kernel_operation(_LobeColors, means, dc, amplitude, axis, log_sharpness, origin)
    return result
