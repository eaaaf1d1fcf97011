"""Compute the gradient row of a (tile, primitive) pair from the gradients of its lanes (pixels).

Both orders of compositing use this module. A lane's gradient is dL/d(2 FIELD HALF FADE), the gradient by the density
integral: 2 x mean density x half chord x mean edge weight. :func:`neuron_gradients` and :func:`chord_gradient` read
stored chords, which float64, colour networks and many neurons need. :func:`gradients_at_once` keeps each chord in
registers, for at most two neurons.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import inline
from neuprim.core.render import layout as P
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.chord import (
    TAU,
    add_ray_gradient,
    chord_backward,
    chord_edge_fade,
    cos_turns,
    half_chord_slope,
    intersect_chord,
    load_ray,
    sinc_turns,
    slopes_fast,
    slopes_medium,
    slopes_slow,
    store_ray_gradient,
    zero_ray_sums,
)
from neuprim.core.render.cpu.float64 import chords_float64, neurons_float64
from neuprim.core.render.cpu.tiles import lane_chords

f = np.float32
AT_ONCE = 2  # largest number of neurons whose sums fit into registers with those of the chord
_TINY = f(1e-30)


@inline
def _load_neuron(p, o):  # type: ignore[no-untyped-def]
    return p[o + P.WX], p[o + P.WY], p[o + P.WZ], p[o + P.PHASE], p[o + P.AMPLITUDE]


def _neuron_products(slopes):  # type: ignore[no-untyped-def]
    """Return a function that computes cos B, d(cos B)/d phase and cos dB/d rate for each of two neurons.

    cos is the cosine of the phase at the chord's middle. B is the neuron's profile, the factor from its value at the
    middle to its mean over the chord. ``slopes`` computes B and dB/d rate. In the returned function, (qx, qy, qz) is
    the chord's middle, and (vx, vy, vz) the half chord as a vector. ``first`` and ``second`` are results of
    :func:`_load_neuron`.
    """

    @inline
    def products(edge, qx, qy, qz, vx, vy, vz, first, second):  # type: ignore[no-untyped-def]
        ax, ay, az, ab, _ = first
        bx, by, bz, bb, _ = second
        u = qx * ax + qy * ay + qz * az + ab
        r = u - np.rint(u)
        u1 = qx * bx + qy * by + qz * bz + bb
        r1 = u1 - np.rint(u1)
        b, slope, b1, slope1 = slopes(edge, vx * ax + vy * ay + vz * az, vx * bx + vy * by + vz * bz)
        z, z1 = r * r, r1 * r1
        c, c1 = cos_turns(z), cos_turns(z1)
        s, s1 = -TAU * TAU * r * sinc_turns(z) * b, -TAU * TAU * r1 * sinc_turns(z1) * b1
        return c * b, s, c * slope, c1 * b1, s1, c1 * slope1

    return products


_slow, _medium, _fast = _neuron_products(slopes_slow), _neuron_products(slopes_medium), _neuron_products(slopes_fast)


@inline
def _add_neuron_gradient(sums, cosine, u, v, qx, qy, qz, vx, vy, vz):  # type: ignore[no-untyped-def]
    """Return ``sums`` plus one lane's dL/d(amplitude, phase, W) of a neuron.

    dL/d phase and dL/dW still lack the factor amplitude. ``cosine``, ``u`` and ``v`` are the results of
    :func:`_neuron_products` times dL/d FIELD. (qx, qy, qz) is the chord's middle, and (vx, vy, vz) the half chord as a
    vector.
    """
    s0, s1, s2, s3, s4 = sums
    return s0 + cosine, s1 + u, s2 + (u * qx + v * vx), s3 + (u * qy + v * vy), s4 + (u * qz + v * vz)


@inline
def _store_neuron_gradient(sums, amplitude, m, out):  # type: ignore[no-untyped-def]
    """Write the sums of neuron ``m`` into gradient row ``out``; multiply the sums for phase and W by ``amplitude``."""
    s0, s1, s2, s3, s4 = sums
    o = P.G_NEURONS + P.PER_NEURON * m
    out[o + P.AMPLITUDE], out[o + P.PHASE] = s0, amplitude * s1
    out[o + P.WX], out[o + P.WY], out[o + P.WZ] = amplitude * s2, amplitude * s3, amplitude * s4


# ---------------------------------------------------------------- the chord stays in registers


@inline
def _gradients_without_neurons(S, n, frame, pair, edge, out):  # type: ignore[no-untyped-def]
    """Do the work of :func:`gradients_at_once` for a density without neurons, which is the constant b2."""
    p, fx0, fy0, depth_floor = frame.rows[pair.i], pair.fx0, pair.fy0, frame.depth_floor
    row, tc, field = load_ray(p), p[P.TC], p[P.OFFSET]
    total, rays = f(0), zero_ray_sums()
    for k in range(n):
        du, dv, slide, ex, ey, ez, px, py, pz, D, ia, tm, h, uncut, mid, half = intersect_chord(
            S[L.PIXEL + k], fx0, fy0, row
        )
        fade, by_d = chord_edge_fade(D, edge)
        g = f(2) * S[L.GRAD + k]
        total += g * half * fade
        gmx, gmy, gmz, gex, gey, gez = chord_backward(
            g * field * fade, f(0), f(0), g * half * field * by_d, f(0), half, ex, ey, ez, px, py, pz, mid, tm, ia, h,
            uncut,
            half_chord_slope(D, ia, depth_floor, edge), f(0), f(0), f(0), f(0), f(0), f(0),
        )  # fmt: skip
        rays = add_ray_gradient(rays, du, dv, slide, tc + slide, gmx, gmy, gmz, gex, gey, gez)
    out[P.G_OFFSET], out[P.G_LOG_M] = total, total * field
    store_ray_gradient(rays, out)


def _gradients_of_two_neurons(products):  # type: ignore[no-untyped-def]
    """Return a function that does the work of :func:`gradients_at_once` for two neurons, with their ``products``."""

    @inline
    def gradients(S, n, frame, pair, edge, out):  # type: ignore[no-untyped-def]
        p, fx0, fy0, depth_floor = frame.rows[pair.i], pair.fx0, pair.fy0, frame.depth_floor
        row, tc, offset = load_ray(p), p[P.TC], p[P.OFFSET]
        first, second = _load_neuron(p, P.NEURONS), _load_neuron(p, P.NEURONS + P.PER_NEURON)
        ax, ay, az, _, aa = first
        bx, by, bz, _, ba = second
        ax1, ay1, az1, bx1, by1, bz1 = ax * aa, ay * aa, az * aa, bx * ba, by * ba, bz * ba
        total, rays = f(0), zero_ray_sums()
        sums, sums1 = (f(0), f(0), f(0), f(0), f(0)), (f(0), f(0), f(0), f(0), f(0))
        for k in range(n):
            du, dv, slide, ex, ey, ez, px, py, pz, D, ia, tm, h, uncut, mid, half = intersect_chord(
                S[L.PIXEL + k], fx0, fy0, row
            )
            shift = mid - tm
            qx, qy, qz = px + shift * ex, py + shift * ey, pz + shift * ez
            vx, vy, vz = ex * half, ey * half, ez * half
            c, s, d, c1, s1, d1 = products(edge, qx, qy, qz, vx, vy, vz, first, second)
            field = offset + c * aa + c1 * ba
            fade, by_d = chord_edge_fade(D, edge)
            g = f(2) * S[L.GRAD + k]
            gf = g * half * fade
            total += gf
            u, v, u1, v1 = gf * s, gf * d, gf * s1, gf * d1
            sums = _add_neuron_gradient(sums, gf * c, u, v, qx, qy, qz, vx, vy, vz)
            sums1 = _add_neuron_gradient(sums1, gf * c1, u1, v1, qx, qy, qz, vx, vy, vz)
            gqx, gqy, gqz = u * ax1 + u1 * bx1, u * ay1 + u1 * by1, u * az1 + u1 * bz1
            gvx, gvy, gvz = v * ax1 + v1 * bx1, v * ay1 + v1 * by1, v * az1 + v1 * bz1
            gmx, gmy, gmz, gex, gey, gez = chord_backward(
                gvx * ex + gvy * ey + gvz * ez + g * field * fade, gqx * ex + gqy * ey + gqz * ez, f(0),
                g * half * field * by_d, f(0),
                half, ex, ey, ez, px, py, pz, mid, tm, ia, h, uncut, half_chord_slope(D, ia, depth_floor, edge),
                gqx, gqy, gqz, gvx, gvy, gvz,
            )  # fmt: skip
            rays = add_ray_gradient(rays, du, dv, slide, tc + slide, gmx, gmy, gmz, gex, gey, gez)
        out[P.G_OFFSET], out[P.G_LOG_M] = total, total * offset + aa * sums[0] + ba * sums1[0]
        _store_neuron_gradient(sums, aa, 0, out)
        _store_neuron_gradient(sums1, ba, 1, out)
        store_ray_gradient(rays, out)

    return gradients


_with_two_slow = _gradients_of_two_neurons(_slow)
_with_two_medium = _gradients_of_two_neurons(_medium)
_with_two_fast = _gradients_of_two_neurons(_fast)


@inline
def gradients_at_once(S, n, frame, pair, edge, out):  # type: ignore[no-untyped-def]
    """Fill the gradient row of a (tile, primitive) pair, for at most :data:`AT_ONCE` neurons, from PIXEL and GRAD.

    PIXEL holds the position of each lane (pixel of the pair), GRAD the lane's gradient dL/d(2 FIELD HALF FADE).
    """
    if frame.neurons == 0:
        _gradients_without_neurons(S, n, frame, pair, edge, out)
        return
    kind = frame.kinds[pair.i, 0]
    if kind == L.MEDIUM:
        _with_two_medium(S, n, frame, pair, edge, out)
    elif kind == L.SLOW:
        _with_two_slow(S, n, frame, pair, edge, out)
    else:
        _with_two_fast(S, n, frame, pair, edge, out)


# ---------------------------------------------------------------- the chord is in the lanes


@inline
def lanes_with_slopes(S, D, V, n, frame, pair, edge):  # type: ignore[no-untyped-def]
    """Compute the chords of ``n`` lanes (pixels) of a (tile, primitive) pair; in float64 also FIELD and ``V``.

    ``V`` gets three products for each neuron, which the neuron's gradients need: N_COS, N_SIN and N_DSINC. The function
    returns True if the pair is in float64 and the near plane cuts a chord.
    """
    slot = frame.slots[pair.i]
    if slot >= 0:
        cut = chords_float64(S, D, n, frame, pair, False, True, edge)
        neurons_float64(S, D, V, n, frame.wide[slot], frame.neurons, cut, edge)
        return cut
    lane_chords(S, n, frame, pair, False, True, edge)
    return False


@inline
def _chord_field_gradient(S, n, out, edge, in_float64):  # type: ignore[no-untyped-def]
    """Fill GF = dL/d FIELD of ``n`` lanes from dL/d(2 FIELD HALF FADE); store the sums of dL/d b2 and of G_LOG_M.

    FIELD is the mean of the density network over a chord. Except in float64, the function recovers FIELD from the
    optical depth. It doubles GRAD, to dL/d(FIELD HALF FADE), and sets the gradients of chords, to which neurons add,
    to 0.
    """
    offset, log_m = f(0), f(0)
    for k in range(n):
        g = f(2) * S[L.GRAD + k]
        length = S[L.HALF + k] * S[L.FADE + k] if len(edge) > 0 else S[L.HALF + k]
        field = S[L.FIELD + k] if in_float64 else f(0.5) * S[L.DEPTH + k] / max(length * S[L.NORM_L + k], _TINY)
        gf = g * length
        S[L.GRAD + k], S[L.GF + k], S[L.FIELD + k] = g, gf, field
        offset += gf
        log_m += gf * field
        S[L.GQX + k], S[L.GQY + k], S[L.GQZ + k] = f(0), f(0), f(0)
        S[L.GEX + k], S[L.GEY + k], S[L.GEZ + k] = f(0), f(0), f(0)
    out[P.G_OFFSET], out[P.G_LOG_M] = offset, log_m


def _two_neuron_lane_gradients(products):  # type: ignore[no-untyped-def]
    """Return a function that writes the gradients of neurons m and m + 1, and adds to dL/dQ and dL/d(half e) of lanes.

    Q is the middle of a lane's chord, and half e its half chord as a vector. ``products`` is from
    :func:`_neuron_products`. If it is None, the function reads the same three values per neuron from V0 and V1.
    """

    @inline
    def add(S, V0, V1, n, p, m, edge, out):  # type: ignore[no-untyped-def]
        o = P.NEURONS + P.PER_NEURON * m
        first, second = _load_neuron(p, o), _load_neuron(p, o + P.PER_NEURON)
        ax, ay, az, _, aa = first
        bx, by, bz, _, ba = second
        # amplitudes once per neuron, not per lane: in the weights here, in the sums below
        ax1, ay1, az1, bx1, by1, bz1 = ax * aa, ay * aa, az * aa, bx * ba, by * ba, bz * ba
        sums, sums1 = (f(0), f(0), f(0), f(0), f(0)), (f(0), f(0), f(0), f(0), f(0))
        for k in range(n):
            gf, half = S[L.GF + k], S[L.HALF + k]
            qx, qy, qz = S[L.QX + k], S[L.QY + k], S[L.QZ + k]
            vx, vy, vz = S[L.EXL + k] * half, S[L.EYL + k] * half, S[L.EZL + k] * half
            if products is None:
                c, s, d = V0[L.N_COS + k], V0[L.N_SIN + k], V0[L.N_DSINC + k]
                c1, s1, d1 = V1[L.N_COS + k], V1[L.N_SIN + k], V1[L.N_DSINC + k]
            else:
                c, s, d, c1, s1, d1 = products(edge, qx, qy, qz, vx, vy, vz, first, second)
            u, v, u1, v1 = gf * s, gf * d, gf * s1, gf * d1
            sums = _add_neuron_gradient(sums, gf * c, u, v, qx, qy, qz, vx, vy, vz)
            sums1 = _add_neuron_gradient(sums1, gf * c1, u1, v1, qx, qy, qz, vx, vy, vz)
            S[L.GQX + k] += u * ax1 + u1 * bx1
            S[L.GQY + k] += u * ay1 + u1 * by1
            S[L.GQZ + k] += u * az1 + u1 * bz1
            S[L.GEX + k] += v * ax1 + v1 * bx1
            S[L.GEY + k] += v * ay1 + v1 * by1
            S[L.GEZ + k] += v * az1 + v1 * bz1
        _store_neuron_gradient(sums, aa, m, out)
        _store_neuron_gradient(sums1, ba, m + 1, out)

    return add


_two_slow = _two_neuron_lane_gradients(_slow)
_two_medium = _two_neuron_lane_gradients(_medium)
_two_fast = _two_neuron_lane_gradients(_fast)
_two_float64 = _two_neuron_lane_gradients(None)


@inline
def neuron_gradients(S, V, n, p, kinds, neurons, edge, in_float64, cut, out):  # type: ignore[no-untyped-def]
    """Fill the gradients of b2, log m and every neuron of a (tile, primitive) pair, and of the chords of its lanes.

    The gradients of a chord are dL/dQ, Q its middle, and dL/d(half e), half e the half chord as a vector. ``p`` is the
    primitive's row, ``kinds`` its ranges of rates. ``V`` (float64 only) and ``cut`` are from :func:`lanes_with_slopes`.
    """
    _chord_field_gradient(S, n, out, edge, in_float64)
    for m in range(0, neurons, 2):
        kind = kinds[m // 2]
        if in_float64:
            _two_float64(S, V[m], V[m + 1], n, p, m, edge, out)
        elif kind == L.MEDIUM:
            _two_medium(S, V[m], V[m + 1], n, p, m, edge, out)
        elif kind == L.SLOW:
            _two_slow(S, V[m], V[m + 1], n, p, m, edge, out)
        else:
            _two_fast(S, V[m], V[m + 1], n, p, m, edge, out)
    if len(edge) > 0 and cut:  # before colours add to dL/dQ: see chord_gradient
        for k in range(n):
            S[L.INSIDE + k] = S[L.GQX + k] * S[L.EXL + k] + S[L.GQY + k] * S[L.EYL + k] + S[L.GQZ + k] * S[L.EZL + k]


@inline
def chord_gradient(S, n, p, out, edge, cut):  # type: ignore[no-untyped-def]
    """Fill dL/d(E0, EX, EY, XA) of a primitive's rays from the gradients by chord middle, half chord and direction.

    With a hard edge, gradients flow through the chord's ends. A soft edge adds the gradient of the edge weight through
    D = 1 - |p|^2 at the closest point p. If the near plane cuts no chord of the pair, BY_D is d FADE/dD. If the near
    plane cuts a chord (``cut``, only in float64), the ends have no gradient, because an end is either fixed by the near
    plane or at zero density. Instead, BY_D, BY_A and BY_TM are the derivatives of FADE FIELD by D, by a = e.e and by t
    of the closest point.
    """
    tc, soft = p[P.TC], len(edge)
    rays = zero_ray_sums()
    for k in range(n):
        half, ex, ey, ez = S[L.HALF + k], S[L.EXL + k], S[L.EYL + k], S[L.EZL + k]
        mid, tm, slide = S[L.MID + k], S[L.TM + k], S[L.SLIDE + k]
        shift = mid - tm  # recompute the closest point: this saves three stores per lane
        px, py, pz = S[L.QX + k] - shift * ex, S[L.QY + k] - shift * ey, S[L.QZ + k] - shift * ez
        gqx, gqy, gqz = S[L.GQX + k], S[L.GQY + k], S[L.GQZ + k]
        gvx, gvy, gvz = S[L.GEX + k], S[L.GEY + k], S[L.GEZ + k]
        g, field = S[L.GRAD + k], S[L.FIELD + k]
        g_half = gvx * ex + gvy * ey + gvz * ez + (g * field * S[L.FADE + k] if soft > 0 else g * field)
        g_mid = gqx * ex + gqy * ey + gqz * ez + S[L.GMID + k]
        g_tm, gD, gA = f(0), f(0), f(0)
        if soft > 0:
            if cut:
                g_half, g_mid = f(0), g_mid - S[L.INSIDE + k]
                g_tm, gD, gA = g * half * S[L.BY_TM + k], g * half * S[L.BY_D + k], g * half * S[L.BY_A + k]
            else:
                gD = g * half * field * S[L.BY_D + k]
        gmx, gmy, gmz, gex, gey, gez = chord_backward(
            g_half, g_mid, g_tm, gD, gA, half, ex, ey, ez, px, py, pz, mid, tm, S[L.IA + k], S[L.HEIGHT + k],
            S[L.UNCUT + k],
            S[L.DH + k], gqx, gqy, gqz, gvx, gvy, gvz,
        )  # fmt: skip
        rays = add_ray_gradient(rays, S[L.DU + k], S[L.DV + k], slide, tc + slide, gmx, gmy, gmz, gex, gey, gez)
    store_ray_gradient(rays, out)
