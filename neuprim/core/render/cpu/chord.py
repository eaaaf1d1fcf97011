"""One lane's chord in float32, forward and backward, as numbers instead of arrays (method: "Line integral")."""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import inline, inline_source
from neuprim.core.model.edge import NORMS
from neuprim.core.render import layout as P

f = np.float32
_MEANS = tuple(f(n / 2) for n in NORMS)  # of (1 - u^2)^p over [-1, 1]


@inline_source
def load_ray(p):  # type: ignore[no-untyped-def]
    """What :func:`intersect_chord` reads of a primitive's row, read once for all lanes."""
    return (
        p[P.E0], p[P.E0 + 1], p[P.E0 + 2], p[P.EX], p[P.EX + 1], p[P.EX + 2], p[P.EY], p[P.EY + 1], p[P.EY + 2],
        p[P.XA], p[P.XA + 1], p[P.XA + 2], p[P.XU], p[P.XU + 1], p[P.XU + 2], p[P.XV], p[P.XV + 1], p[P.XV + 2],
        p[P.TU], p[P.TV], p[P.NEAR],
    )  # fmt: skip


@inline_source
def intersect_chord(pixel, fx0, fy0, row):  # type: ignore[no-untyped-def]
    """The chord of one pixel of the tile, named as in the layout; ``half`` is 0 where the ray misses.

    fx0, fy0: the tile corner's pixel centre from the anchor; row: from :func:`load_ray`.
    """
    e0, e1, e2, x0, x1, x2, y0, y1, y2, a0, a1, a2, u0, u1, u2, v0, v1, v2, tu, tv, near = row
    y = np.floor(pixel * f(1 / P.TILE))
    du, dv = fx0 + (pixel - y * f(P.TILE)), fy0 + y
    slide = du * tu + dv * tv
    gx, gy, gz = du * x0 + dv * y0, du * x1 + dv * y1, du * x2 + dv * y2
    ex, ey, ez = e0 + gx, e1 + gy, e2 + gz
    mx, my, mz = (
        a0 + du * u0 + dv * v0 + slide * gx,
        a1 + du * u1 + dv * v1 + slide * gy,
        a2 + du * u2 + dv * v2 + slide * gz,
    )
    ia = f(1) / (ex * ex + ey * ey + ez * ez)
    tm = -(mx * ex + my * ey + mz * ez) * ia
    px, py, pz = mx + tm * ex, my + tm * ey, mz + tm * ez
    D = f(1) - (px * px + py * py + pz * pz)
    h = np.sqrt(max(D, f(1e-12)) * ia)
    t0, t1 = tm - h, tm + h
    near_here = near - slide
    uncut = f(1) if t0 > near_here else f(0)
    t0 = max(t0, near_here)
    mid = (t0 + t1) * f(0.5)
    half = (t1 - t0) * f(0.5)
    half = half if D > f(0) else f(0)
    half = max(half, f(0))
    return du, dv, slide, ex, ey, ez, px, py, pz, D, ia, tm, h, uncut, mid, half


@inline_source
def half_chord_slope(D, ia, depth_floor, edge):  # type: ignore[no-untyped-def]
    """dh/dD of h = sqrt(D/a), with the floor on D; a soft edge needs none, as D^p tames what grows as D^-1/2."""
    return f(0.5) * ia / np.sqrt(max(D, depth_floor if len(edge) == 0 else f(1e-12)) * ia)


@inline_source
def chord_edge_fade(D, edge):  # type: ignore[no-untyped-def]
    """FADE of a whole chord, the mean of (1 - |y|^2)^p, and its derivative by D; 1 and 0 for a hard edge."""
    inner = max(D, f(0))
    if len(edge) == 0:
        return f(1), f(0)
    if len(edge) == 1:
        return _MEANS[1] * inner, _MEANS[1]
    return _MEANS[2] * inner * inner, f(2) * _MEANS[2] * inner


@inline
def chord_backward(  # type: ignore[no-untyped-def]
    g_half, g_mid, g_tm, gD, gA, half, ex, ey, ez, px, py, pz, mid, tm, ia, h, uncut, dh, qx, qy, qz, vx, vy, vz,
):  # fmt: skip
    """From dL/d(half, MID), dL/d(chord middle) = q, dL/d(half e) = v to dL/d(origin m, direction e) of the ray.

    g_tm, gD, gA: what reaches closest approach, D = 1 - |p|^2 and a = e.e other than through the chord's ends.
    """
    gex, gey, gez = vx * half + mid * qx, vy * half + mid * qy, vz * half + mid * qz
    gt1 = (g_mid + g_half) * f(0.5)
    gt0 = (g_mid - g_half) * f(0.5) * uncut
    g_tm, g_h = g_tm + gt0 + gt1, gt1 - gt0  # t0 = tm - h, t1 = tm + h
    gD += g_h * dh
    gA -= (g_h * h * f(0.5) + g_tm * tm) * ia  # via a = e.e, h = sqrt(D/a), tm = -(m.e)/a
    gB = -g_tm * ia
    m2 = f(-2) * gD  # D = 1 - |p|^2, and |p| = |m + tm e| does not change with tm
    gmx, gmy, gmz = qx + m2 * px + gB * ex, qy + m2 * py + gB * ey, qz + m2 * pz + gB * ez
    # the ray's origin is m = p - tm e
    gA2 = f(2) * gA - gB * tm
    gp = tm * m2 + gB
    return gmx, gmy, gmz, gex + gp * px + gA2 * ex, gey + gp * py + gA2 * ey, gez + gp * pz + gA2 * ez


@inline
def zero_ray_sums():  # type: ignore[no-untyped-def]
    """The sums of :func:`add_ray_gradient` at the start."""
    return f(0), f(0), f(0), f(0), f(0), f(0), f(0), f(0), f(0), f(0), f(0), f(0)


@inline
def add_ray_gradient(sums, du, dv, slide, reach, gmx, gmy, gmz, gex, gey, gez):  # type: ignore[no-untyped-def]
    """One lane's share of dL/d(E0, EX, EY, XA), from dL/dm and dL/de; ``reach`` is tc + slide."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, b0, b1 = sums
    hx, hy, hz = gex + reach * gmx, gey + reach * gmy, gez + reach * gmz
    return (
        a0 + (gex + slide * gmx), a1 + (gey + slide * gmy), a2 + (gez + slide * gmz),
        a3 + du * hx, a4 + du * hy, a5 + du * hz, a6 + dv * hx, a7 + dv * hy, a8 + dv * hz,
        a9 + gmx, b0 + gmy, b1 + gmz,
    )  # fmt: skip


@inline
def store_ray_gradient(sums, out):  # type: ignore[no-untyped-def]
    """Write the sums into a gradient row."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, b0, b1 = sums
    out[P.E0], out[P.E0 + 1], out[P.E0 + 2] = a0, a1, a2
    out[P.EX], out[P.EX + 1], out[P.EX + 2] = a3, a4, a5
    out[P.EY], out[P.EY + 1], out[P.EY + 2] = a6, a7, a8
    out[P.XA], out[P.XA + 1], out[P.XA + 2] = a9, b0, b1
