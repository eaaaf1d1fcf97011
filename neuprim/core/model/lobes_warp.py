# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Lobe colours on a GPU, a thread a primitive, float64 inside: the twin of ``model.lobes_cpu``."""

from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.warp import OPTIONS, array, launch_kernel, wp
from neuprim.core.model.lobes_constants import LOG_LIMIT, MOST_LOBES, SHORTEST
from neuprim.core.model.sh_constants import C0

d, f = wp.float64, wp.float32
_vec8 = wp.types.vector(length=MOST_LOBES, dtype=wp.float64)
_C0, _LIMIT, _SHORTEST = wp.constant(d(C0)), wp.constant(d(LOG_LIMIT)), wp.constant(d(SHORTEST))


@wp.func
def _one_over(v: wp.vec3d):
    """The reciprocal of a length; zero where there is no direction."""
    length = wp.length(v)
    if length > _SHORTEST:
        return d(1.0) / length
    return d(0.0)


@wp.func
def _sharpness(log_sharpness: float):
    value = d(log_sharpness)
    if value > _LIMIT:
        value = _LIMIT
    if value < -_LIMIT:
        value = -_LIMIT
    return wp.exp(value)


@wp.func
def _nearness(cosine: wp.float64):
    if cosine > d(1.0):
        return d(0.0)
    return cosine - d(1.0)


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def _forward(
    means: wp.array(dtype=wp.vec3), dc: wp.array2d(dtype=float), amplitude: wp.array3d(dtype=float),
    axis: wp.array2d(dtype=wp.vec3), log_sharpness: wp.array2d(dtype=float), origin: wp.array(dtype=wp.float64),
    color: wp.array2d(dtype=float),
):  # fmt: skip
    i = wp.tid()
    offset = wp.vec3d(means[i]) - wp.vec3d(origin[0], origin[1], origin[2])
    direction = _one_over(offset) * offset
    weights = _vec8()
    for j in range(axis.shape[1]):
        m = wp.vec3d(axis[i, j])
        cosine = _one_over(m) * wp.dot(m, direction)
        weights[j] = wp.exp(_sharpness(log_sharpness[i, j]) * _nearness(cosine))
    for c in range(color.shape[1]):
        value = _C0 * d(dc[i, c]) + d(0.5)
        for j in range(axis.shape[1]):
            value += weights[j] * d(amplitude[i, j, c])
        if value < d(0.0):
            value = d(0.0)
        color[i, c] = f(value)


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def _backward(
    means: wp.array(dtype=wp.vec3), amplitude: wp.array3d(dtype=float), axis: wp.array2d(dtype=wp.vec3),
    log_sharpness: wp.array2d(dtype=float), origin: wp.array(dtype=wp.float64), color: wp.array2d(dtype=float),
    grad: wp.array2d(dtype=float), g_means: wp.array(dtype=wp.vec3), g_dc: wp.array2d(dtype=float),
    g_amplitude: wp.array3d(dtype=float), g_axis: wp.array2d(dtype=wp.vec3), g_log_sharpness: wp.array2d(dtype=float),
):  # fmt: skip
    i = wp.tid()
    offset = wp.vec3d(means[i]) - wp.vec3d(origin[0], origin[1], origin[2])
    near = _one_over(offset)
    direction = near * offset
    for c in range(color.shape[1]):
        g_dc[i, c] = 0.0
        if color[i, c] > 0.0:
            g_dc[i, c] = f(_C0 * d(grad[i, c]))
    free = wp.vec3d()
    for j in range(axis.shape[1]):
        m = wp.vec3d(axis[i, j])
        over = _one_over(m)
        m = over * m
        cosine = wp.dot(m, direction)
        sharpness, nearness = _sharpness(log_sharpness[i, j]), _nearness(cosine)
        weight = wp.exp(sharpness * nearness)
        pull = d(0.0)
        for c in range(color.shape[1]):
            g = d(0.0)
            if color[i, c] > 0.0:
                g = d(grad[i, c])
            g_amplitude[i, j, c] = f(weight * g)
            pull += d(amplitude[i, j, c]) * g
        pull *= weight * sharpness
        g_log_sharpness[i, j] = 0.0
        if wp.abs(d(log_sharpness[i, j])) <= _LIMIT:
            g_log_sharpness[i, j] = f(pull * nearness)
        if cosine > d(1.0):  # by rounding: the gradient across the direction is zero there
            pull = d(0.0)
        g_axis[i, j] = wp.vec3(pull * over * (direction - cosine * m))
        free += pull * m
    g_means[i] = wp.vec3(near * (free - wp.dot(free, direction) * direction))


class _LobeColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        means, dc, amplitude, axis, log_sharpness, origin = (x.detach().contiguous() for x in tensors)
        centre = device.to_device_like(origin.double(), means.double())
        color = torch.empty(dc.shape, dtype=torch.float32, device=dc.device)
        ctx.tensors = (means, amplitude, axis, log_sharpness, centre, color)
        ctx.origin = (tensors[-1].dtype, tensors[-1].device)
        launch_kernel(
            _forward, len(means),
            (
                array(means, wp.vec3), array(dc, wp.float32), array(amplitude, wp.float32), array(axis, wp.vec3),
                array(log_sharpness, wp.float32), array(centre, wp.float64), array(color, wp.float32),
            ), means.device,
        )  # fmt: skip
        return color

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
        means, amplitude, axis, log_sharpness, centre, color = ctx.tensors
        made = [torch.empty_like(x) for x in (means, color, amplitude, axis, log_sharpness)]
        g_means, g_dc, g_amplitude, g_axis, g_log_sharpness = made
        launch_kernel(
            _backward, len(means),
            (
                array(means, wp.vec3), array(amplitude, wp.float32), array(axis, wp.vec3),
                array(log_sharpness, wp.float32), array(centre, wp.float64), array(color, wp.float32),
                array(grad.contiguous(), wp.float32), array(g_means, wp.vec3), array(g_dc, wp.float32),
                array(g_amplitude, wp.float32), array(g_axis, wp.vec3), array(g_log_sharpness, wp.float32),
            ), means.device,
        )  # fmt: skip
        dtype, place = ctx.origin
        view = -g_means.sum(0, dtype=torch.float64).to(place, dtype) if ctx.needs_input_grad[-1] else None
        return (*made, view)


def fused_lobe_colors(
    means: Tensor, dc: Tensor, amplitude: Tensor, axis: Tensor, log_sharpness: Tensor, origin: Tensor
) -> Tensor:
    """:func:`~neuprim.core.model.lobes.lobe_colors` of float32 GPU tensors, at least one lobe; differentiable."""
    result: Tensor = _LobeColors.apply(means, dc, amplitude, axis, log_sharpness, origin)
    return result
