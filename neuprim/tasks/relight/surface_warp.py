# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""CUDA kernels of ``surface.surface_colors``, one thread per primitive, in float64; for CPUs see ``surface_cpu``."""

from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.warp import OPTIONS, array, launch_kernel, wp
from neuprim.core.model.colour_constants import LOG_LIMIT
from neuprim.core.model.colours_warp import lobe_nearness, lobe_sharpness
from neuprim.tasks.relight.surface_constants import GATE, SHORTEST, WRAP

d, f = wp.float64, wp.float32
_WRAP, _GATE, _SHORTEST, _LIMIT = (wp.constant(d(x)) for x in (WRAP, GATE, SHORTEST, LOG_LIMIT))


@wp.func
def _over(v: wp.vec3d, shortest: wp.float64):
    """Return the factor 1 / max(length of v, ``shortest``), which normalises ``v``."""
    length = wp.length(v)
    if not length >= shortest:
        length = shortest
    return d(1.0) / length


@wp.func
def _pull_back(g: wp.vec3d, v: wp.vec3d, over: wp.float64, shortest: wp.float64):
    """Return the gradient with respect to ``v``, from the gradient ``g`` with respect to the unit vector ``over`` v.

    ``over`` is the result of :func:`_over` for ``v`` and ``shortest``.
    """
    if not wp.length(v) >= shortest:
        return over * g
    unit = over * v
    return over * (g - wp.dot(g, unit) * unit)


@wp.func
def _positive(value: float):
    """Return max(0, ``value``) as float64; NaN stays NaN."""
    if value < 0.0:
        return d(0.0)
    return d(value)


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def _forward(
    means: wp.array(dtype=wp.vec3), sizes: wp.array(dtype=float), normal: wp.array(dtype=wp.vec3),
    albedo: wp.array2d(dtype=float), highlight: wp.array3d(dtype=float), log_gloss: wp.array2d(dtype=float),
    indirect: wp.array3d(dtype=float), places: wp.array(dtype=wp.vec3d), color: wp.array3d(dtype=float),
):  # fmt: skip
    """Write the direct colour of primitive i to ``color[i, 0]``, and the indirect colour to ``color[i, 1]``.

    ``places`` has the positions of the light and of the camera.
    """
    i = wp.tid()
    shortest = _SHORTEST * d(sizes[i])
    n, l, v = wp.vec3d(normal[i]), places[0] - wp.vec3d(means[i]), places[1] - wp.vec3d(means[i])
    n, l, v = _over(n, _SHORTEST) * n, _over(l, shortest) * l, _over(v, shortest) * v
    h = l + v
    h = _over(h, _SHORTEST) * h
    cosine, near = wp.dot(n, l), lobe_nearness(wp.dot(n, h))
    diffuse = d(0.5) * (cosine + wp.sqrt(cosine * cosine + _WRAP))
    gate = d(1.0) / (d(1.0) + wp.exp(-_GATE * cosine))
    for c in range(albedo.shape[1]):
        value = _positive(albedo[i, c]) * diffuse
        for j in range(log_gloss.shape[1]):
            value += _positive(highlight[i, j, c]) * gate * wp.exp(lobe_sharpness(log_gloss[i, j]) * near)
        color[i, 0, c] = f(value)
        value = d(indirect[i, 0, c])
        for b in range(1, indirect.shape[1]):
            value += l[b - 1] * d(indirect[i, b, c])
        if value < d(0.0):
            value = d(0.0)
        color[i, 1, c] = f(value)


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def _backward(
    means: wp.array(dtype=wp.vec3), sizes: wp.array(dtype=float), normal: wp.array(dtype=wp.vec3),
    albedo: wp.array2d(dtype=float), highlight: wp.array3d(dtype=float), log_gloss: wp.array2d(dtype=float),
    indirect: wp.array3d(dtype=float), places: wp.array(dtype=wp.vec3d), grad: wp.array3d(dtype=float),
    g_places: wp.array2d(dtype=wp.vec3d), g_normal: wp.array(dtype=wp.vec3), g_albedo: wp.array2d(dtype=float),
    g_highlight: wp.array3d(dtype=float), g_log_gloss: wp.array2d(dtype=float), g_indirect: wp.array3d(dtype=float),
):  # fmt: skip
    """Write the gradients ``g_...`` of the arguments of :func:`_forward`, from ``grad``, the gradient of the colours.

    ``g_places[i]`` has gradients with respect to the vectors from primitive i to the light and to the camera.
    """
    i = wp.tid()
    shortest = _SHORTEST * d(sizes[i])
    own, to_light, to_eye = wp.vec3d(normal[i]), places[0] - wp.vec3d(means[i]), places[1] - wp.vec3d(means[i])
    over_n, over_l, over_v = _over(own, _SHORTEST), _over(to_light, shortest), _over(to_eye, shortest)
    n, l = over_n * own, over_l * to_light
    middle = l + over_v * to_eye
    over_h = _over(middle, _SHORTEST)
    h = over_h * middle
    cosine, between = wp.dot(n, l), wp.dot(n, h)
    near, root = lobe_nearness(between), wp.sqrt(cosine * cosine + _WRAP)
    gate = d(1.0) / (d(1.0) + wp.exp(-_GATE * cosine))
    pull = d(0.0)
    for c in range(albedo.shape[1]):
        g = d(grad[i, 0, c])
        pull += _positive(albedo[i, c]) * g
        g_albedo[i, c] = 0.0
        if albedo[i, c] >= 0.0:
            g_albedo[i, c] = f(d(0.5) * (cosine + root) * g)
    g_cosine, g_between = d(0.5) * (d(1.0) + cosine / root) * pull, d(0.0)
    for j in range(log_gloss.shape[1]):
        sharpness = lobe_sharpness(log_gloss[i, j])
        weight = wp.exp(sharpness * near)
        pull = d(0.0)
        for c in range(albedo.shape[1]):
            g = d(grad[i, 0, c])
            pull += _positive(highlight[i, j, c]) * g
            g_highlight[i, j, c] = 0.0
            if highlight[i, j, c] >= 0.0:
                g_highlight[i, j, c] = f(gate * weight * g)
        g_cosine += _GATE * gate * (d(1.0) - gate) * weight * pull
        pull *= gate * weight * sharpness
        g_log_gloss[i, j] = 0.0
        if wp.abs(d(log_gloss[i, j])) <= _LIMIT:
            g_log_gloss[i, j] = f(pull * near)
        if between <= d(1.0):  # above 1 by rounding only: the gradient across the normal is 0
            g_between += pull
    g_l = g_cosine * n
    for c in range(albedo.shape[1]):
        value = d(indirect[i, 0, c])
        for b in range(1, indirect.shape[1]):
            value += l[b - 1] * d(indirect[i, b, c])
        g = d(0.0)
        if value >= d(0.0):
            g = d(grad[i, 1, c])
        g_indirect[i, 0, c] = f(g)
        for b in range(1, indirect.shape[1]):
            g_indirect[i, b, c] = f(l[b - 1] * g)
            g_l[b - 1] += d(indirect[i, b, c]) * g
    half = _pull_back(g_between * n, middle, over_h, _SHORTEST)
    g_places[i, 0] = _pull_back(g_l + half, to_light, over_l, shortest)
    g_places[i, 1] = _pull_back(half, to_eye, over_v, shortest)
    g_normal[i] = wp.vec3(_pull_back(g_cosine * l + g_between * h, own, over_n, _SHORTEST))


def _arrays(means: Tensor, sizes: Tensor, normal: Tensor, *others: Tensor) -> tuple[Any, ...]:
    vectors = (array(means, wp.vec3), array(sizes, wp.float32), array(normal, wp.vec3))
    return (*vectors, *(array(other, wp.float32) for other in others))


class _SurfaceColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        own, places = [x.detach().contiguous() for x in tensors[:-2]], tensors[-2:]
        ctx.own, ctx.kinds = own, [(place.dtype, place.device) for place in places]
        ctx.places = torch.stack([device.to_device_like(place.detach().double(), own[0].double()) for place in places])
        count, channels = own[3].shape
        color = torch.empty((count, 2, channels), dtype=torch.float32, device=own[0].device)
        inputs = (*_arrays(*own), array(ctx.places, wp.vec3d), array(color, wp.float32))
        launch_kernel(_forward, count, inputs, own[0].device)
        return color

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
        means, _, normal, *others = ctx.own
        to_places = torch.empty((len(means), 2, 3), dtype=torch.float64, device=means.device)
        made = [torch.empty_like(x) for x in (normal, *others)]
        inputs = (*_arrays(*ctx.own), array(ctx.places, wp.vec3d), array(grad.contiguous(), wp.float32))
        inputs += (array(to_places, wp.vec3d), array(made[0], wp.vec3), *(array(x, wp.float32) for x in made[1:]))
        launch_kernel(_backward, len(means), inputs, means.device)
        sums = [g.to(place, dtype) for g, (dtype, place) in zip(to_places.sum(0), ctx.kinds, strict=True)]
        return (-to_places.sum(1).to(means), None, *made, *sums)


def fused_surface_colors(*tensors: Tensor) -> Tensor:
    """Compute :func:`~neuprim.tasks.relight.surface.surface_colors` on the GPU; differentiable.

    The arguments are those of ``surface_colors``, in the same order. All tensors but ``light`` and ``eye`` are float32
    CUDA tensors. There must be at least one lobe and one coefficient of indirect light.
    """
    result: Tensor = _SurfaceColors.apply(*tensors)
    return result
