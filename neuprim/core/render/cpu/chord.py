"""The integral along one chord (part of a ray inside an ellipsoid) in float32, forward and backward.

Phases u are in turns (2 pi) and are reduced exactly to half a turn: ``r = u - rint(u)``. A neuron's rate v is the
change of its phase over half a chord, in turns. The mean of a neuron over the chord is its value at the chord's middle
times its profile B_p(2 pi v). p is the exponent of the edge (:mod:`neuprim.core.model.edge`). B_0 is sinc, for a hard
edge; B_1 and B_2 are for a soft edge (density that fades to zero at the ellipsoid's boundary).

cos, B_p and the exponential are polynomials (tools/fit_polynomials.py). One polynomial of B_p serves |v| up to half a
turn, a longer one |v| up to 1.5 turns. For larger |v| and z = 2 pi v, B_1 = 3 (B_0 - cos z)/z^2 and
B_2 = 15 (B_1 - B_0)/z^2. The derivatives are dB_1/dz = -3 (B_1 - B_0)/z and dB_2/dz = -5 (B_2 - B_1)/z. float32 errors
are below 2e-6.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from neuprim.core.compute.kernels import compile_dispatch_by_length, inline, inline_source
from neuprim.core.model.edge import NORMS
from neuprim.core.render import layout as P

EDGE_TYPES: tuple[tuple[int, ...], ...] = ((), (0,), (0, 0))
"""The edge exponents p = 0, 1, 2 as arguments of kernels: tuples of p zeros. A tuple's length is part of its type, so
numba compiles one kernel per exponent, and only for the exponents that are used."""

Kernel = Callable[..., Any]
f = np.float32
TAU = f(2 * np.pi)

_C0, _C1, _C2, _C3, _C4, _C5, _C6 = (
    f(c) for c in (
        1.0, -19.73920440673828, 64.93911743164062, -85.45016479492188, 60.16783142089844, -25.968313217163086,
        6.529610633850098,
    )
)  # fmt: skip
_S0, _S1, _S2, _S3, _S4, _S5 = (
    f(c) for c in (
        0.9999999403953552, -6.579718589782715, 12.987038612365723, -12.193624496459961, 6.580165386199951,
        -1.9852460622787476,
    )
)  # fmt: skip
_D0, _D1, _D2, _D3, _D4, _D5 = (
    f(c) for c in (
        -6.579736232757568, 25.975732803344727, -36.623226165771484, 26.756011962890625, -11.860190391540527,
        3.093101978302002,
    )
)  # fmt: skip
_M0, _M1, _M2, _M3, _M4, _M5, _M6, _M7, _M8, _M9, _M10 = (
    f(c) for c in (
        0.05581631940701254, 0.4362123752771363, -0.6370321672800427, -0.27636890430229927, 0.8312559868298691,
        -0.5947233435367446, 0.2374873217981118, -0.06324641573684713, 0.012253660547389418, -0.0018736913572860911,
        0.00021887869764285634,
    )
)  # fmt: skip
_N0, _N1, _N2, _N3, _N4, _N5, _N6, _N7, _N8, _N9 = (
    f(c) for c in (
        0.3877441347416979, -1.132501461406376, -0.7369757903376593, 2.9555745464283736, -2.6432625907720526,
        1.2666074512059946, -0.3934441512729933, 0.08712575631466417, -0.015040448572156936, 0.0019507300281688589,
    )
)  # fmt: skip
_TO_UNIT = f(2 / 1.5**2)  # v^2 on [0, 1.5^2] to [-1, 1]: small coefficients, nothing cancels
_E2, _E3, _E4, _E5, _E6 = f(1 / 2), f(1 / 6), f(1 / 24), f(1 / 120), f(1 / 720)
_ONE, _TWO, _SIXTEENTH, _CEIL = f(1), f(2), f(-1 / 16), f(9.4)

_SLOW = {
    1: (
        1.0, -3.947838068008423, 5.566062927246094, -4.0664262771606445, 1.8025330305099487, -0.4700953960418701,
    ),
    2: (
        1.0, -2.8198859691619873, 3.0923011302948, -1.8488370180130005, 0.695292592048645, -0.15979965031147003,
    ),
}  # fmt: skip
_SLOW_SLOPE = {
    1: (
        -3.9478418827056885, 11.132474899291992, -12.208269119262695, 7.302683353424072, -2.7615163326263428,
        0.6567270755767822,
    ),
    2: (
        -2.8198869228363037, 6.184709548950195, -5.549287796020508, 2.8098440170288086, -0.9264959692955017,
        0.20373320579528809,
    ),
}  # fmt: skip
_MEDIUM = {
    1: (
        -0.05893004313111305, 0.17211958765983582, 0.11200688779354095, -0.44919347763061523, 0.40172773599624634,
        -0.1925012469291687, 0.05979634076356888, -0.013241526670753956, 0.002285874215885997, -0.00029647554038092494,
    ),
    2: (
        -0.03875413164496422, -0.05043990537524223, 0.30341872572898865, -0.3617872893810272, 0.2167164385318756,
        -0.08087369054555893, 0.0208695400506258, -0.003977504093199968, 0.0006010864744894207, -6.996675801929086e-05,
    ),
}  # fmt: skip
_MEDIUM_SLOPE = {
    1: (
        0.15299518406391144, 0.19912876188755035, -1.1978490352630615, 1.428278923034668, -0.8555622100830078,
        0.31927651166915894, -0.08238963782787323, 0.01570255681872368, -0.0023729943204671144, 0.00027621767367236316,
    ),
    2: (
        -0.044835470616817474, 0.5394122004508972, -0.9647660255432129, 0.7705288529396057, -0.35943883657455444,
        0.11138193309307098, -0.024748504161834717, 0.004155985079705715, -0.0005599680007435381,
        5.919351679040119e-05,
    ),
}  # fmt: skip


@inline
def one_minus_exp(x):  # type: ignore[no-untyped-def]
    """Return 1 - exp(-x) for x clamped to [0, 9.4]; larger x are not needed, because alpha is at most 0.9999.

    The function computes exp(-x/16) - 1 by a polynomial, then doubles the exponent four times.
    """
    r = min(max(x, f(0)), _CEIL) * _SIXTEENTH
    q = (((((_E6 * r + _E5) * r + _E4) * r + _E3) * r + _E2) * r + _ONE) * r
    q = q * (q + _TWO)
    q = q * (q + _TWO)
    q = q * (q + _TWO)
    q = q * (q + _TWO)
    return -q


@inline
def cos_turns(z):  # type: ignore[no-untyped-def]
    """Return cos(2 pi r) from z = r^2, |r| <= 1/2."""
    return (((((_C6 * z + _C5) * z + _C4) * z + _C3) * z + _C2) * z + _C1) * z + _C0


@inline
def sinc_turns(z):  # type: ignore[no-untyped-def]
    """Return sin(2 pi r)/(2 pi r) from z = r^2, |r| <= 1/2."""
    return ((((_S5 * z + _S4) * z + _S3) * z + _S2) * z + _S1) * z + _S0


@inline
def dsinc_turns(z):  # type: ignore[no-untyped-def]
    """Return the derivative of :func:`sinc_turns` by z.

    The derivative has its own polynomial, because the difference cos - sinc loses digits for small z.
    """
    return ((((_D5 * z + _D4) * z + _D3) * z + _D2) * z + _D1) * z + _D0


@inline
def _chord_sinc_medium(t):  # type: ignore[no-untyped-def]
    """Return sin(2 pi v)/(2 pi v) for |v| <= 1.5, from t = v^2 2/1.5^2 - 1, which lies in [-1, 1]."""
    low = ((((_M5 * t + _M4) * t + _M3) * t + _M2) * t + _M1) * t + _M0
    high = (((_M10 * t + _M9) * t + _M8) * t + _M7) * t + _M6
    t2 = t * t
    return high * (t2 * t2 * t2) + low


@inline
def _chord_dsinc_medium(t):  # type: ignore[no-untyped-def]
    """Return the derivative of sinc(2 pi v) by v^2 for |v| <= 1.5, from t = v^2 2/1.5^2 - 1."""
    return ((((((((_N9 * t + _N8) * t + _N7) * t + _N6) * t + _N5) * t + _N4) * t + _N3) * t + _N2) * t + _N1) * t + _N0


# sinc(2 pi v) of two neurons, and the same with d sinc / dv, for the three ranges of v


@inline
def _hard_sincs_slow(v, w):  # type: ignore[no-untyped-def]
    """Return sinc(2 pi v) and sinc(2 pi w) for the rates of two neurons, |v|, |w| <= 1/2; sinc x = sin x / x."""
    return sinc_turns(v * v), sinc_turns(w * w)


@inline
def _hard_slopes_slow(v, w):  # type: ignore[no-untyped-def]
    """Return sinc(2 pi v), its derivative by v, sinc(2 pi w) and its derivative by w, for |v|, |w| <= 1/2."""
    y, z = v * v, w * w
    return sinc_turns(y), dsinc_turns(y) * _TWO * v, sinc_turns(z), dsinc_turns(z) * _TWO * w


@inline
def _hard_sincs_medium(v, w):  # type: ignore[no-untyped-def]
    """Return sinc(2 pi v) and sinc(2 pi w) for the rates of two neurons, |v|, |w| <= 3/2; sinc x = sin x / x."""
    return _chord_sinc_medium(v * v * _TO_UNIT - _ONE), _chord_sinc_medium(w * w * _TO_UNIT - _ONE)


@inline
def _hard_slopes_medium(v, w):  # type: ignore[no-untyped-def]
    """Return sinc(2 pi v), its derivative by v, sinc(2 pi w) and its derivative by w, for |v|, |w| <= 3/2."""
    y, z = v * v * _TO_UNIT - _ONE, w * w * _TO_UNIT - _ONE
    return (
        _chord_sinc_medium(y),
        _chord_dsinc_medium(y) * _TWO * v,
        _chord_sinc_medium(z),
        _chord_dsinc_medium(z) * _TWO * w,
    )


@inline
def _reduced_chord_rates(v, w):  # type: ignore[no-untyped-def]
    """Return six values: v and w minus the nearest integers, whether |v| <= 1/2 and |w| <= 1/2, and 1/v and 1/w.

    v and w are the rates of two neurons. A reciprocal is replaced by 1 if the rate is at most 1/2.
    """
    k, j = np.rint(v), np.rint(w)
    a, b = k == f(0), j == f(0)
    sv, sw = f(1) if a else v, f(1) if b else w
    q = f(1) / (sv * sw)
    return v - k, w - j, a, b, q * sw, q * sv


@inline
def _hard_reduced(v, near, r, iv):  # type: ignore[no-untyped-def]
    """Return sinc(2 pi v) and its derivative by v, for any rate v, from r = v - rint(v) and iv = 1/v.

    If ``near`` (|v| is at most half a turn), both are polynomials. Otherwise, sinc(2 pi v) = r/v sinc(2 pi r), and the
    derivative is (cos(2 pi v) - sinc(2 pi v))/v.
    """
    z = r * r
    x = sinc_turns(z)
    b = x if near else x * r * iv
    return b, dsinc_turns(z) * _TWO * v if near else (cos_turns(z) - b) * iv


def _horner_polynomial(coefficients: tuple[float, ...]) -> Kernel:
    """Return a function that evaluates the polynomial with these coefficients (lowest power first) without a loop."""
    first = f(coefficients[0])
    if len(coefficients) == 1:

        @inline
        def last(z):  # type: ignore[no-untyped-def]
            return first

        return last
    rest = _horner_polynomial(coefficients[1:])

    @inline
    def polynomial(z):  # type: ignore[no-untyped-def]
        return rest(z) * z + first

    return polynomial


def _split_chord_polynomial(coefficients: tuple[float, ...]) -> Kernel:
    """Return a function that evaluates the polynomial with ten coefficients as two shorter chains.

    Unlike in :func:`_horner_polynomial`, the latencies of the chains overlap.
    """
    low, high = _horner_polynomial(coefficients[:5]), _horner_polynomial(coefficients[5:])

    @inline
    def polynomial(t):  # type: ignore[no-untyped-def]
        t2 = t * t
        return high(t) * (t2 * t2 * t) + low(t)

    return polynomial


def _slow_chord_profiles(p: int) -> tuple[Kernel, Kernel]:
    """Return both functions of :func:`_fast_chord_profiles` for edge exponent ``p``, 1 or 2, and |v|, |w| <= 1/2."""
    value, slope = _horner_polynomial(_SLOW[p]), _horner_polynomial(_SLOW_SLOPE[p])

    @inline
    def profiles(v, w):  # type: ignore[no-untyped-def]
        return value(v * v), value(w * w)

    @inline
    def slopes(v, w):  # type: ignore[no-untyped-def]
        y, z = v * v, w * w
        return value(y), slope(y) * f(2) * v, value(z), slope(z) * f(2) * w

    return profiles, slopes


def _medium_chord_profiles(p: int) -> tuple[Kernel, Kernel]:
    """Return both functions of :func:`_fast_chord_profiles` for edge exponent ``p``, 1 or 2, and |v|, |w| <= 3/2."""
    value, slope = _split_chord_polynomial(_MEDIUM[p]), _split_chord_polynomial(_MEDIUM_SLOPE[p])

    @inline
    def profiles(v, w):  # type: ignore[no-untyped-def]
        return value(v * v * _TO_UNIT - f(1)), value(w * w * _TO_UNIT - f(1))

    @inline
    def slopes(v, w):  # type: ignore[no-untyped-def]
        y, z = v * v * _TO_UNIT - f(1), w * w * _TO_UNIT - f(1)
        return value(y), slope(y) * f(2) * v, value(z), slope(z) * f(2) * w

    return profiles, slopes


def _soft_reduced(p: int) -> Kernel:
    """Return a function like :func:`_hard_reduced` for a soft edge of exponent ``p``, 1 or 2."""
    value, slope = _horner_polynomial(_SLOW[p]), _horner_polynomial(_SLOW_SLOPE[p])
    first = p == 1

    @inline
    def reduced(v, near, r, iv):  # type: ignore[no-untyped-def]
        """Return B_p(2 pi v) and its derivative by v, from r = v - rint(v) and iv = 1/v.

        If ``near`` (|v| is at most half a turn), both are polynomials; otherwise, the formulas of the module apply.
        """
        z, iz = r * r, iv * f(1 / TAU)  # iz = 1/(2 pi v)
        b0, cosine = sinc_turns(z) * r * iv, cos_turns(z)
        b1 = f(3) * (b0 - cosine) * iz * iz
        if first:
            b, db = b1, f(-3) * (b1 - b0) * iv
        else:
            b2 = f(15) * (b1 - b0) * iz * iz
            b, db = b2, f(-5) * (b2 - b1) * iv
        y = v * v if near else f(0)
        return value(y) if near else b, slope(y) * f(2) * v if near else db

    return reduced


def _fast_chord_profiles(reduced: Kernel) -> tuple[Kernel, Kernel]:
    """Return two functions of the rates v and w of two neurons, for rates of any size.

    The first function returns B_p(2 pi v) and B_p(2 pi w). The second function returns B_p(2 pi v), the derivative of
    B_p(2 pi v) by v, and the same two values for w. ``reduced`` computes B_p, see :func:`_hard_reduced`.
    """

    @inline
    def profiles(v, w):  # type: ignore[no-untyped-def]
        r, s, a, b, iv, iw = _reduced_chord_rates(v, w)
        return reduced(v, a, r, iv)[0], reduced(w, b, s, iw)[0]

    @inline
    def slopes(v, w):  # type: ignore[no-untyped-def]
        r, s, a, b, iv, iw = _reduced_chord_rates(v, w)
        x, dx = reduced(v, a, r, iv)
        y, dy = reduced(w, b, s, iw)
        return x, dx, y, dy

    return profiles, slopes


_soft_slow, _soft_medium = ((kind(1), kind(2)) for kind in (_slow_chord_profiles, _medium_chord_profiles))
_reduced = (_hard_reduced, _soft_reduced(1), _soft_reduced(2))
_fast = tuple(_fast_chord_profiles(reduced) for reduced in _reduced)
profiles_slow = compile_dispatch_by_length(_hard_sincs_slow, _soft_slow[0][0], _soft_slow[1][0])
profiles_medium = compile_dispatch_by_length(_hard_sincs_medium, _soft_medium[0][0], _soft_medium[1][0])
profiles_fast = compile_dispatch_by_length(*(profiles for profiles, _ in _fast))
slopes_slow = compile_dispatch_by_length(_hard_slopes_slow, _soft_slow[0][1], _soft_slow[1][1])
slopes_medium = compile_dispatch_by_length(_hard_slopes_medium, _soft_medium[0][1], _soft_medium[1][1])
slopes_fast = compile_dispatch_by_length(*(slopes for _, slopes in _fast))
# (edge, v, whether |v| <= 1/2, v minus the nearest integer, 1/v or 1) -> B_p(2 pi v) and its derivative by v
reduced_profile = compile_dispatch_by_length(*_reduced)


_MEANS = tuple(f(n / 2) for n in NORMS)  # means of (1 - u^2)^p over [-1, 1]


@inline_source
def load_ray(p):  # type: ignore[no-untyped-def]
    """Return the numbers of a primitive's row that :func:`intersect_chord` needs; load them once for many pixels."""
    return (
        p[P.E0], p[P.E0 + 1], p[P.E0 + 2], p[P.EX], p[P.EX + 1], p[P.EX + 2], p[P.EY], p[P.EY + 1], p[P.EY + 2],
        p[P.XA], p[P.XA + 1], p[P.XA + 2], p[P.XU], p[P.XU + 1], p[P.XU + 2], p[P.XV], p[P.XV + 1], p[P.XV + 2],
        p[P.TU], p[P.TV], p[P.NEAR],
    )  # fmt: skip


@inline_source
def intersect_chord(pixel, fx0, fy0, row):  # type: ignore[no-untyped-def]
    """Intersect one pixel's ray with a primitive's ellipsoid; return 16 numbers that describe the chord.

    The 16 numbers are: offset du, dv from the anchor pixel; slide (see :mod:`neuprim.core.render.layout`); ray
    direction e (3) and point p (3) closest to the centre, both in whitened space; D = 1 - |p|^2; ia = 1/(e.e); t of p;
    half the uncut chord; uncut (1 if the near plane does not cut the chord, else 0); middle t and half length of the
    chord beyond the near plane. The half length is 0 if the ray misses. Lengths are in units of m along e.

    ``pixel`` is 16 y + x in the tile, (``fx0``, ``fy0``) the offset of the tile's first pixel centre from the anchor.
    ``row`` is the result of :func:`load_ray`.
    """
    e0, e1, e2, x0, x1, x2, y0, y1, y2, a0, a1, a2, u0, u1, u2, v0, v1, v2, tu, tv, near = row
    y = np.floor(pixel * f(1 / P.TILE))
    du, dv = fx0 + (pixel - y * f(P.TILE)), fy0 + y
    slide = du * tu + dv * tv
    gx, gy, gz = du * x0 + dv * y0, du * x1 + dv * y1, du * x2 + dv * y2
    ex, ey, ez = e0 + gx, e1 + gy, e2 + gz
    mx = a0 + du * u0 + dv * v0 + slide * gx
    my = a1 + du * u1 + dv * v1 + slide * gy
    mz = a2 + du * u2 + dv * v2 + slide * gz
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
    """Return dh/dD of the half chord h = sqrt(D ``ia``); for a hard edge, D counts as at least ``depth_floor``.

    ``ia`` is 1/(e.e) for the ray direction e. At a silhouette, D is 0 and dh/dD grows without bound. A soft edge needs
    no such floor, because its weight D^p outweighs D^-1/2.
    """
    return f(0.5) * ia / np.sqrt(max(D, depth_floor if len(edge) == 0 else f(1e-12)) * ia)


@inline_source
def chord_edge_fade(D, edge):  # type: ignore[no-untyped-def]
    """Return FADE, the mean edge weight (1 - |y|^2)^p of an uncut chord, and dFADE/dD; 1 and 0 for a hard edge (p = 0).

    y is a point in whitened space. ``D`` is 1 - |y|^2 at the chord's middle.
    """
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
    """Return dL/dm (3) and dL/de (3) of a ray with origin m and direction e, from the gradients of its chord.

    ``g_half`` and ``g_mid`` are the gradients by the half chord and by t of the chord's middle. (qx, qy, qz) is
    dL/d(chord's middle point), and (vx, vy, vz) is dL/d(half e). ``g_tm``, ``gD`` and ``gA`` are the gradients by t of
    the closest point p, by D = 1 - |p|^2 and by a = e.e. These three exclude the parts through the chord's ends.
    ``dh`` is dh/dD. The other arguments are results of :func:`intersect_chord`.
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
    """Return twelve zeros, the sums with which :func:`add_ray_gradient` starts."""
    return f(0), f(0), f(0), f(0), f(0), f(0), f(0), f(0), f(0), f(0), f(0), f(0)


@inline
def add_ray_gradient(sums, du, dv, slide, reach, gmx, gmy, gmz, gex, gey, gez):  # type: ignore[no-untyped-def]
    """Return ``sums`` plus one pixel's gradient by E0, EX, EY, XA, the 12 numbers that define a primitive's rays.

    (gmx, gmy, gmz) and (gex, gey, gez) are the pixel's dL/d(ray origin m) and dL/d(ray direction e). ``du`` and ``dv``
    are the pixel's offset from the anchor pixel. ``slide`` is how far the origin is slid along the ray. ``reach`` is TC
    (depth of the anchor, in units of the longest semi-axis) plus ``slide``.
    """
    a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, b0, b1 = sums
    hx, hy, hz = gex + reach * gmx, gey + reach * gmy, gez + reach * gmz
    return (
        a0 + (gex + slide * gmx), a1 + (gey + slide * gmy), a2 + (gez + slide * gmz),
        a3 + du * hx, a4 + du * hy, a5 + du * hz, a6 + dv * hx, a7 + dv * hy, a8 + dv * hz,
        a9 + gmx, b0 + gmy, b1 + gmz,
    )  # fmt: skip


@inline
def store_ray_gradient(sums, out):  # type: ignore[no-untyped-def]
    """Write the twelve sums of :func:`add_ray_gradient` into their columns of a gradient row."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8, a9, b0, b1 = sums
    out[P.E0], out[P.E0 + 1], out[P.E0 + 2] = a0, a1, a2
    out[P.EX], out[P.EX + 1], out[P.EX + 2] = a3, a4, a5
    out[P.EY], out[P.EY + 1], out[P.EY + 2] = a6, a7, a8
    out[P.XA], out[P.XA + 1], out[P.XA + 2] = a9, b0, b1
