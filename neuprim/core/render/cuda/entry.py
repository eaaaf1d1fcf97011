# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Compositing in the order in which each ray enters its chords (``sort = "entry"``), forward and backward.

Every hit is listed first, with a key of pixel and entry (:mod:`~neuprim.core.render.cuda.forward`), the list is sorted,
and a thread a pixel walks its part. Entries that agree in float32 keep the order of the centres, and so do all chords
that the near plane cuts: slots lie in that order, and the sort is stable. Nothing can stop early before the list is
complete, so hidden primitives cost. What follows, over pairs, is the same.
"""

import functools
from typing import Any

from neuprim.core.compute.warp import FAST, Floats, Floats2d, Ints, Longs, Vec2s, Vec4s2d, wp
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.layout import Form


@wp.func
def _begin(keys: Longs, count: int, pixel: int):
    """The first of the sorted keys that belongs to this pixel or a later one."""
    low, high = int(0), int(count)
    while low < high:
        middle = low + (high - low) // 2
        if int(keys[middle] >> wp.int64(32)) < pixel:
            low = middle + 1
        else:
            high = middle
    return low


@functools.cache
def composite_kernel(form: Form, depth: bool) -> Any:
    """A thread a pixel, front to back; slots keep (alpha, transmittance before), alpha 0 behind the last that
    counts."""
    C, H = form.channels, form.hidden
    colours = L.colours(form.neurons)
    colour_type = wp.types.vector(length=C, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options=FAST, grid_stride=False)
    def composite(
        rows: Vec4s2d, ids: Ints, keys: Longs, order: Longs, count: int, owners: Ints, limits: wp.vec4,
        background: Floats, hues: Floats2d, depths: Floats, hits: Vec2s, rgb: Floats2d, transmittance: Floats,
        zsum: Floats, begins: Ints,
    ):  # fmt: skip
        """``begins[pixel]`` receives where its hits begin in ``order``."""
        n = wp.tid()
        first = _begin(keys, count, n)
        begins[n] = first
        T, z = float(1.0), float(0.0)
        color = colour_type()
        for k in range(first, _begin(keys, count, n + 1)):
            slot = int(order[k])
            alpha = hits[slot][0]
            if T < limits[2]:
                alpha = 0.0
            hits[slot] = wp.vec2(alpha, T)
            weight = alpha * T
            hue = wp.vec4()
            for c in range(wp.static(C)):
                if wp.static(H >= 0):
                    color[c] += weight * wp.max(hues[slot, c], 0.0)
                else:
                    if wp.static(c % 4 == 0):
                        hue = rows[ids[owners[slot]], wp.static(colours + c // 4)]
                    color[c] += weight * hue[wp.static(c % 4)]
            if wp.static(depth):
                z += weight * depths[slot]
            T -= weight
        for c in range(wp.static(C)):
            rgb[n, c] = color[c] + T * background[c]
        transmittance[n] = T
        if wp.static(depth):
            zsum[n] = z

    return composite


@functools.cache
def uncomposite_kernel(form: Form, depth: bool) -> Any:
    """Back to front: (alpha, T) of every hit becomes (dL/dI, weight), see
    :func:`~neuprim.core.render.cuda.backward.pixels_kernel`."""
    C, H = form.channels, form.hidden
    colours = L.colours(form.neurons)

    @wp.kernel(enable_backward=False, module="unique", module_options=FAST, grid_stride=False)
    def uncomposite(
        rows: Vec4s2d, ids: Ints, order: Longs, begins: Ints, owners: Ints, limits: wp.vec4, transmittance: Floats,
        g_rgb: Floats2d, g_transmittance: Floats, g_z: Floats, depths: Floats, hues: Floats2d, hits: Vec2s,
    ):  # fmt: skip
        n = wp.tid()
        behind = transmittance[n] * g_transmittance[n]
        first = begins[n]
        count = begins[n + 1] - first
        for back in range(count):
            slot = int(order[first + count - 1 - back])
            hit = hits[slot]
            alpha = hit[0]
            out = wp.vec2()
            if alpha > 0.0:
                weight = alpha * hit[1]
                by_weight = float(0.0)
                hue = wp.vec4()
                for c in range(wp.static(C)):
                    if wp.static(H >= 0):
                        by_weight += wp.max(hues[slot, c], 0.0) * g_rgb[n, c]
                    else:
                        if wp.static(c % 4 == 0):
                            hue = rows[ids[owners[slot]], wp.static(colours + c // 4)]
                        by_weight += hue[wp.static(c % 4)] * g_rgb[n, c]
                if wp.static(depth):
                    by_weight += g_z[n] * depths[slot]
                slope = float(0.0)
                if alpha < limits[1]:
                    slope = (1.0 - alpha) * hit[1] * by_weight - behind
                behind += weight * by_weight
                out = wp.vec2(slope, weight)
            hits[slot] = out

    return uncomposite
