"""Kernels of :class:`~neuprim.tasks.dynamic.time_density.TimeDensity`: windows in time, and motion of primitives."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.compute.threads import apply_kernel_operation
from neuprim.core.model.edge import edge_weight
from neuprim.core.model.rows import cosine_gain_backward

WINDOW_EDGE = 2  # exponent of the window in time


@exact_kernel
def _rows_in_time_window_kernel(center, log_window, xi, rows):  # type: ignore[no-untyped-def]
    """Write the indices of primitives that are active at time ``xi`` to the start of ``rows``; return their number.

    A primitive is active if its window contains ``xi``: |xi - center| < exp(log_window).
    """
    found = 0
    for n in range(center.shape[0]):
        if abs(xi - np.float64(center[n, 0])) < np.exp(np.float64(log_window[n, 0])):
            rows[found] = n
            found += 1
    return found


def rows_in_time_window(center: Tensor, log_window: Tensor, xi: Tensor) -> Tensor:
    """Return the indices of primitives that are active at time ``xi``: |xi - center| < exp(log_window), in float64.

    The indices are int64, ascending. ``center`` and ``log_window`` are (N, 1); there is no gradient.
    """
    center, log_window = center.detach(), log_window.detach()
    if not device.on_numba(center, log_window):
        return ((xi - center[:, 0].double()).abs() < log_window[:, 0].double().exp()).nonzero()[:, 0]
    rows = np.empty(len(center), np.int64)
    found = _rows_in_time_window_kernel(center.contiguous().numpy(), log_window.contiguous().numpy(), float(xi), rows)
    return torch.from_numpy(rows[:found])


class _TimeWindow(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, w2: Tensor, b2: Tensor, center: Tensor, log_window: Tensor, xi: Tensor
    ) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        tau = log_window.exp()
        u = (xi.to(b2) - center) / tau
        weight = edge_weight(u.square(), WINDOW_EDGE)
        ctx.save_for_backward(w2, b2, tau, u, weight)
        return w2 * weight, b2 * weight

    @staticmethod
    def backward(ctx: Any, p_w2: Tensor, p_b2: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        w2, b2, tau, u, weight = ctx.saved_tensors
        g_w2, g_b2, pulled = (torch.empty(x.shape, dtype=x.dtype) for x in (w2, b2, weight))
        given = (x.detach().contiguous().numpy() for x in (w2, b2, weight, p_w2, p_b2))
        cosine_gain_backward(*given, g_w2.numpy(), g_b2.numpy(), pulled.numpy())
        g_u = pulled.mul_(edge_weight(u.square(), WINDOW_EDGE - 1)).mul_(u).mul_(-2.0 * WINDOW_EDGE)
        return g_w2, g_b2, -g_u / tau, -g_u * u, None


def apply_time_window(w2: Tensor, b2: Tensor, center: Tensor, log_window: Tensor, xi: Tensor) -> tuple[Tensor, Tensor]:
    """Return w2 (N, K) and b2 (N, 1), which scale the density, multiplied by the factor of a window in time.

    The factor is (1 - u^2)^2, or 0 if |u| > 1, with u = (xi - center)/exp(log_window). ``center`` and ``log_window``
    are (N, 1). All tensors of primitives have the same dtype. The time ``xi``, 0-dim, gets no gradient.
    """
    if not device.on_numba(w2, b2, center, log_window):
        weight = edge_weight(((xi.to(b2.dtype) - center) / log_window.exp()).square(), WINDOW_EDGE)
        return w2 * weight, b2 * weight
    result: tuple[Tensor, Tensor] = apply_kernel_operation(_TimeWindow, w2, b2, center, log_window, xi)
    return result


@exact_kernel
def _move_in_time_backward(velocity, acceleration, since, pulled, g_velocity, g_acceleration, g_center):  # type: ignore[no-untyped-def]
    """Write the gradients ``g_...`` from ``pulled``, the gradient of the moved centres.

    ``since`` (N, 1) is xi - center.
    """
    for n in range(since.shape[0]):
        total = 0.0
        for j in range(3):
            g_velocity[n, j] = pulled[n, j] * since[n, 0]
            g_acceleration[n, j] = g_velocity[n, j] * since[n, 0]
            total += np.float64(pulled[n, j]) * (velocity[n, j] + 2.0 * acceleration[n, j] * since[n, 0])
        g_center[n, 0] = -total


class _MoveInTime(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, means: Tensor, velocity: Tensor, acceleration: Tensor, center: Tensor, xi: Tensor) -> Tensor:  # type: ignore[override]
        since = xi.to(velocity) - center
        ctx.save_for_backward(velocity, acceleration, since)
        return means + (velocity + acceleration * since) * since

    @staticmethod
    def backward(ctx: Any, pulled: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        velocity, acceleration, since = ctx.saved_tensors
        made = [torch.empty(x.shape, dtype=x.dtype) for x in (velocity, acceleration, since)]
        given = (x.detach().contiguous().numpy() for x in (velocity, acceleration, since, pulled))
        _move_in_time_backward(*given, *(x.numpy() for x in made))
        return pulled, *made, None


def move_means(means: Tensor, velocity: Tensor, acceleration: Tensor, center: Tensor, xi: Tensor) -> Tensor:
    """Return the (N, 3) centres at time ``xi``: means + velocity (xi - center) + acceleration (xi - center)^2.

    ``center`` (N, 1) is the time at which a primitive is at ``means``. All tensors of primitives have the same dtype.
    ``xi``, 0-dim, gets no gradient.
    """
    if not device.on_numba(means, velocity, acceleration, center):
        since = xi.to(velocity.dtype) - center
        return means + (velocity + acceleration * since) * since
    moved: Tensor = apply_kernel_operation(_MoveInTime, means, velocity, acceleration, center, xi)
    return moved
