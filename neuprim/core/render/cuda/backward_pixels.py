# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Backward, first pass: a thread a pixel walks its hits back to front and leaves dL/dI and the weight in each slot. No
neurons, no sums."""

from __future__ import annotations

import functools
from typing import Any

from neuprim.core.compute.warp import FAST, wp
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.chord import pixel, place
from neuprim.core.render.cuda.forms import Form
from neuprim.core.render.cuda.memory import column_of, hit_at, leave_hit, span_of, whole

__all__ = ["pixels_kernel"]


@functools.cache
def pixels_kernel(form: Form, depth: bool) -> Any:
    """Of a form; ``depth``: a gradient of the sum of w z arrives, too."""
    C, H = form.channels, form.hidden
    colours, width = L.colours(form.neurons), L.columns(form.neurons, C)
    vecC = wp.types.vector(length=C, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options=FAST, grid_stride=False)
    def backward_pixels(
        rows: wp.array2d(dtype=wp.vec4),
        starts: wp.array(dtype=wp.int32),
        ids: wp.array(dtype=wp.int32),
        spans: wp.array2d(dtype=wp.uint16),
        offsets: wp.array(dtype=wp.int32),
        limits: wp.vec4,
        size: wp.vec2i,
        transmittance: wp.array(dtype=wp.float32),
        reached: wp.array(dtype=wp.int32),
        g_rgb: wp.array2d(dtype=wp.float32),
        g_transmittance: wp.array(dtype=wp.float32),
        g_z: wp.array(dtype=wp.float32),
        depths: wp.array(dtype=wp.float32),
        hues: wp.array2d(dtype=wp.float32),
        hits: wp.array(dtype=wp.vec2),
    ):
        """``g_transmittance`` already holds the background's share. With b what lies behind a hit, sum of w (dL/dw) and
        the rest of the light: dL/dI = (1 - alpha) T dL/dw - b, and 0 where the opacity was clamped."""
        tile, lane = wp.tid()
        across = (size[0] + L.TILE - 1) // L.TILE
        at = pixel(lane)
        X = (tile % across) * L.TILE + at[0]
        Y = (tile // across) * L.TILE + at[1]
        if X < size[0] and Y < size[1]:
            n = Y * size[0] + X
            behind = transmittance[n] * g_transmittance[n]
            own = vecC()
            for k in range(wp.static(C)):
                own[k] = g_rgb[n, k]
            first = starts[tile]
            count = reached[tile] - first
            for back in range(count):
                p = first + count - 1 - back
                slot = place(span_of(spans, p, at[1]), whole(offsets, p), at[0])
                if slot >= 0:
                    hit = hit_at(hits, slot)
                    alpha = hit[0]
                    out = wp.vec2()
                    if alpha > 0.0:
                        i = whole(ids, p)
                        weight = alpha * hit[1]
                        by_weight = float(0.0)
                        hue = wp.vec4()
                        for k in range(wp.static(C)):
                            if wp.static(H >= 0):
                                by_weight += wp.max(hues[slot, k], 0.0) * own[k]
                            else:
                                if wp.static(k % 4 == 0):
                                    hue = column_of(rows, i, wp.static(width), wp.static(colours + k // 4))
                                by_weight += hue[wp.static(k % 4)] * own[k]
                        if wp.static(depth):
                            by_weight += g_z[n] * depths[slot]
                        slope = float(0.0)
                        if alpha < limits[1]:
                            slope = (1.0 - alpha) * hit[1] * by_weight - behind
                        behind += weight * by_weight
                        out = wp.vec2(slope, weight)
                    leave_hit(hits, slot, out)

    return backward_pixels
