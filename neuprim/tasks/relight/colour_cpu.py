"""The closed form of a colour network under one camera and one light with its gradient, fused per primitive, in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.compute.threads import parallel_for

__all__ = ["fused_network"]

_CHUNK = 512
_NEAREST_SQUARE = 1e-12  # scene units squared, see LightNetwork.lower
_NEAREST = 1e-6  # see directions.unit

strict = njit(error_model="numpy", forceinline=True)


@strict
def _direction(v, d):  # type: ignore[no-untyped-def]
    """directions.unit of v into d; returns the factor on v, and whether the radial part of a gradient is lost."""
    top = max(max(abs(v[0]), abs(v[1])), max(abs(v[2]), _NEAREST))
    n = np.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    normal = n >= top
    factor = 1.0 / (n if normal else top)
    d[0], d[1], d[2] = v[0] * factor, v[1] * factor, v[2] * factor
    return factor, normal


@strict
def _direction_backward(d, factor, normal, g):  # type: ignore[no-untyped-def]
    """g in place, from that of d to that of v."""
    radial = g[0] * d[0] + g[1] * d[1] + g[2] * d[2] if normal else 0.0
    g[0], g[1], g[2] = (g[0] - radial * d[0]) * factor, (g[1] - radial * d[1]) * factor, (g[2] - radial * d[2]) * factor


@exact_kernel
def _lower(start, stop, camera, light, strength, falloff, multiplicative, boost, params, Wx, bias, Wout, base):  # type: ignore[no-untyped-def]
    means, c_dc, net_x, net_view, net_light, net_phase, net_out = params
    H, C = net_x.shape[1], c_dc.shape[1]
    v, d, t, e = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for n in range(start, stop):
        for j in range(3):
            v[j], t[j] = means[n, j] - camera[j], light[j] - means[n, j]
        _direction(v, d)
        _direction(t, e)
        over = max(t[0] * t[0] + t[1] * t[1] + t[2] * t[2], _NEAREST_SQUARE) if falloff else 1.0
        for k in range(H):
            phase = 0.0
            for j in range(3):
                phase += net_view[n, k, j] * d[j] + net_light[n, k, j] * e[j]
                Wx[n, k, j] = boost * net_x[n, k, j]
            bias[n, k] = boost * (phase + net_phase[n, k])
        for c in range(C):
            factor, own = strength[c] / over, np.float64(c_dc[n, c])
            shown = max(own, 0.0) if multiplicative else own
            base[n, c] = shown * factor
            for k in range(H):
                Wout[n, c, k] = shown * net_out[n, 0, k] * factor if multiplicative else net_out[n, c, k] * factor


@exact_kernel
def _lower_backward(  # type: ignore[no-untyped-def]
    start, stop, camera, light, strength, falloff, multiplicative, boost, params, p_Wx, p_bias, p_Wout, p_base, gradients,
):  # fmt: skip
    means, c_dc, net_x, net_view, net_light, _, net_out = params
    g_means, g_c_dc, g_net_x, g_net_view, g_net_light, g_net_phase, g_net_out = gradients
    H, C = net_x.shape[1], c_dc.shape[1]
    v, d, t, e, gd, ge, out = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(max(H, 1))
    for n in range(start, stop):
        for j in range(3):
            v[j], t[j] = means[n, j] - camera[j], light[j] - means[n, j]
            gd[j], ge[j] = 0.0, 0.0
        by_view, view_normal = _direction(v, d)
        by_light, light_normal = _direction(t, e)
        square = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
        over = max(square, _NEAREST_SQUARE) if falloff else 1.0
        for k in range(H):
            g = boost * np.float64(p_bias[n, k])
            g_net_phase[n, k], out[k] = g, 0.0
            for j in range(3):
                g_net_view[n, k, j], g_net_light[n, k, j], g_net_x[n, k, j] = g * d[j], g * e[j], boost * p_Wx[n, k, j]
                gd[j] += g * net_view[n, k, j]
                ge[j] += g * net_light[n, k, j]
        faded = 0.0  # sum of dL/df f over the channels' factors f
        for c in range(C):
            factor, own = strength[c] / over, np.float64(c_dc[n, c])
            if multiplicative:
                albedo = max(own, 0.0)
                g = np.float64(p_base[n, c])
                for k in range(H):
                    g += np.float64(p_Wout[n, c, k]) * net_out[n, 0, k]
                    out[k] += p_Wout[n, c, k] * albedo * factor
                faded += g * albedo * factor
                g_c_dc[n, c] = g * factor if own >= 0.0 else 0.0
            else:
                faded += p_base[n, c] * own * factor
                g_c_dc[n, c] = p_base[n, c] * factor
                for k in range(H):
                    faded += p_Wout[n, c, k] * factor * net_out[n, c, k]
                    g_net_out[n, c, k] = p_Wout[n, c, k] * factor
        if multiplicative:
            for k in range(H):
                g_net_out[n, 0, k] = out[k]
        _direction_backward(d, by_view, view_normal, gd)
        _direction_backward(e, by_light, light_normal, ge)
        pull = 2.0 * faded / square if falloff and square >= _NEAREST_SQUARE else 0.0
        for j in range(3):
            g_means[n, j] = gd[j] - ge[j] + pull * t[j]


class _Network(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, camera: Tensor, light: Tensor, strength: Tensor, falloff: bool, multiplicative: bool, boost: float, *params: Tensor
    ) -> tuple[Tensor, ...]:
        around = [np.ascontiguousarray(x.detach().double().numpy()) for x in (camera, light, strength)]
        given = tuple(x.detach().contiguous().numpy() for x in params)
        count, hidden, channels = len(given[0]), given[2].shape[1], given[1].shape[1]
        made = [np.empty((count, *shape), np.float32) for shape in ((hidden, 3), (hidden,), (channels, hidden), (channels,))]
        ctx.arguments = (*around, falloff, multiplicative, boost, given)
        parallel_for(_lower, count, _CHUNK, 0, *ctx.arguments, *made)
        return tuple(torch.from_numpy(x) for x in made)

    @staticmethod
    def backward(ctx: Any, *pulled: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        made = tuple(np.empty(x.shape, np.float32) for x in ctx.arguments[-1])
        parallel_for(_lower_backward, len(made[0]), _CHUNK, 0, *ctx.arguments, *(x.contiguous().numpy() for x in pulled), made)
        return (None,) * 6 + tuple(torch.from_numpy(x) for x in made)


def fused_network(
    camera: Tensor, light: Tensor, strength: Tensor, falloff: bool, multiplicative: bool, boost: float, *params: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(Wx, bias, Wout, base) of :class:`~neuprim.core.model.forms.RayNet`, as ``LightNetwork.lower`` in torch has them.

    Args:
        camera, light: (3,) positions, and strength: (C,) of the light, before any falloff; without gradient.
        params: float32 on the CPU, a row per primitive: means, c_dc, net_x, net_view, net_light, net_phase and net_out.
    """
    made: tuple[Tensor, Tensor, Tensor, Tensor] = _Network.apply(camera, light, strength, falloff, multiplicative, boost, *params)
    return made
