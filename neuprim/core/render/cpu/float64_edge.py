"""Neurons of the float64 path with any edge; soft ones along whole chords and along those that the near plane cuts.

Along a chord u in [-1, 1], 1 - |y|^2 = D - a (shift + half u)^2 with D at the closest approach, a = e.e and shift from
there to the chord's middle. Its p-th power is a polynomial q, and the mean of q cos(phase + z u) follows from the
moments

    C_n = 1/2 integral of u^n cos(z u) du (n even),   S_n = 1/2 integral of u^n sin(z u) du (n odd),   dC_n/dz =
    -S_(n+1), dS_n/dz = C_(n+1)

which are sums of spherical Bessel functions j_0 to j_5 (:mod:`neuprim.core.model.edge`). FADE is the mean of q, FIELD
the mean of the density weighted by q over that of q, so that gradients of weights read alike for every edge.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import dispatch_by_length, inline
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.float64 import (
    HALF64,
    INNER,
    SHIFT,
    SQUARE,
    hard_neurons_float64,
    hard_slopes_float64,
    reduced_float64,
)
from neuprim.core.render.cpu.trigonometry import TAU, cos_turns, sinc_turns

__all__ = ["neurons_float64", "slopes_float64"]

f = np.float32
_PI2 = 2.0 * np.pi
_TERMS = 14


@inline
def _bessel(z, j):  # type: ignore[no-untyped-def]
    """j_0 to j_5 of any z: a series below 2, where upward recursion loses digits."""
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
def _moments(z, j, M):  # type: ignore[no-untyped-def]
    """M[n] = C_n for even n, S_n for odd n, n = 0..5."""
    _bessel(z, j)
    M[0], M[1] = j[0], j[1]
    M[2], M[3] = (j[0] - 2.0 * j[2]) / 3.0, (3.0 * j[1] - 2.0 * j[3]) / 5.0
    M[4] = (7.0 * j[0] - 20.0 * j[2] + 8.0 * j[4]) / 35.0
    M[5] = (27.0 * j[1] - 28.0 * j[3] + 8.0 * j[5]) / 63.0


@inline
def _weight(D, shift, square, half, soft, q):  # type: ignore[no-untyped-def]
    """Coefficients q[0..4] of (D - a (shift + half u)^2)^p, and their mean over the chord."""
    c0, c1, c2 = D - square * shift * shift, -2.0 * square * shift * half, -square * half * half
    q[0], q[1], q[2], q[3], q[4] = c0, c1, c2, 0.0, 0.0
    if soft == 2:
        q[0], q[1], q[2], q[3], q[4] = c0 * c0, 2.0 * c0 * c1, c1 * c1 + 2.0 * c0 * c2, 2.0 * c1 * c2, c2 * c2
    return q[0] + q[2] / 3.0 + q[4] / 5.0


@inline
def _soft_neurons(S, X, n, p, neurons, soft):  # type: ignore[no-untyped-def]
    q, j, M = np.zeros(5), np.zeros(6), np.zeros(6)
    for k in range(n):
        mean = _weight(X[INNER + k], X[SHIFT + k], X[SQUARE + k], X[HALF64 + k], soft, q)
        alive = mean > 0.0 and X[HALF64 + k] > 0.0
        S[L.FADE + k] = f(mean) if alive else f(0)
        if not alive:
            continue
        total = 0.0
        for m in range(neurons):
            o = L.NEURONS + L.PER_NEURON * m
            r, _, v = reduced_float64(X, k, p, o)
            _moments(_PI2 * v, j, M)
            even, odd = q[0] * M[0] + q[2] * M[2] + q[4] * M[4], q[1] * M[1] + q[3] * M[3]
            total += p[o + L.AMPLITUDE] * (cos_turns(r * r) * even - TAU * r * sinc_turns(r * r) * odd)
        S[L.FIELD + k] += f(total / mean)


@inline
def _soft_slopes(S, X, V, n, p, neurons, soft):  # type: ignore[no-untyped-def]
    q, j, M, rest = np.zeros(5), np.zeros(6), np.zeros(6), np.zeros(3)
    for k in range(n):
        D, shift, square, half = X[INNER + k], X[SHIFT + k], X[SQUARE + k], X[HALF64 + k]
        mean = _weight(D, shift, square, half, soft, q)
        alive = mean > 0.0 and half > 0.0
        S[L.FADE + k] = f(mean) if alive else f(0)
        # of p q^(p - 1), whose moments with 1, u and u^2 the weight's own derivatives need
        c0, c1, c2 = 1.0, 0.0, 0.0
        if soft == 2:
            c0, c1, c2 = 2.0 * (D - square * shift * shift), -4.0 * square * shift * half, -2.0 * square * half * half
        offset = p[L.OFFSET]
        rest[0] = offset * (c0 + c2 / 3.0)
        rest[1] = offset * c1 / 3.0
        rest[2] = offset * (c0 / 3.0 + c2 / 5.0)
        total = 0.0
        for m in range(neurons):
            o = L.NEURONS + L.PER_NEURON * m
            V[m, L.N_COS + k], V[m, L.N_SIN + k], V[m, L.N_DSINC + k] = f(0), f(0), f(0)
            if not alive:
                continue
            r, _, v = reduced_float64(X, k, p, o)
            _moments(_PI2 * v, j, M)
            c, s, a = np.float64(cos_turns(r * r)), np.float64(TAU * r * sinc_turns(r * r)), p[o + L.AMPLITUDE]
            even, odd = q[0] * M[0] + q[2] * M[2] + q[4] * M[4], q[1] * M[1] + q[3] * M[3]
            d_even, d_odd = -(q[0] * M[1] + q[2] * M[3] + q[4] * M[5]), q[1] * M[2] + q[3] * M[4]
            V[m, L.N_COS + k] = f((c * even - s * odd) / mean)
            V[m, L.N_SIN + k] = f(-_PI2 * (s * even + c * odd) / mean)
            V[m, L.N_DSINC + k] = f(_PI2 * (c * d_even - s * d_odd) / mean)
            total += a * (c * even - s * odd)
            rest[0] += a * (c * (c0 * M[0] + c2 * M[2]) - s * c1 * M[1])
            rest[1] += a * (c * c1 * M[2] - s * (c0 * M[1] + c2 * M[3]))
            rest[2] += a * (c * (c0 * M[2] + c2 * M[4]) - s * c1 * M[3])
        S[L.BY_D + k], S[L.BY_A + k], S[L.BY_TM + k] = f(0), f(0), f(0)
        if alive:
            S[L.FIELD + k] += f(total / mean)
            S[L.BY_D + k] = f(rest[0])
            S[L.BY_A + k] = f(-(shift * shift * rest[0] + 2.0 * shift * half * rest[1] + half * half * rest[2]))
            S[L.BY_TM + k] = f(2.0 * square * (shift * rest[0] + half * rest[1]))


@inline
def _soft_neurons_1(S, X, n, p, neurons):  # type: ignore[no-untyped-def]
    _soft_neurons(S, X, n, p, neurons, 1)


@inline
def _soft_neurons_2(S, X, n, p, neurons):  # type: ignore[no-untyped-def]
    _soft_neurons(S, X, n, p, neurons, 2)


@inline
def _soft_slopes_1(S, X, V, n, p, neurons):  # type: ignore[no-untyped-def]
    _soft_slopes(S, X, V, n, p, neurons, 1)


@inline
def _soft_slopes_2(S, X, V, n, p, neurons):  # type: ignore[no-untyped-def]
    _soft_slopes(S, X, V, n, p, neurons, 2)


neurons_float64 = dispatch_by_length(hard_neurons_float64, _soft_neurons_1, _soft_neurons_2)
"""(edge, S, X, n, p, neurons): FADE, and FIELD += the weighted mean of every neuron of a float64 row."""
slopes_float64 = dispatch_by_length(hard_slopes_float64, _soft_slopes_1, _soft_slopes_2)
"""(edge, S, X, V, n, p, neurons): the same, and what the gradients need."""
