"""From dL/d(2 FIELD HALF FADE) of every lane back to one gradient row: shared by both orders of compositing."""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import inline
from neuprim.core.render.cpu import layout as L

__all__ = ["chord_gradient", "density_alone", "field_gradient", "two_neurons"]

f = np.float32


@inline
def field_gradient(S, n, out, edge):  # type: ignore[no-untyped-def]
    """From dL/d(2 FIELD HALF FADE) to dL/d FIELD, and the sums for b2 and log m."""
    offset, log_m = f(0), f(0)
    for k in range(n):
        g = f(2) * S[L.GRAD + k]
        gf = g * S[L.HALF + k] * S[L.FADE + k] if len(edge) > 0 else g * S[L.HALF + k]
        S[L.GRAD + k], S[L.GF + k] = g, gf
        offset += gf
        log_m += gf * S[L.FIELD + k]
        S[L.GQX + k], S[L.GQY + k], S[L.GQZ + k] = f(0), f(0), f(0)
        S[L.GEX + k], S[L.GEY + k], S[L.GEZ + k] = f(0), f(0), f(0)
    out[L.G_OFFSET], out[L.G_LOG_M] = offset, log_m


@inline
def two_neurons(S, V0, V1, n, p, m, out):  # type: ignore[no-untyped-def]
    """Gradients of neurons m and m + 1, and their share of dL/dQ and dL/d(half e); two at a time to share the loads."""
    o = L.NEURONS + L.PER_NEURON * m
    ax, ay, az, aa = p[o + L.WX], p[o + L.WY], p[o + L.WZ], p[o + L.AMPLITUDE]
    o2 = o + L.PER_NEURON
    bx, by, bz, ba = p[o2 + L.WX], p[o2 + L.WY], p[o2 + L.WZ], p[o2 + L.AMPLITUDE]
    s0, s1, s2, s3, s4 = f(0), f(0), f(0), f(0), f(0)
    r0, r1, r2, r3, r4 = f(0), f(0), f(0), f(0), f(0)
    # amplitudes once per neuron, not per lane: in the weights here, in the sums below
    ax1, ay1, az1, bx1, by1, bz1 = ax * aa, ay * aa, az * aa, bx * ba, by * ba, bz * ba
    for k in range(n):
        gf, half = S[L.GF + k], S[L.HALF + k]
        qx, qy, qz = S[L.QX + k], S[L.QY + k], S[L.QZ + k]
        ex, ey, ez = S[L.EXL + k] * half, S[L.EYL + k] * half, S[L.EZL + k] * half
        s0 += gf * V0[L.N_COS + k]
        u = gf * V0[L.N_SIN + k]
        v = gf * V0[L.N_DSINC + k]
        s1 += u
        s2 += u * qx + v * ex
        s3 += u * qy + v * ey
        s4 += u * qz + v * ez
        r0 += gf * V1[L.N_COS + k]
        u1 = gf * V1[L.N_SIN + k]
        v1 = gf * V1[L.N_DSINC + k]
        r1 += u1
        r2 += u1 * qx + v1 * ex
        r3 += u1 * qy + v1 * ey
        r4 += u1 * qz + v1 * ez
        S[L.GQX + k] += u * ax1 + u1 * bx1
        S[L.GQY + k] += u * ay1 + u1 * by1
        S[L.GQZ + k] += u * az1 + u1 * bz1
        S[L.GEX + k] += v * ax1 + v1 * bx1
        S[L.GEY + k] += v * ay1 + v1 * by1
        S[L.GEZ + k] += v * az1 + v1 * bz1
    o, o2 = L.G_NEURONS + L.PER_NEURON * m, L.G_NEURONS + L.PER_NEURON * (m + 1)
    out[o + L.AMPLITUDE], out[o + L.PHASE], out[o + L.WX], out[o + L.WY], out[o + L.WZ] = s0, aa * s1, aa * s2, aa * s3, aa * s4
    out[o2 + L.AMPLITUDE], out[o2 + L.PHASE], out[o2 + L.WX], out[o2 + L.WY], out[o2 + L.WZ] = r0, ba * r1, ba * r2, ba * r3, ba * r4


@inline
def density_alone(S, n):  # type: ignore[no-untyped-def]
    """Keep dL/dQ . e before colours add to dL/dQ: see :func:`chord_gradient`."""
    for k in range(n):
        S[L.INSIDE + k] = S[L.GQX + k] * S[L.EXL + k] + S[L.GQY + k] * S[L.EYL + k] + S[L.GQZ + k] * S[L.EZL + k]


@inline
def chord_gradient(S, n, p, out, edge, in_float64):  # type: ignore[no-untyped-def]
    """From chord middle, half chord and direction back to the affine ray (E0, EX, EY, XA).

    A hard edge has the gradient of its ends, t0 and t1. A soft one has none there, the density being zero, but its weight depends on
    D = 1 - |p|^2, and on a = e.e and the closest approach where the near plane may cut the chord. In float32 no chord is cut, the weight is
    proportional to D^p, and the ends' share through HALF is kept, as it belongs to the closed form: BY_D is d FADE/dD. In float64
    the ends are left out, and BY_D, BY_A and BY_TM are derivatives of the whole mean FADE FIELD.
    """
    tc, soft = p[L.TC], len(edge)
    a0, a1, a2, a3, a4, a5 = f(0), f(0), f(0), f(0), f(0), f(0)
    a6, a7, a8, a9, b0, b1 = f(0), f(0), f(0), f(0), f(0), f(0)
    for k in range(n):
        half, ex, ey, ez = S[L.HALF + k], S[L.EXL + k], S[L.EYL + k], S[L.EZL + k]
        mid, tm, ia, uncut, dh = S[L.MID + k], S[L.TM + k], S[L.IA + k], S[L.UNCUT + k], S[L.DH + k]
        h, slide = S[L.HEIGHT + k], S[L.SLIDE + k]
        shift = mid - tm  # the closest point again: three stores fewer before
        px, py, pz = S[L.QX + k] - shift * ex, S[L.QY + k] - shift * ey, S[L.QZ + k] - shift * ez
        gqx, gqy, gqz = S[L.GQX + k], S[L.GQY + k], S[L.GQZ + k]
        vx, vy, vz = S[L.GEX + k], S[L.GEY + k], S[L.GEZ + k]
        g, field = S[L.GRAD + k], S[L.FIELD + k]
        g_half = vx * ex + vy * ey + vz * ez + (g * field * S[L.FADE + k] if soft > 0 else g * field)
        gex, gey, gez = vx * half + mid * gqx, vy * half + mid * gqy, vz * half + mid * gqz
        g_mid = gqx * ex + gqy * ey + gqz * ez + S[L.GMID + k]
        if soft > 0 and in_float64:
            g_half, g_mid = f(0), g_mid - S[L.INSIDE + k]
        gt1 = (g_mid + g_half) * f(0.5)
        gt0 = (g_mid - g_half) * f(0.5) * uncut
        g_tm, g_h = gt0 + gt1, gt1 - gt0  # t0 = tm - h, t1 = tm + h
        if soft > 0 and in_float64:
            g_tm += g * half * S[L.BY_TM + k]
        gD = g_h * dh  # dh/dD with D floored
        if soft > 0:
            gD += g * half * S[L.BY_D + k] if in_float64 else g * half * field * S[L.BY_D + k]
        gA = -(g_h * h * f(0.5) + g_tm * tm) * ia  # via a = e.e, h = sqrt(D/a), tm = -(m.e)/a
        if soft > 0 and in_float64:
            gA += g * half * S[L.BY_A + k]
        gB = -g_tm * ia
        m2 = f(-2) * gD  # D = 1 - |p|^2, and |p| = |m + tm e| does not change with tm
        gmx, gmy, gmz = gqx + m2 * px + gB * ex, gqy + m2 * py + gB * ey, gqz + m2 * pz + gB * ez
        # the ray's origin is m = p - tm e
        gA2 = f(2) * gA - gB * tm
        gp = tm * m2 + gB
        gex += gp * px + gA2 * ex
        gey += gp * py + gA2 * ey
        gez += gp * pz + gA2 * ez
        du, dv, reach = S[L.DU + k], S[L.DV + k], tc + slide
        hx, hy, hz = gex + reach * gmx, gey + reach * gmy, gez + reach * gmz
        a0 += gex + slide * gmx
        a1 += gey + slide * gmy
        a2 += gez + slide * gmz
        a3 += du * hx
        a4 += du * hy
        a5 += du * hz
        a6 += dv * hx
        a7 += dv * hy
        a8 += dv * hz
        a9 += gmx
        b0 += gmy
        b1 += gmz
    out[L.E0], out[L.E0 + 1], out[L.E0 + 2] = a0, a1, a2
    out[L.EX], out[L.EX + 1], out[L.EX + 2] = a3, a4, a5
    out[L.EY], out[L.EY + 1], out[L.EY + 2] = a6, a7, a8
    out[L.XA], out[L.XA + 1], out[L.XA + 2] = a9, b0, b1
