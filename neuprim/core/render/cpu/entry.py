"""Tile-wise compositing in the order in which each ray enters its chords (``sort = "entry"``), forward and backward.

The default kernels walk a tile's primitives in one order, that of their centres. Here every pixel has its own. A first
pass over the tile's primitives lists the hits: the pixel, the camera-z at which its ray enters, the opacity. Each
pixel's hits are then sorted and composited front to back. The backward pass lists and composites again, walks back to
front, which leaves dL/d(2 FIELD HALF) with every hit, and in a second pass over the primitives turns these into the
same gradient rows, one per (tile, primitive), as the default kernel writes. Nothing can stop early before the lists are
complete, so hidden primitives cost.

Entries that agree in float32 keep the order of the centres, and so do all chords that the near plane cuts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from neuprim.core.compute.kernels import inline, kernel
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.backward import opacity, optical_depths
from neuprim.core.render.cpu.float64 import FLOAT64_SCRATCH
from neuprim.core.render.cpu.gradients import chord_gradient, lanes_with_slopes, neuron_gradients
from neuprim.core.render.cpu.neurons import field_values
from neuprim.core.render.cpu.ray_colours import ray_colour_gradient, ray_colours
from neuprim.core.render.cpu.tiles import compact, row_spans

__all__ = ["backward_tiles_by_entry", "composite_tiles_by_entry"]

f = np.float32

# One row per hit of the tile, because hits are read in another order than they are written. The backward pass fills the
# last three.
H_ENTRY, H_ALPHA, H_SLOPE, H_DEPTH, H_OPTICAL, H_WEIGHT, H_BEFORE, H_GRAD = range(
    8
)  # H_DEPTH: camera-z of the chord's middle
H_FLOATS = 8
H_PIXEL, H_LANE, H_PAIR = 0, 1, 2  # pixel of the tile, lane of the pair, pair of the tile
H_INTS = 4
_CUT = f(-1e30)  # entry of every chord that the near plane cuts: in front of all others, and equal


@inline
def _lanes_of(S, state, offset, bounds, rows_live, span, box, p, tx, ty):  # type: ignore[no-untyped-def]
    """Compact the pixels of one pair into lanes; returns (lanes, first row, row after the last, and the tile's corner
    from the anchor)."""
    y0, y1 = max(box[1] - ty, 0), min(box[3] - ty, L.TILE)
    x0, x1 = max(box[0] - tx, 0), min(box[2] - tx, L.TILE)
    fx0, fy0 = f(tx) + f(0.5) - p[L.UX], f(ty) + f(0.5) - p[L.UY]
    row_spans(span, fx0, fy0, y0, y1, x0, x1, rows_live, bounds)
    return compact(S, state, offset, bounds, y0, y1), y0, y1, fx0, fy0


@inline
def _load_tile(state, rows_live, norms, tx, ty):  # type: ignore[no-untyped-def]
    """Ray norms of a tile's pixels, and which of its rows lie in the image."""
    height, width = norms.shape
    for y in range(L.TILE):
        rows_live[y] = f(1) if ty + y < height else f(0)
        for x in range(L.TILE):
            inside = tx + x < width and ty + y < height
            state[L.NORM + y * L.TILE + x] = norms[ty + y, tx + x] if inside else f(0)


@inline
def _room(first, end, ids, boxes, tx, ty):  # type: ignore[no-untyped-def]
    """An upper bound of the hits of one tile: the boxes' pixels."""
    room = 1
    for q in range(first, end):
        box = boxes[ids[q]]
        x = min(box[2] - tx, L.TILE) - max(box[0] - tx, 0)
        y = min(box[3] - ty, L.TILE) - max(box[1] - ty, 0)
        room += max(x, 0) * max(y, 0)
    return room


@inline
def _list_hits(  # type: ignore[no-untyped-def]
    S, D, state, offset, bounds, rows_live, first, end, tx, ty, rows, wide, slots, spans, kinds, boxes, ids, limits, neurons,
    hits, marks, starts_of, colors, net, waves, hues, edge,
):  # fmt: skip
    """List the hits of a tile in the order of its pairs; those of pair r lie in ``starts_of[r] : starts_of[r + 1]``.

    With a ``net`` their colours go to ``hues``. Returns (hits, evaluated lanes).
    """
    amin, amax, floor = limits[0], limits[1], limits[3]
    count, evaluated = 0, 0
    for q in range(first, end):
        i = ids[q]
        p = rows[i]
        starts_of[q - first] = count
        n, y0, y1, fx0, fy0 = _lanes_of(S, state, offset, bounds, rows_live, spans[i], boxes[i], p, tx, ty)
        if n == 0:
            continue
        n16 = ((n + 15) // 16) * 16
        evaluated += n16
        field_values(
            S, D, n16, bounds, y0, y1, tx, ty, fx0, fy0, i, rows, wide, slots, kinds, neurons, floor, False, True, edge
        )
        optical_depths(S, n16, edge)
        opacity(S, n16, amin, amax)
        if net is not None:
            ray_colours(S, D, waves, n16, i, net, slots, colors[i], False)
        anchor, unit = p[L.ANCHOR_Z], p[L.UNIT]
        for y in range(y0, y1):
            at = offset[y] - bounds[y]
            for x in range(bounds[y], bounds[y + L.TILE]):
                k = at + x
                if S[L.ALPHA + k] > f(0):
                    middle = S[L.MID + k] + S[L.SLIDE + k]
                    hits[count, H_ENTRY] = anchor + unit * (middle - S[L.HALF + k]) if S[L.UNCUT + k] > f(0) else _CUT
                    hits[count, H_ALPHA], hits[count, H_SLOPE] = S[L.ALPHA + k], S[L.SLOPE + k]
                    hits[count, H_DEPTH], hits[count, H_OPTICAL] = anchor + unit * middle, S[L.DEPTH + k]
                    marks[count, H_PIXEL], marks[count, H_LANE], marks[count, H_PAIR] = y * L.TILE + x, k, q - first
                    if net is not None:
                        for c in range(hues.shape[1]):
                            hues[count, c] = max(S[L.RAY_COLOUR + c * L.LANES + k], f(0))
                    count += 1
    starts_of[end - first] = count
    return count, evaluated


@inline
def _sort_hits(count, hits, marks, begin, listing):  # type: ignore[no-untyped-def]
    """``listing[begin[j] : begin[j + 1]]`` are the hits of pixel j, front to back.

    A counting sort by pixel, which keeps the order of the centres, then an insertion sort by entry: centres are nearly
    in the right order, so few hits move far. Equal entries do not move.
    """
    begin[:] = 0
    for s in range(count):
        begin[marks[s, H_PIXEL] + 1] += 1
    for j in range(L.PIXELS):
        begin[j + 1] += begin[j]
    for s in range(count):
        j = marks[s, H_PIXEL]
        listing[begin[j]] = s
        begin[j] += 1
    for j in range(L.PIXELS):  # every begin has moved to its end: move them back
        begin[L.PIXELS - j] = begin[L.PIXELS - j - 1]
    begin[0] = 0
    for j in range(L.PIXELS):
        first = begin[j]
        for e in range(first + 1, begin[j + 1]):
            s = listing[e]
            entry, at = hits[s, H_ENTRY], e
            while at > first and hits[listing[at - 1], H_ENTRY] > entry:
                listing[at] = listing[at - 1]
                at -= 1
            listing[at] = s


@kernel
def composite_tiles_by_entry(  # type: ignore[no-untyped-def]
    start, stop, rows, wide, slots, spans, kinds, boxes, starts, ids, colors, norms, background, limits, with_depth, neurons,
    rgb, transmittance, zsum, last, net, edge,
):  # fmt: skip
    """As :func:`~neuprim.core.render.cpu.forward.composite_tiles`; ``last`` receives how many hits each pixel
    composited."""
    height, width = norms.shape
    across = (width + L.TILE - 1) // L.TILE
    C = colors.shape[1]
    tmin = limits[2]
    scratch = L.BACKWARD_SCRATCH
    waves: Any = None
    hues: Any = None
    if net is not None:
        scratch = L.BACKWARD_SCRATCH + 2 * C * L.LANES
        waves, hues = np.zeros((net.hidden, L.NET_SCRATCH), np.float32), np.empty((1, C), np.float32)
    S, D = np.zeros(scratch + 1024, np.float32), np.zeros(FLOAT64_SCRATCH, np.float64)
    state = np.zeros(L.NORM + L.PIXELS + 2 * L.TILE, np.float32)
    bounds, offset = np.zeros(2 * L.TILE, np.int32), np.zeros(L.TILE, np.int32)
    rows_live, color = np.zeros(L.TILE, np.float32), np.zeros(C, np.float32)
    hits, marks, listing = np.empty((1, H_FLOATS), np.float32), np.empty((1, H_INTS), np.int32), np.empty(1, np.int32)
    starts_of, begin = np.empty(1, np.int32), np.empty(L.PIXELS + 1, np.int32)
    evaluated = 0
    for t in range(start, stop):
        tx, ty = (t % across) * L.TILE, (t // across) * L.TILE
        first, end = starts[t], starts[t + 1]
        _load_tile(state, rows_live, norms, tx, ty)
        room = _room(first, end, ids, boxes, tx, ty)
        if room > listing.shape[0]:
            hits, marks, listing = (
                np.empty((room, H_FLOATS), np.float32),
                np.empty((room, H_INTS), np.int32),
                np.empty(room, np.int32),
            )
            if net is not None:
                hues = np.empty((room, C), np.float32)
        if end - first >= starts_of.shape[0]:
            starts_of = np.empty(end - first + 1, np.int32)
        count, lanes = _list_hits(
            S, D, state, offset, bounds, rows_live, first, end, tx, ty, rows, wide, slots, spans, kinds, boxes, ids, limits, neurons,
            hits, marks, starts_of, colors, net, waves, hues, edge,
        )  # fmt: skip
        evaluated += lanes
        _sort_hits(count, hits, marks, begin, listing)
        for y in range(min(L.TILE, height - ty)):
            for x in range(min(L.TILE, width - tx)):
                j = y * L.TILE + x
                T, z, drawn = f(1), f(0), 0
                color[:] = f(0)
                for e in range(begin[j], begin[j + 1]):
                    if T < tmin:
                        break
                    s = listing[e]
                    i = ids[first + marks[s, H_PAIR]]
                    weight = hits[s, H_ALPHA] * T
                    for c in range(C):
                        color[c] += weight * (colors[i, c] if net is None else hues[s, c])
                    z += weight * hits[s, H_DEPTH]
                    T -= weight
                    drawn += 1
                for c in range(C):
                    rgb[ty + y, tx + x, c] = color[c] + T * background[c]
                transmittance[ty + y, tx + x] = T
                last[ty + y, tx + x] = drawn
                if with_depth:
                    zsum[ty + y, tx + x] = z
    return evaluated


@kernel
def backward_tiles_by_entry(  # type: ignore[no-untyped-def]
    start, stop, rows, wide, slots, spans, kinds, boxes, starts, ids, colors, norms, limits, with_depth, neurons,
    transmittance, last, g_rgb, g_transmittance, g_z, error, pair_rows, net, edge,
):  # fmt: skip
    """As :func:`~neuprim.core.render.cpu.backward.backward_tiles`. Composites anew, so ``transmittance`` and ``last``
    are not read."""
    height, width = norms.shape
    across = (width + L.TILE - 1) // L.TILE
    C = colors.shape[1]
    color_at = L.G_NEURONS + L.PER_NEURON * neurons
    tmin, floor = limits[2], limits[3]
    scratch = L.BACKWARD_SCRATCH
    waves: Any = None
    hues: Any = None
    if net is not None:
        scratch = L.BACKWARD_SCRATCH + 2 * C * L.LANES
        waves, hues = np.zeros((net.hidden, L.NET_SCRATCH), np.float32), np.empty((1, C), np.float32)
    S, D = np.zeros(scratch + 1024, np.float32), np.zeros(FLOAT64_SCRATCH, np.float64)
    V = np.zeros((neurons, L.NEURON_SCRATCH), np.float32)
    state = np.zeros(L.NORM + L.PIXELS + 2 * L.TILE, np.float32)
    bounds, offset = np.zeros(2 * L.TILE, np.int32), np.zeros(L.TILE, np.int32)
    rows_live = np.zeros(L.TILE, np.float32)
    hits, marks, listing = np.empty((1, H_FLOATS), np.float32), np.empty((1, H_INTS), np.int32), np.empty(1, np.int32)
    starts_of, begin = np.empty(1, np.int32), np.empty(L.PIXELS + 1, np.int32)
    evaluated = 0
    for t in range(start, stop):
        tx, ty = (t % across) * L.TILE, (t // across) * L.TILE
        first, end = starts[t], starts[t + 1]
        _load_tile(state, rows_live, norms, tx, ty)
        room = _room(first, end, ids, boxes, tx, ty)
        if room > listing.shape[0]:
            hits, marks, listing = (
                np.empty((room, H_FLOATS), np.float32),
                np.empty((room, H_INTS), np.int32),
                np.empty(room, np.int32),
            )
            if net is not None:
                hues = np.empty((room, C), np.float32)
        if end - first >= starts_of.shape[0]:
            starts_of = np.empty(end - first + 1, np.int32)
        count, lanes = _list_hits(
            S, D, state, offset, bounds, rows_live, first, end, tx, ty, rows, wide, slots, spans, kinds, boxes, ids, limits, neurons,
            hits, marks, starts_of, colors, net, waves, hues, edge,
        )  # fmt: skip
        evaluated += lanes
        _sort_hits(count, hits, marks, begin, listing)

        for y in range(min(L.TILE, height - ty)):
            for x in range(min(L.TILE, width - tx)):
                j, Y, X = y * L.TILE + x, ty + y, tx + x
                T, stopped = f(1), begin[j]
                for e in range(begin[j], begin[j + 1]):
                    s = listing[e]
                    if T < tmin:  # behind the primitive that stopped the ray
                        hits[s, H_WEIGHT], hits[s, H_GRAD] = f(0), f(0)
                        continue
                    weight = hits[s, H_ALPHA] * T
                    hits[s, H_BEFORE], hits[s, H_WEIGHT] = T, weight
                    T -= weight
                    stopped = e + 1
                behind = T * g_transmittance[Y, X]
                for back in range(stopped - begin[j]):
                    s = listing[stopped - 1 - back]
                    i = ids[first + marks[s, H_PAIR]]
                    cg = f(0)
                    for c in range(C):
                        cg += (colors[i, c] if net is None else hues[s, c]) * g_rgb[Y, X, c]
                    if with_depth:
                        cg += g_z[Y, X] * hits[s, H_DEPTH]
                    hits[s, H_GRAD] = (hits[s, H_BEFORE] * cg - behind / (f(1) - hits[s, H_ALPHA])) * hits[s, H_SLOPE]
                    behind += hits[s, H_WEIGHT] * cg

        for q in range(first, end):
            i = ids[q]
            p, out = rows[i], pair_rows[q]
            out[:] = f(0)
            weight, wrong = f(0), f(0)
            for s in range(starts_of[q - first], starts_of[q - first + 1]):
                j, w = marks[s, H_PIXEL], hits[s, H_WEIGHT]
                Y, X = ty + j // L.TILE, tx + j % L.TILE
                weight += w
                wrong += w * error[Y, X]
                if net is None:
                    for c in range(C):
                        out[color_at + c] += w * g_rgb[Y, X, c]
            if weight == f(0):
                continue  # hidden or below the cut everywhere: every gradient is zero
            out[L.G_WEIGHT], out[L.G_ERROR] = weight, wrong
            n, y0, y1, fx0, fy0 = _lanes_of(S, state, offset, bounds, rows_live, spans[i], boxes[i], p, tx, ty)
            n16 = ((n + 15) // 16) * 16
            evaluated += n16
            lanes_with_slopes(
                S, D, V, n16, bounds, y0, y1, tx, ty, fx0, fy0, i, rows, wide, slots, neurons, floor, edge
            )
            for k in range(n16):
                S[L.GRAD + k], S[L.GMID + k], S[L.DEPTH + k] = f(0), f(0), f(0)
            if net is not None:
                ray_colours(S, D, waves, n16, i, net, slots, colors[i], True)
                for c in range(C, 2 * C):
                    for k in range(n16):
                        S[L.RAY_COLOUR + c * L.LANES + k] = f(0)
            for s in range(starts_of[q - first], starts_of[q - first + 1]):
                k, j = marks[s, H_LANE], marks[s, H_PIXEL]
                S[L.GRAD + k], S[L.DEPTH + k] = hits[s, H_GRAD], hits[s, H_OPTICAL]
                if net is not None:
                    for c in range(C):
                        if S[L.RAY_COLOUR + c * L.LANES + k] >= f(0):
                            S[L.RAY_COLOUR + (C + c) * L.LANES + k] = (
                                hits[s, H_WEIGHT] * g_rgb[ty + j // L.TILE, tx + j % L.TILE, c]
                            )
                if with_depth:
                    S[L.GMID + k] = hits[s, H_WEIGHT] * g_z[ty + j // L.TILE, tx + j % L.TILE] * p[L.UNIT]
            neuron_gradients(S, V, n16, p, kinds[i], neurons, edge, slots[i] >= 0, out)
            if net is not None:
                ray_colour_gradient(S, waves, n16, i, net, C, out, color_at)
            chord_gradient(S, n16, p, out, edge, slots[i] >= 0)
    return evaluated
