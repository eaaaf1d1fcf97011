# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""The pixel stage in float64, for the few primitives for which float32 is not accurate enough.

The pixel stage computes chords, opacities and gradients. The formulas are those of
:mod:`neuprim.core.render.cpu.float64`; the edge weight q of a hard edge is 1. Before compositing, opacities and entries
(depths at which rays enter the primitive) are stored in the slots (pixels of (tile, primitive) pairs). For the
gradients of soft edges see :func:`neuprim.core.render.cpu.gradients.chord_gradient`.
"""

from __future__ import annotations

import functools
from typing import Any

from neuprim.core.compute.warp import OPTIONS, Doubles2d, Floats, Floats2d, Ints, Shorts2d, Vec2s, wp
from neuprim.core.render import layout as W
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.block_ops import gradient_row_sums, gradient_row_type
from neuprim.core.render.cuda.chord import pixel_of_slot
from neuprim.core.render.cuda.layout import CUT_AT, KernelForm

d = wp.float64
_TWO_PI = 6.283185307179586
vec6d = wp.types.vector(length=6, dtype=wp.float64)
vec5d = wp.types.vector(length=5, dtype=wp.float64)

_TERMS = 14


@wp.struct
class Chord64:
    """A :class:`~neuprim.core.render.cuda.chord.Chord` (part of a ray in a primitive) in float64.

    Unlike in float32, the ray's origin is not slid along the ray.
    """

    du: wp.float64
    dv: wp.float64
    e: wp.vec3d
    x: wp.vec3d
    D: wp.float64
    ia: wp.float64
    tm: wp.float64
    h: wp.float64
    uncut: wp.float64
    mid: wp.float64
    half: wp.float64
    q: wp.vec3d  # the chord's middle


@wp.func
def _wide_row_vector(wide: Doubles2d, r: int, c: int):
    return wp.vec3d(wide[r, c], wide[r, c + 1], wide[r, c + 2])


@wp.func
def intersect_chord64(wide: Doubles2d, r: int, X: int, Y: int):
    """Return the chord of the ray through pixel (X, Y) in the primitive whose row in ``wide`` is ``r``."""
    c = Chord64()
    zero, one = d(0.0), d(1.0)
    c.du = d(X) + d(0.5) - wide[r, W.UX]
    c.dv = d(Y) + d(0.5) - wide[r, W.UY]
    G = c.du * _wide_row_vector(wide, r, W.EX) + c.dv * _wide_row_vector(wide, r, W.EY)
    c.e = _wide_row_vector(wide, r, W.E0) + G
    m = _wide_row_vector(wide, r, W.XA) + wide[r, W.TC] * G
    c.ia = one / wp.dot(c.e, c.e)
    c.tm = -wp.dot(m, c.e) * c.ia
    c.x = m + c.tm * c.e
    c.D = one - wp.dot(c.x, c.x)
    c.h = wp.sqrt(wp.max(c.D, zero) * c.ia)
    near = wide[r, W.NEAR]
    t0 = c.tm - c.h
    c.uncut = wp.where(t0 > near, one, zero)
    t0 = wp.max(t0, near)
    c.mid = d(0.5) * (t0 + c.tm + c.h)
    c.half = wp.max(d(0.5) * (c.tm + c.h - t0), zero)
    c.q = c.x + (c.mid - c.tm) * c.e
    return c


@wp.struct
class Weight:
    """The edge weight q(u) along a chord, u from -1 to 1, and the derivative of q.

    ``q`` holds the coefficients of the polynomial q(u), lowest power first. ``mean`` is the mean of q(u) over the
    chord. dq/d(1 - |y|^2) is b0 + b1 u + b2 u^2, y the point in whitened space.
    """

    q: vec5d
    mean: wp.float64
    b0: wp.float64
    b1: wp.float64
    b2: wp.float64


@wp.func
def chord_edge_polynomial64(c: Chord64, edge: int):
    """Return the edge weight q(u) = (D - a (shift + half u)^2)^p along a chord, u in [-1, 1], for p = ``edge``.

    a is e.e, and shift is the distance in t from the point closest to the centre to the chord's middle.
    """
    w = Weight()
    two, a, shift = d(2.0), d(1.0) / c.ia, c.mid - c.tm
    c0, c1, c2 = c.D - a * shift * shift, -two * a * shift * c.half, -a * c.half * c.half
    w.q = vec5d()
    if edge == 0:
        w.q[0] = d(1.0)
    elif edge == 1:
        w.q[0] = c0
        w.q[1] = c1
        w.q[2] = c2
        w.b0 = d(1.0)
    else:
        w.q[0] = c0 * c0
        w.q[1] = two * c0 * c1
        w.q[2] = c1 * c1 + two * c0 * c2
        w.q[3] = two * c1 * c2
        w.q[4] = c2 * c2
        w.b0 = two * c0
        w.b1 = two * c1
        w.b2 = two * c2
    w.mean = w.q[0] + w.q[2] / d(3.0) + w.q[4] / d(5.0)
    return w


@wp.func
def _chord_bessel(z: wp.float64):
    """Return the spherical Bessel functions j_0 to j_5 at any z.

    For |z| < 2, where upward recursion loses digits, the function sums a series.
    """
    j = vec6d()
    if wp.abs(z) < d(2.0):
        square, power = d(0.5) * z * z, d(1.0)
        for n in range(6):
            term, total = d(power), d(power)
            for k in range(1, _TERMS):
                term *= -square / d(k * (2 * n + 2 * k + 1))
                total += term
            j[n] = total
            power *= z / d(2 * n + 3)
    else:
        j[0] = wp.sin(z) / z
        j[1] = (j[0] - wp.cos(z)) / z
        over = d(1.0) / z
        j[2] = d(3.0) * over * j[1] - j[0]
        j[3] = d(5.0) * over * j[2] - j[1]
        j[4] = d(7.0) * over * j[3] - j[2]
        j[5] = d(9.0) * over * j[4] - j[3]
    return j


@wp.func
def chord_moments(z: wp.float64):
    """Return the means over u in [-1, 1] of u^n cos(z u) for n = 0, 2, 4 and of u^n sin(z u) for n = 1, 3, 5."""
    j = _chord_bessel(z)
    two, three, eight = d(2.0), d(3.0), d(8.0)
    M = vec6d()
    M[0] = j[0]
    M[1] = j[1]
    M[2] = (j[0] - two * j[2]) / three
    M[3] = (three * j[1] - two * j[3]) / d(5.0)
    M[4] = (d(7.0) * j[0] - d(20.0) * j[2] + eight * j[4]) / d(35.0)
    M[5] = (d(27.0) * j[1] - d(28.0) * j[3] + eight * j[5]) / d(63.0)
    return M


@wp.func
def chord_phase64(c: Chord64, w: wp.vec3d, phase: wp.float64):
    """Return a neuron's phase at the chord's middle, in radians, reduced to half a turn."""
    u = wp.dot(c.q, w) + phase
    return d(_TWO_PI) * (u - wp.rint(u))


@wp.func
def rate64(c: Chord64, w: wp.vec3d):
    """Return z, the change of a neuron's phase over half a chord, in radians."""
    return d(_TWO_PI) * c.half * wp.dot(c.e, w)


@wp.struct
class Moments:
    """Means of q(u) cos(z u) and q(u) sin(z u) over a chord, and their derivatives by z."""

    even: wp.float64
    odd: wp.float64
    d_even: wp.float64
    d_odd: wp.float64


@wp.func
def weighted_moments64(w: Weight, M: vec6d):
    """Return the :class:`Moments` of an edge weight from ``M``, the result of :func:`chord_moments`."""
    out = Moments()
    out.even = w.q[0] * M[0] + w.q[2] * M[2] + w.q[4] * M[4]
    out.odd = w.q[1] * M[1] + w.q[3] * M[3]
    out.d_even = -(w.q[0] * M[1] + w.q[2] * M[3] + w.q[4] * M[5])
    out.d_odd = w.q[1] * M[2] + w.q[3] * M[4]
    return out


@wp.struct
class Pull64:
    """Gradients of the loss by a ray's origin m, by its direction e = E0 + G, and by G = du EX + dv EY."""

    m: wp.vec3d
    e: wp.vec3d
    G: wp.vec3d


@wp.func
def chord_backward64(
    c: Chord64, tc: wp.float64, depth_floor: float, g_half: wp.float64, g_mid: wp.float64, g_tm: wp.float64,
    gD: wp.float64, gA: wp.float64,
    gq: wp.vec3d, gv: wp.vec3d,
):  # fmt: skip
    """Return the gradients of a ray from the gradients of its chord, in float64.

    For the arguments see :func:`~neuprim.core.render.cuda.chord.chord_ends_backward`. Unlike there, ``gD`` excludes
    dL/dh dh/dD, which this function adds. In dh/dD, D counts as at least ``depth_floor``. ``tc`` is the anchor's depth
    divided by the longest semi-axis m.
    """
    half, two = d(0.5), d(2.0)
    gt1, gt0 = half * (g_mid + g_half), half * (g_mid - g_half) * c.uncut
    tm, g_h = g_tm + gt0 + gt1, gt1 - gt0
    D = gD + g_h * half * c.ia / wp.sqrt(wp.max(c.D, d(depth_floor)) * c.ia)
    a = gA - (half * g_h * c.h + tm * c.tm) * c.ia
    b, m2 = -tm * c.ia, -two * D
    out = Pull64()
    out.m = gq + m2 * c.x + b * c.e
    out.e = c.half * gv + c.mid * gq + (c.tm * m2 + b) * c.x + (two * a - b * c.tm) * c.e
    out.G = out.e + tc * out.m
    return out


@wp.func
def ray_norm(lens: wp.vec4, X: int, Y: int):
    """Return the length of the ray direction of pixel (X, Y), scaled to camera-z 1; ``lens`` is (fx, fy, cx, cy)."""
    x = (d(X) + d(0.5) - d(lens[2])) / d(lens[0])
    y = (d(Y) + d(0.5) - d(lens[3])) / d(lens[1])
    return wp.sqrt(x * x + y * y + d(1.0))


@functools.cache
def float64_opacity_kernel(depth: bool) -> Any:
    """Return a kernel that computes the opacities of float64 pairs.

    With ``depth``, the kernel also computes the camera-z of the chords' middles.
    """

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def float64_opacity(
        pairs: Ints, wide: Doubles2d, slots: Ints, ids: Ints, tiles: Ints, spans: Shorts2d, offsets: Ints,
        lens: wp.vec4, limits: wp.vec4, size: wp.vec2i, neurons: int, edge: int, hits: Vec2s, depths: Floats,
    ):  # fmt: skip
        """Store (alpha, entry depth) in the ``hits`` of all slots of ``pairs``, with one block per pair.

        ``slots`` holds the row of each primitive in ``wide``.
        """
        member, lane = wp.tid()
        n, r = pairs[member], int(-1)
        if n >= 0:  # -1 fills the list
            r = slots[ids[n]]
        if r >= 0:
            across = (size[0] + L.TILE - 1) // L.TILE
            tx, ty, begin = (tiles[n] % across) * L.TILE, (tiles[n] // across) * L.TILE, offsets[n]
            for s in range(lane, offsets[n + 1] - begin, wp.static(L.PIXELS)):
                at = pixel_of_slot(spans, n, s)
                X, Y = tx + at[0], ty + at[1]
                c = intersect_chord64(wide, r, X, Y)
                w = chord_edge_polynomial64(c, edge)
                alpha = float(0.0)
                if c.half > d(0.0) and w.mean > d(0.0):
                    total = w.mean * wide[r, W.OFFSET]
                    for k in range(neurons):
                        o = wp.static(W.NEURONS) + wp.static(W.PER_NEURON) * k
                        v = _wide_row_vector(wide, r, o)
                        phase = chord_phase64(c, v, wide[r, o + W.PHASE])
                        m = weighted_moments64(w, chord_moments(rate64(c, v)))
                        total += wide[r, o + W.AMPLITUDE] * (wp.cos(phase) * m.even - wp.sin(phase) * m.odd)
                    I = d(2.0) * total * c.half * ray_norm(lens, X, Y)
                    if I > d(0.0):
                        alpha = wp.min(float(d(1.0) - wp.exp(-I)), limits[1])
                        if alpha < limits[0]:
                            alpha = 0.0
                entry = float(CUT_AT)
                if c.uncut > d(0.0):
                    entry = float(wide[r, W.ANCHOR_Z] + wide[r, W.UNIT] * (c.mid - c.half))
                hits[begin + s] = wp.vec2(alpha, entry)
                if wp.static(depth):
                    depths[begin + s] = float(wide[r, W.ANCHOR_Z] + wide[r, W.UNIT] * c.mid)

    return float64_opacity


@functools.cache
def float64_pairs_kernel(form: KernelForm, depth: bool) -> Any:
    """Return the kernel that writes the gradient rows of float64 pairs, with one warp per (tile, primitive) pair.

    ``depth`` tells whether the depth image has a gradient.
    """
    K, P, C = form.neurons, form.edge, form.channels
    width = L.gradient_width(K, C)
    row_of, add_lanes = gradient_row_type(width), gradient_row_sums(width)

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def float64_pairs(
        pairs: Ints, wide: Doubles2d, slots: Ints, ids: Ints, tiles: Ints, spans: Shorts2d, offsets: Ints,
        lens: wp.vec4, depth_floor: float, size: wp.vec2i, neurons: int, reached: Ints, hits: Vec2s, g_rgb: Floats2d,
        g_z: Floats, error: Floats, out: Floats,
    ):  # fmt: skip
        member, lane = wp.tid()
        n, r = pairs[member], int(-1)
        if n >= 0:  # -1 fills the list
            r = slots[ids[n]]
        if r >= 0:
            total = row_of()
            tile = tiles[n]
            if n < reached[tile]:
                across = (size[0] + L.TILE - 1) // L.TILE
                zero, two, turn, begin = d(0.0), d(2.0), d(_TWO_PI), offsets[n]
                for s in range(lane, offsets[n + 1] - begin, wp.static(L.WARP)):
                    hit = hits[begin + s]
                    if hit[1] > 0.0:
                        at = pixel_of_slot(spans, n, s)
                        X = (tile % across) * L.TILE + at[0]
                        Y = (tile // across) * L.TILE + at[1]
                        pixel = Y * size[0] + X
                        total[L.G_WEIGHT] += hit[1]
                        total[L.G_ERROR] += hit[1] * error[pixel]
                        for k in range(wp.static(C)):
                            total[wp.static(L.G_NEURONS + 5 * K + k)] += hit[1] * g_rgb[pixel, k]
                        c = intersect_chord64(wide, r, X, Y)
                        w = chord_edge_polynomial64(c, P)
                        g = two * d(hit[0]) * ray_norm(lens, X, Y)  # dL/d(mean half)
                        gh = g * c.half
                        mean = w.mean * wide[r, W.OFFSET]
                        # moments of d q/d(1 - |y|^2) with 1, u and u^2
                        rest0 = wide[r, W.OFFSET] * (w.b0 + w.b2 / d(3.0))
                        rest1 = wide[r, W.OFFSET] * w.b1 / d(3.0)
                        rest2 = wide[r, W.OFFSET] * (w.b0 / d(3.0) + w.b2 / d(5.0))
                        gq, gv = wp.vec3d(), wp.vec3d()
                        for k in range(neurons):
                            o = wp.static(W.NEURONS) + wp.static(W.PER_NEURON) * k
                            og = wp.static(L.G_NEURONS) + wp.static(W.PER_NEURON) * k
                            v = _wide_row_vector(wide, r, o)
                            phase = chord_phase64(c, v, wide[r, o + W.PHASE])
                            M = chord_moments(rate64(c, v))
                            m = weighted_moments64(w, M)
                            cosine, sine, amplitude = wp.cos(phase), wp.sin(phase), wide[r, o + W.AMPLITUDE]
                            one = cosine * m.even - sine * m.odd
                            mean += amplitude * one
                            gu = -gh * amplitude * turn * (sine * m.even + cosine * m.odd)
                            gw = gh * amplitude * turn * (cosine * m.d_even - sine * m.d_odd)
                            gx = gu * c.q + (gw * c.half) * c.e
                            total[og] += float(gx[0])
                            total[og + 1] += float(gx[1])
                            total[og + 2] += float(gx[2])
                            total[og + W.PHASE] += float(gu)
                            total[og + W.AMPLITUDE] += float(gh * one)
                            gq += gu * v
                            gv += gw * v
                            rest0 += amplitude * (cosine * (w.b0 * M[0] + w.b2 * M[2]) - sine * w.b1 * M[1])
                            rest1 += amplitude * (cosine * w.b1 * M[2] - sine * (w.b0 * M[1] + w.b2 * M[3]))
                            rest2 += amplitude * (cosine * (w.b0 * M[2] + w.b2 * M[4]) - sine * w.b1 * M[3])
                        total[L.G_OFFSET] += float(gh * w.mean)
                        total[L.G_LOG_M] += float(gh * mean)
                        g_half, g_mid = wp.dot(gv, c.e) + g * mean, wp.dot(gq, c.e)
                        g_tm, gD, gA = d(0.0), d(0.0), d(0.0)
                        if wp.static(P > 0):
                            shift, g_half, g_mid = c.mid - c.tm, zero, zero
                            g_tm = gh * two / c.ia * (shift * rest0 + c.half * rest1)
                            gD = gh * rest0
                            gA = -gh * (shift * shift * rest0 + two * shift * c.half * rest1 + c.half * c.half * rest2)
                        if wp.static(depth):
                            g_mid += d(hit[1] * g_z[pixel]) * wide[r, W.UNIT]
                        pull = chord_backward64(c, wide[r, W.TC], depth_floor, g_half, g_mid, g_tm, gD, gA, gq, gv)
                        for k in range(3):
                            total[k] += float(pull.e[k])
                            total[3 + k] += float(c.du * pull.G[k])
                            total[6 + k] += float(c.dv * pull.G[k])
                            total[9 + k] += float(pull.m[k])
            add_lanes(total, lane, out, n)

    return float64_pairs
