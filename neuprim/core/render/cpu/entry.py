"""Compositing in the order in which each ray enters the primitives (``sort = "entry"``), forward and backward.

For each tile of 16 x 16 pixels, a pass over its primitives lists the hits. A hit is a pixel and a primitive whose
opacity in the pixel is above 0. Each pixel's hits are sorted and composited front to back. The backward pass repeats
these steps and computes GRAD, the gradient by the density integral, of every hit, back to front. A second pass over the
primitives then writes the same gradient rows as the default kernel. All hits must be listed before the first can be
composited, so hidden primitives take time. Chords that the near plane cuts come first. Such chords, and hits whose
entries agree in float32, stay in the order of the primitives' centres.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from neuprim.core.compute.kernels import borrow_array, borrow_arrays, inline, kernel, release_array
from neuprim.core.render import layout as P
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.backward import lane_opacities, lane_optical_depths
from neuprim.core.render.cpu.colour_net import ray_colour_gradient, ray_colours
from neuprim.core.render.cpu.float64 import FLOAT64_SCRATCH
from neuprim.core.render.cpu.gradients import chord_gradient, lanes_with_slopes, neuron_gradients
from neuprim.core.render.cpu.tiles import box_pixels, chord_field_values, compact_lanes, pair_window, row_spans

f = np.float32

# One row per hit of the tile, because hits are not read in the order in which they are written. The backward pass fills
# the last three. H_DEPTH: camera-z of the chord's middle.
H_ENTRY, H_ALPHA, H_SLOPE, H_DEPTH, H_OPTICAL, H_WEIGHT, H_BEFORE, H_GRAD = range(8)
H_FLOATS = 8
H_PIXEL, H_LANE, H_PAIR = 0, 1, 2  # pixel of the tile, lane of the pair, pair of the tile
H_INTS = 4
_CUT = f(-1e30)  # entry of every chord that the near plane cuts: in front of all others, and equal
Array = np.ndarray[Any, Any]


class _PairLanes(NamedTuple):
    """Scratch memory for the lanes (pixels) of one (tile, primitive) pair.

    ``S`` and ``D`` hold the lanes in float32 and float64, ``state`` the tile's pixels. For ``bounds``, ``offset`` and
    ``rows_live`` see :func:`row_spans` and :func:`compact_lanes`. ``waves`` holds cosines of a colour network's units
    and their derivatives; it is None without a network.
    """

    S: Array
    D: Array
    state: Array
    bounds: Array
    offset: Array
    rows_live: Array
    waves: Any


class _Hits(NamedTuple):
    """The hits of one tile, in the order of the tile's (tile, primitive) pairs.

    A hit is a pixel and a primitive with opacity above 0 in the pixel. ``values`` (columns H_ENTRY to H_GRAD),
    ``marks`` (H_PIXEL, H_LANE, H_PAIR) and ``colours`` (channels) have one row per hit. The hits of pair q are
    ``pair_start[q]`` to ``pair_start[q + 1]`` - 1. For ``listing`` and ``pixel_start`` see :func:`_sort_tile_hits`.
    """

    values: Array
    marks: Array
    colours: Array
    pair_start: Array
    listing: Array
    pixel_start: Array


@inline
def _allocate_lanes(C, net):  # type: ignore[no-untyped-def]
    scratch = L.BACKWARD_SCRATCH
    waves: Any = None
    if net is not None:
        scratch = L.BACKWARD_SCRATCH + 2 * C * L.LANES
        waves = np.zeros((net.hidden, L.NET_SCRATCH), np.float32)
    return _PairLanes(
        np.zeros(scratch + 1024, np.float32),
        np.zeros(FLOAT64_SCRATCH, np.float64),
        np.zeros(L.NORM + P.PIXELS + 2 * P.TILE, np.float32),
        np.zeros(2 * P.TILE, np.int32),
        np.zeros(P.TILE, np.int32),
        np.zeros(P.TILE, np.float32),
        waves,
    )


@inline
def _allocate_hits(start, stop, across, frame, C, net):  # type: ignore[no-untyped-def]
    """Return memory for the hits of any single tile in ``start:stop``.

    There is room for one hit per pixel in the pixel box of each (tile, primitive) pair.
    """
    room, pairs = 1, 1
    for t in range(start, stop):
        first, end = frame.starts[t], frame.starts[t + 1]
        tx, ty = (t % across) * P.TILE, (t // across) * P.TILE
        pixels = 0
        for q in range(first, end):
            pixels += box_pixels(frame, frame.ids[q], tx, ty)
        room, pairs = max(room, pixels), max(pairs, end - first)
    return _Hits(
        np.empty((room, H_FLOATS), np.float32),
        np.empty((room, H_INTS), np.int32),
        np.empty((1 if net is None else room, C), np.float32),
        np.empty(pairs + 1, np.int32),
        np.empty(room, np.int32),
        np.empty(P.PIXELS + 1, np.int32),
    )


@inline
def _gather_lanes(lanes, frame, pair):  # type: ignore[no-untyped-def]
    """Gather the pixels of one (tile, primitive) pair inside the silhouette into lanes; return the number of lanes."""
    row_spans(frame.spans[pair.i], pair, lanes.rows_live, lanes.bounds)
    return compact_lanes(lanes.S, lanes.state, lanes.offset, lanes.bounds, pair.y0, pair.y1)


@inline
def _load_tile_norms(lanes, norms, tx, ty):  # type: ignore[no-untyped-def]
    """Load into ``lanes`` which rows of a tile lie in the image, and the ray norm of each pixel.

    The ray norm is the length of the pixel's ray direction whose camera-z is 1.
    """
    height, width = norms.shape
    for y in range(P.TILE):
        lanes.rows_live[y] = f(1) if ty + y < height else f(0)
        for x in range(P.TILE):
            inside = tx + x < width and ty + y < height
            lanes.state[L.NORM + y * P.TILE + x] = norms[ty + y, tx + x] if inside else f(0)


@inline
def _list_tile_hits(lanes, hits, frame, first, end, tx, ty, colors, net, edge):  # type: ignore[no-untyped-def]
    """List the hits of a tile; return (number of hits, number of evaluated lanes).

    A lane is one pixel of a (tile, primitive) pair, a hit a lane with opacity above 0.
    """
    S, D, offset, bounds = lanes.S, lanes.D, lanes.offset, lanes.bounds
    values, marks = hits.values, hits.marks
    count, evaluated = 0, 0
    for q in range(first, end):
        i = frame.ids[q]
        p = frame.rows[i]
        hits.pair_start[q - first] = count
        pair = pair_window(frame, i, tx, ty)
        n = _gather_lanes(lanes, frame, pair)
        if n == 0:
            continue
        n16 = ((n + 15) // 16) * 16
        evaluated += n16
        chord_field_values(S, D, n16, frame, pair, False, True, edge)
        lane_optical_depths(S, n16, edge)
        lane_opacities(S, n16, frame.alpha_min, frame.alpha_max)
        if net is not None:
            ray_colours(S, D, lanes.waves, n16, i, net, frame.slots, colors[i], False)
        anchor, unit = p[P.ANCHOR_Z], p[P.UNIT]
        for y in range(pair.y0, pair.y1):
            at = offset[y] - bounds[y]
            for x in range(bounds[y], bounds[y + P.TILE]):
                k = at + x
                if S[L.ALPHA + k] > f(0):
                    middle = S[L.MID + k] + S[L.SLIDE + k]
                    values[count, H_ENTRY] = anchor + unit * (middle - S[L.HALF + k]) if S[L.UNCUT + k] > f(0) else _CUT
                    values[count, H_ALPHA], values[count, H_SLOPE] = S[L.ALPHA + k], S[L.SLOPE + k]
                    values[count, H_DEPTH], values[count, H_OPTICAL] = anchor + unit * middle, S[L.DEPTH + k]
                    marks[count, H_PIXEL], marks[count, H_LANE], marks[count, H_PAIR] = y * P.TILE + x, k, q - first
                    if net is not None:
                        for c in range(colors.shape[1]):
                            hits.colours[count, c] = max(S[L.RAY_COLOUR + c * L.LANES + k], f(0))
                    count += 1
    hits.pair_start[end - first] = count
    return count, evaluated


@inline
def _sort_tile_hits(count, hits):  # type: ignore[no-untyped-def]
    """Sort the hits of a tile: fill ``listing``, the hits by pixel and entry, and ``pixel_start``.

    ``pixel_start`` holds the index of each pixel's first hit in ``listing``.

    A counting sort by pixel keeps each pixel's hits in the order of the primitives' centres. A stable insertion sort by
    entry follows, which is fast because few hits move far.
    """
    values, marks, listing, begin = hits.values, hits.marks, hits.listing, hits.pixel_start
    begin[:] = 0
    for s in range(count):
        begin[marks[s, H_PIXEL] + 1] += 1
    for j in range(P.PIXELS):
        begin[j + 1] += begin[j]
    for s in range(count):
        j = marks[s, H_PIXEL]
        listing[begin[j]] = s
        begin[j] += 1
    for j in range(P.PIXELS):  # each begin is now its end: shift them back
        begin[P.PIXELS - j] = begin[P.PIXELS - j - 1]
    begin[0] = 0
    for j in range(P.PIXELS):
        first = begin[j]
        for e in range(first + 1, begin[j + 1]):
            s = listing[e]
            entry, at = values[s, H_ENTRY], e
            while at > first and values[listing[at - 1], H_ENTRY] > entry:
                listing[at] = listing[at - 1]
                at -= 1
            listing[at] = s


@kernel
def composite_tiles_by_entry(start, stop, frame, colors, image, net, edge):  # type: ignore[no-untyped-def]
    """Render tiles ``start:stop``, with each pixel's hits sorted by entry; return the number of evaluated lanes.

    For arguments see :func:`~neuprim.core.render.cpu.forward.composite_tiles`; ``image.last`` counts the composited
    hits per pixel.
    """
    frame, image, colors = borrow_arrays(frame), borrow_arrays(image), borrow_array(colors)
    height, width = frame.norms.shape
    across = (width + P.TILE - 1) // P.TILE
    C, tmin = colors.shape[1], frame.transmittance_min
    own_lanes, own_hits = _allocate_lanes(C, net), _allocate_hits(start, stop, across, frame, C, net)
    lanes, hits = borrow_arrays(own_lanes), borrow_arrays(own_hits)
    values, marks, listing, begin = hits.values, hits.marks, hits.listing, hits.pixel_start
    color = np.zeros(C, np.float32)
    evaluated = 0
    for t in range(start, stop):
        tx, ty = (t % across) * P.TILE, (t // across) * P.TILE
        first, end = frame.starts[t], frame.starts[t + 1]
        _load_tile_norms(lanes, frame.norms, tx, ty)
        count, tile_lanes = _list_tile_hits(lanes, hits, frame, first, end, tx, ty, colors, net, edge)
        evaluated += tile_lanes
        _sort_tile_hits(count, hits)
        for y in range(min(P.TILE, height - ty)):
            for x in range(min(P.TILE, width - tx)):
                j = y * P.TILE + x
                T, z, drawn = f(1), f(0), 0
                color[:] = f(0)
                for e in range(begin[j], begin[j + 1]):
                    if T < tmin:
                        break
                    s = listing[e]
                    i = frame.ids[first + marks[s, H_PAIR]]
                    weight = values[s, H_ALPHA] * T
                    for c in range(C):
                        color[c] += weight * (colors[i, c] if net is None else hits.colours[s, c])
                    z += weight * values[s, H_DEPTH]
                    T -= weight
                    drawn += 1
                for c in range(C):
                    image.rgb[ty + y, tx + x, c] = color[c] + T * image.background[c]
                image.transmittance[ty + y, tx + x] = T
                image.last[ty + y, tx + x] = drawn
                if image.with_depth:
                    image.zsum[ty + y, tx + x] = z
    release_array(own_lanes)
    release_array(own_hits)
    return evaluated


@inline
def _uncomposite_hits(hits, ids, first, tx, ty, norms, colors, image, tmin, net):  # type: ignore[no-untyped-def]
    """Composite the hits of a tile again, then go back to front: fill every hit's weight alpha T and GRAD.

    T is the transmittance before the hit, GRAD the gradient by the hit's density integral. ``image`` is an
    ImageGradient, and ``first`` the index of the tile's first pair.
    """
    values, marks, listing, begin = hits.values, hits.marks, hits.listing, hits.pixel_start
    height, width = norms.shape
    for y in range(min(P.TILE, height - ty)):
        for x in range(min(P.TILE, width - tx)):
            j, Y, X = y * P.TILE + x, ty + y, tx + x
            T, stopped = f(1), begin[j]
            for e in range(begin[j], begin[j + 1]):
                s = listing[e]
                if T < tmin:  # behind the primitive that stopped the ray
                    values[s, H_WEIGHT], values[s, H_GRAD] = f(0), f(0)
                    continue
                weight = values[s, H_ALPHA] * T
                values[s, H_BEFORE], values[s, H_WEIGHT] = T, weight
                T -= weight
                stopped = e + 1
            behind = T * image.g_transmittance[Y, X]
            for back in range(stopped - begin[j]):
                s = listing[stopped - 1 - back]
                i = ids[first + marks[s, H_PAIR]]
                cg = f(0)
                for c in range(colors.shape[1]):
                    cg += (colors[i, c] if net is None else hits.colours[s, c]) * image.rgb[Y, X, c]
                if image.with_depth:
                    cg += image.z[Y, X] * values[s, H_DEPTH]
                values[s, H_GRAD] = (values[s, H_BEFORE] * cg - behind / (f(1) - values[s, H_ALPHA])) * values[
                    s, H_SLOPE
                ]
                behind += values[s, H_WEIGHT] * cg


@kernel
def backward_tiles_by_entry(start, stop, frame, colors, image, net, edge):  # type: ignore[no-untyped-def]
    """Fill the gradient rows of all pairs of tiles ``start:stop``, with hits sorted by entry; return the lane count.

    For arguments see :func:`~neuprim.core.render.cpu.backward.backward_tiles`. Unlike that function, this function
    composites the hits again, because the forward pass saves nothing for it.
    """
    frame, image, colors = borrow_arrays(frame), borrow_arrays(image), borrow_array(colors)
    across = (frame.norms.shape[1] + P.TILE - 1) // P.TILE
    C, neurons, with_depth = colors.shape[1], frame.neurons, image.with_depth
    color_at = P.G_NEURONS + P.PER_NEURON * neurons
    own_lanes, own_hits = _allocate_lanes(C, net), _allocate_hits(start, stop, across, frame, C, net)
    lanes, hits = borrow_arrays(own_lanes), borrow_arrays(own_hits)
    S, D, waves, values, marks, pair_start = lanes.S, lanes.D, lanes.waves, hits.values, hits.marks, hits.pair_start
    V = np.zeros((neurons, L.NEURON_SCRATCH), np.float32)
    evaluated = 0
    for t in range(start, stop):
        tx, ty = (t % across) * P.TILE, (t // across) * P.TILE
        first, end = frame.starts[t], frame.starts[t + 1]
        _load_tile_norms(lanes, frame.norms, tx, ty)
        count, tile_lanes = _list_tile_hits(lanes, hits, frame, first, end, tx, ty, colors, net, edge)
        evaluated += tile_lanes
        _sort_tile_hits(count, hits)
        _uncomposite_hits(hits, frame.ids, first, tx, ty, frame.norms, colors, image, frame.transmittance_min, net)
        for q in range(first, end):
            i = frame.ids[q]
            p, out = frame.rows[i], image.pair_rows[q]
            out[:] = f(0)
            weight, wrong = f(0), f(0)
            for s in range(pair_start[q - first], pair_start[q - first + 1]):
                j, w = marks[s, H_PIXEL], values[s, H_WEIGHT]
                Y, X = ty + j // P.TILE, tx + j % P.TILE
                weight += w
                wrong += w * image.error[Y, X]
                if net is None:
                    for c in range(C):
                        out[color_at + c] += w * image.rgb[Y, X, c]
            if weight == f(0):
                continue  # hidden or below the cut everywhere: every gradient is zero
            out[P.G_WEIGHT], out[P.G_ERROR] = weight, wrong
            pair = pair_window(frame, i, tx, ty)
            n = _gather_lanes(lanes, frame, pair)
            n16 = ((n + 15) // 16) * 16
            evaluated += n16
            cut = lanes_with_slopes(S, D, V, n16, frame, pair, edge)
            for k in range(n16):
                S[L.GRAD + k], S[L.GMID + k], S[L.DEPTH + k] = f(0), f(0), f(0)
            if net is not None:
                ray_colours(S, D, waves, n16, i, net, frame.slots, colors[i], True)
                for c in range(C, 2 * C):
                    for k in range(n16):
                        S[L.RAY_COLOUR + c * L.LANES + k] = f(0)
            for s in range(pair_start[q - first], pair_start[q - first + 1]):
                k, j = marks[s, H_LANE], marks[s, H_PIXEL]
                Y, X = ty + j // P.TILE, tx + j % P.TILE
                S[L.GRAD + k], S[L.DEPTH + k] = values[s, H_GRAD], values[s, H_OPTICAL]
                if net is not None:
                    for c in range(C):
                        if S[L.RAY_COLOUR + c * L.LANES + k] >= f(0):
                            S[L.RAY_COLOUR + (C + c) * L.LANES + k] = values[s, H_WEIGHT] * image.rgb[Y, X, c]
                if with_depth:
                    S[L.GMID + k] = values[s, H_WEIGHT] * image.z[Y, X] * p[P.UNIT]
            neuron_gradients(S, V, n16, p, frame.kinds[i], neurons, edge, frame.slots[i] >= 0, cut, out)
            if net is not None:
                ray_colour_gradient(S, waves, n16, i, net, C, out, color_at)
            chord_gradient(S, n16, p, out, edge, cut)
    release_array(own_lanes)
    release_array(own_hits)
    return evaluated
