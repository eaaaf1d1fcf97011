"""Colour networks (:class:`~neuprim.core.model.forms.RayNet`), one per primitive, evaluated in each pixel.

The input of a network is the middle of a ray's chord, which the density's kernels store for each lane (a pixel of one
(tile, primitive) pair). The first layer is converted in float64 to whitened axes (units of the semi-axes) and to turns,
once per primitive, like the density's neurons. The conversion does not depend on the camera. RAY_COLOUR holds the
colours of the lanes before max(0, .). For three channels, one loop computes all channels. Other numbers of channels,
float64 and gradients need scratch memory ``V``, which holds the cosine of each unit and its derivative.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from neuprim.core.compute.kernels import exact_kernel, inline
from neuprim.core.compute.threads import parallel_for
from neuprim.core.model.rows import ellipsoid_rotation_backward, fill_ellipsoid_rotation
from neuprim.core.render import layout as P
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.chord import TAU, cos_turns, sinc_turns
from neuprim.core.render.cpu.float64 import chord_phase_float64

f = np.float32
_TURNS = 1.0 / (2.0 * np.pi)
_PRIMITIVES_PER_CHUNK = 512
_RGB_GRADIENT = L.RAY_COLOUR + 3 * L.LANES  # dL/d RAY_COLOUR of three channels, behind the C arrays of RAY_COLOUR
Array = np.ndarray[Any, Any]


class ColourNet(NamedTuple):
    """The colour networks of all primitives of a frame, as the pixel kernels read them."""

    # (N, net_row_width) float32: for each unit, the first layer (WX, WY, WZ, PHASE; on whitened axes, in turns), then C
    # output weights
    rows: Array
    wide: Array  # (M, net_row_width) float64 rows of the primitives drawn in float64, in the order of their slots
    hidden: int  # units per primitive, padded to an even number by units whose output weights are 0


# ---- Per primitive


@exact_kernel
def _fill_net_rows(start, stop, which, log_scales, quats, Wx, bias, Wout, out, fast):  # type: ignore[no-untyped-def]
    """Fill ``out[n]`` with the network row of primitive ``which[n]``, for n in ``start:stop``.

    ``fast[n]`` is set if the phase of a unit changes too fast along a chord for float32.
    """
    H, C = Wx.shape[1], Wout.shape[1]
    local, axes = np.empty((3, 3)), np.empty(3)
    for n in range(start, stop):
        i = which[n]
        row = out[n]
        row[:] = 0.0
        fast[n] = False
        fill_ellipsoid_rotation(quats[i], local)
        top = max(np.float64(log_scales[i, 0]), np.float64(log_scales[i, 1]), np.float64(log_scales[i, 2]))
        for a in range(3):
            axes[a] = np.exp(np.float64(log_scales[i, a]) - top)
        for j in range(H):
            o, square = (P.NET_OUT + C) * j, 0.0
            for a in range(3):
                w = (
                    _TURNS
                    * axes[a]
                    * (Wx[i, j, 0] * local[0, a] + Wx[i, j, 1] * local[1, a] + Wx[i, j, 2] * local[2, a])
                )
                row[o + P.WX + a] = w
                square += w * w
            phase = _TURNS * np.float64(bias[i, j])
            row[o + P.PHASE] = phase - np.rint(phase)
            for c in range(C):
                row[o + P.NET_OUT + c] = Wout[i, c, j]
            fast[n] |= square > P.FLOAT64_TURNS**2


def prepare_rasterizer_colour_net(which: Array, t: dict[str, Array], wide: bool, threads: int) -> tuple[Array, Array]:
    """Return the network rows of primitives ``which``, and a bool array: whether each network needs float64.

    A network needs float64 if the phase of a unit changes too fast along a chord. The rows are float64 if ``wide``,
    else float32. ``t`` holds the tensors by name.
    """
    H, C = t["Wx"].shape[1], t["Wout"].shape[1]
    out = np.empty((len(which), L.net_row_width(H + H % 2, C)), np.float64 if wide else np.float32)
    fast = np.empty(len(which), np.bool_)
    tensors = (t[name] for name in ("log_scales", "quats", "Wx", "bias", "Wout"))
    parallel_for(_fill_net_rows, len(which), _PRIMITIVES_PER_CHUNK, threads, which, *tensors, out, fast)
    return out, fast


@exact_kernel
def colour_net_backward(  # type: ignore[no-untyped-def]
    start, stop, log_scales, quats, Wx, rows, grads, first, touched, g_log_scales, g_quats, g_Wx, g_bias, g_Wout,
):  # fmt: skip
    """Compute the gradients of the colour networks of primitives ``start:stop`` from the gradient rows ``grads``.

    The columns of the network begin at ``first`` in a gradient row. ``rows`` are the network rows. Primitives that are
    not ``touched`` are skipped. The kernel fills ``g_Wx``, ``g_bias`` and ``g_Wout``, and adds to ``g_log_scales`` and
    ``g_quats``. The density's columns already contain the gradient through the chord's middle.
    """
    H, C = Wx.shape[1], g_Wout.shape[1]
    local, gL, axes, gl, q, gq = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(4), np.empty(4)
    for i in range(start, stop):
        if not touched[i]:
            continue
        g = grads[i]
        inverse = fill_ellipsoid_rotation(quats[i], local)
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
            o = (P.NET_OUT + C) * j
            og = first + o
            for b in range(3):
                g_Wx[i, j, b] = _TURNS * (
                    g[og + P.WX] * axes[0] * local[b, 0]
                    + g[og + P.WY] * axes[1] * local[b, 1]
                    + g[og + P.WZ] * axes[2] * local[b, 2]
                )
            for a in range(3):
                gw = np.float64(g[og + P.WX + a])
                gl[a] += gw * rows[i, o + P.WX + a]  # scales with s_a/m
                gl[longest] -= gw * rows[i, o + P.WX + a]
                for b in range(3):
                    gL[b, a] += _TURNS * axes[a] * Wx[i, j, b] * gw
            g_bias[i, j] = _TURNS * g[og + P.PHASE]
            for c in range(C):
                g_Wout[i, c, j] = g[og + P.NET_OUT + c]
        for a in range(4):
            q[a] = quats[i, a]
        ellipsoid_rotation_backward(q, inverse, gL, gq)
        for a in range(3):
            g_log_scales[i, a] += gl[a]
        for a in range(4):
            g_quats[i, a] += gq[a]


# ---- Per lane, after the density's chord stage


@inline
def _ray_rgb_unit(p, o):  # type: ignore[no-untyped-def]
    return (
        p[o + P.WX], p[o + P.WY], p[o + P.WZ], p[o + P.PHASE], p[o + P.NET_OUT], p[o + P.NET_OUT + 1],
        p[o + P.NET_OUT + 2],
    )  # fmt: skip


@inline
def _add_ray_rgb_units(S, V0, V1, n, p, o, o2, slopes):  # type: ignore[no-untyped-def]
    """Add the outputs of two network units at ``n`` lanes (pixels) to RAY_COLOUR, for three channels.

    The units begin at columns ``o`` and ``o2`` of the network row ``p``. With ``slopes``, store each unit's cosine and
    its derivative by the phase in turns in ``V0`` and ``V1``.
    """
    ax, ay, az, ab, a0, a1, a2 = _ray_rgb_unit(p, o)
    bx, by, bz, bb, b0, b1, b2 = _ray_rgb_unit(p, o2)
    for k in range(n):
        qx, qy, qz = S[L.QX + k], S[L.QY + k], S[L.QZ + k]
        u = qx * ax + qy * ay + qz * az + ab
        r = u - np.rint(u)
        u1 = qx * bx + qy * by + qz * bz + bb
        r1 = u1 - np.rint(u1)
        z, z1 = r * r, r1 * r1
        c, c1 = cos_turns(z), cos_turns(z1)
        if slopes:
            V0[L.NET_COS + k] = c
            V0[L.NET_SIN + k] = -TAU * TAU * r * sinc_turns(z)
            V1[L.NET_COS + k] = c1
            V1[L.NET_SIN + k] = -TAU * TAU * r1 * sinc_turns(z1)
        S[L.RAY_COLOUR + k] += c * a0 + c1 * b0
        S[L.RAY_COLOUR + L.LANES + k] += c * a1 + c1 * b1
        S[L.RAY_COLOUR + 2 * L.LANES + k] += c * a2 + c1 * b2


@inline
def _unit_waves(S, V0, n, p, o):  # type: ignore[no-untyped-def]
    """Store one network unit's cosine and its derivative by the phase in turns, at ``n`` lanes (pixels), in ``V0``."""
    wx, wy, wz, b = p[o + P.WX], p[o + P.WY], p[o + P.WZ], p[o + P.PHASE]
    for k in range(n):
        u = S[L.QX + k] * wx + S[L.QY + k] * wy + S[L.QZ + k] * wz + b
        r = u - np.rint(u)
        z = r * r
        V0[L.NET_COS + k] = cos_turns(z)
        V0[L.NET_SIN + k] = -TAU * TAU * r * sinc_turns(z)


@inline
def _unit_waves_float64(D, V0, n, p, o):  # type: ignore[no-untyped-def]
    """Like :func:`_unit_waves`, but compute the phases in float64, from chords ``D`` and network row ``p``."""
    for k in range(n):
        r = chord_phase_float64(D, k, p, o)
        z = r * r
        V0[L.NET_COS + k] = cos_turns(z)
        V0[L.NET_SIN + k] = -TAU * TAU * r * sinc_turns(z)


@inline
def _mix_net_outputs(S, V, n, p, hidden, C):  # type: ignore[no-untyped-def]
    """Add the outputs of all network units to RAY_COLOUR, from their cosines in ``V``; for any number of channels."""
    for c in range(C):
        colour = S[L.RAY_COLOUR + c * L.LANES :]
        for j in range(hidden):
            cosine, weight = V[j, L.NET_COS :], p[(P.NET_OUT + C) * j + P.NET_OUT + c]
            for k in range(n):
                colour[k] += cosine[k] * weight


@inline
def ray_colours(S, D, V, n, i, net, slots, base, slopes):  # type: ignore[no-untyped-def]
    """Evaluate the colour network of primitive ``i`` at ``n`` lanes (pixels); fill RAY_COLOUR, before max(0, .).

    ``base`` is the constant colour, to which the network adds. ``D`` has the float64 chords if the primitive is drawn
    in float64 (has a slot). With ``slopes``, the function also fills ``V``, which :func:`ray_colour_gradient` needs.
    """
    C, p = base.shape[0], net.rows[i]
    for c in range(C):
        colour = S[L.RAY_COLOUR + c * L.LANES :]
        for k in range(n):
            colour[k] = base[c]
    if slots[i] >= 0:
        for j in range(net.hidden):
            _unit_waves_float64(D, V[j], n, net.wide[slots[i]], (P.NET_OUT + C) * j)
        _mix_net_outputs(S, V, n, p, net.hidden, C)
    elif C == 3:
        for j in range(0, net.hidden, 2):
            o = (P.NET_OUT + 3) * j
            _add_ray_rgb_units(S, V[j], V[j + 1], n, p, o, o + P.NET_OUT + 3, slopes)
    else:
        for j in range(net.hidden):
            _unit_waves(S, V[j], n, p, (P.NET_OUT + C) * j)
        _mix_net_outputs(S, V, n, p, net.hidden, C)


@inline
def _rgb_units_gradient(S, V0, V1, n, p, o, o2, out):  # type: ignore[no-untyped-def]
    """Write the gradients of two units into row ``out``, for three channels; add to dL/dQ, Q the chord's middle."""
    ax, ay, az, _, a0, a1, a2 = _ray_rgb_unit(p, o)
    bx, by, bz, _, b0, b1, b2 = _ray_rgb_unit(p, o2)
    s0, s1, s2, s3, s4, s5, s6 = f(0), f(0), f(0), f(0), f(0), f(0), f(0)
    r0, r1, r2, r3, r4, r5, r6 = f(0), f(0), f(0), f(0), f(0), f(0), f(0)
    for k in range(n):
        g0, g1, g2 = S[_RGB_GRADIENT + k], S[_RGB_GRADIENT + L.LANES + k], S[_RGB_GRADIENT + 2 * L.LANES + k]
        qx, qy, qz = S[L.QX + k], S[L.QY + k], S[L.QZ + k]
        c, c1 = V0[L.NET_COS + k], V1[L.NET_COS + k]
        u = (g0 * a0 + g1 * a1 + g2 * a2) * V0[L.NET_SIN + k]
        u1 = (g0 * b0 + g1 * b1 + g2 * b2) * V1[L.NET_SIN + k]
        s0 += u * qx
        s1 += u * qy
        s2 += u * qz
        s3 += u
        s4 += g0 * c
        s5 += g1 * c
        s6 += g2 * c
        r0 += u1 * qx
        r1 += u1 * qy
        r2 += u1 * qz
        r3 += u1
        r4 += g0 * c1
        r5 += g1 * c1
        r6 += g2 * c1
        S[L.GQX + k] += u * ax + u1 * bx
        S[L.GQY + k] += u * ay + u1 * by
        S[L.GQZ + k] += u * az + u1 * bz
    out[o + P.WX], out[o + P.WY], out[o + P.WZ], out[o + P.PHASE] = s0, s1, s2, s3
    out[o + P.NET_OUT], out[o + P.NET_OUT + 1], out[o + P.NET_OUT + 2] = s4, s5, s6
    out[o2 + P.WX], out[o2 + P.WY], out[o2 + P.WZ], out[o2 + P.PHASE] = r0, r1, r2, r3
    out[o2 + P.NET_OUT], out[o2 + P.NET_OUT + 1], out[o2 + P.NET_OUT + 2] = r4, r5, r6


@inline
def _unit_gradient(S, V0, n, p, o, C, out):  # type: ignore[no-untyped-def]
    """Write the gradients of one network unit into ``out``, for any number of channels; add to dL/dQ.

    Q is the chord's middle. The unit begins at column ``o`` of the network row ``p``. The function overwrites the
    unit's cosines in ``V0``.
    """
    wx, wy, wz = p[o + P.WX], p[o + P.WY], p[o + P.WZ]
    for c in range(C):
        gradient, total = S[L.RAY_COLOUR + (C + c) * L.LANES :], f(0)
        for k in range(n):
            total += gradient[k] * V0[L.NET_COS + k]
        out[o + P.NET_OUT + c] = total
    for k in range(n):
        V0[L.NET_COS + k] = f(0)
    for c in range(C):
        gradient, weight = S[L.RAY_COLOUR + (C + c) * L.LANES :], p[o + P.NET_OUT + c]
        for k in range(n):
            V0[L.NET_COS + k] += gradient[k] * weight
    s0, s1, s2, s3 = f(0), f(0), f(0), f(0)
    for k in range(n):
        u = V0[L.NET_COS + k] * V0[L.NET_SIN + k]
        s0 += u * S[L.QX + k]
        s1 += u * S[L.QY + k]
        s2 += u * S[L.QZ + k]
        s3 += u
        S[L.GQX + k] += u * wx
        S[L.GQY + k] += u * wy
        S[L.GQZ + k] += u * wz
    out[o + P.WX], out[o + P.WY], out[o + P.WZ], out[o + P.PHASE] = s0, s1, s2, s3


@inline
def ray_colour_gradient(S, V, n, i, net, C, out, base_at):  # type: ignore[no-untyped-def]
    """Write the gradients of a colour network into ``out``: first of the constant colour, then of the units.

    The gradients begin at column ``base_at``. The input is dL/d RAY_COLOUR of ``n`` lanes (pixels). The function also
    adds to dL/dQ of the lanes, Q the middle of the chord.
    """
    p, row = net.rows[i], out[base_at + C :]
    for c in range(C):
        gradient, total = S[L.RAY_COLOUR + (C + c) * L.LANES :], f(0)
        for k in range(n):
            total += gradient[k]
        out[base_at + c] = total
    if C == 3:
        for j in range(0, net.hidden, 2):
            o = (P.NET_OUT + 3) * j
            _rgb_units_gradient(S, V[j], V[j + 1], n, p, o, o + P.NET_OUT + 3, row)
    else:
        for j in range(net.hidden):
            _unit_gradient(S, V[j], n, p, (P.NET_OUT + C) * j, C, row)
