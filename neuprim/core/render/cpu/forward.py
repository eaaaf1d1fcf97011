"""Forward pass for primitives sorted by the depth of their centres: composite tiles, and save data for backward.

A lane is one pixel of a (tile, primitive) pair. The forward pass saves the optical depth of every evaluated lane (4
bytes). For each pair, the pass also saves a mask of the tile rows with unfinished pixels (2 bytes) and the index of the
pair's first lane (4 bytes). From these data, the backward pass computes all opacities without evaluating densities. For
most primitives, the backward pass then evaluates only the lanes that have a gradient.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from neuprim.core.compute.kernels import borrow_array, borrow_arrays, inline, kernel, release_array
from neuprim.core.render import layout as P
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.chord import one_minus_exp
from neuprim.core.render.cpu.colour_net import ray_colours
from neuprim.core.render.cpu.float64 import FLOAT64_SCRATCH
from neuprim.core.render.cpu.tiles import (
    aligned_tile_zeros,
    box_pixels,
    chord_field_values,
    compact_lanes,
    pair_window,
    prefetch_pair,
    row_spans,
)

f = np.float32
index = np.uint64  # an unsigned index is never negative (from the end), so that LLVM vectorises without slices
_STEPS = np.arange(P.TILE).astype(np.float32)
_LIVE_EVERY = 4  # pairs between two checks for live pixels: a dead row wastes a few lanes, a check reduces every row
Array = np.ndarray[Any, Any]


class TileImage(NamedTuple):
    """Images that the forward kernels fill, and the (C,) background. Several images are stacked along H.

    w = alpha T is the weight of a sample (ray x primitive), and z the camera-z of its chord's middle. The rank of a
    primitive is its position, from 0, in a tile's front-to-back list.
    """

    # (H, W, C) and (H, W)
    rgb: Array
    transmittance: Array
    zsum: Array  # (H, W) sum of w z, filled if with_depth
    # (H, W) rank + 1 of the last primitive composited in each pixel; if sorted by entry, number of composited hits
    last: Array
    background: Array  # (C,)
    with_depth: bool


@dataclass
class SavedForBackward:
    """Data that the forward pass of one frame saves for the backward pass; empty if no gradient is needed.

    A pair is a tile and a primitive that reaches it; a lane is one pixel of a pair. A tile row is live until a check
    finds that the transmittance T is below T_min in all pixels of the row.
    """

    # (pairs,) bit y is set if row y of the tile was live when the pair was drawn; no pairs if nothing is saved
    live: Array
    first_lane: Array  # (pairs,) first lane of each pair in the depths of its chunk
    # one (lanes,) array per chunk of tiles: the optical depth of each evaluated lane
    depths: list[Array] = field(default_factory=list)

    @classmethod
    def allocate(cls, pairs: int) -> SavedForBackward:
        """Allocate memory for ``pairs`` (tile, primitive) pairs; with 0, the forward pass saves nothing."""
        return cls(np.empty(pairs, np.uint16), np.empty(pairs, np.int32))


@inline
def _live_tile_row_bits(rows_live):  # type: ignore[no-untyped-def]
    bits = np.int64(0)
    for y in range(P.TILE):
        bits |= np.int64(rows_live[y] > f(0)) << y
    return np.uint16(bits)


@inline
def _depth_array(floats):  # type: ignore[no-untyped-def]
    """Return an uninitialised float32 array of length ``floats``, aligned to a cache line.

    Pages of the array that are never written take no memory.
    """
    block = np.empty(floats + 16, np.float32)
    shift = -(np.int64(block.ctypes.data) // 4) % 16
    return block[shift : shift + floats]


@inline
def _max_lanes(start, stop, across, frame):  # type: ignore[no-untyped-def]
    """Return an upper bound of the number of lanes (pixels of all pairs) of tiles ``start:stop``.

    The number of each pair is rounded up to a multiple of 16.
    """
    lanes = 0
    for t in range(start, stop):
        tx, ty = (t % across) * P.TILE, (t // across) * P.TILE
        for q in range(frame.starts[t], frame.starts[t + 1]):
            lanes += (box_pixels(frame, frame.ids[q], tx, ty) + 15) // 16 * 16
    return lanes


@inline
def _store_opacities(S, n, frame, edge, keep, depths, at):  # type: ignore[no-untyped-def]
    """Fill ALPHA, the opacity of ``n`` lanes (pixels), from their chords; if ``keep``, save optical depths.

    The optical depths go to ``depths[at:]``. An opacity below alpha_min becomes 0, as does the opacity of an optical
    depth <= 0. Every other opacity is at most alpha_max.
    """
    amin, amax = frame.alpha_min, frame.alpha_max
    for k in range(n):
        depth = S[L.FIELD + k] * S[L.HALF + k] * S[L.NORM_L + k] * f(2)
        if len(edge) > 0:
            depth *= S[L.FADE + k]
        if keep:
            depths[index(at + k)] = depth
        alpha = min(one_minus_exp(depth), amax)
        alpha = alpha if alpha >= amin else f(0)
        S[L.ALPHA + k] = alpha if depth > f(0) else f(0)


# ---- One pixel row; ``at`` is the lane of the row's pixel 0. A pixel is live while T >= T_min. With a ``net``,
# RAY_COLOUR holds the lanes' own colours, before max(0, .).


@inline
def _composite_rgb_row(state, S, base, at, a, b, tmin, rank, color, net):  # type: ignore[no-untyped-def]
    """Composite a primitive with three colour channels into a row of pixels: add alpha T colour, update T.

    alpha is the primitive's opacity in a pixel, T the pixel's transmittance.

    ``state`` has the tile's pixel arrays, in which the row begins at ``base``. Pixels ``a`` to ``b`` - 1 are inside the
    silhouette; pixel k of the row is lane ``at`` + k of ``S``. Pixels with T < ``tmin`` do not change. ``rank``, 1 +
    the primitive's position in the tile's list, is stored in LAST where alpha > 0. With a ``net`` (colour network),
    RAY_COLOUR replaces ``color``.
    """
    a, b = f(a), f(b)
    c0, c1, c2 = color[0], color[1], color[2]
    for k in range(P.TILE):
        step, T = _STEPS[k], state[index(base + k + L.T_)]
        use = (step >= a) & (step < b) & (T >= tmin)
        alpha = S[index(at + k + L.ALPHA)] if use else f(0)
        weight = alpha * T
        state[index(base + k + L.T_)] = T - weight
        state[index(base + k + L.LAST)] = rank if alpha > f(0) else state[index(base + k + L.LAST)]
        if net is not None:
            c0 = max(S[index(at + k + L.RAY_COLOUR)], f(0))
            c1 = max(S[index(at + k + L.RAY_COLOUR + L.LANES)], f(0))
            c2 = max(S[index(at + k + L.RAY_COLOUR + 2 * L.LANES)], f(0))
        state[index(base + k + L.COLOR)] += weight * c0
        state[index(base + k + L.COLOR + P.PIXELS)] += weight * c1
        state[index(base + k + L.COLOR + 2 * P.PIXELS)] += weight * c2


@inline
def _composite_row(state, S, base, at, a, b, tmin, rank, w):  # type: ignore[no-untyped-def]
    """Like :func:`_composite_rgb_row`, but fill the weights ``w`` = alpha T instead of adding colours."""
    a, b = f(a), f(b)
    st, lanes = state[base:], S[L.ALPHA + at :]
    for k in range(P.TILE):
        step, T = _STEPS[k], st[k + L.T_]
        use = (step >= a) & (step < b) & (T >= tmin)
        alpha = lanes[k] if use else f(0)
        weight = alpha * T
        w[k] = weight
        st[k + L.T_] = T - weight
        st[k + L.LAST] = rank if alpha > f(0) else st[k + L.LAST]


@inline
def _add_colours(state, S, base, at, w, color, net):  # type: ignore[no-untyped-def]
    """Add weight ``w`` times ``color`` to the colours of a row of pixels, for any number of channels.

    With a ``net`` (colour network), RAY_COLOUR replaces ``color``.
    """
    for c in range(color.shape[0]):
        st = state[L.COLOR + c * P.PIXELS + base :]
        if net is None:
            own = color[c]
            for k in range(P.TILE):
                st[k] += w[k] * own
        else:
            lanes = S[L.RAY_COLOUR + c * L.LANES + at :]
            for k in range(P.TILE):
                st[k] += w[k] * max(lanes[k], f(0))


@inline
def _fill_background(tx, ty, down, wide_row, image):  # type: ignore[no-untyped-def]
    """Fill a tile that has no primitives with the background.

    The part of the tile inside the image has ``down`` rows of ``wide_row`` pixels, from pixel (tx, ty).
    """
    for y in range(down):
        Y = index(ty + y)
        for x in range(wide_row):
            X = index(tx + x)
            image.transmittance[Y, X], image.last[Y, X] = f(1), 0
            for c in range(image.background.shape[0]):
                image.rgb[Y, X, index(c)] = image.background[c]
            if image.with_depth:
                image.zsum[Y, X] = f(0)


@inline
def _store_tile(state, tx, ty, down, wide_row, image):  # type: ignore[no-untyped-def]
    """Write a tile's pixels, composited over the background, to the image; arguments as in :func:`_fill_background`."""
    rgb, transmittance, zsum, last, background, with_depth = image
    for y in range(down):
        Y, j = index(ty + y), y * P.TILE
        for x in range(wide_row):
            transmittance[Y, index(tx + x)] = state[index(j + x + L.T_)]
            last[Y, index(tx + x)] = np.int32(state[index(j + x + L.LAST)])
        for c in range(background.shape[0]):
            behind = background[c]
            for x in range(wide_row):
                rgb[Y, index(tx + x), index(c)] = (
                    state[index(j + x + L.COLOR + c * P.PIXELS)] + state[index(j + x + L.T_)] * behind
                )
        if with_depth:
            for x in range(wide_row):
                zsum[Y, index(tx + x)] = state[index(j + x + L.ZSUM)]


@kernel
def composite_tiles(start, stop, frame, colors, image, live, first_lane, net, edge):  # type: ignore[no-untyped-def]
    """Render tiles ``start:stop``; return the number of evaluated lanes, and an array with the lanes' optical depths.

    A lane is one pixel of a (tile, primitive) pair. If the frame has several images, ``live`` must be empty, because
    the backward pass supports only one image.

    Args:
        frame: :class:`~neuprim.core.render.cpu.tiles.FrameArrays`.
        colors: (N, C) colours, or the constants that colour networks add to.
        image: :class:`TileImage`, filled.
        live, first_lane: filled, see :class:`SavedForBackward`. If they are empty, the returned array is empty, too.
        net: :class:`~neuprim.core.render.cpu.colour_net.ColourNet`; None compiles a kernel without networks.
        edge: one of :data:`~neuprim.core.render.cpu.chord.EDGE_TYPES`.
    """
    frame, image, colors = borrow_arrays(frame), borrow_arrays(image), borrow_array(colors)
    live, first_lane = borrow_array(live), borrow_array(first_lane)
    rows, starts, ids, norms = frame.rows, frame.starts, frame.ids, frame.norms
    height, width = norms.shape
    with_depth, tmin = image.with_depth, frame.transmittance_min
    keep = live.shape[0] > 0
    across = (width + P.TILE - 1) // P.TILE
    tiles = across * ((height + P.TILE - 1) // P.TILE)  # of one image
    saved_depths = _depth_array(_max_lanes(start, stop, across, frame) if keep else 0)
    depths = borrow_array(saved_depths)
    C = colors.shape[1]
    scratch = L.FORWARD_SCRATCH
    if net is not None:
        scratch = L.BACKWARD_SCRATCH + 2 * C * L.LANES
        waves = aligned_tile_zeros(net.hidden * L.NET_SCRATCH).reshape((net.hidden, L.NET_SCRATCH))
    lanes, wide_lanes = aligned_tile_zeros(scratch + 1024), np.zeros(FLOAT64_SCRATCH, np.float64)
    pixels = aligned_tile_zeros((4 + C) * P.PIXELS + 2 * P.TILE)
    weights = aligned_tile_zeros(P.TILE)
    lives = aligned_tile_zeros(P.TILE)
    ends, begins = np.zeros(2 * P.TILE, np.int32), np.zeros(P.TILE, np.int32)
    S, D, state, w = borrow_array(lanes), borrow_array(wide_lanes), borrow_array(pixels), borrow_array(weights)
    bounds, offset, rows_live = borrow_array(ends), borrow_array(begins), borrow_array(lives)
    evaluated = 0
    for t in range(start, stop):
        tx, ty, above = (t % across) * P.TILE, (t % tiles // across) * P.TILE, t // tiles * height
        down, wide_row = min(P.TILE, height - ty), min(P.TILE, width - tx)
        if starts[t] == starts[t + 1]:
            _fill_background(tx, above + ty, down, wide_row, image)
            continue
        state[:] = f(0)
        for y in range(P.TILE):
            rows_live[y] = f(1) if y < down else f(0)
            for x in range(P.TILE):
                state[index(y * P.TILE + x + L.T_)] = f(-1)  # outside the image: never live
        for y in range(down):
            for x in range(wide_row):
                j = y * P.TILE + x
                state[index(j + L.T_)], state[index(j + L.NORM)] = f(1), norms[index(ty + y), index(tx + x)]
        for q in range(starts[t], starts[t + 1]):
            if q + 1 < starts[t + 1]:
                prefetch_pair(np.int64(ids[q + 1]), frame)
            i = ids[q]
            p = rows[i]
            pair = pair_window(frame, i, tx, ty)
            row_spans(frame.spans[i], pair, rows_live, bounds)
            n = compact_lanes(S, state, offset, bounds, pair.y0, pair.y1)
            if keep:
                live[q], first_lane[q] = _live_tile_row_bits(rows_live), evaluated
            if n > 0:
                n16 = ((n + 15) // 16) * 16
                chord_field_values(S, D, n16, frame, pair, with_depth, False, edge)
                _store_opacities(S, n16, frame, edge, keep, depths, evaluated)
                evaluated += n16
                if net is not None:
                    ray_colours(S, D, waves, n16, i, net, frame.slots, colors[i], False)
                rank = f(q - starts[t] + 1)
                for y in range(pair.y0, pair.y1):
                    a, b = bounds[y], bounds[y + P.TILE]
                    if b > a:
                        # the row's lanes start at offset[y], its pixels at a: shift both so that k indexes them
                        at, base = offset[y] - a, y * P.TILE
                        if C == 3 and not with_depth:
                            _composite_rgb_row(state, S, base, at, a, b, tmin, rank, colors[i], net)
                        else:
                            _composite_row(state, S, base, at, a, b, tmin, rank, w)
                            _add_colours(state, S, base, at, w, colors[i], net)
                            if with_depth:
                                st = state[L.ZSUM + base :]
                                for k in range(a, b):
                                    st[k] += w[k] * (p[P.ANCHOR_Z] + p[P.UNIT] * S[L.MID + at + k])
            if (q - starts[t]) % _LIVE_EVERY == _LIVE_EVERY - 1:
                any_live = f(0)
                for y in range(P.TILE):
                    if rows_live[y] > f(0):
                        top = f(-1)
                        for k in range(P.TILE):
                            top = max(top, state[L.T_ + y * P.TILE + k])
                        rows_live[y] = f(1) if top >= tmin else f(0)
                        any_live += rows_live[y]
                if any_live == f(0):
                    break
        _store_tile(state, tx, above + ty, down, wide_row, image)
    for own in (lanes, pixels, weights, lives):
        release_array(own)
    release_array(wide_lanes)
    for numbers in (ends, begins):
        release_array(numbers)
    return evaluated, saved_depths
