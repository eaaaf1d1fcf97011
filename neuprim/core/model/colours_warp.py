# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""GPU kernels of view-dependent colours: spherical harmonics and spherical Gaussian lobes.

One thread computes one primitive, in float64. The CPU kernels are in :mod:`neuprim.core.model.colours_cpu`.
"""

import functools
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.warp import OPTIONS, array, launch_kernel, wp
from neuprim.core.model.colour_constants import C0, C1, C2, C3, LOG_LIMIT, MOST_LOBES, SHORTEST

d, f = wp.float64, wp.float32
_C0, _C1 = wp.constant(d(C0)), wp.constant(d(C1))
_vec15 = wp.types.vector(length=15, dtype=wp.float64)


@functools.cache
def _harmonic_functions(degree: int) -> tuple[Any, Any]:
    """Return two Warp functions: spherical harmonics up to ``degree``, and their gradient by the direction."""
    a0, a1, a2, a3, a4 = (d(c) for c in C2)
    b0, b1, b2, b3, b4, b5, b6 = (d(c) for c in C3)
    two, three, four, six, eight = d(2.0), d(3.0), d(4.0), d(6.0), d(8.0)

    @wp.func
    def basis(v: wp.vec3d):
        """Return the spherical harmonics of bands 1 to ``degree`` at the unit vector v."""
        x, y, z = v[0], v[1], v[2]
        Y = _vec15()
        Y[0] = -_C1 * y
        Y[1] = _C1 * z
        Y[2] = -_C1 * x
        xx, yy, zz = x * x, y * y, z * z
        if wp.static(degree >= 2):
            Y[3] = a0 * x * y
            Y[4] = a1 * y * z
            Y[5] = a2 * (two * zz - xx - yy)
            Y[6] = a3 * x * z
            Y[7] = a4 * (xx - yy)
        if wp.static(degree >= 3):
            Y[8] = b0 * y * (three * xx - yy)
            Y[9] = b1 * x * y * z
            Y[10] = b2 * y * (four * zz - xx - yy)
            Y[11] = b3 * z * (two * zz - three * xx - three * yy)
            Y[12] = b4 * x * (four * zz - xx - yy)
            Y[13] = b5 * z * (xx - yy)
            Y[14] = b6 * x * (xx - three * yy)
        return Y

    @wp.func
    def gradient(v: wp.vec3d, g: _vec15):
        """Return the vector sum_k g_k dY_k/dv, where Y = basis(v) is differentiated as if v could have any length."""
        x, y, z = v[0], v[1], v[2]
        out = wp.vec3d(-_C1 * g[2], -_C1 * g[0], _C1 * g[1])
        if wp.static(degree >= 2):
            p, q, r, s, t = a0 * g[3], a1 * g[4], a2 * g[5], a3 * g[6], a4 * g[7]
            out += wp.vec3d(
                p * y - two * r * x + s * z + two * t * x,
                p * x + q * z - two * r * y - two * t * y,
                q * y + four * r * z + s * x,
            )
        if wp.static(degree >= 3):
            xx, yy, zz = x * x, y * y, z * z
            i, j, k, l = b0 * g[8], b1 * g[9], b2 * g[10], b3 * g[11]
            m, n, o = b4 * g[12], b5 * g[13], b6 * g[14]
            out += wp.vec3d(
                six * i * x * y + j * y * z - two * k * x * y - six * l * x * z
                + m * (four * zz - three * xx - yy) + two * n * x * z
                + three * o * (xx - yy),
                three * i * (xx - yy) + j * x * z + k * (four * zz - xx - three * yy) - six * l * y * z
                - two * m * x * y - two * n * y * z
                - six * o * x * y,
                j * x * y + eight * k * y * z + l * (six * zz - three * xx - three * yy)
                + eight * m * x * z + n * (xx - yy),
            )  # fmt: skip
        return out

    return basis, gradient


@functools.cache
def _harmonic_kernels(degree: int) -> tuple[Any, Any]:
    """Return the forward and the backward kernel of :func:`fused_harmonic_colors`, one thread per primitive."""
    basis, basis_gradient = _harmonic_functions(degree)
    bands = (degree + 1) * (degree + 1) - 1

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def forward(
        means: wp.array(dtype=wp.vec3), dc: wp.array2d(dtype=float), rest: wp.array3d(dtype=float),
        origin: wp.array(dtype=wp.float64),
        color: wp.array2d(dtype=float),
    ):  # fmt: skip
        i = wp.tid()
        offset = wp.vec3d(means[i]) - wp.vec3d(origin[0], origin[1], origin[2])
        Y = basis(offset / wp.max(wp.length(offset), d(1e-30)))
        for c in range(color.shape[1]):
            value = _C0 * d(dc[i, c]) + d(0.5)
            for k in range(bands):
                value += Y[k] * d(rest[i, k, c])
            color[i, c] = f(wp.max(value, d(0.0)))

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def backward(
        means: wp.array(dtype=wp.vec3), rest: wp.array3d(dtype=float), origin: wp.array(dtype=wp.float64),
        color: wp.array2d(dtype=float),
        grad: wp.array2d(dtype=float), g_means: wp.array(dtype=wp.vec3), g_dc: wp.array2d(dtype=float),
        g_rest: wp.array3d(dtype=float),
    ):  # fmt: skip
        i = wp.tid()
        offset = wp.vec3d(means[i]) - wp.vec3d(origin[0], origin[1], origin[2])
        over = d(1.0) / wp.max(wp.length(offset), d(1e-30))
        v = over * offset
        Y = basis(v)
        gY = _vec15()
        for c in range(color.shape[1]):
            g = d(0.0)
            if color[i, c] > 0.0:
                g = d(grad[i, c])
            g_dc[i, c] = f(_C0 * g)
            for k in range(bands):
                g_rest[i, k, c] = f(Y[k] * g)
                gY[k] += g * d(rest[i, k, c])
            for k in range(bands, rest.shape[1]):
                g_rest[i, k, c] = 0.0
        free = basis_gradient(v, gY)
        g_means[i] = wp.vec3(over * (free - wp.dot(free, v) * v))

    return forward, backward


class _HarmonicColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, dc: Tensor, rest: Tensor, origin: Tensor, degree: int) -> Tensor:
        means, dc, rest = (x.detach().contiguous() for x in (means, dc, rest))
        centre = device.to_device_like(origin.detach(), means).double().contiguous()
        color = torch.empty(dc.shape, dtype=torch.float32, device=dc.device)
        arrays = (
            array(means, wp.vec3),
            array(dc, wp.float32),
            array(rest, wp.float32),
            array(centre, wp.float64),
            array(color, wp.float32),
        )
        launch_kernel(_harmonic_kernels(degree)[0], len(means), arrays, means.device)
        ctx.tensors = means, rest, centre, color.detach()  # the output itself would be a cycle
        ctx.degree, ctx.origin = degree, (origin.dtype, origin.device)
        return color

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
        means, rest, centre, color = ctx.tensors
        g_means, g_dc, g_rest = torch.empty_like(means), torch.empty_like(color), torch.empty_like(rest)
        launch_kernel(
            _harmonic_kernels(ctx.degree)[1], len(means),
            (
                array(means, wp.vec3), array(rest, wp.float32), array(centre, wp.float64), array(color, wp.float32),
                array(grad.contiguous(), wp.float32), array(g_means, wp.vec3), array(g_dc, wp.float32),
                array(g_rest, wp.float32),
            ), means.device,
        )  # fmt: skip
        dtype, place = ctx.origin
        view = -g_means.sum(0, dtype=torch.float64).to(place, dtype) if ctx.needs_input_grad[3] else None
        return g_means, g_dc, g_rest, view, None


def fused_harmonic_colors(means: Tensor, dc: Tensor, rest: Tensor, origin: Tensor, degree: int) -> Tensor:
    """Return the (N, C) colours of :func:`~neuprim.core.model.sh.sh_colors`, computed by one GPU kernel;
    differentiable. ``means``, ``dc`` and ``rest`` are float32 on the GPU; ``degree`` is 1 to 3."""
    result: Tensor = _HarmonicColors.apply(means, dc, rest, origin, degree)
    return result


# ---------------------------------------------------------------- lobes

_vec8 = wp.types.vector(length=MOST_LOBES, dtype=wp.float64)
_LIMIT, _SHORTEST = wp.constant(d(LOG_LIMIT)), wp.constant(d(SHORTEST))


@wp.func
def _one_over(v: wp.vec3d):
    """Return 1/length of a vector; 0 for a length of at most 1e-24, too short for a direction."""
    length = wp.length(v)
    if length > _SHORTEST:
        return d(1.0) / length
    return d(0.0)


@wp.func
def lobe_sharpness(log_sharpness: float):
    """Return exp(``log_sharpness``), float64, with the logarithm clamped to +-LOG_LIMIT."""
    value = d(log_sharpness)
    if value > _LIMIT:
        value = _LIMIT
    if value < -_LIMIT:
        value = -_LIMIT
    return wp.exp(value)


@wp.func
def lobe_nearness(cosine: wp.float64):
    """Return ``cosine`` - 1, clamped to at most 0; times the sharpness, this is the exponent of a lobe."""
    if cosine > d(1.0):
        return d(0.0)
    return cosine - d(1.0)


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def _lobe_forward(
    means: wp.array(dtype=wp.vec3), dc: wp.array2d(dtype=float), amplitude: wp.array3d(dtype=float),
    axis: wp.array2d(dtype=wp.vec3), log_sharpness: wp.array2d(dtype=float), origin: wp.array(dtype=wp.float64),
    color: wp.array2d(dtype=float),
):  # fmt: skip
    """Compute the colours of :func:`~neuprim.core.model.lobes.lobe_colors`, one thread per primitive."""
    i = wp.tid()
    offset = wp.vec3d(means[i]) - wp.vec3d(origin[0], origin[1], origin[2])
    direction = _one_over(offset) * offset
    weights = _vec8()
    for j in range(axis.shape[1]):
        m = wp.vec3d(axis[i, j])
        cosine = _one_over(m) * wp.dot(m, direction)
        weights[j] = wp.exp(lobe_sharpness(log_sharpness[i, j]) * lobe_nearness(cosine))
    for c in range(color.shape[1]):
        value = _C0 * d(dc[i, c]) + d(0.5)
        for j in range(axis.shape[1]):
            value += weights[j] * d(amplitude[i, j, c])
        if value < d(0.0):
            value = d(0.0)
        color[i, c] = f(value)


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def _lobe_backward(
    means: wp.array(dtype=wp.vec3), amplitude: wp.array3d(dtype=float), axis: wp.array2d(dtype=wp.vec3),
    log_sharpness: wp.array2d(dtype=float), origin: wp.array(dtype=wp.float64), color: wp.array2d(dtype=float),
    grad: wp.array2d(dtype=float), g_means: wp.array(dtype=wp.vec3), g_dc: wp.array2d(dtype=float),
    g_amplitude: wp.array3d(dtype=float), g_axis: wp.array2d(dtype=wp.vec3), g_log_sharpness: wp.array2d(dtype=float),
):  # fmt: skip
    """Compute the gradients of :func:`_lobe_forward`, one thread per primitive; ``color`` is the forward result."""
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
        sharpness, nearness = lobe_sharpness(log_sharpness[i, j]), lobe_nearness(cosine)
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
        ctx.tensors = (
            means,
            amplitude,
            axis,
            log_sharpness,
            centre,
            color.detach(),
        )  # the output itself would be a cycle
        ctx.origin = (tensors[-1].dtype, tensors[-1].device)
        launch_kernel(
            _lobe_forward, len(means),
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
            _lobe_backward, len(means),
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
    """Return the (N, C) colours of :func:`~neuprim.core.model.lobes.lobe_colors`, computed by one GPU kernel;
    differentiable. All tensors except ``origin`` are float32 on the GPU. Each primitive has at least one lobe."""
    result: Tensor = _LobeColors.apply(means, dc, amplitude, axis, log_sharpness, origin)
    return result
