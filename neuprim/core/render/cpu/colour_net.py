"""The per-primitive stage of a :class:`~neuprim.core.model.forms.RayNet`, in float64, and its hand-written backward.

The network sees the chord's middle, x~_m = local (axes q) with q the middle in whitened space, which the density's
pixel stage leaves in the lanes anyway. So its first layer goes to whitened axes and turns once per primitive, exactly
as the density's neurons do, and nothing here depends on the camera. The pixel stage is in ``ray_colours``.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.compute.threads import parallel_for
from neuprim.core.model.rotation import rotation, rotation_backward
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.prepare import FLOAT64_TURNS

__all__ = ["Net", "net_backward", "net_rows", "prepare_net"]

_TURNS = 1.0 / (2.0 * np.pi)
_PRIMITIVES_PER_CHUNK = 512
Array = np.ndarray[Any, Any]


class Net(NamedTuple):
    """The networks of one frame, as the pixel kernels take them; ``None`` in its place compiles a kernel for constant
    colours.

    Attributes:
        rows: (N, width) float32: per unit its first layer (WX, WY, WZ, PHASE: whitened axes, turns), then C output
        weights. wide: the same in float64 of the primitives that are drawn so, by slot.
        hidden: units per primitive, padded to a whole number of pairs by units without output.
    """

    rows: Array
    wide: Array
    hidden: int


@exact_kernel
def prepare_net(start, stop, which, log_scales, quats, Wx, bias, Wout, out, fast):  # type: ignore[no-untyped-def]
    """Rows ``out[n]`` (float32 or float64) of primitives ``which[n]``; ``fast[n]`` where a unit turns too fast for
    float32 pixels."""
    H, C = Wx.shape[1], Wout.shape[1]
    local, axes = np.empty((3, 3)), np.empty(3)
    for n in range(start, stop):
        i = which[n]
        row = out[n]
        row[:] = 0.0
        fast[n] = False
        rotation(quats[i], local)
        top = max(np.float64(log_scales[i, 0]), np.float64(log_scales[i, 1]), np.float64(log_scales[i, 2]))
        for a in range(3):
            axes[a] = np.exp(np.float64(log_scales[i, a]) - top)
        for j in range(H):
            o, square = (L.NET_OUT + C) * j, 0.0
            for a in range(3):
                w = (
                    _TURNS
                    * axes[a]
                    * (Wx[i, j, 0] * local[0, a] + Wx[i, j, 1] * local[1, a] + Wx[i, j, 2] * local[2, a])
                )
                row[o + L.WX + a] = w
                square += w * w
            phase = _TURNS * np.float64(bias[i, j])
            row[o + L.PHASE] = phase - np.rint(phase)
            for c in range(C):
                row[o + L.NET_OUT + c] = Wout[i, c, j]
            fast[n] |= square > FLOAT64_TURNS**2


def net_rows(which: Array, t: dict[str, Array], wide: bool, threads: int) -> tuple[Array, Array]:
    """Network rows of primitives ``which``, float64 if ``wide``, and which of them have a fast unit."""
    H, C = t["Wx"].shape[1], t["Wout"].shape[1]
    out = np.empty((len(which), L.net_row_width(H + H % 2, C)), np.float64 if wide else np.float32)
    fast = np.empty(len(which), np.bool_)
    parallel_for(
        prepare_net,
        len(which),
        _PRIMITIVES_PER_CHUNK,
        threads,
        which,
        t["log_scales"],
        t["quats"],
        t["Wx"],
        t["bias"],
        t["Wout"],
        out,
        fast,
    )
    return out, fast


@exact_kernel
def net_backward(  # type: ignore[no-untyped-def]
    start, stop, log_scales, quats, Wx, rows, grads, first, touched, g_log_scales, g_quats, g_Wx, g_bias, g_Wout,
):  # fmt: skip
    """Chain rule from gradient rows (the networks' columns begin at ``first``) to parameters, for primitives
    ``start:stop``.

    Adds to ``g_log_scales`` and ``g_quats``: the first layer on whitened axes depends on the ellipsoid's axes. What
    flows through the chord's middle is already in the density's columns.
    """
    H, C = Wx.shape[1], g_Wout.shape[1]
    local, gL, axes, gl, q, gq = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(4), np.empty(4)
    for i in range(start, stop):
        if not touched[i]:
            continue
        g = grads[i]
        inverse = rotation(quats[i], local)
        longest = 0
        for a in range(1, 3):
            if log_scales[i, a] > log_scales[i, longest]:
                longest = a
        for a in range(3):
            axes[a] = np.exp(np.float64(log_scales[i, a]) - np.float64(log_scales[i, longest]))
            gl[a] = 0.0
            for b in range(3):
                gL[a, b] = 0.0
        for j in range(H):
            o = (L.NET_OUT + C) * j
            og = first + o
            for b in range(3):
                g_Wx[i, j, b] = _TURNS * (
                    g[og + L.WX] * axes[0] * local[b, 0]
                    + g[og + L.WX + 1] * axes[1] * local[b, 1]
                    + g[og + L.WX + 2] * axes[2] * local[b, 2]
                )
            for a in range(3):
                gw = np.float64(g[og + L.WX + a])
                gl[a] += gw * rows[i, o + L.WX + a]  # scales with s_a/m
                gl[longest] -= gw * rows[i, o + L.WX + a]
                for b in range(3):
                    gL[b, a] += _TURNS * axes[a] * Wx[i, j, b] * gw
            g_bias[i, j] = _TURNS * g[og + L.PHASE]
            for c in range(C):
                g_Wout[i, c, j] = g[og + L.NET_OUT + c]
        for a in range(4):
            q[a] = quats[i, a]
        rotation_backward(q, inverse, gL, gq)
        for a in range(3):
            g_log_scales[i, a] += gl[a]
        for a in range(4):
            g_quats[i, a] += gq[a]
