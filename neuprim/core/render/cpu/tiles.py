"""Tiles of 16 x 16 pixels: which primitives reach each tile, front to back, and which pixels each primitive covers.

The forward and the backward pass take the same steps for each (tile, primitive) pair. They find the pixels of each tile
row that are inside the silhouette, and gather these pixels into a compact list of lanes. Then they compute the chords
and neurons of all lanes, and write the results back row by row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from neuprim.core.compute.kernels import copy16, exact_kernel, inline
from neuprim.core.compute.threads import chunk_size, parallel_for
from neuprim.core.render import layout as P
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.chord import (
    chord_edge_fade,
    cos_turns,
    half_chord_slope,
    intersect_chord,
    load_ray,
    profiles_fast,
    profiles_medium,
    profiles_slow,
)
from neuprim.core.render.cpu.float64 import chords_float64, neurons_float64
from neuprim.core.render.cpu.prepare import Projected

f = np.float32
index = np.uint64  # an unsigned index is never negative (from the end), so that LLVM vectorises without slices
_STEPS = np.arange(P.TILE).astype(np.float32)
_NUMBERS = np.arange(P.PIXELS + P.TILE).astype(np.float32)  # of the tile's pixels, plus one vector
_MARGIN, _ROUNDING = f(2e-3), f(4e-7)  # of a span: pixels, and per pixel of the ellipse; D rejects superfluous lanes
Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class TileLists:
    """Pairs (tile, primitive) of a frame, sorted by tile, then by the depth of the primitive's centre.

    The pairs of primitive i have the indices ``slots[first[i] : first[i + 1]]``.
    """

    starts: NDArray[np.int64]  # (tiles + 1,) first pair of each tile
    ids: NDArray[np.int32]  # (pairs,) primitive of each pair
    first: NDArray[np.int64]  # (N + 1,) first entry of each primitive in slots
    slots: NDArray[np.int32]  # (pairs,) indices in ids of the pairs of primitive 0, then of primitive 1 and so on

    @property
    def pairs(self) -> int:
        return int(self.ids.shape[0])


def depth_order(depth: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the indices that sort primitives front to back by ``depth``; equal depths stay in index order.

    The function sorts unique integer keys with the bits of the depth above and the index below. This is many times
    faster than a stable float argsort. With 1 million primitives, depths that agree to about 2e-10 of their value count
    as equal.
    """
    count = depth.shape[0]
    bits = max(int(count - 1).bit_length(), 1)
    u = depth.view(np.int64)
    u = np.where(u < 0, ~u, u | np.int64(-(2**63))).view(np.uint64)  # monotone map of floats to unsigned integers
    key = (u >> np.uint64(bits)) << np.uint64(bits) | np.arange(count, dtype=np.uint64)
    key.sort()
    return (key & np.uint64((1 << bits) - 1)).astype(np.int64)


@exact_kernel
def _reached_tiles(start, stop, projected, across, first):  # type: ignore[no-untyped-def]
    """Return the tiles that the silhouettes of primitives ``start:stop`` reach, with a margin of 1e-3 pixels.

    The result holds int32 tile numbers, counted row by row with ``across`` tiles per row: first all tiles of primitive
    ``start``, then all tiles of the next primitive and so on. ``first[i + 1]`` gets the number of tiles of primitive i.
    """
    rows, spans, boxes, status = projected.rows, projected.spans, projected.boxes, projected.status
    tiles, n = np.empty(4096, np.int32), 0
    for i in range(start, stop):
        before = n
        if status[i] == P.VISIBLE:
            box = boxes[i]
            lo, hi = box[0] // P.TILE, (box[2] - 1) // P.TILE + 1
            hx, hy, skew = np.float64(spans[i, P.HX]), np.float64(spans[i, P.HY]), np.float64(spans[i, P.SKEW])
            ellipse = spans[i, P.HY] < P.UNBOUNDED
            over, base = 1.0 / hy, 0.5 - np.float64(rows[i, P.UY]) - spans[i, P.YC]
            middle = spans[i, P.XC] + np.float64(rows[i, P.UX])
            peak = skew * hy * hy / np.sqrt(hx * hx + skew * skew * hy * hy)  # where the ellipse is furthest right
            for ty in range(box[1] // P.TILE, (box[3] - 1) // P.TILE + 1):
                if ellipse:
                    d0 = max(max(ty * P.TILE, box[1]) + base, -hy)
                    d1 = min(min(ty * P.TILE + P.TILE, box[3]) - 1 + base, hy)
                    if d1 < d0:
                        continue
                    a, b = min(max(peak, d0), d1), min(max(-peak, d0), d1)
                    right = skew * a + hx * np.sqrt(max(1 - (a * over) ** 2, 0.0)) + middle
                    left = skew * b - hx * np.sqrt(max(1 - (b * over) ** 2, 0.0)) + middle
                    x0 = max(np.ceil(left - 0.501), np.float64(box[0]))
                    x1 = min(np.floor(right - 0.499), np.float64(box[2] - 1))
                    if x1 < x0:
                        continue
                    lo, hi = int(x0) // P.TILE, int(x1) // P.TILE + 1
                if n + hi - lo > tiles.shape[0]:
                    grown = np.empty(2 * (n + hi - lo), np.int32)
                    for k in range(n):  # numba compiles an assignment of slices much longer
                        grown[k] = tiles[k]
                    tiles = grown
                for tx in range(lo, hi):
                    tiles[n] = ty * across + tx
                    n += 1
        first[i + 1] = n - before
    return tiles[:n]


@exact_kernel
def _sort_pairs_by_tile(order, first, tiles, starts, ids, slots):  # type: ignore[no-untyped-def]
    """Sort (tile, primitive) pairs by tile; the primitives of each tile stay in the order of ``order``, front to back.

    This is a counting sort. Primitive i reaches the tiles ``tiles[first[i] : first[i + 1]]``.
    Fills ``starts`` (given as zeros), ``ids`` and ``slots`` of :class:`TileLists`.
    """
    for k in range(tiles.shape[0]):
        starts[tiles[k] + 1] += 1
    for t in range(starts.shape[0] - 1):
        starts[t + 1] += starts[t]
    fill = starts[:-1].copy()
    for r in range(order.shape[0]):
        i = order[r]
        for k in range(first[i], first[i + 1]):
            slot = fill[tiles[k]]
            fill[tiles[k]] = slot + 1
            ids[slot] = i
            slots[k] = slot


def bin_primitives(
    projected: Projected, width: int, height: int, threads: int, images: tuple[Array, int] | None = None
) -> TileLists:
    """Return the sorted (tile, primitive) pairs of a frame with images of ``width`` x ``height`` pixels.

    ``images`` holds each primitive's image index, (N,), and the number of images; None means one image. The tiles of
    several images are numbered image by image.
    """
    count = projected.depth.shape[0]
    across, down = -(-width // P.TILE), -(-height // P.TILE)
    first = np.zeros(count + 1, np.int64)
    parts = parallel_for(_reached_tiles, count, chunk_size(count, 512, threads), threads, projected, across, first)
    np.cumsum(first, out=first)
    tiles = np.concatenate(parts) if parts else np.empty(0, np.int32)
    starts = np.zeros((1 if images is None else images[1]) * across * down + 1, np.int64)
    if images is not None:
        tiles += np.repeat(images[0].astype(np.int32) * np.int32(across * down), np.diff(first))
    ids, slots = np.empty(len(tiles), np.int32), np.empty(len(tiles), np.int32)
    _sort_pairs_by_tile(depth_order(projected.depth), first, tiles, starts, ids, slots)
    return TileLists(starts, ids, first, slots)


class FrameArrays(NamedTuple):
    """The data of one frame that the pixel kernels read."""

    rows: Array  # (N, row_width) float32, one row per primitive (layout)
    wide: Array  # (M, row_width) float64 rows of the primitives that are drawn in float64
    slots: Array  # (N,) row of each primitive in wide, or -1
    # (N, SPAN_WIDTH) silhouettes and (N, 4) pixel boxes
    spans: Array
    boxes: Array
    kinds: Array  # (N, K/2) range of rates (SLOW, MEDIUM or FAST) of each pair of neurons
    # first pair of each tile, and primitive of each pair (TileLists)
    starts: Array
    ids: Array
    norms: Array  # (H, W) length of each pixel's ray direction whose camera-z is 1
    # values of the settings, float32
    alpha_min: Any
    alpha_max: Any
    transmittance_min: Any
    depth_floor: Any
    neurons: int  # K, padded to a whole number of pairs


class PairWindow(NamedTuple):
    """The pixels of one tile that lie in the pixel box of primitive ``i``: columns x0:x1 and rows y0:y1 of the tile.

    (tx, ty) is the tile's first pixel. (fx0, fy0) is the offset from the primitive's anchor, the pixel that usually
    shows the primitive's centre, to the centre of the tile's first pixel.
    """

    i: int
    tx: int
    ty: int
    x0: int
    x1: int
    y0: int
    y1: int
    fx0: float
    fy0: float


@inline
def pair_window(frame, i, tx, ty):  # type: ignore[no-untyped-def]
    """Return the :class:`PairWindow` of primitive ``i`` in the tile whose first pixel is (tx, ty)."""
    box, p = frame.boxes[i], frame.rows[i]
    return PairWindow(
        i, tx, ty, max(box[0] - tx, 0), min(box[2] - tx, P.TILE), max(box[1] - ty, 0), min(box[3] - ty, P.TILE),
        f(tx) + f(0.5) - p[P.UX], f(ty) + f(0.5) - p[P.UY],
    )  # fmt: skip


@inline
def box_pixels(frame, i, tx, ty):  # type: ignore[no-untyped-def]
    """Return how many pixels of a tile lie in the pixel box of primitive ``i``; (tx, ty) is the tile's first pixel."""
    box = frame.boxes[i]
    wide = min(box[2] - tx, P.TILE) - max(box[0] - tx, 0)
    high = min(box[3] - ty, P.TILE) - max(box[1] - ty, 0)
    return max(wide, 0) * max(high, 0)


@inline
def aligned_tile_zeros(floats):  # type: ignore[no-untyped-def]
    """Return a float32 array of zeros aligned to a cache line of 64 bytes.

    numba aligns arrays only to 32 bytes, and access to a vector that spans two cache lines costs twice.
    """
    room = np.zeros(floats + 16, np.float32)
    shift = -(np.int64(room.ctypes.data) // 4) % 16
    return room[shift : shift + floats]


def _emit_prefetch(context, address):  # type: ignore[no-untyped-def]
    """Define the intrinsic ``_prefetch(address)``, which prefetches the cache line at ``address``.

    The program reads no data, so any address is allowed.
    """

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        byte, i32 = ir.IntType(8).as_pointer(), ir.IntType(32)
        function = builder.module.declare_intrinsic(
            "llvm.prefetch", (byte,), ir.FunctionType(ir.VoidType(), [byte, i32, i32, i32])
        )
        builder.call(function, [builder.inttoptr(arguments[0], byte), i32(0), i32(3), i32(1)])  # read, keep, data
        return context.get_dummy_value()

    return types.void(types.intp), code


_prefetch: Any = intrinsic(_emit_prefetch)


@inline
def prefetch_pair(i, frame):  # type: ignore[no-untyped-def]
    """Prefetch the row, silhouette and pixel box of primitive ``i``, which the next (tile, primitive) pair reads."""
    rows, spans, boxes = frame.rows, frame.spans, frame.boxes
    row = rows.ctypes.data + i * rows.strides[0]
    for at in range(0, rows.strides[0], 64):
        _prefetch(row + at)
    _prefetch(spans.ctypes.data + i * spans.strides[0])
    _prefetch(boxes.ctypes.data + i * boxes.strides[0])


@inline
def prefetch_lane_depths(depths, first, stop):  # type: ignore[no-untyped-def]
    """Prefetch the optical depths of lanes (pixels) ``first:stop``."""
    for at in range(first, stop, 16):
        _prefetch(depths.ctypes.data + 4 * at)


@inline
def row_spans(span, pair, rows_live, bounds):  # type: ignore[no-untyped-def]
    """Find the pixels ``bounds[y]`` to ``bounds[y + 16]`` - 1 of each tile row y that are inside a silhouette.

    ``span`` is the primitive's silhouette (columns SKEW to HY), ``pair`` a :class:`PairWindow`. A row gets no pixels if
    its ``rows_live`` is 0, because then all its pixels are finished. Because of a margin for rounding, a few pixels may
    be outside the silhouette.
    """
    skew, xc, yc, hx = span[P.SKEW], span[P.XC] - pair.fx0, span[P.YC] - pair.fy0, span[P.HX]
    ihy = f(1) / span[P.HY]
    low, high, top, bottom = f(pair.x0), f(pair.x1), f(pair.y0), f(pair.y1)
    for y in range(P.TILE):
        row = _STEPS[y]
        dv = row - yc
        k = dv * ihy
        s = f(1) - k * k
        mid = xc + skew * dv
        half = hx * np.sqrt(max(s, f(0)))
        half += _MARGIN + _ROUNDING * (half + abs(mid))
        lo = max(np.ceil(mid - half), low)
        hi = min(np.floor(mid + half) + f(1), high)
        inside = (s > f(-1e-2)) & (row >= top) & (row < bottom) & (rows_live[y] > f(0)) & (hi > lo)
        bounds[y] = np.int32(lo if inside else f(0))
        bounds[y + P.TILE] = np.int32(hi if inside else f(0))


@inline
def compact_lanes(S, state, offset, bounds, y0, y1):  # type: ignore[no-untyped-def]
    """Gather the pixels inside a silhouette into lanes: fill PIXEL and NORM_L; return the number of lanes.

    ``bounds`` has the pixels of each tile row, from :func:`row_spans`. Row y of the tile starts at lane ``offset[y]``.
    NORM_L is the length of the pixel's ray direction whose camera-z is 1, from ``state``. After the last lane, 16
    padding lanes follow, with the first lane's pixel and a NORM_L of 0. Every row copies a whole vector of 16 pixels
    without a branch; the next row, or the padding, overwrites the excess.
    """
    n = 0
    for y in range(y0, y1):
        offset[y] = n
        a = bounds[y]
        j = y * P.TILE + a
        copy16(S, L.PIXEL + n, _NUMBERS, j)
        copy16(S, L.NORM_L + n, state, L.NORM + j)
        n += bounds[y + P.TILE] - a
    first = S[L.PIXEL] if n > 0 else f(0)
    for k in range(P.TILE):
        S[index(L.PIXEL + n + k)] = first
        S[index(L.NORM_L + n + k)] = f(0)
    return n


@inline
def lane_chords(S, n, frame, pair, with_mid, backward, edge):  # type: ignore[no-untyped-def]
    """Compute the chords (rays inside the primitive) of n lanes (pixels): middle Q, direction E, half length HALF.

    Q and E are in whitened space, where the primitive is the unit ball. HALF is 0 where the ray misses. FIELD is set to
    b2 and FADE to the mean edge weight. ``with_mid`` also fills MID, for the depth image. ``backward`` also fills the
    arrays that gradients need. The near plane must not cut a chord with a soft edge, because primitives with such
    chords are drawn in float64.
    """
    p, fx0, fy0, depth_floor = frame.rows[pair.i], pair.fx0, pair.fy0, frame.depth_floor
    row, offset = load_ray(p), p[P.OFFSET]
    for k in range(n):
        du, dv, slide, ex, ey, ez, px, py, pz, D, ia, tm, h, uncut, mid, half = intersect_chord(
            S[L.PIXEL + k], fx0, fy0, row
        )
        # from the closest point, not from the ray's origin: the shift is zero unless the near plane cuts
        shift = mid - tm
        S[L.QX + k], S[L.QY + k], S[L.QZ + k] = px + shift * ex, py + shift * ey, pz + shift * ez
        S[L.EXL + k], S[L.EYL + k], S[L.EZL + k] = ex, ey, ez
        S[L.HALF + k] = half
        S[L.FIELD + k] = offset
        if len(edge) > 0:
            fade, by_d = chord_edge_fade(D, edge)
            S[L.FADE + k] = fade
            if backward:
                S[L.BY_D + k] = by_d
        if with_mid:
            S[L.MID + k] = mid + slide
        if backward:
            S[L.DU + k], S[L.DV + k] = du, dv
            S[L.MID + k], S[L.TM + k], S[L.IA + k], S[L.UNCUT + k] = mid, tm, ia, uncut
            S[L.HEIGHT + k], S[L.SLIDE + k] = h, slide
            S[L.DH + k] = half_chord_slope(D, ia, depth_floor, edge)


def _neuron_values(profiles):  # type: ignore[no-untyped-def]
    """Return a function that adds the means of two neurons over each lane's chord to FIELD.

    The mean of a neuron is w2 cos(phase at the middle) B_p(2 pi v), v the change of the phase over half a chord in
    turns. ``profiles`` computes B_p, see :mod:`~neuprim.core.render.cpu.chord`, for both neurons. In the returned
    function, ``p`` is the primitive's row, and the first neuron begins at column ``o``.
    """

    @inline
    def add(S, n, p, o, edge):  # type: ignore[no-untyped-def]
        ax, ay, az, ab, aa = p[o + P.WX], p[o + P.WY], p[o + P.WZ], p[o + P.PHASE], p[o + P.AMPLITUDE]
        o2 = o + P.PER_NEURON
        bx, by, bz, bb, ba = p[o2 + P.WX], p[o2 + P.WY], p[o2 + P.WZ], p[o2 + P.PHASE], p[o2 + P.AMPLITUDE]
        for k in range(n):
            half = S[L.HALF + k]
            ex, ey, ez = S[L.EXL + k], S[L.EYL + k], S[L.EZL + k]
            qx, qy, qz = S[L.QX + k], S[L.QY + k], S[L.QZ + k]
            v = (ex * ax + ey * ay + ez * az) * half
            u = qx * ax + qy * ay + qz * az + ab
            r = u - np.rint(u)
            v1 = (ex * bx + ey * by + ez * bz) * half
            u1 = qx * bx + qy * by + qz * bz + bb
            r1 = u1 - np.rint(u1)
            b, b1 = profiles(edge, v, v1)
            S[L.FIELD + k] += cos_turns(r * r) * b * aa + cos_turns(r1 * r1) * b1 * ba

    return add


_values_slow = _neuron_values(profiles_slow)
_values_medium = _neuron_values(profiles_medium)
_values_fast = _neuron_values(profiles_fast)


@inline
def chord_field_values(S, D, n, frame, pair, with_mid, backward, edge):  # type: ignore[no-untyped-def]
    """Compute chords of ``n`` lanes (pixels) and FIELD, the mean of the density network over each chord.

    The mean is weighted by the edge weight (1 - |y|^2)^p, y the point in whitened space. If the primitive needs
    float64, ``D`` gets the float64 chords. For the other arguments see :func:`lane_chords`.
    """
    i = pair.i
    if frame.slots[i] >= 0:
        cut = chords_float64(S, D, n, frame, pair, with_mid, backward, edge)
        neurons_float64(S, D, None, n, frame.wide[frame.slots[i]], frame.neurons, cut, edge)
    else:
        p = frame.rows[i]
        lane_chords(S, n, frame, pair, with_mid, backward, edge)
        for m in range(0, frame.neurons, 2):
            o = P.NEURONS + P.PER_NEURON * m
            if frame.kinds[i, m // 2] == L.MEDIUM:
                _values_medium(S, n, p, o, edge)
            elif frame.kinds[i, m // 2] == L.SLOW:
                _values_slow(S, n, p, o, edge)
            else:
                _values_fast(S, n, p, o, edge)
