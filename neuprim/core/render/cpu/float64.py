"""Chords and densities of pixels in float64, for the few primitives for which float32 is not accurate enough.

Results are rounded to float32 and stored in the arrays of the lanes (pixels of one (tile, primitive) pair). A chord is
the part of a ray inside an ellipsoid. For hard edges, and for pairs of which the near plane cuts no chord, this module
uses the profiles of the float32 stage, with phases reduced in float64.

The profiles do not hold for a soft edge if the near plane cuts the chord. The density of a soft edge fades as
(1 - |y|^2)^p, with y the point in units of the semi-axes. u goes from -1 to 1 along the chord. e is the ray direction,
and a = e.e. D is 1 - |y|^2 at the point closest to the centre, and shift is the distance (in t) from this point to the
chord's middle. Then 1 - |y|^2 = D - a (shift + half u)^2. The p-th power is a polynomial q in u. The mean of
q cos(phase + z u) follows from the moments

    C_n = 1/2 integral of u^n cos(z u) du (n even),   S_n = 1/2 integral of u^n sin(z u) du (n odd),
    dC_n/dz = -S_(n+1), dS_n/dz = C_(n+1)

which are sums of spherical Bessel functions (:mod:`neuprim.core.model.edge`). FADE is the mean of q. FIELD is the mean
of q times density, divided by FADE, so that the gradients of weights use the same code for every edge.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import inline
from neuprim.core.render import layout as P
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.chord import TAU, chord_edge_fade, cos_turns, reduced_profile, sinc_turns

f = np.float32
_PI2 = 2.0 * np.pi
_TERMS = 14
# float64 lanes: chord middle and half chord vector in whitened space, 1 - |y|^2 at the closest approach, shift from
# there to the middle, e.e, and half chord (shift and half chord in units of m along e)
_Q0, _Q1, _Q2 = _Q = L.lane_array(0), L.lane_array(1), L.lane_array(2)
_V0, _V1, _V2 = _V = L.lane_array(3), L.lane_array(4), L.lane_array(5)
_INNER, _SHIFT, _SQUARE, _HALF = L.lane_array(6), L.lane_array(7), L.lane_array(8), L.lane_array(9)
FLOAT64_SCRATCH = L.lane_array(10)


@inline
def chords_float64(S, X, n, frame, pair, with_mid, backward, edge):  # type: ignore[no-untyped-def]
    """Compute the chords (rays inside the ellipsoid) of ``n`` lanes in float64; return whether the near plane cuts any.

    Fills the same arrays as :func:`~neuprim.core.render.cpu.tiles.lane_chords`, and ``X`` with the float64 values.
    """
    p, fx0, fy0 = frame.wide[frame.slots[pair.i]], pair.tx + 0.5, pair.ty + 0.5
    e0, e1, e2, tc, near = p[P.E0], p[P.E0 + 1], p[P.E0 + 2], p[P.TC], p[P.NEAR]
    x0, x1, x2, y0, y1, y2 = p[P.EX], p[P.EX + 1], p[P.EX + 2], p[P.EY], p[P.EY + 1], p[P.EY + 2]
    a0, a1, a2, offset = p[P.XA], p[P.XA + 1], p[P.XA + 2], f(p[P.OFFSET])
    fx0, fy0, depth_floor, cut = fx0 - p[P.UX], fy0 - p[P.UY], frame.depth_floor, f(0)
    for k in range(n):
        pixel = S[L.PIXEL + k]
        y = np.floor(pixel * f(1 / P.TILE))
        du, dv = fx0 + np.float64(pixel - y * f(P.TILE)), fy0 + np.float64(y)
        gx, gy, gz = du * x0 + dv * y0, du * x1 + dv * y1, du * x2 + dv * y2
        ex, ey, ez = e0 + gx, e1 + gy, e2 + gz
        mx, my, mz = a0 + tc * gx, a1 + tc * gy, a2 + tc * gz
        ia = 1.0 / (ex * ex + ey * ey + ez * ez)
        tm = -(mx * ex + my * ey + mz * ez) * ia
        px, py, pz = mx + tm * ex, my + tm * ey, mz + tm * ez
        D = 1.0 - (px * px + py * py + pz * pz)
        h = np.sqrt(max(D, 0.0) * ia)
        t0, t1 = tm - h, tm + h
        uncut = f(1) if t0 > near else f(0)
        t0 = max(t0, near)
        mid, half = 0.5 * (t0 + t1), max(0.5 * (t1 - t0), 0.0)
        shift = mid - tm
        cut += f(1) - uncut if D > 0.0 else f(0)
        qx, qy, qz = px + shift * ex, py + shift * ey, pz + shift * ez
        X[_Q0 + k], X[_Q1 + k], X[_Q2 + k] = qx, qy, qz
        X[_V0 + k], X[_V1 + k], X[_V2 + k] = ex * half, ey * half, ez * half
        X[_INNER + k], X[_SHIFT + k], X[_SQUARE + k], X[_HALF + k] = D, shift, 1.0 / ia, half
        S[L.QX + k], S[L.QY + k], S[L.QZ + k] = f(qx), f(qy), f(qz)
        S[L.EXL + k], S[L.EYL + k], S[L.EZL + k] = f(ex), f(ey), f(ez)
        S[L.HALF + k], S[L.FIELD + k] = f(half), offset
        if len(edge) > 0:
            fade, by_d = chord_edge_fade(f(D), edge)
            S[L.FADE + k] = fade
            if backward:
                S[L.BY_D + k] = by_d
        if with_mid:
            S[L.MID + k] = f(mid)
        if backward:
            S[L.DU + k], S[L.DV + k] = f(du), f(dv)
            S[L.MID + k], S[L.TM + k], S[L.IA + k], S[L.UNCUT + k] = f(mid), f(tm), f(ia), uncut
            S[L.HEIGHT + k], S[L.SLIDE + k] = f(h), f(0)
            S[L.DH + k] = f(0.5 * ia / np.sqrt(max(D, depth_floor if len(edge) == 0 else 1e-12) * ia))
    return cut > f(0)


@inline
def chord_phase_float64(X, k, p, o):  # type: ignore[no-untyped-def]
    """Return the phase of a colour network's unit at the middle of lane ``k``'s chord, in turns, in [-1/2, 1/2].

    ``X`` has the float64 chords. ``p`` is the float64 row of the network, in which the unit begins at column ``o``.
    """
    u = X[k + _Q0] * p[o + P.WX] + X[k + _Q1] * p[o + P.WY] + X[k + _Q2] * p[o + P.WZ] + p[o + P.PHASE]
    return f(u - np.rint(u))


@inline
def _reduced_chord_phases(X, k, p, o):  # type: ignore[no-untyped-def]
    """Return a neuron's phase at the middle of lane ``k``'s chord and its change over half the chord, both in turns.

    The phase is reduced to [-1/2, 1/2]. ``p`` is the primitive's float64 row, and ``o`` the neuron's first column.
    """
    wx, wy, wz = p[o + P.WX], p[o + P.WY], p[o + P.WZ]
    u = X[k + _Q0] * wx + X[k + _Q1] * wy + X[k + _Q2] * wz + p[o + P.PHASE]
    v = X[k + _V0] * wx + X[k + _V1] * wy + X[k + _V2] * wz
    return f(u - np.rint(u)), v


@inline
def _whole_chord_neurons(S, X, V, n, p, neurons, edge):  # type: ignore[no-untyped-def]
    """Add each neuron's mean over a chord, w2 cos(phase at the middle) B_p(phase change over half a chord), to FIELD.

    B_p is the profile for edge exponent p (:mod:`~neuprim.core.render.cpu.chord`). The near plane must not cut a chord
    with a soft edge. ``X`` has the float64 chords. ``V``, if not None, gets the factors that the neurons' gradients
    need (N_COS, N_SIN and N_DSINC).
    """
    for m in range(neurons):
        o = P.NEURONS + P.PER_NEURON * m
        wx, wy, wz, phase, amplitude = p[o + P.WX], p[o + P.WY], p[o + P.WZ], p[o + P.PHASE], f(p[o + P.AMPLITUDE])
        for k in range(n):
            u = X[_Q0 + k] * wx + X[_Q1 + k] * wy + X[_Q2 + k] * wz + phase
            v = X[_V0 + k] * wx + X[_V1 + k] * wy + X[_V2 + k] * wz
            whole = np.rint(v)
            near, r = whole == 0.0, f(u - np.rint(u))
            b, slope = reduced_profile(edge, f(v), near, f(v - whole), f(1) / (f(1) if near else f(v)))
            c = cos_turns(r * r)
            S[L.FIELD + k] += amplitude * c * b
            if V is not None:
                V[m, L.N_COS + k], V[m, L.N_DSINC + k] = c * b, c * slope
                V[m, L.N_SIN + k] = -TAU * TAU * r * sinc_turns(r * r) * b


@inline
def _chord_bessel(z, j):  # type: ignore[no-untyped-def]
    """Fill ``j`` with the spherical Bessel functions j_0 to j_5 at any z.

    Below |z| = 2, where upward recursion loses digits, the function sums a series.
    """
    if abs(z) < 2.0:
        square, power = 0.5 * z * z, 1.0
        for n in range(6):
            term, total = power, power
            for k in range(1, _TERMS):
                term *= -square / (k * (2 * n + 2 * k + 1))
                total += term
            j[n] = total
            power *= z / (2 * n + 3)
    else:
        j[0] = np.sin(z) / z
        j[1] = (j[0] - np.cos(z)) / z
        for n in range(1, 5):
            j[n + 1] = (2 * n + 1) / z * j[n] - j[n - 1]


@inline
def _chord_moments(z, j, M):  # type: ignore[no-untyped-def]
    """Fill M[n], n = 0..5, with the mean over u in [-1, 1] of u^n cos(z u) for even n and of u^n sin(z u) for odd n.

    ``j`` is scratch memory for six numbers.
    """
    _chord_bessel(z, j)
    M[0], M[1] = j[0], j[1]
    M[2], M[3] = (j[0] - 2.0 * j[2]) / 3.0, (3.0 * j[1] - 2.0 * j[3]) / 5.0
    M[4] = (7.0 * j[0] - 20.0 * j[2] + 8.0 * j[4]) / 35.0
    M[5] = (27.0 * j[1] - 28.0 * j[3] + 8.0 * j[5]) / 63.0


@inline
def _edge_polynomial(D, shift, square, half, soft, q):  # type: ignore[no-untyped-def]
    """Fill q[0..4] with the coefficients by u of the edge weight (D - ``square`` (shift + half u)^2)^``soft``.

    u goes from -1 to 1 along the chord. ``square`` is e.e, and ``soft`` (1 or 2) the edge exponent; for D, shift and
    half see the module. The function returns the mean weight over the chord.
    """
    c0, c1, c2 = D - square * shift * shift, -2.0 * square * shift * half, -square * half * half
    q[0], q[1], q[2], q[3], q[4] = c0, c1, c2, 0.0, 0.0
    if soft == 2:
        q[0], q[1], q[2], q[3], q[4] = c0 * c0, 2.0 * c0 * c1, c1 * c1 + 2.0 * c0 * c2, 2.0 * c1 * c2, c2 * c2
    return q[0] + q[2] / 3.0 + q[4] / 5.0


@inline
def _cut_chord_neurons(S, X, V, n, p, neurons, soft):  # type: ignore[no-untyped-def]
    """Add the neurons' means to FIELD for soft-edged chords that the near plane cuts; fill FADE, the mean edge weight.

    ``soft`` is the edge exponent. ``V``, if not None, gets the factors that the neurons' gradients need. In this case,
    the function also fills BY_D, BY_A and BY_TM: the derivatives of FADE FIELD, through the edge weight, by D, by
    a = e.e and by t of the closest point.
    """
    q, j, M, rest = np.zeros(5), np.zeros(6), np.zeros(6), np.zeros(3)
    for k in range(n):
        D, shift, square, half = X[_INNER + k], X[_SHIFT + k], X[_SQUARE + k], X[_HALF + k]
        mean = _edge_polynomial(D, shift, square, half, soft, q)
        visible = mean > 0.0 and half > 0.0
        S[L.FADE + k] = f(mean) if visible else f(0)
        c0, c1, c2, total = 1.0, 0.0, 0.0, 0.0
        if V is not None:
            if soft == 2:
                c0, c1 = 2.0 * (D - square * shift * shift), -4.0 * square * shift * half
                c2 = -2.0 * square * half * half
            offset = p[P.OFFSET]
            rest[0], rest[1], rest[2] = offset * (c0 + c2 / 3.0), offset * c1 / 3.0, offset * (c0 / 3.0 + c2 / 5.0)
            S[L.BY_D + k], S[L.BY_A + k], S[L.BY_TM + k] = f(0), f(0), f(0)
            for m in range(neurons):
                V[m, L.N_COS + k], V[m, L.N_SIN + k], V[m, L.N_DSINC + k] = f(0), f(0), f(0)
        if not visible:
            continue
        for m in range(neurons):
            o = P.NEURONS + P.PER_NEURON * m
            r, v = _reduced_chord_phases(X, k, p, o)
            _chord_moments(_PI2 * v, j, M)
            c, s, a = np.float64(cos_turns(r * r)), np.float64(TAU * r * sinc_turns(r * r)), p[o + P.AMPLITUDE]
            even, odd = q[0] * M[0] + q[2] * M[2] + q[4] * M[4], q[1] * M[1] + q[3] * M[3]
            total += a * (c * even - s * odd)
            if V is not None:
                d_even, d_odd = -(q[0] * M[1] + q[2] * M[3] + q[4] * M[5]), q[1] * M[2] + q[3] * M[4]
                V[m, L.N_COS + k] = f((c * even - s * odd) / mean)
                V[m, L.N_SIN + k] = f(-_PI2 * (s * even + c * odd) / mean)
                V[m, L.N_DSINC + k] = f(_PI2 * (c * d_even - s * d_odd) / mean)
                rest[0] += a * (c * (c0 * M[0] + c2 * M[2]) - s * c1 * M[1])
                rest[1] += a * (c * c1 * M[2] - s * (c0 * M[1] + c2 * M[3]))
                rest[2] += a * (c * (c0 * M[2] + c2 * M[4]) - s * c1 * M[3])
        S[L.FIELD + k] += f(total / mean)
        if V is not None:
            S[L.BY_D + k] = f(rest[0])
            S[L.BY_A + k] = f(-(shift * shift * rest[0] + 2.0 * shift * half * rest[1] + half * half * rest[2]))
            S[L.BY_TM + k] = f(2.0 * square * (shift * rest[0] + half * rest[1]))


@inline
def neurons_float64(S, X, V, n, p, neurons, cut, edge):  # type: ignore[no-untyped-def]
    """Add the mean of every neuron over the chord, weighted by the edge, to FIELD of ``n`` lanes (pixels).

    If ``cut`` (the near plane cuts a chord) and the edge is soft, also fill FADE, the mean edge weight. ``V``, if not
    None, gets the factors that the neurons' gradients need.
    """
    if len(edge) > 0 and cut:
        _cut_chord_neurons(S, X, V, n, p, neurons, len(edge))
    else:
        _whole_chord_neurons(S, X, V, n, p, neurons, edge)
