"""Colours per lane, for :class:`~neuprim.core.model.forms.RayNet`: the pixel stage of ``colour_net``, forward and
backward.

Every function works on the lanes of one (tile, primitive) pair, after the density's chord stage. RAY_COLOUR holds the
colours before max(0, .), so that forward and backward clamp alike. Three channels have fused loops over constant
offsets; other counts, and primitives drawn in float64, go unit by unit through ``V``.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import inline
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.float64 import phase_float64
from neuprim.core.render.cpu.trigonometry import TAU, cos_turns, sinc_turns

__all__ = [
    "add_ray_colours",
    "composite_rgb_ray_colours",
    "ray_colour_gradient",
    "ray_colour_gradient_row",
    "ray_colours",
    "uncomposite_rgb_ray_colours",
    "weigh_ray_colours",
]

f = np.float32
index = np.uint64  # an unsigned index cannot count from the end: LLVM vectorises without slicing first
_STEPS = np.arange(L.TILE).astype(np.float32)
_RGB_GRADIENT = (
    L.RAY_COLOUR + 3 * L.LANES
)  # dL/d RAY_COLOUR of three channels; in general it follows the C arrays of RAY_COLOUR


# ---------------------------------------------------------------- the network


@inline
def _rgb(S, n, p, o, o2):  # type: ignore[no-untyped-def]
    """RAY_COLOUR += output of the two units at ``o`` and ``o2``, three channels."""
    ax, ay, az, ab, a0, a1, a2 = (
        p[o + L.WX],
        p[o + L.WY],
        p[o + L.WZ],
        p[o + L.PHASE],
        p[o + L.NET_OUT],
        p[o + L.NET_OUT + 1],
        p[o + L.NET_OUT + 2],
    )
    bx, by, bz, bb, b0, b1, b2 = (
        p[o2 + L.WX],
        p[o2 + L.WY],
        p[o2 + L.WZ],
        p[o2 + L.PHASE],
        p[o2 + L.NET_OUT],
        p[o2 + L.NET_OUT + 1],
        p[o2 + L.NET_OUT + 2],
    )
    for k in range(n):
        qx, qy, qz = S[L.QX + k], S[L.QY + k], S[L.QZ + k]
        u = qx * ax + qy * ay + qz * az + ab
        r = u - np.rint(u)
        u1 = qx * bx + qy * by + qz * bz + bb
        r1 = u1 - np.rint(u1)
        c, c1 = cos_turns(r * r), cos_turns(r1 * r1)
        S[L.RAY_COLOUR + k] += c * a0 + c1 * b0
        S[L.RAY_COLOUR + L.LANES + k] += c * a1 + c1 * b1
        S[L.RAY_COLOUR + 2 * L.LANES + k] += c * a2 + c1 * b2


@inline
def _rgb_with_slopes(S, V0, V1, n, p, o, o2):  # type: ignore[no-untyped-def]
    """The same, and both units' cos and d cos/d turn for the backward pass."""
    ax, ay, az, ab, a0, a1, a2 = (
        p[o + L.WX],
        p[o + L.WY],
        p[o + L.WZ],
        p[o + L.PHASE],
        p[o + L.NET_OUT],
        p[o + L.NET_OUT + 1],
        p[o + L.NET_OUT + 2],
    )
    bx, by, bz, bb, b0, b1, b2 = (
        p[o2 + L.WX],
        p[o2 + L.WY],
        p[o2 + L.WZ],
        p[o2 + L.PHASE],
        p[o2 + L.NET_OUT],
        p[o2 + L.NET_OUT + 1],
        p[o2 + L.NET_OUT + 2],
    )
    for k in range(n):
        qx, qy, qz = S[L.QX + k], S[L.QY + k], S[L.QZ + k]
        u = qx * ax + qy * ay + qz * az + ab
        r = u - np.rint(u)
        u1 = qx * bx + qy * by + qz * bz + bb
        r1 = u1 - np.rint(u1)
        z, z1 = r * r, r1 * r1
        c, c1 = cos_turns(z), cos_turns(z1)
        V0[L.NET_COS + k] = c
        V0[L.NET_SIN + k] = -TAU * TAU * r * sinc_turns(z)
        V1[L.NET_COS + k] = c1
        V1[L.NET_SIN + k] = -TAU * TAU * r1 * sinc_turns(z1)
        S[L.RAY_COLOUR + k] += c * a0 + c1 * b0
        S[L.RAY_COLOUR + L.LANES + k] += c * a1 + c1 * b1
        S[L.RAY_COLOUR + 2 * L.LANES + k] += c * a2 + c1 * b2


@inline
def _waves(S, V0, n, p, o):  # type: ignore[no-untyped-def]
    """cos and d cos/d turn of one unit."""
    wx, wy, wz, b = p[o + L.WX], p[o + L.WY], p[o + L.WZ], p[o + L.PHASE]
    for k in range(n):
        u = S[L.QX + k] * wx + S[L.QY + k] * wy + S[L.QZ + k] * wz + b
        r = u - np.rint(u)
        z = r * r
        V0[L.NET_COS + k] = cos_turns(z)
        V0[L.NET_SIN + k] = -TAU * TAU * r * sinc_turns(z)


@inline
def _waves_float64(D, V0, n, p, o):  # type: ignore[no-untyped-def]
    """The same from a float64 row and float64 chord middles."""
    for k in range(n):
        r = phase_float64(D, k, p, o)
        z = r * r
        V0[L.NET_COS + k] = cos_turns(z)
        V0[L.NET_SIN + k] = -TAU * TAU * r * sinc_turns(z)


@inline
def _mix(S, V, n, p, hidden, C):  # type: ignore[no-untyped-def]
    """RAY_COLOUR += output of all units, any channels, from their cos in ``V``."""
    for c in range(C):
        colour = S[L.RAY_COLOUR + c * L.LANES :]
        for j in range(hidden):
            cosine, weight = V[j, L.NET_COS :], p[(L.NET_OUT + C) * j + L.NET_OUT + c]
            for k in range(n):
                colour[k] += cosine[k] * weight


@inline
def ray_colours(S, D, V, n, i, net, slots, base, slopes):  # type: ignore[no-untyped-def]
    """RAY_COLOUR of ``n`` lanes of primitive ``i``; with ``slopes`` also what :func:`ray_colour_gradient` needs, in
    ``V``."""
    C, p = base.shape[0], net.rows[i]
    for c in range(C):
        colour = S[L.RAY_COLOUR + c * L.LANES :]
        for k in range(n):
            colour[k] = base[c]
    if slots[i] >= 0:
        for j in range(net.hidden):
            _waves_float64(D, V[j], n, net.wide[slots[i]], (L.NET_OUT + C) * j)
        _mix(S, V, n, p, net.hidden, C)
    elif C == 3:
        for j in range(0, net.hidden, 2):
            o = (L.NET_OUT + 3) * j
            if slopes:
                _rgb_with_slopes(S, V[j], V[j + 1], n, p, o, o + L.NET_OUT + 3)
            else:
                _rgb(S, n, p, o, o + L.NET_OUT + 3)
    else:
        for j in range(net.hidden):
            _waves(S, V[j], n, p, (L.NET_OUT + C) * j)
        _mix(S, V, n, p, net.hidden, C)


@inline
def _rgb_gradient(S, V0, V1, n, p, o, o2, out):  # type: ignore[no-untyped-def]
    """Gradients of two units, three channels, and their share of dL/dQ."""
    ax, ay, az, a0, a1, a2 = (
        p[o + L.WX],
        p[o + L.WY],
        p[o + L.WZ],
        p[o + L.NET_OUT],
        p[o + L.NET_OUT + 1],
        p[o + L.NET_OUT + 2],
    )
    bx, by, bz, b0, b1, b2 = (
        p[o2 + L.WX],
        p[o2 + L.WY],
        p[o2 + L.WZ],
        p[o2 + L.NET_OUT],
        p[o2 + L.NET_OUT + 1],
        p[o2 + L.NET_OUT + 2],
    )
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
    out[o + L.WX], out[o + L.WY], out[o + L.WZ], out[o + L.PHASE] = s0, s1, s2, s3
    out[o + L.NET_OUT], out[o + L.NET_OUT + 1], out[o + L.NET_OUT + 2] = s4, s5, s6
    out[o2 + L.WX], out[o2 + L.WY], out[o2 + L.WZ], out[o2 + L.PHASE] = r0, r1, r2, r3
    out[o2 + L.NET_OUT], out[o2 + L.NET_OUT + 1], out[o2 + L.NET_OUT + 2] = r4, r5, r6


@inline
def _unit_gradient(S, V0, n, p, o, C, out):  # type: ignore[no-untyped-def]
    """Gradients of one unit, any channels, and its share of dL/dQ. Uses up the unit's cos in ``V0``."""
    wx, wy, wz = p[o + L.WX], p[o + L.WY], p[o + L.WZ]
    for c in range(C):
        gradient, total = S[L.RAY_COLOUR + (C + c) * L.LANES :], f(0)
        for k in range(n):
            total += gradient[k] * V0[L.NET_COS + k]
        out[o + L.NET_OUT + c] = total
    for k in range(n):
        V0[L.NET_COS + k] = f(0)
    for c in range(C):
        gradient, weight = S[L.RAY_COLOUR + (C + c) * L.LANES :], p[o + L.NET_OUT + c]
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
    out[o + L.WX], out[o + L.WY], out[o + L.WZ], out[o + L.PHASE] = s0, s1, s2, s3


@inline
def ray_colour_gradient(S, V, n, i, net, C, out, base_at):  # type: ignore[no-untyped-def]
    """From dL/d RAY_COLOUR of every lane to the gradient row: base at ``base_at``, then the units; adds to dL/dQ."""
    p, row = net.rows[i], out[base_at + C :]
    for c in range(C):
        gradient, total = S[L.RAY_COLOUR + (C + c) * L.LANES :], f(0)
        for k in range(n):
            total += gradient[k]
        out[base_at + c] = total
    if C == 3:
        for j in range(0, net.hidden, 2):
            o = (L.NET_OUT + 3) * j
            _rgb_gradient(S, V[j], V[j + 1], n, p, o, o + L.NET_OUT + 3, row)
    else:
        for j in range(net.hidden):
            _unit_gradient(S, V[j], n, p, (L.NET_OUT + C) * j, C, row)


# ---------------------------------------------------------------- compositing one pixel row; ``at`` is the lane of the
# row's pixel 0


@inline
def composite_rgb_ray_colours(state, S, base, at, a, b, tmin, rank):  # type: ignore[no-untyped-def]
    """Three channels: colour += alpha T max(0, RAY_COLOUR), then T; a pixel is live while T >= T_min."""
    a, b = f(a), f(b)
    for k in range(L.TILE):
        step, T = _STEPS[k], state[index(base + k + L.T_)]
        use = (step >= a) & (step < b) & (T >= tmin)
        alpha = S[index(at + k + L.ALPHA)] if use else f(0)
        weight = alpha * T
        state[index(base + k + L.T_)] = T - weight
        state[index(base + k + L.LAST)] = rank if alpha > f(0) else state[index(base + k + L.LAST)]
        state[index(base + k + L.COLOR)] += weight * max(S[index(at + k + L.RAY_COLOUR)], f(0))
        state[index(base + k + L.COLOR + L.PIXELS)] += weight * max(S[index(at + k + L.RAY_COLOUR + L.LANES)], f(0))
        state[index(base + k + L.COLOR + 2 * L.PIXELS)] += weight * max(
            S[index(at + k + L.RAY_COLOUR + 2 * L.LANES)], f(0)
        )


@inline
def add_ray_colours(state, S, base, at, w, C):  # type: ignore[no-untyped-def]
    """colour += w max(0, RAY_COLOUR), any channels."""
    for c in range(C):
        st, colour = state[L.COLOR + c * L.PIXELS + base :], S[L.RAY_COLOUR + c * L.LANES + at :]
        for k in range(L.TILE):
            st[k] += w[k] * max(colour[k], f(0))


@inline
def uncomposite_rgb_ray_colours(state, S, base, at, sums, a, b, rank):  # type: ignore[no-untyped-def]
    """Three channels: recover T before this primitive, dL/d(2 FIELD HALF) and dL/d RAY_COLOUR, and the two tallies."""
    a, b = f(a), f(b)
    for k in range(L.TILE):
        step, alpha = _STEPS[k], S[index(at + k + L.ALPHA)]
        inside = (step >= a) & (step < b)
        use = inside & (alpha > f(0)) & (state[index(base + k + L.LAST)] >= rank)
        alpha = alpha if use else f(0)
        over = S[index(at + k + L.OVER)] if use else f(1)
        g0 = state[index(base + k + L.G_COLOR)]
        g1 = state[index(base + k + L.G_COLOR + L.PIXELS)]
        g2 = state[index(base + k + L.G_COLOR + 2 * L.PIXELS)]
        c0, c1, c2 = (
            S[index(at + k + L.RAY_COLOUR)],
            S[index(at + k + L.RAY_COLOUR + L.LANES)],
            S[index(at + k + L.RAY_COLOUR + 2 * L.LANES)],
        )
        cg = g0 * max(c0, f(0)) + g1 * max(c1, f(0)) + g2 * max(c2, f(0))
        behind = state[index(base + k + L.BEHIND)]
        before = state[index(base + k + L.T_)] * over
        weight = alpha * before
        g = (before * cg - behind * over) * S[index(at + k + L.SLOPE)]
        state[index(base + k + L.BEHIND)] = behind + weight * cg
        state[index(base + k + L.T_)] = before
        g = g if use else f(0)
        S[index(at + k + L.GRAD)] = g if inside else S[index(at + k + L.GRAD)]
        sums[k] += weight
        sums[k + L.TILE] += weight * state[index(base + k + L.ERR)]
        h0 = weight * g0 if c0 >= f(0) else f(0)
        h1 = weight * g1 if c1 >= f(0) else f(0)
        h2 = weight * g2 if c2 >= f(0) else f(0)
        S[index(at + k + _RGB_GRADIENT)] = h0 if inside else S[index(at + k + _RGB_GRADIENT)]
        S[index(at + k + _RGB_GRADIENT + L.LANES)] = h1 if inside else S[index(at + k + _RGB_GRADIENT + L.LANES)]
        S[index(at + k + _RGB_GRADIENT + 2 * L.LANES)] = (
            h2 if inside else S[index(at + k + _RGB_GRADIENT + 2 * L.LANES)]
        )


@inline
def weigh_ray_colours(state, S, base, at, cg, C):  # type: ignore[no-untyped-def]
    """cg += sum over channels of max(0, RAY_COLOUR) dL/d colour."""
    for c in range(C):
        st, colour = state[L.G_COLOR + c * L.PIXELS + base :], S[L.RAY_COLOUR + c * L.LANES + at :]
        for k in range(L.TILE):
            cg[k] += max(colour[k], f(0)) * st[k]


@inline
def ray_colour_gradient_row(state, S, base, at, w, a, b, C):  # type: ignore[no-untyped-def]
    """dL/d RAY_COLOUR = w dL/d colour where the colour is not clamped, any channels; other rows' lanes keep theirs."""
    a, b = f(a), f(b)
    for c in range(C):
        st, colour, gradient = (
            state[L.G_COLOR + c * L.PIXELS + base :],
            S[L.RAY_COLOUR + c * L.LANES + at :],
            S[L.RAY_COLOUR + (C + c) * L.LANES + at :],
        )
        for k in range(L.TILE):
            g = w[k] * st[k] if colour[k] >= f(0) else f(0)
            gradient[k] = g if (_STEPS[k] >= a) & (_STEPS[k] < b) else gradient[k]
