# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""GPU path of :mod:`neuprim.core.volumes.points`: sums of cosine densities at points, by Warp kernels in float64.

In the forward pass, a thread adds up the densities of part of the primitives at one point. In the backward pass, a
thread adds up the gradients of one primitive over part of the points. The partial sums are added in a fixed order, so
reruns give the same bits. The points are not sorted into a grid, because a test of a point against a primitive's box
takes only a few instructions, and there are only a few thousand points.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.warp import OPTIONS, Doubles, Doubles2d, Mat33ds, Vec3ds, Vec3ds2d, array, launch_kernel, wp
from neuprim.core.model.forms import Cosine
from neuprim.core.model.geometry import Geometry

d = wp.float64
_FORWARD_PARTS, _BACKWARD_PARTS = 32, 8  # threads per point, and per primitive
_MARGIN = 1 + 1e-12  # of the boxes around ellipsoids: rounding must not leave out a point


def cosine_point_values(geometry: Geometry, form: Cosine, points: Tensor, weights: Tensor, shares: Any) -> Tensor:
    """Return (M, 1 + C) float32 sums over N primitives at ``points`` (M, 3): extinction, and extinction x ``weights``.

    The host does not wait for the GPU. All values are NaN if a parameter is not finite. Differentiable except in the
    points; the backward pass fills ``shares`` (:class:`~neuprim.core.volumes.points.PointShares`).

    Args:
        weights: (N, C) factors of the extinction of each primitive.
    """
    g = geometry.double()
    means, scales, axes, m = g.means, g.scales, g.rotations, g.length_scale
    A = axes.transpose(1, 2) / scales[:, :, None]  # y = A (x - mu)
    rate = form.omega0 * form.W1.double() / m[:, None, None]
    phase, amplitude = form.omega0 * form.b1.double(), form.w2.double() / m[:, None]
    offset = form.b2.double().reshape(-1) / m
    tensors = (means, A, rate, phase, amplitude, offset, weights.double())
    reach = _MARGIN * (axes * scales[:, None, :]).norm(dim=2).detach()
    found: Tensor = _PointSums.apply(points.detach().double().to(means.device), reach, form.edge, shares, *tensors)
    not_finite = sum(x.detach().sum() * 0.0 for x in (reach, *tensors))  # comparisons with NaN leave a primitive out
    return (found + not_finite).float()


@wp.func
def _is_in_box(offset: wp.vec3d, reach: wp.vec3d):
    return wp.abs(offset[0]) <= reach[0] and wp.abs(offset[1]) <= reach[1] and wp.abs(offset[2]) <= reach[2]


@wp.func
def _network_at(offset: wp.vec3d, n: int, rate: Vec3ds2d, phase: Doubles2d, amplitude: Doubles2d, constant: Doubles):
    """Return f/m, the network's output over the longest semi-axis, at ``offset`` from primitive n's centre."""
    total = constant[n]
    for k in range(phase.shape[1]):
        total += amplitude[n, k] * wp.cos(phase[n, k] + wp.dot(rate[n, k], offset))
    return total


@wp.func
def _fade(inner: wp.float64, edge: int):
    """Return (1 - |y|^2)^p, which fades density to the boundary; ``inner`` is 1 - |y|^2 and ``edge`` is p."""
    value = d(1.0)
    if edge > 0:
        value = inner
    if edge > 1:
        value = inner * inner
    return value


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def _add_primitives(
    points: Vec3ds, reach: Vec3ds, edge: int, means: Vec3ds, A: Mat33ds, rate: Vec3ds2d, phase: Doubles2d,
    amplitude: Doubles2d, constant: Doubles, weights: Doubles2d, values: Doubles2d,
):  # fmt: skip
    """Add sigma (extinction) and sigma x ``weights`` of some primitives at one of M points to ``values``.

    Thread (part, at) takes point ``at`` and primitives part, part + 32, ..., and adds to row part x M + at.
    """
    part, at = wp.tid()
    p = part * points.shape[0] + at
    for n in range(part, means.shape[0], _FORWARD_PARTS):
        offset = points[at] - means[n]
        if _is_in_box(offset, reach[n]):
            y = A[n] * offset
            inner = d(1.0) - wp.dot(y, y)
            if inner > d(0.0):
                f = _network_at(offset, n, rate, phase, amplitude, constant)
                if f > d(0.0):
                    sigma = f * _fade(inner, edge)
                    values[p, 0] = values[p, 0] + sigma
                    for q in range(weights.shape[1]):
                        values[p, 1 + q] = values[p, 1 + q] + sigma * weights[n, q]


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def _add_points(
    points: Vec3ds, reach: Vec3ds, edge: int, means: Vec3ds, A: Mat33ds, rate: Vec3ds2d, phase: Doubles2d,
    amplitude: Doubles2d, constant: Doubles, weights: Doubles2d, pulled: Doubles2d, error: Doubles,
    g_means: Vec3ds, g_A: Mat33ds, g_rate: Vec3ds2d, g_phase: Doubles2d, g_amplitude: Doubles2d,
    g_constant: Doubles, g_weights: Doubles2d, shares: Doubles2d,
):  # fmt: skip
    """Add up the gradients of one of N primitives over some points, and ``shares``: sums of sigma and sigma x error.

    Thread (part, n) takes primitive n and points part, part + 8, ..., and writes row part x N + n. The gradient arrays
    are given as zeros. ``pulled`` is the gradient of the loss by the values at the points.
    """
    part, n = wp.tid()
    row = part * means.shape[0] + n
    g_mean, gA = wp.vec3d(), wp.mat33d()
    whole, weight, wrong = d(0.0), d(0.0), d(0.0)
    for p in range(part, points.shape[0], _BACKWARD_PARTS):
        offset = points[p] - means[n]
        if _is_in_box(offset, reach[n]):
            y = A[n] * offset
            inner = d(1.0) - wp.dot(y, y)
            if inner > d(0.0):
                f = _network_at(offset, n, rate, phase, amplitude, constant)
                if f > d(0.0):
                    fade = _fade(inner, edge)
                    sigma = f * fade
                    weight += sigma
                    wrong += sigma * error[p]
                    g = pulled[p, 0]
                    for q in range(weights.shape[1]):
                        g += pulled[p, 1 + q] * weights[n, q]
                        g_weights[row, q] = g_weights[row, q] + pulled[p, 1 + q] * sigma
                    gf = g * fade
                    whole += gf
                    for k in range(phase.shape[1]):
                        angle = phase[n, k] + wp.dot(rate[n, k], offset)
                        g_amplitude[row, k] = g_amplitude[row, k] + gf * wp.cos(angle)
                        turn = -gf * amplitude[n, k] * wp.sin(angle)
                        g_phase[row, k] = g_phase[row, k] + turn
                        g_rate[row, k] = g_rate[row, k] + turn * offset
                        g_mean -= turn * rate[n, k]
                    if edge > 0:
                        by_y = d(-2.0) * g * f * y
                        if edge > 1:
                            by_y = d(2.0) * inner * by_y
                        gA += wp.outer(by_y, offset)
                        g_mean -= wp.transpose(A[n]) * by_y
    g_means[row] = g_mean
    g_A[row] = gA
    g_constant[row] = whole
    shares[row, 0] = weight
    shares[row, 1] = wrong


_TYPES = (wp.vec3d, wp.mat33d, wp.vec3d, d, d, d, d)


def _primitive_arrays(tensors: tuple[Tensor, ...]) -> list[Any]:
    """Return (means, A, rate, phase, amplitude, offset, weights) of primitives, or their gradients, as Warp arrays."""
    means, A, *rest = tensors
    return [array(x, kind) for x, kind in zip((means, A.view(-1, 9), *rest), _TYPES, strict=True)]


class _PointSums(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, points: Tensor, reach: Tensor, edge: int, shares: Any, *tensors: Tensor) -> Tensor:  # type: ignore[override]
        own, M = tuple(x.detach().contiguous() for x in tensors), len(points)
        values = points.new_zeros(_FORWARD_PARTS * M, 1 + own[-1].shape[1])
        ctx.given = (array(points, wp.vec3d), array(reach, wp.vec3d), edge)
        ctx.own, ctx.shares, ctx.points = own, shares, points
        inputs = (*ctx.given, *_primitive_arrays(own), array(values, d))
        launch_kernel(_add_primitives, (_FORWARD_PARTS, M), inputs, points.device)
        return values.view(_FORWARD_PARTS, M, values.shape[1]).sum(0)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        own, shares, points = ctx.own, ctx.shares, ctx.points
        N = len(own[0])
        found = tuple(x.new_zeros(_BACKWARD_PARTS * N, *x.shape[1:]) for x in own)
        error = torch.zeros_like(points[:, 0]) if shares.error is None else shares.error.double()
        sums = points.new_zeros(_BACKWARD_PARTS * N, 2)
        watched = (array(gradient.contiguous(), d), array(error.contiguous(), d))
        inputs = (*ctx.given, *_primitive_arrays(own), *watched, *_primitive_arrays(found), array(sums, d))
        launch_kernel(_add_points, (_BACKWARD_PARTS, N), inputs, points.device)
        *grads, totals = (x.view(_BACKWARD_PARTS, N, *x.shape[1:]).sum(0) for x in (*found, sums))
        shares.weight, shares.error_weight = totals.float().unbind(1)
        return (None,) * 4 + tuple(grads)
