"""Building blocks shared by the forward and the backward pass of one (tile, primitive) pair.

Per pair: solve the silhouette for each pixel row, gather only the pixels inside it into a compact list of lanes, run
chord and neurons over that list, scatter back row by row. Evaluated lanes then nearly equal true hits.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from neuprim.core.compute.kernels import inline
from neuprim.core.compute.views import copy16
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.chord import by_depth, chord, ray, weight

__all__ = ["aligned", "chords", "compact", "fetch_ahead", "lanes_ahead", "row_spans"]

f = np.float32
index = np.uint64  # an unsigned index cannot count from the end: LLVM vectorises without slicing first
_STEPS = np.arange(L.TILE).astype(np.float32)
_NUMBERS = np.arange(L.PIXELS + L.TILE).astype(np.float32)  # of the tile's pixels, and a vector beyond
_MARGIN, _ROUNDING = f(2e-3), f(4e-7)  # pixels, and per pixel of the ellipse; a lane too many is rejected by its own D


@inline
def aligned(floats):  # type: ignore[no-untyped-def]
    """Zeros that begin a cache line: numba aligns to 32 bytes, and a vector of 64 that lies across two lines costs
    twice."""
    room = np.zeros(floats + 16, np.float32)
    shift = -(np.int64(room.ctypes.data) // 4) % 16
    return room[shift : shift + floats]


def _prefetch(context, address):  # type: ignore[no-untyped-def]
    """Ask memory for the cache line at an address. Nothing is read, so that no address is wrong."""

    def code(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        byte, i32 = ir.IntType(8).as_pointer(), ir.IntType(32)
        function = builder.module.declare_intrinsic(
            "llvm.prefetch", (byte,), ir.FunctionType(ir.VoidType(), [byte, i32, i32, i32])
        )
        builder.call(function, [builder.inttoptr(arguments[0], byte), i32(0), i32(3), i32(1)])  # to read, to stay, data
        return context.get_dummy_value()

    return types.void(types.intp), code


_ask: Any = intrinsic(_prefetch)


@inline
def fetch_ahead(i, rows, spans, boxes):  # type: ignore[no-untyped-def]
    """Ask memory for what the pair after this one, of primitive ``i``, reads first: tiles meet primitives in no order
    that it could guess."""
    row = rows.ctypes.data + i * rows.strides[0]
    for at in range(0, rows.strides[0], 64):
        _ask(row + at)
    _ask(spans.ctypes.data + i * spans.strides[0])
    _ask(boxes.ctypes.data + i * boxes.strides[0])


@inline
def lanes_ahead(depths, first, stop):  # type: ignore[no-untyped-def]
    """The same for the optical depths of a pair's lanes ``first:stop``."""
    for at in range(first, stop, 16):
        _ask(depths.ctypes.data + 4 * at)


@inline
def row_spans(span, fx0, fy0, y0, y1, x0, x1, rows_live, bounds):  # type: ignore[no-untyped-def]
    """Pixels [bounds[y], bounds[y + 16]) of each live tile row inside the silhouette, equal in the others and outside
    rows y0:y1.

    fx0, fy0: the tile corner's pixel centre from the anchor. All 16 rows at once: one vector.
    """
    skew, xc, yc, hx = span[L.SKEW], span[L.XC] - fx0, span[L.YC] - fy0, span[L.HX]
    ihy = f(1) / span[L.HY]
    low, high, top, bottom = f(x0), f(x1), f(y0), f(y1)
    for y in range(L.TILE):
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
        bounds[y + L.TILE] = np.int32(hi if inside else f(0))


@inline
def compact(S, state, offset, bounds, y0, y1):  # type: ignore[no-untyped-def]
    """Gather pixels and their ray norms into lanes; ``offset[y]`` is where row y starts. Returns the lane count.

    Every row copies a whole vector, without a branch that would be guessed wrong every other time; the next row, or the
    final padding, overwrites what stands over, so tail lanes always hold numbers of pixels of the tile.
    """
    n = 0
    for y in range(y0, y1):
        offset[y] = n
        a = bounds[y]
        j = y * L.TILE + a
        copy16(S, L.PIXEL + n, _NUMBERS, j)
        copy16(S, L.NORM_L + n, state, L.NORM + j)
        n += bounds[y + L.TILE] - a
    for k in range(L.TILE):
        S[index(L.PIXEL + n + k)] = f(y0 * L.TILE)
        S[index(L.NORM_L + n + k)] = f(0)
    return n


@inline
def chords(S, n, p, fx0, fy0, depth_floor, with_mid, backward, edge):  # type: ignore[no-untyped-def]
    """Chord middle Q, direction E and half length of n lanes (:func:`~chord.chord`); HALF = 0 where the ray misses.

    Where the edge is soft, no chord may be cut: such primitives are drawn in float64.
    """
    row, offset = ray(p), p[L.OFFSET]
    for k in range(n):
        du, dv, slide, ex, ey, ez, px, py, pz, D, ia, tm, h, uncut, mid, half = chord(S[L.PIXEL + k], fx0, fy0, row)
        # from the closest point, not from the ray's origin: the shift is zero unless the near plane cuts
        shift = mid - tm
        S[L.QX + k], S[L.QY + k], S[L.QZ + k] = px + shift * ex, py + shift * ey, pz + shift * ez
        S[L.EXL + k], S[L.EYL + k], S[L.EZL + k] = ex, ey, ez
        S[L.HALF + k] = half
        S[L.FIELD + k] = offset
        if len(edge) > 0:
            fade, by_d = weight(D, edge)
            S[L.FADE + k] = fade
            if backward:
                S[L.BY_D + k] = by_d
        if with_mid:
            S[L.MID + k] = mid + slide
        if backward:
            S[L.DU + k], S[L.DV + k] = du, dv
            S[L.MID + k], S[L.TM + k], S[L.IA + k], S[L.UNCUT + k] = mid, tm, ia, uncut
            S[L.HEIGHT + k], S[L.SLIDE + k] = h, slide
            S[L.DH + k] = by_depth(D, ia, depth_floor, edge)
