# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""The backward pass over pairs for primitives in float64: :mod:`~neuprim.core.render.cuda.backward_pairs` for the few.

A hard edge has the gradient of its ends. A soft one has none there, the density being zero, and its weight depends on
D, on a = e.e and on the closest approach, where the near plane may cut the chord; see
:func:`neuprim.core.render.cpu.gradients.chord_gradient`.
"""

from __future__ import annotations

import functools
from typing import Any

from neuprim.core.compute.warp import OPTIONS, wp
from neuprim.core.render.cpu import layout as W
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.backward_pairs import pixel_of_slot
from neuprim.core.render.cuda.chord64 import chord64, dot64, moments, neuron64, phase64, rate64, through64, weight_of
from neuprim.core.render.cuda.delicate import ray_norm
from neuprim.core.render.cuda.forms import Form
from neuprim.core.render.cuda.together import row_sums, row_type

__all__ = ["delicate_pairs_kernel"]

_TWO_PI = 6.283185307179586


@functools.cache
def delicate_pairs_kernel(form: Form, depth: bool) -> Any:
    """Of a form; ``depth``: a gradient of the sum of w z arrives, too."""
    K, P, C = form.neurons, form.edge, form.channels
    width = L.gradient_width(K, C)
    row_of, add_lanes = row_type(width), row_sums(width)

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def delicate_pairs(
        pairs: wp.array(dtype=wp.int32),
        wide: wp.array2d(dtype=wp.float64),
        slots: wp.array(dtype=wp.int32),
        ids: wp.array(dtype=wp.int32),
        tiles: wp.array(dtype=wp.int32),
        spans: wp.array2d(dtype=wp.uint16),
        offsets: wp.array(dtype=wp.int32),
        lens: wp.vec4,
        depth_floor: float,
        size: wp.vec2i,
        neurons: int,
        reached: wp.array(dtype=wp.int32),
        hits: wp.array(dtype=wp.vec2),
        g_rgb: wp.array2d(dtype=wp.float32),
        g_z: wp.array(dtype=wp.float32),
        error: wp.array(dtype=wp.float32),
        out: wp.array(dtype=wp.float32),
    ):
        member, lane = wp.tid()
        n = pairs[member]
        r = slots[ids[n]]
        if r >= 0:
            total = row_of()
            tile = tiles[n]
            if n < reached[tile]:
                across = (size[0] + L.TILE - 1) // L.TILE
                zero = wp.float64(0.0)
                two = wp.float64(2.0)
                turn = wp.float64(_TWO_PI)
                begin = offsets[n]
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
                        c = chord64(wide, r, X, Y)
                        w = weight_of(c, P)
                        g = two * wp.float64(hit[0]) * ray_norm(lens, X, Y)  # dL/d(mean half)
                        gh = g * c.half
                        mean = w.mean * wide[r, W.OFFSET]
                        # moments of d q/d(1 - |y|^2) with 1, u and u^2
                        rest0 = wide[r, W.OFFSET] * (w.b0 + w.b2 / wp.float64(3.0))
                        rest1 = wide[r, W.OFFSET] * w.b1 / wp.float64(3.0)
                        rest2 = wide[r, W.OFFSET] * (w.b0 / wp.float64(3.0) + w.b2 / wp.float64(5.0))
                        gq = wp.vec3d()
                        gv = wp.vec3d()
                        for k in range(neurons):
                            o = wp.static(W.NEURONS) + wp.static(W.PER_NEURON) * k
                            og = wp.static(L.G_NEURONS) + wp.static(W.PER_NEURON) * k
                            v = neuron64(wide, r, o)
                            phase = phase64(c, v, wide[r, o + W.PHASE])
                            M = moments(rate64(c, v))
                            m = dot64(w, M)
                            cosine = wp.cos(phase)
                            sine = wp.sin(phase)
                            amplitude = wide[r, o + W.AMPLITUDE]
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
                        g_half = wp.dot(gv, c.e) + g * mean
                        g_mid = wp.dot(gq, c.e)
                        g_tm = wp.float64(0.0)
                        gD = wp.float64(0.0)
                        gA = wp.float64(0.0)
                        if wp.static(P > 0):
                            shift = c.mid - c.tm
                            g_half = zero
                            g_mid = zero
                            g_tm = gh * two / c.ia * (shift * rest0 + c.half * rest1)
                            gD = gh * rest0
                            gA = -gh * (shift * shift * rest0 + two * shift * c.half * rest1 + c.half * c.half * rest2)
                        if wp.static(depth):
                            g_mid += wp.float64(hit[1] * g_z[pixel]) * wide[r, W.UNIT]
                        pull = through64(c, wide[r, W.TC], depth_floor, g_half, g_mid, g_tm, gD, gA, gq, gv)
                        for k in range(3):
                            total[k] += float(pull.e[k])
                            total[3 + k] += float(c.du * pull.G[k])
                            total[6 + k] += float(c.dv * pull.G[k])
                            total[9 + k] += float(pull.m[k])
            add_lanes(total, lane, out, n)

    return delicate_pairs
