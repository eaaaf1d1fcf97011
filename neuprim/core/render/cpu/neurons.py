"""A pair's field: the mean density over every lane's chord, which either order of compositing evaluates once a pair's
pixels are gathered."""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import inline
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.float64 import chords_float64
from neuprim.core.render.cpu.float64_edge import neurons_float64
from neuprim.core.render.cpu.profiles import profiles_fast, profiles_medium, profiles_slow
from neuprim.core.render.cpu.tiles import chords
from neuprim.core.render.cpu.trigonometry import cos_turns

__all__ = ["field_values"]

f = np.float32


def _values(profiles):  # type: ignore[no-untyped-def]
    """FIELD += w2 cos(phase at the middle) B_p(rate x half chord) of two neurons, with the profiles of their range of
    rates."""

    @inline
    def add(S, n, p, o, edge):  # type: ignore[no-untyped-def]
        ax, ay, az, ab, aa = p[o + L.WX], p[o + L.WY], p[o + L.WZ], p[o + L.PHASE], p[o + L.AMPLITUDE]
        o2 = o + L.PER_NEURON
        bx, by, bz, bb, ba = p[o2 + L.WX], p[o2 + L.WY], p[o2 + L.WZ], p[o2 + L.PHASE], p[o2 + L.AMPLITUDE]
        for k in range(n):
            half = S[L.HALF + k]
            ex, ey, ez = S[L.EXL + k], S[L.EYL + k], S[L.EZL + k]
            qx, qy, qz = S[L.QX + k], S[L.QY + k], S[L.QZ + k]
            v = (ex * ax + ey * ay + ez * az) * half
            u = qx * ax + qy * ay + qz * az + ab
            r = u - np.rint(u)
            v1 = (ex * bx + ey * by + ez * bz) * half
            u1 = qx * bx + qy * by + qz * bz + bb
            r1 = u1 - np.rint(u1)
            b, b1 = profiles(edge, v, v1)
            S[L.FIELD + k] += cos_turns(r * r) * b * aa + cos_turns(r1 * r1) * b1 * ba

    return add


_values_slow, _values_medium, _values_fast = _values(profiles_slow), _values(profiles_medium), _values(profiles_fast)


@inline
def field_values(  # type: ignore[no-untyped-def]
    S, D, n, bounds, y0, y1, tx, ty, fx0, fy0, i, rows, wide, slots, kinds, neurons, floor, with_mid, backward, edge
):
    """Chords and FIELD of ``n`` lanes of primitive ``i``, in float64 where float32 is too coarse; see
    :func:`~tiles.chords`."""
    if slots[i] >= 0:
        chords_float64(S, D, bounds, y0, y1, tx, ty, n, wide[slots[i]], floor, with_mid, backward)
        neurons_float64(edge, S, D, n, wide[slots[i]], neurons)
    else:
        p = rows[i]
        chords(S, n, p, fx0, fy0, floor, with_mid, backward, edge)
        for m in range(0, neurons, 2):
            o = L.NEURONS + L.PER_NEURON * m
            if kinds[i, m // 2] == L.MEDIUM:
                _values_medium(S, n, p, o, edge)
            elif kinds[i, m // 2] == L.SLOW:
                _values_slow(S, n, p, o, edge)
            else:
                _values_fast(S, n, p, o, edge)
