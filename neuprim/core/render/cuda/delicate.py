# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Opacities in float64 of the primitives that float32 cannot follow, and where rays enter them, left in their pixels'
slots beforehand."""

from __future__ import annotations

import functools
from typing import Any

from neuprim.core.compute.warp import OPTIONS, wp
from neuprim.core.render.cpu import layout as W
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.backward_pairs import pixel_of_slot
from neuprim.core.render.cuda.chord64 import chord64, dot64, moments, neuron64, phase64, rate64, weight_of
from neuprim.core.render.cuda.forward import CUT_AT

__all__ = ["delicate_kernel", "ray_norm"]


@wp.func
def ray_norm(lens: wp.vec4, X: int, Y: int):
    """Length of the ray direction whose camera-z is 1."""
    x = (wp.float64(X) + wp.float64(0.5) - wp.float64(lens[2])) / wp.float64(lens[0])
    y = (wp.float64(Y) + wp.float64(0.5) - wp.float64(lens[3])) / wp.float64(lens[1])
    return wp.sqrt(x * x + y * y + wp.float64(1.0))


@functools.cache
def delicate_kernel(depth: bool) -> Any:
    """For any form; ``depth``: also camera-z of the chords' middles."""

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def delicate(
        pairs: wp.array(dtype=wp.int32),
        wide: wp.array2d(dtype=wp.float64),
        slots: wp.array(dtype=wp.int32),
        ids: wp.array(dtype=wp.int32),
        tiles: wp.array(dtype=wp.int32),
        spans: wp.array2d(dtype=wp.uint16),
        offsets: wp.array(dtype=wp.int32),
        lens: wp.vec4,
        limits: wp.vec4,
        size: wp.vec2i,
        neurons: int,
        edge: int,
        hits: wp.array(dtype=wp.vec2),
        depths: wp.array(dtype=wp.float32),
    ):
        """A warp a pair of those listed in ``pairs``; ``slots[i]``: the row of primitive i in ``wide``."""
        member, lane = wp.tid()
        n = pairs[member]
        r = slots[ids[n]]
        if r >= 0:
            across = (size[0] + L.TILE - 1) // L.TILE
            tx = (tiles[n] % across) * L.TILE
            ty = (tiles[n] // across) * L.TILE
            begin = offsets[n]
            for s in range(lane, offsets[n + 1] - begin, wp.static(L.WARP)):
                at = pixel_of_slot(spans, n, s)
                X = tx + at[0]
                Y = ty + at[1]
                c = chord64(wide, r, X, Y)
                w = weight_of(c, edge)
                alpha = float(0.0)
                if c.half > wp.float64(0.0) and w.mean > wp.float64(0.0):
                    total = w.mean * wide[r, W.OFFSET]
                    for k in range(neurons):
                        o = wp.static(W.NEURONS) + wp.static(W.PER_NEURON) * k
                        v = neuron64(wide, r, o)
                        phase = phase64(c, v, wide[r, o + W.PHASE])
                        m = dot64(w, moments(rate64(c, v)))
                        total += wide[r, o + W.AMPLITUDE] * (wp.cos(phase) * m.even - wp.sin(phase) * m.odd)
                    I = wp.float64(2.0) * total * c.half * ray_norm(lens, X, Y)
                    if I > wp.float64(0.0):
                        alpha = wp.min(float(wp.float64(1.0) - wp.exp(-I)), limits[1])
                        if alpha < limits[0]:
                            alpha = 0.0
                entry = float(CUT_AT)
                if c.uncut > wp.float64(0.0):
                    entry = float(wide[r, W.ANCHOR_Z] + wide[r, W.UNIT] * (c.mid - c.half))
                hits[begin + s] = wp.vec2(alpha, entry)
                if wp.static(depth):
                    depths[begin + s] = float(wide[r, W.ANCHOR_Z] + wide[r, W.UNIT] * c.mid)

    return delicate
