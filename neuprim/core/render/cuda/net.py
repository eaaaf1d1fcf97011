# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Colour networks per primitive (:class:`~neuprim.core.model.forms.RayNet`), in float64: the twin of
:mod:`neuprim.core.render.cpu.colour_net`.

The network sees the chord's middle, which the density's pixel stage has anyway in whitened space: its first layer goes
there, in turns, once per primitive, as the density's neurons do, and nothing here depends on the camera.
"""

import functools
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.warp import array, launch, wp
from neuprim.core.render.cpu.limits import FLOAT64_TURNS
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.placement import EXACT, PER_BLOCK, View, place
from neuprim.core.render.cuda.prepare_backward import quaternion_gradient

__all__ = ["Net", "net_backward", "prepared_net", "wide_net"]

d, f = wp.float64, wp.float32
_TURNS = wp.constant(d(1.0 / (2.0 * math.pi)))
_FAST = wp.constant(d(FLOAT64_TURNS**2))


@dataclass
class Net:
    """The networks of a frame.

    Attributes:
        Wx: (N, H, 3), bias: (N, H), Wout: (N, C, H): the parameters, contiguous, float32 or float64 alike.
        rows: (N, H net_columns(C), 4) float32, columns of :func:`~neuprim.core.render.cuda.layout.net_columns`.
        fast: (N,) bool, where a unit turns too fast for float32.
        wide: (M, H, 4) float64 (WX, WY, WZ, PHASE) of the primitives that are drawn in float64.
    """

    Wx: Tensor
    bias: Tensor
    Wout: Tensor
    rows: Tensor
    fast: Tensor
    wide: Tensor

    @property
    def hidden(self) -> int:
        return int(self.Wx.shape[1])


@wp.func
def _unit(log_scale: wp.vec3d, quat: wp.vec4d, w: wp.vec3d, phase: wp.float64):
    """(WX, WY, WZ, PHASE): on whitened axes and in turns."""
    p = place(wp.vec3d(), log_scale, quat, View())
    on_axes = _TURNS * wp.cw_mul(p.axes, wp.transpose(p.local) * w)
    turns = _TURNS * phase
    return wp.vec4d(on_axes[0], on_axes[1], on_axes[2], turns - wp.rint(turns))


@functools.cache
def _kernels(double: bool) -> tuple[Any, Any, Any]:
    real, vec3, vec4 = (wp.float64, wp.vec3d, wp.vec4d) if double else (wp.float32, wp.vec3, wp.vec4)

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def prepare_net(
        log_scales: wp.array(dtype=vec3), quats: wp.array(dtype=vec4), Wx: wp.array2d(dtype=vec3), bias: wp.array2d(dtype=real),
        Wout: wp.array3d(dtype=real), channels: int, rows: wp.array2d(dtype=wp.vec4), fast: wp.array2d(dtype=wp.bool),
    ):  # fmt: skip
        """Thread (i, j): unit j of primitive i."""
        i, j = wp.tid()
        unit = _unit(wp.vec3d(log_scales[i]), wp.vec4d(quats[i]), wp.vec3d(Wx[i, j]), d(bias[i, j]))
        fast[i, j] = unit[0] * unit[0] + unit[1] * unit[1] + unit[2] * unit[2] > _FAST
        at = j * (1 + (channels + 3) // 4)
        rows[i, at] = wp.vec4(unit)
        for first in range(0, channels, 4):
            out = wp.vec4()
            for c in range(4):
                if first + c < channels:
                    out[c] = f(Wout[i, first + c, j])
            rows[i, at + 1 + first // 4] = out

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def prepare_wide(
        which: wp.array(dtype=wp.int32), log_scales: wp.array(dtype=vec3), quats: wp.array(dtype=vec4), Wx: wp.array2d(dtype=vec3),
        bias: wp.array2d(dtype=real), wide: wp.array2d(dtype=wp.vec4d),
    ):  # fmt: skip
        """Thread (m, j): unit j of primitive ``which[m]``."""
        m, j = wp.tid()
        i = which[m]
        wide[m, j] = _unit(wp.vec3d(log_scales[i]), wp.vec4d(quats[i]), wp.vec3d(Wx[i, j]), d(bias[i, j]))

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def backward(
        log_scales: wp.array(dtype=vec3), quats: wp.array(dtype=vec4), Wx: wp.array2d(dtype=vec3), hidden: int, channels: int,
        weights: wp.array2d(dtype=wp.float32), grads: wp.array2d(dtype=wp.float32), first: int,
        g_log_scales: wp.array(dtype=wp.vec3), g_quats: wp.array(dtype=wp.vec4), g_Wx: wp.array2d(dtype=wp.vec3),
        g_bias: wp.array2d(dtype=wp.float32), g_Wout: wp.array3d(dtype=wp.float32),
    ):  # fmt: skip
        """Thread i. ``weights``: rows whose column G_WEIGHT says whether the primitive was seen. Adds to
        ``g_log_scales`` and ``g_quats``."""
        i = wp.tid()
        seen = weights[i, wp.static(L.G_WEIGHT)] > f(0.0)
        logs, quat = wp.vec3d(log_scales[i]), wp.vec4d(quats[i])
        p = place(wp.vec3d(), logs, quat, View())
        gL, gl, log_m = wp.mat33d(), wp.vec3d(), d(0.0)
        for j in range(hidden):
            at = first + j * (4 + channels)
            if seen:
                w = wp.vec3d(Wx[i, j])
                g = wp.vec3d(d(grads[i, at]), d(grads[i, at + 1]), d(grads[i, at + 2]))
                gw = _TURNS * wp.cw_mul(g, p.axes)
                gL += wp.outer(w, gw)
                scaled = wp.cw_mul(gw, wp.transpose(p.local) * w)  # the first layer on whitened axes scales with s_a/m
                gl += scaled
                log_m -= scaled[0] + scaled[1] + scaled[2]
                g_Wx[i, j] = wp.vec3(p.local * gw)
                g_bias[i, j] = f(_TURNS * d(grads[i, at + 3]))
                for c in range(channels):
                    g_Wout[i, c, j] = grads[i, at + 4 + c]
            else:
                g_Wx[i, j] = wp.vec3()
                g_bias[i, j] = f(0.0)
                for c in range(channels):
                    g_Wout[i, c, j] = f(0.0)
        if seen:
            if logs[2] > wp.max(logs[0], logs[1]):  # the first of the longest axes is m
                gl[2] += log_m
            elif logs[1] > logs[0]:
                gl[1] += log_m
            else:
                gl[0] += log_m
            g_log_scales[i] = g_log_scales[i] + wp.vec3(gl)
            g_quats[i] = g_quats[i] + wp.vec4(quaternion_gradient(quat, p.inverse, gL))

    return prepare_net, prepare_wide, backward


def _types(double: bool) -> tuple[Any, Any, Any]:
    return (wp.float64, wp.vec3d, wp.vec4d) if double else (wp.float32, wp.vec3, wp.vec4)


def prepared_net(log_scales: Tensor, quats: Tensor, Wx: Tensor, bias: Tensor, Wout: Tensor) -> Net:
    """Rows of all primitives; ``wide`` is empty, see :func:`wide_net`."""
    tensors = (log_scales, quats, Wx, bias, Wout)
    double = any(x.dtype == torch.float64 for x in tensors)
    dtype = torch.float64 if double else torch.float32
    log_scales, quats, Wx, bias, Wout = (x.detach().to(dtype).contiguous() for x in tensors)
    (N, H, _), C, device = Wx.shape, Wout.shape[1], Wx.device
    real, vec3, vec4 = _types(double)
    rows = torch.empty(N, H * L.net_columns(C), 4, device=device)
    fast = torch.empty(N, H, dtype=torch.bool, device=device)
    launch(
        _kernels(double)[0], (N, H),
        (
            array(log_scales, vec3), array(quats, vec4), array(Wx, vec3), array(bias, real), array(Wout, real), C,
            array(rows, wp.vec4), array(fast, wp.bool),
        ), device, PER_BLOCK,
    )  # fmt: skip
    return Net(Wx, bias, Wout, rows, fast.any(1), torch.empty(0, H, 4, dtype=torch.float64, device=device))


def wide_net(net: Net, which: Tensor, log_scales: Tensor, quats: Tensor) -> None:
    """Fill ``net.wide`` for primitives ``which`` (M,) int32; parameters as the frame has them."""
    M, H, device = len(which), net.hidden, net.Wx.device
    double = net.Wx.dtype == torch.float64
    real, vec3, vec4 = _types(double)
    net.wide = torch.empty(M, H, 4, dtype=torch.float64, device=device)
    launch(
        _kernels(double)[1], (M, H),
        (
            array(which, wp.int32), array(log_scales.to(net.Wx), vec3), array(quats.to(net.Wx), vec4), array(net.Wx, vec3), array(net.bias, real),
            array(net.wide, wp.vec4d),
        ), device, PER_BLOCK,
    )  # fmt: skip


def net_backward(
    net: Net,
    log_scales: Tensor,
    quats: Tensor,
    weights: Tensor,
    grads: Tensor,
    first: int,
    g_log_scales: Tensor,
    g_quats: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of Wx, bias and Wout in float32; adds to those of log_scales and quats.

    Args:
        weights: (N, .) gradient rows of the density's pass; grads: (N, .) those of the networks' pass, units from
        column ``first``.
    """
    double = net.Wx.dtype == torch.float64
    _, vec3, vec4 = _types(double)
    out = tuple(torch.empty(x.shape, dtype=torch.float32, device=x.device) for x in (net.Wx, net.bias, net.Wout))
    launch(
        _kernels(double)[2], net.Wx.shape[0],
        (
            array(log_scales.to(net.Wx), vec3), array(quats.to(net.Wx), vec4), array(net.Wx, vec3), net.hidden, int(net.Wout.shape[1]),
            array(weights, wp.float32), array(grads, wp.float32), first, array(g_log_scales, wp.vec3), array(g_quats, wp.vec4),
            array(out[0], wp.vec3), array(out[1], wp.float32), array(out[2], wp.float32),
        ), net.Wx.device, PER_BLOCK,
    )  # fmt: skip
    return out[0], out[1], out[2]
