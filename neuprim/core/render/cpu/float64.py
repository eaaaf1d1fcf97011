"""The float64 pixel stage, for the few primitives that float32 cannot follow: needles and discs near the camera, fast
neurons.

Same interface as the float32 building blocks: what they leave in the lanes is rounded to float32 at the end, so
compositing and the gradient sums are shared.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import inline
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.trigonometry import TAU, cos_turns, dsinc_turns, sinc_turns

__all__ = [
    "FLOAT64_SCRATCH", "HALF64", "INNER", "SHIFT", "SQUARE", "chords_float64", "hard_neurons_float64", "hard_slopes_float64", "phase_float64", "reduced_float64",
]  # fmt: skip

f = np.float32
# float64 lanes: chord middle and half chord vector in whitened space, then 1 - |y|^2 at the closest approach, how far
# the middle is from it
# and the half chord (units of m along e), and e.e
_Q, _V = (L.lane(0), L.lane(1), L.lane(2)), (L.lane(3), L.lane(4), L.lane(5))
_Q0, _Q1, _Q2 = _Q
_V0, _V1, _V2 = _V
INNER, SHIFT, SQUARE, HALF64 = L.lane(6), L.lane(7), L.lane(8), L.lane(9)
FLOAT64_SCRATCH = L.lane(10)


@inline
def chords_float64(S, X, bounds, y0, y1, tx, ty, n, p, depth_floor, with_mid, backward):  # type: ignore[no-untyped-def]
    """As :func:`~neuprim.core.render.cpu.tiles.chords` from a float64 row ``p``, for the pixels of ``bounds``; lanes n:
    are padding."""
    at = 0
    for y in range(y0, y1):
        dv = ty + y + 0.5 - p[L.UY]
        for x in range(bounds[y], bounds[y + L.TILE]):
            du = tx + x + 0.5 - p[L.UX]
            gx, gy, gz = (
                du * p[L.EX] + dv * p[L.EY],
                du * p[L.EX + 1] + dv * p[L.EY + 1],
                du * p[L.EX + 2] + dv * p[L.EY + 2],
            )
            ex, ey, ez = p[L.E0] + gx, p[L.E0 + 1] + gy, p[L.E0 + 2] + gz
            mx, my, mz = p[L.XA] + p[L.TC] * gx, p[L.XA + 1] + p[L.TC] * gy, p[L.XA + 2] + p[L.TC] * gz
            ia = 1.0 / (ex * ex + ey * ey + ez * ez)
            tm = -(mx * ex + my * ey + mz * ez) * ia
            px, py, pz = mx + tm * ex, my + tm * ey, mz + tm * ez
            D = 1.0 - (px * px + py * py + pz * pz)
            h = np.sqrt(max(D, 0.0) * ia)
            t0, t1 = tm - h, tm + h
            uncut = f(1) if t0 > p[L.NEAR] else f(0)
            t0 = max(t0, p[L.NEAR])
            mid = 0.5 * (t0 + t1)
            half = max(0.5 * (t1 - t0), 0.0)
            shift = mid - tm
            qx, qy, qz = px + shift * ex, py + shift * ey, pz + shift * ez
            X[at + _Q0], X[at + _Q1], X[at + _Q2] = qx, qy, qz
            X[at + _V0], X[at + _V1], X[at + _V2] = ex * half, ey * half, ez * half
            S[L.QX + at], S[L.QY + at], S[L.QZ + at] = f(qx), f(qy), f(qz)
            S[L.EXL + at], S[L.EYL + at], S[L.EZL + at] = f(ex), f(ey), f(ez)
            X[at + INNER], X[at + SHIFT], X[at + SQUARE], X[at + HALF64] = D, shift, 1.0 / ia, half
            S[L.HALF + at] = f(half)
            S[L.FIELD + at] = f(p[L.OFFSET])
            if with_mid:
                S[L.MID + at] = f(mid)
            if backward:
                S[L.DU + at], S[L.DV + at] = f(du), f(dv)
                S[L.MID + at], S[L.TM + at], S[L.IA + at], S[L.UNCUT + at] = f(mid), f(tm), f(ia), uncut
                S[L.HEIGHT + at], S[L.SLIDE + at] = f(h), f(0)
                S[L.DH + at] = f(0.5 * ia / np.sqrt(max(D, np.float64(depth_floor)) * ia))
            at += 1
    for k in range(at, n):  # padding: a chord of length zero, finite everywhere
        for a in (L.QX, L.QY, L.QZ, L.EXL, L.EYL, L.EZL, L.HALF, L.FIELD):
            S[a + k] = f(0)
        for a in _Q + _V:
            X[a + k] = 0.0
        X[INNER + k], X[SHIFT + k], X[SQUARE + k], X[HALF64 + k] = 0.0, 0.0, 0.0, 0.0
        if with_mid or backward:
            S[L.MID + k] = f(0)
        if backward:
            for a in (L.DU, L.DV, L.TM, L.IA, L.UNCUT, L.HEIGHT, L.SLIDE, L.DH):
                S[a + k] = f(0)


@inline
def phase_float64(X, k, p, o):  # type: ignore[no-untyped-def]
    """Phase at the chord's middle of the unit at ``o`` of a float64 row, reduced to half a turn."""
    u = X[k + _Q0] * p[o + L.WX] + X[k + _Q1] * p[o + L.WY] + X[k + _Q2] * p[o + L.WZ] + p[o + L.PHASE]
    return f(u - np.rint(u))


@inline
def reduced_float64(X, k, p, o):  # type: ignore[no-untyped-def]
    """Phase at the chord's middle and half its change, in turns: both reduced to half a turn, and the second whole."""
    wx, wy, wz = p[o + L.WX], p[o + L.WY], p[o + L.WZ]
    u = X[k + _Q0] * wx + X[k + _Q1] * wy + X[k + _Q2] * wz + p[o + L.PHASE]
    v = X[k + _V0] * wx + X[k + _V1] * wy + X[k + _V2] * wz
    return f(u - np.rint(u)), f(v - np.rint(v)), v


@inline
def hard_neurons_float64(S, X, n, p, neurons):  # type: ignore[no-untyped-def]
    """FIELD += w2 cos(phase at the middle) sinc(half its change) of every neuron of a float64 row."""
    for m in range(neurons):
        o = L.NEURONS + L.PER_NEURON * m
        for k in range(n):
            r, s, v = reduced_float64(X, k, p, o)
            sinc = sinc_turns(s * s)
            if abs(v) > 0.5:
                sinc *= f(s / v)
            S[L.FIELD + k] += f(p[o + L.AMPLITUDE]) * cos_turns(r * r) * sinc


@inline
def hard_slopes_float64(S, X, V, n, p, neurons):  # type: ignore[no-untyped-def]
    """The same, and the three products per neuron that the gradients need."""
    for m in range(neurons):
        o = L.NEURONS + L.PER_NEURON * m
        for k in range(n):
            r, s, v = reduced_float64(X, k, p, o)
            sinc, slope = sinc_turns(s * s), dsinc_turns(s * s) * f(2) * s
            if abs(v) > 0.5:
                sinc *= f(s / v)
                slope = (cos_turns(s * s) - sinc) * f(1.0 / v)
            c = cos_turns(r * r)
            V[m, L.N_COS + k] = c * sinc
            V[m, L.N_SIN + k] = -TAU * TAU * r * sinc_turns(r * r) * sinc
            V[m, L.N_DSINC + k] = c * slope
            S[L.FIELD + k] += f(p[o + L.AMPLITUDE]) * c * sinc
