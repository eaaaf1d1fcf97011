# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Colour networks at pixels: the backward pass over pairs of what they add, and both passes in float64 for delicate
primitives.

A slot's hue is the colour before max(0, .), which the forward pass leaves there. A network's share of the gradient of a
ray comes through the chord's middle alone; it is linear, so that it is added to the density's row by row.
"""

import functools
from typing import Any

from neuprim.core.compute.warp import FAST, OPTIONS, wp
from neuprim.core.render.cpu import layout as W
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.backward_pairs import pixel_of_slot
from neuprim.core.render.cuda.chord import chord, phase, ray_of, through_chord, xyz
from neuprim.core.render.cuda.chord64 import chord64, through64
from neuprim.core.render.cuda.forms import Form
from neuprim.core.render.cuda.functions import TAU, cos_turns, sin_turns
from neuprim.core.render.cuda.together import row_sums, row_type

__all__ = ["FIRST_COLOUR", "delicate_hues_kernel", "delicate_net_kernel", "net_pairs_kernel", "net_width"]

FIRST_COLOUR = L.G_NEURONS
"""Column of a network's gradient row where the C bases begin, then (WX, WY, WZ, PHASE, C weights) of each unit; the
ray's come first."""

d = wp.float64
_TWO_PI = wp.constant(wp.float64(TAU))


def net_width(form: Form) -> int:
    """Columns of a network's gradient row."""
    return L.gradient_width(0, form.channels, form.hidden)


@functools.cache
def net_pairs_kernel(form: Form) -> Any:
    """A warp a pair: gradients of its network, and the ray's share through the chord's middle."""
    C, H, P = form.channels, form.hidden, form.edge
    each, width = L.net_columns(C), net_width(form)
    columns, net_columns = L.columns(form.neurons, C), max(H * each, 1)
    row_of, add_lanes = row_type(width), row_sums(width)
    vecC = wp.types.vector(length=C, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options=FAST, grid_stride=False)
    def net_pairs(
        rows: wp.array2d(dtype=wp.vec4), net: wp.array2d(dtype=wp.vec4), ids: wp.array(dtype=wp.int32), tiles: wp.array(dtype=wp.int32),
        spans: wp.array2d(dtype=wp.uint16), offsets: wp.array(dtype=wp.int32), depth_floor: float, size: wp.vec2i,
        reached: wp.array(dtype=wp.int32), hits: wp.array(dtype=wp.vec2), hues: wp.array2d(dtype=wp.float32), g_rgb: wp.array2d(dtype=wp.float32),
        out: wp.array(dtype=wp.float32),
    ):  # fmt: skip
        n, lane = wp.tid()
        tile = tiles[n]
        across = (size[0] + L.TILE - 1) // L.TILE
        i = ids[n]
        if rows[i, L.REST][3] == 0.0:  # the others' rows come from a kernel in float64
            total = row_of()
            if n < reached[tile]:
                which = wp.tile_load(ids, shape=1, offset=n, storage="shared")
                row = wp.tile_load_indexed(rows, indices=which, shape=(1, columns), axis=0, storage="shared")
                units = wp.tile_load_indexed(net, indices=which, shape=(1, net_columns), axis=0, storage="shared")
                begin = offsets[n]
                left = (tile % across) * L.TILE  # here, as no compiler moves a division out of a branch
                top = (tile // across) * L.TILE
                for s in range(lane, offsets[n + 1] - begin, wp.static(L.WARP)):
                    weight = hits[begin + s][1]
                    if weight > 0.0:
                        at = pixel_of_slot(spans, n, s)
                        X = left + at[0]
                        Y = top + at[1]
                        c = chord(ray_of(row, 0), float(X) + 0.5, float(Y) + 0.5)
                        q = c.x + (c.mid - c.tm) * c.e
                        g = vecC()
                        for k in range(wp.static(C)):
                            if hues[begin + s, k] >= 0.0:
                                g[k] = weight * g_rgb[Y * size[0] + X, k]
                            total[wp.static(L.G_NEURONS + k)] += g[k]
                        gq = wp.vec3()
                        for j in range(wp.static(H)):
                            w = units[0, wp.static(each * j)]
                            u = phase(q, w)
                            r = u - wp.rint(u)
                            cosine = cos_turns(r * r)
                            pull = float(0.0)
                            mixed = wp.vec4()
                            for k in range(wp.static(C)):
                                if wp.static(k % 4 == 0):
                                    mixed = units[0, wp.static(each * j + 1 + k // 4)]
                                pull += mixed[wp.static(k % 4)] * g[k]
                                total[wp.static(L.G_NEURONS + C + (4 + C) * j + 4 + k)] += g[k] * cosine
                            gu = -TAU * sin_turns(r) * pull
                            total[wp.static(L.G_NEURONS + C + (4 + C) * j)] += gu * q[0]
                            total[wp.static(L.G_NEURONS + C + (4 + C) * j + 1)] += gu * q[1]
                            total[wp.static(L.G_NEURONS + C + (4 + C) * j + 2)] += gu * q[2]
                            total[wp.static(L.G_NEURONS + C + (4 + C) * j + 3)] += gu
                            gq += gu * xyz(w)
                        D = wp.max(c.D, 1.0e-12)
                        by_depth = 0.5 * c.h / D
                        if wp.static(P == 0):
                            by_depth = 0.5 * c.ia / wp.sqrt(wp.max(D, depth_floor) * c.ia)
                        pulled = through_chord(c, 0.0, wp.dot(gq, c.e), 0.0, by_depth, gq, wp.vec3())
                        gE = pulled.e + c.slide * pulled.m
                        gG = pulled.e + (row[0, L.REST][0] + c.slide) * pulled.m
                        for k in range(3):
                            total[k] += gE[k]
                            total[3 + k] += c.du * gG[k]
                            total[6 + k] += c.dv * gG[k]
                            total[9 + k] += pulled.m[k]
            add_lanes(total, lane, out, n)

    return net_pairs


@functools.cache
def delicate_hues_kernel(channels: int) -> Any:
    """Hues of the delicate pairs' slots, in float64."""

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def delicate_hues(
        pairs: wp.array(dtype=wp.int32), wide: wp.array2d(dtype=wp.float64), net: wp.array2d(dtype=wp.vec4d), mixes: wp.array2d(dtype=wp.vec4),
        rows: wp.array2d(dtype=wp.vec4), first: int, hidden: int, slots: wp.array(dtype=wp.int32), ids: wp.array(dtype=wp.int32),
        tiles: wp.array(dtype=wp.int32), spans: wp.array2d(dtype=wp.uint16), offsets: wp.array(dtype=wp.int32), size: wp.vec2i,
        hues: wp.array2d(dtype=wp.float32),
    ):  # fmt: skip
        """``mixes``: the networks' float32 rows, for their output weights; ``rows``: the primitives', with the bases
        from column ``first``."""
        member, lane = wp.tid()
        n = pairs[member]
        i = ids[n]
        r = slots[i]
        across = (size[0] + L.TILE - 1) // L.TILE
        begin = offsets[n]
        for s in range(lane, offsets[n + 1] - begin, wp.static(L.WARP)):
            at = pixel_of_slot(spans, n, s)
            c = chord64(wide, r, (tiles[n] % across) * L.TILE + at[0], (tiles[n] // across) * L.TILE + at[1])
            for k in range(wp.static(channels)):
                hue = d(rows[i, first + k // 4][k % 4])
                for j in range(hidden):
                    w = net[r, j]
                    u = wp.dot(c.q, wp.vec3d(w[0], w[1], w[2])) + w[3]
                    mixed = mixes[i, j * wp.static(L.net_columns(channels)) + 1 + k // 4][k % 4]
                    hue += d(mixed) * wp.cos(_TWO_PI * (u - wp.rint(u)))
                hues[begin + s, k] = float(hue)

    return delicate_hues


@functools.cache
def delicate_net_kernel(form: Form) -> Any:
    """:func:`net_pairs_kernel` for delicate pairs, in float64."""
    C = form.channels
    each, width = L.net_columns(C), net_width(form)
    row_of, add_lanes = row_type(width), row_sums(width)
    vecC = wp.types.vector(length=C, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def delicate_net(
        pairs: wp.array(dtype=wp.int32), wide: wp.array2d(dtype=wp.float64), net: wp.array2d(dtype=wp.vec4d), mixes: wp.array2d(dtype=wp.vec4),
        hidden: int, slots: wp.array(dtype=wp.int32), ids: wp.array(dtype=wp.int32), tiles: wp.array(dtype=wp.int32),
        spans: wp.array2d(dtype=wp.uint16), offsets: wp.array(dtype=wp.int32), depth_floor: float, size: wp.vec2i,
        reached: wp.array(dtype=wp.int32), hits: wp.array(dtype=wp.vec2), hues: wp.array2d(dtype=wp.float32), g_rgb: wp.array2d(dtype=wp.float32),
        out: wp.array(dtype=wp.float32),
    ):  # fmt: skip
        member, lane = wp.tid()
        n = pairs[member]
        i = ids[n]
        r = slots[i]
        tile = tiles[n]
        total = row_of()
        if n < reached[tile]:
            across = (size[0] + L.TILE - 1) // L.TILE
            begin = offsets[n]
            for s in range(lane, offsets[n + 1] - begin, wp.static(L.WARP)):
                weight = hits[begin + s][1]
                if weight > 0.0:
                    at = pixel_of_slot(spans, n, s)
                    X = (tile % across) * L.TILE + at[0]
                    Y = (tile // across) * L.TILE + at[1]
                    c = chord64(wide, r, X, Y)
                    g = vecC()
                    for k in range(wp.static(C)):
                        if hues[begin + s, k] >= 0.0:
                            g[k] = weight * g_rgb[Y * size[0] + X, k]
                        total[wp.static(L.G_NEURONS + k)] += g[k]
                    gq = wp.vec3d()
                    for j in range(hidden):
                        to = wp.static(L.G_NEURONS + C) + wp.static(4 + C) * j
                        w = net[r, j]
                        axes = wp.vec3d(w[0], w[1], w[2])
                        u = wp.dot(c.q, axes) + w[3]
                        phase = _TWO_PI * (u - wp.rint(u))
                        pull = d(0.0)
                        for k in range(wp.static(C)):
                            pull += d(mixes[i, j * wp.static(each) + 1 + k // 4][k % 4] * g[k])
                            total[to + 4 + k] += g[k] * float(wp.cos(phase))
                        gu = -_TWO_PI * wp.sin(phase) * pull
                        total[to] += float(gu * c.q[0])
                        total[to + 1] += float(gu * c.q[1])
                        total[to + 2] += float(gu * c.q[2])
                        total[to + 3] += float(gu)
                        gq += gu * axes
                    zero = d(0.0)
                    moved = through64(
                        c, wide[r, W.TC], depth_floor, zero, wp.dot(gq, c.e), zero, zero, zero, gq, wp.vec3d()
                    )
                    for k in range(3):
                        total[k] += float(moved.e[k])
                        total[3 + k] += float(c.du * moved.G[k])
                        total[6 + k] += float(c.dv * moved.G[k])
                        total[9 + k] += float(moved.m[k])
        add_lanes(total, lane, out, n)

    return delicate_net
