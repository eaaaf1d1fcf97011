"""CPU kernels of :func:`~neuprim.tasks.relight.surface.surface_colors`, forward and backward, float64 inside."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute.kernels import exact_kernel, strict
from neuprim.core.compute.threads import apply_kernel_operation, parallel_for
from neuprim.core.model.colour_constants import LOG_LIMIT
from neuprim.core.model.colours_cpu import lobe_weight
from neuprim.tasks.relight.surface_constants import GATE, SHORTEST, WRAP

_CHUNK = 2048  # primitives per unit of work


@strict
def _unit(x, y, z, shortest):  # type: ignore[no-untyped-def]
    """Divide a vector by max(length, ``shortest``); return the quotient, the inverse of the divisor, and 1.0 or 0.0.

    The last value is 1.0 if the result has unit length. The backward pass needs it: the gradient of a normalised vector
    has no component along the vector. NaN stays NaN.
    """
    length, whole = np.sqrt(x * x + y * y + z * z), 1.0
    if not length >= shortest:
        length, whole = shortest, 0.0
    over = 1.0 / length
    return x * over, y * over, z * over, over, whole


@strict
def _project_gradient(g, i, unit):  # type: ignore[no-untyped-def]
    """Convert row i of ``g`` in place: from the gradient of a normalised vector to the gradient of the original vector.

    ``unit`` is the result of :func:`_unit` for the original vector.
    """
    x, y, z, over, whole = unit
    along = (g[i, 0] * x + g[i, 1] * y + g[i, 2] * z) * whole
    g[i, 0], g[i, 1], g[i, 2] = (g[i, 0] - along * x) * over, (g[i, 1] - along * y) * over, (g[i, 2] - along * z) * over


@strict
def _directions(i, means, sizes, normal, light, eye):  # type: ignore[no-untyped-def]
    """Return four results of :func:`_unit` for primitive i.

    These are the unit normal, the directions to the light and to the camera, and the half vector of these directions.
    """
    shortest = SHORTEST * np.float64(sizes[i])
    n = _unit(np.float64(normal[i, 0]), np.float64(normal[i, 1]), np.float64(normal[i, 2]), SHORTEST)
    l = _unit(light[0] - means[i, 0], light[1] - means[i, 1], light[2] - means[i, 2], shortest)
    v = _unit(eye[0] - means[i, 0], eye[1] - means[i, 1], eye[2] - means[i, 2], shortest)
    return n, l, v, _unit(l[0] + v[0], l[1] + v[1], l[2] + v[2], SHORTEST)


@strict
def _positive(value):  # type: ignore[no-untyped-def]
    """Return max(0, value); NaN stays NaN."""
    return 0.0 if value < 0.0 else np.float64(value)


@exact_kernel
def _surface_colors(  # type: ignore[no-untyped-def]
    start, stop, means, sizes, normal, albedo, highlight, log_gloss, indirect, light, eye, color
):
    """Fill ``color`` (N, 2, C) of primitives ``start:stop``; for arguments and result see ``surface_colors``."""
    lobes, numbers = log_gloss.shape[1], indirect.shape[1]
    weights = np.empty(lobes)
    for i in range(start, stop):
        n, l, _, h = _directions(i, means, sizes, normal, light, eye)
        cosine = n[0] * l[0] + n[1] * l[1] + n[2] * l[2]
        near = n[0] * h[0] + n[1] * h[1] + n[2] * h[2] - 1.0
        diffuse = 0.5 * (cosine + np.sqrt(cosine * cosine + WRAP))
        gate = 1.0 / (1.0 + np.exp(-GATE * cosine))
        for j in range(lobes):
            weights[j] = gate * lobe_weight(near, np.float64(log_gloss[i, j]))[0]
        for c in range(albedo.shape[1]):
            value = _positive(albedo[i, c]) * diffuse
            for j in range(lobes):
                value += _positive(highlight[i, j, c]) * weights[j]
            color[i, 0, c] = value
            value = np.float64(indirect[i, 0, c]) if numbers else 0.0
            for b in range(1, numbers):
                value += l[b - 1] * indirect[i, b, c]
            color[i, 1, c] = _positive(value)


@exact_kernel
def _surface_colors_backward(  # type: ignore[no-untyped-def]
    start, stop, means, sizes, normal, albedo, highlight, log_gloss, indirect, light, eye, grad,
    g_light, g_eye, g_normal, g_albedo, g_highlight, g_log_gloss, g_indirect,
):  # fmt: skip
    """Write the gradients ``g_...`` of primitives start to stop, from ``grad`` (N, 2, C), the gradient of the colours.

    ``g_light`` and ``g_eye`` (N, 3) are gradients with respect to the vectors from each primitive to light and camera.
    """
    lobes, numbers, channels = log_gloss.shape[1], indirect.shape[1], albedo.shape[1]
    g_l = np.empty(3)
    for i in range(start, stop):
        n, l, v, h = _directions(i, means, sizes, normal, light, eye)
        cosine = n[0] * l[0] + n[1] * l[1] + n[2] * l[2]
        between = n[0] * h[0] + n[1] * h[1] + n[2] * h[2]
        root, gate = np.sqrt(cosine * cosine + WRAP), 1.0 / (1.0 + np.exp(-GATE * cosine))
        pull = 0.0
        for c in range(channels):
            g = np.float64(grad[i, 0, c])
            g_albedo[i, c] = 0.5 * (cosine + root) * g if albedo[i, c] >= 0.0 else 0.0
            pull += _positive(albedo[i, c]) * g
        g_cosine, g_between = 0.5 * (1.0 + cosine / root) * pull, 0.0
        for j in range(lobes):
            log = np.float64(log_gloss[i, j])
            weight, near, sharpness = lobe_weight(between - 1.0, log)
            pull = 0.0
            for c in range(channels):
                g = np.float64(grad[i, 0, c])
                g_highlight[i, j, c] = gate * weight * g if highlight[i, j, c] >= 0.0 else 0.0
                pull += _positive(highlight[i, j, c]) * g
            g_cosine += GATE * gate * (1.0 - gate) * weight * pull
            pull *= gate * weight
            g_log_gloss[i, j] = pull * sharpness * near if abs(log) <= LOG_LIMIT else 0.0
            if between <= 1.0:  # above 1 by rounding only: the gradient across the normal is 0
                g_between += pull * sharpness
        g_l[:] = 0.0
        if numbers:
            for c in range(channels):
                value = np.float64(indirect[i, 0, c])
                for b in range(1, numbers):
                    value += l[b - 1] * indirect[i, b, c]
                g = np.float64(grad[i, 1, c] if value >= 0.0 else 0.0)
                g_indirect[i, 0, c] = g
                for b in range(1, numbers):
                    g_indirect[i, b, c] = l[b - 1] * g
                    g_l[b - 1] += indirect[i, b, c] * g
        along = g_between * between * h[4]
        for a in range(3):
            half = (g_between * n[a] - along * h[a]) * h[3]
            g_light[i, a] = g_l[a] + g_cosine * n[a] + half
            g_eye[i, a] = half
            g_normal[i, a] = g_cosine * l[a] + g_between * h[a]
        _project_gradient(g_light, i, l)
        _project_gradient(g_eye, i, v)
        _project_gradient(g_normal, i, n)


class _SurfaceColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:  # type: ignore[override]
        *own, light, eye = tensors
        ctx.arrays = [x.detach().contiguous().numpy() for x in own]
        ctx.arrays += [x.detach().double().numpy() for x in (light, eye)]
        ctx.places = (light.dtype, eye.dtype)
        count, channels = own[3].shape
        color = np.empty((count, 2, channels), np.float32)
        parallel_for(_surface_colors, count, _CHUNK, 0, *ctx.arrays, color)
        return torch.from_numpy(color)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        means, _, _, *others = ctx.arrays[:-2]
        g_light, g_eye, g_normal = (np.empty(means.shape) for _ in range(3))
        made = [np.empty_like(x) for x in others]
        args = (*ctx.arrays, grad.contiguous().numpy(), g_light, g_eye, g_normal, *made)
        parallel_for(_surface_colors_backward, len(means), _CHUNK, 0, *args)
        vectors = [torch.from_numpy(g).float() for g in (-(g_light + g_eye), g_normal)]
        places = [torch.from_numpy(g.sum(0)).to(dtype) for g, dtype in zip((g_light, g_eye), ctx.places, strict=True)]
        return (vectors[0], None, vectors[1], *map(torch.from_numpy, made), *places)


def fused_surface_colors(*tensors: Tensor) -> Tensor:
    """Compute :func:`~neuprim.tasks.relight.surface.surface_colors` of float32 CPU tensors; differentiable."""
    result: Tensor = apply_kernel_operation(_SurfaceColors, *tensors)
    return result
