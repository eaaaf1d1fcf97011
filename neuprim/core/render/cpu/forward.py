"""Tile-wise compositing, forward."""

from __future__ import annotations

import numpy as np

from neuprim.core.render.cpu.compile import inline, kernel
from neuprim.core.render.cpu.layout import (
    AMPLITUDE,
    ANCHOR_Z,
    COLOR,
    EXL,
    EYL,
    EZL,
    FIELD,
    FORWARD_SCRATCH,
    HALF,
    LAST,
    LIVE,
    MID,
    NEURONS,
    NORM,
    PER_NEURON,
    PHASE,
    PIXELS,
    QX,
    QY,
    QZ,
    T_,
    TILE,
    UNIT,
    UX,
    UY,
    WX,
    WY,
    WZ,
    ZSUM,
)
from neuprim.core.render.cpu.tiles import chords, compact, row_spans
from neuprim.core.render.cpu.turns import cos_turns, one_minus_exp, sinc_turns

__all__ = ["composite_tiles"]

f = np.float32
_STEPS = np.arange(TILE).astype(np.float32)


@inline
def _neuron_simple(S, n, wx, wy, wz, phase, amplitude):  # type: ignore[no-untyped-def]
    """FIELD += w2 cos(phase at the middle) sinc(rate x half chord); the half-chord phase stays within half a turn."""
    for k in range(n):
        v = (S[EXL + k] * wx + S[EYL + k] * wy + S[EZL + k] * wz) * S[HALF + k]
        u = S[QX + k] * wx + S[QY + k] * wy + S[QZ + k] * wz + phase
        r = u - np.rint(u)
        S[FIELD + k] += cos_turns(r * r) * sinc_turns(v * v) * amplitude


@inline
def _neuron(S, n, wx, wy, wz, phase, amplitude):  # type: ignore[no-untyped-def]
    """The same for any rate: sinc(2 pi v) = sinc(2 pi r) r/v with r = v - rint(v), exactly reduced."""
    for k in range(n):
        v = (S[EXL + k] * wx + S[EYL + k] * wy + S[EZL + k] * wz) * S[HALF + k]
        u = S[QX + k] * wx + S[QY + k] * wy + S[QZ + k] * wz + phase
        r = u - np.rint(u)
        turns = np.rint(v)
        rv = v - turns
        ratio = rv / v
        ratio = f(1) if turns == f(0) else ratio
        S[FIELD + k] += cos_turns(r * r) * sinc_turns(rv * rv) * ratio * amplitude


@inline
def _composite_row(state, tau, w, base, at, a, b, amin, amax, tmin, rank):  # type: ignore[no-untyped-def]
    """One pixel row: opacity, weights w = alpha T, new transmittance; returns how many pixels are still live."""
    st, tr = state[base:], tau[at : at + TILE]
    a, b = f(a), f(b)
    live_count = f(0)
    for k in range(TILE):
        step = _STEPS[k]
        depth = tr[k] * st[k + NORM]
        alpha = min(one_minus_exp(depth), amax)
        T, live = st[k + T_], st[k + LIVE]
        use = (step >= a) & (step < b) & (alpha >= amin) & (depth > f(0)) & (live > f(0))
        after = T * (f(1) - alpha)
        w[k] = alpha * T if use else f(0)
        st[k + T_] = after if use else T
        st[k + LAST] = rank if use else st[k + LAST]
        live = f(0) if use & (after < tmin) else live
        st[k + LIVE] = live
        live_count += live
    return live_count


@kernel
def composite_tiles(  # type: ignore[no-untyped-def]
    start, stop, rows, spans, simple, boxes, starts, ids, colors, norms, background, limits, with_depth, neurons,
    rgb, transmittance, zsum, last,
):  # fmt: skip
    """Draw tiles ``start:stop``; returns the number of evaluated lanes.

    limits = (alpha_min, alpha_max, transmittance_min, depth_floor), all float32. ``norms`` (H, W) is the length of the
    pixel's ray direction whose camera-z is 1. ``last`` receives the rank + 1 of each pixel's last contributor.
    """
    height, width = norms.shape
    across = (width + TILE - 1) // TILE
    C = colors.shape[1]
    amin, amax, tmin, floor = limits[0], limits[1], limits[2], limits[3]
    S = np.zeros(FORWARD_SCRATCH + 1024, np.float32)
    state = np.zeros((5 + C) * PIXELS + TILE, np.float32)
    tau = np.zeros(PIXELS + 4 * TILE, np.float32)
    w = np.zeros(TILE, np.float32)
    left, right, offset = np.zeros(TILE, np.int32), np.zeros(TILE, np.int32), np.zeros(TILE, np.int32)
    rows_live = np.zeros(TILE, np.float32)
    lanes = 0
    for t in range(start, stop):
        tx, ty = (t % across) * TILE, (t // across) * TILE
        state[:] = f(0)
        for y in range(TILE):
            rows_live[y] = f(0)
            for x in range(TILE):
                j = y * TILE + x
                state[j + T_] = f(1)
                if tx + x < width and ty + y < height:
                    state[j + LIVE], state[j + NORM] = f(1), norms[ty + y, tx + x]
                    rows_live[y] += f(1)
        for q in range(starts[t], starts[t + 1]):
            i = ids[q]
            p = rows[i]
            y0, y1 = max(boxes[i, 1] - ty, 0), min(boxes[i, 3] - ty, TILE)
            x0, x1 = max(boxes[i, 0] - tx, 0), min(boxes[i, 2] - tx, TILE)
            fx0, fy0 = f(tx) + f(0.5) - p[UX], f(ty) + f(0.5) - p[UY]
            row_spans(spans[i], fx0, fy0, y0, y1, x0, x1, left, right)
            n = compact(S, offset, left, right, y0, y1, rows_live, fx0, fy0)
            if n == 0:
                continue
            n16 = ((n + 15) // 16) * 16
            lanes += n16
            chords(S, n16, p, floor, False)
            for m in range(neurons):
                o = NEURONS + PER_NEURON * m
                if simple[i, m]:
                    _neuron_simple(S, n16, p[o + WX], p[o + WY], p[o + WZ], p[o + PHASE], p[o + AMPLITUDE])
                else:
                    _neuron(S, n16, p[o + WX], p[o + WY], p[o + WZ], p[o + PHASE], p[o + AMPLITUDE])
            for k in range(n16):
                tau[TILE + k] = S[k + FIELD] * S[k + HALF] * f(2)
            rank = f(q - starts[t] + 1)
            any_live = f(0)
            for y in range(y0, y1):
                a, b = left[y], right[y]
                if b > a:
                    rows_live[y] = _composite_row(state, tau, w, y * TILE, TILE + offset[y] - a, a, b, amin, amax, tmin, rank)
                    for c in range(C):
                        st, color = state[COLOR + c * PIXELS + y * TILE :], colors[i, c]
                        for k in range(TILE):
                            st[k] += w[k] * color
                    if with_depth:
                        at = MID + offset[y] - a
                        st = state[ZSUM + y * TILE :]
                        for k in range(a, b):
                            st[k] += w[k] * (p[ANCHOR_Z] + p[UNIT] * S[at + k])
            for y in range(TILE):
                any_live += rows_live[y]
            if any_live == f(0):
                break
        for y in range(min(TILE, height - ty)):
            for x in range(min(TILE, width - tx)):
                j = y * TILE + x
                for c in range(C):
                    rgb[ty + y, tx + x, c] = state[j + COLOR + c * PIXELS] + state[j + T_] * background[c]
                transmittance[ty + y, tx + x] = state[j + T_]
                last[ty + y, tx + x] = np.int32(state[j + LAST])
                if with_depth:
                    zsum[ty + y, tx + x] = state[j + ZSUM]
    return lanes
