"""Tile-wise compositing, forward."""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import inline, kernel
from neuprim.core.compute.views import borrow_array, release_array
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.float64 import FLOAT64_SCRATCH
from neuprim.core.render.cpu.kept import alive, most_lanes, room
from neuprim.core.render.cpu.neurons import field_values
from neuprim.core.render.cpu.ray_colours import add_ray_colours, composite_rgb_ray_colours, ray_colours
from neuprim.core.render.cpu.tiles import aligned, compact, fetch_ahead, row_spans
from neuprim.core.render.cpu.trigonometry import one_minus_exp

__all__ = ["composite_tiles"]

f = np.float32
index = np.uint64  # an unsigned index cannot count from the end: LLVM vectorises without slicing first
_STEPS = np.arange(L.TILE).astype(np.float32)
_LIVE_EVERY = (
    4  # pairs between two counts of live pixels: a dead row costs a few lanes, a count costs a reduction per row
)


@inline
def _opacity(S, n, amin, amax, edge, keep, depths, at):  # type: ignore[no-untyped-def]
    """ALPHA of every lane: 0 below alpha_min and where the integral is not positive, at most alpha_max; its depth to
    ``depths[at + k]``."""
    for k in range(n):
        depth = S[L.FIELD + k] * S[L.HALF + k] * S[L.NORM_L + k] * f(2)
        if len(edge) > 0:
            depth *= S[L.FADE + k]
        if keep:
            depths[index(at + k)] = depth
        alpha = min(one_minus_exp(depth), amax)
        alpha = alpha if alpha >= amin else f(0)
        S[L.ALPHA + k] = alpha if depth > f(0) else f(0)


@inline
def _composite_rgb_row(state, S, base, at, a, b, tmin, rank, c0, c1, c2):  # type: ignore[no-untyped-def]
    """One pixel row of three channels: colour += alpha T c, then T; a pixel is live while T >= T_min."""
    a, b = f(a), f(b)
    for k in range(L.TILE):
        step, T = _STEPS[k], state[index(base + k + L.T_)]
        use = (step >= a) & (step < b) & (T >= tmin)
        alpha = S[index(at + k)] if use else f(0)
        weight = alpha * T
        state[index(base + k + L.T_)] = T - weight
        state[index(base + k + L.LAST)] = rank if alpha > f(0) else state[index(base + k + L.LAST)]
        state[index(base + k + L.COLOR)] += weight * c0
        state[index(base + k + L.COLOR + L.PIXELS)] += weight * c1
        state[index(base + k + L.COLOR + 2 * L.PIXELS)] += weight * c2


@inline
def _composite_row(st, lanes, w, a, b, tmin, rank):  # type: ignore[no-untyped-def]
    """The same for any channels and depth: leaves the weights in ``w``."""
    a, b = f(a), f(b)
    for k in range(L.TILE):
        step, T = _STEPS[k], st[k + L.T_]
        use = (step >= a) & (step < b) & (T >= tmin)
        alpha = lanes[k] if use else f(0)
        weight = alpha * T
        w[k] = weight
        st[k + L.T_] = T - weight
        st[k + L.LAST] = rank if alpha > f(0) else st[k + L.LAST]


@inline
def _empty_tile(tx, ty, down, wide_row, background, with_depth, rgb, transmittance, zsum, last):  # type: ignore[no-untyped-def]
    """A tile that nothing reaches: the background."""
    for y in range(down):
        Y = index(ty + y)
        for x in range(wide_row):
            X = index(tx + x)
            transmittance[Y, X], last[Y, X] = f(1), 0
            for c in range(background.shape[0]):
                rgb[Y, X, index(c)] = background[c]
            if with_depth:
                zsum[Y, X] = f(0)


@kernel
def composite_tiles(  # type: ignore[no-untyped-def]
    start, stop, rows, wide, slots, spans, kinds, boxes, starts, ids, colors, norms, background, limits, with_depth, neurons,
    rgb, transmittance, zsum, last, live, found, net, edge,
):  # fmt: skip
    """Draw tiles ``start:stop``; returns the number of evaluated lanes, and their optical depths if ``live`` and
    ``found`` have room for them.

    limits = (alpha_min, alpha_max, transmittance_min, depth_floor), all float32. ``norms`` (H, W) is the length of the
    pixel's ray direction whose camera-z is 1. Where ``slots[i]`` is not -1, primitive i is drawn in float64 from that
    row of
    ``wide``. ``last`` receives the rank + 1 of each pixel's last contributor. ``net`` is None where ``colors`` is all
    there is to a colour, which leaves no trace of it in the compiled kernel, or the
    :class:`~neuprim.core.render.cpu.colour_net.Net` on that base.
    """
    rows, wide, slots, spans, kinds, boxes = (
        borrow_array(rows),
        borrow_array(wide),
        borrow_array(slots),
        borrow_array(spans),
        borrow_array(kinds),
        borrow_array(boxes),
    )
    starts, ids, colors, live, found = (
        borrow_array(starts),
        borrow_array(ids),
        borrow_array(colors),
        borrow_array(live),
        borrow_array(found),
    )
    height, width = norms.shape
    keep = live.shape[0] > 0
    across = (width + L.TILE - 1) // L.TILE
    found_depths = room(most_lanes(start, stop, across, boxes, starts, ids) if keep else 0)
    depths = borrow_array(found_depths)
    C = colors.shape[1]
    amin, amax, tmin, floor = limits[0], limits[1], limits[2], limits[3]
    scratch = L.FORWARD_SCRATCH
    if net is not None:
        scratch = L.BACKWARD_SCRATCH + 2 * C * L.LANES
        waves = aligned(net.hidden * L.NET_SCRATCH).reshape((net.hidden, L.NET_SCRATCH))
    lanes, wide_lanes, pixels, weights = (
        aligned(scratch + 1024),
        np.zeros(FLOAT64_SCRATCH, np.float64),
        aligned((4 + C) * L.PIXELS + 2 * L.TILE),
        aligned(L.TILE),
    )
    ends, begins, lives = np.zeros(2 * L.TILE, np.int32), np.zeros(L.TILE, np.int32), aligned(L.TILE)
    S, D, state, w = borrow_array(lanes), borrow_array(wide_lanes), borrow_array(pixels), borrow_array(weights)
    bounds, offset, rows_live = borrow_array(ends), borrow_array(begins), borrow_array(lives)
    evaluated = 0
    for t in range(start, stop):
        tx, ty = (t % across) * L.TILE, (t // across) * L.TILE
        down, wide_row = min(L.TILE, height - ty), min(L.TILE, width - tx)
        if starts[t] == starts[t + 1]:
            _empty_tile(tx, ty, down, wide_row, background, with_depth, rgb, transmittance, zsum, last)
            continue
        state[:] = f(0)
        for y in range(L.TILE):
            rows_live[y] = f(1) if y < down else f(0)
            for x in range(L.TILE):
                state[index(y * L.TILE + x + L.T_)] = f(-1)  # outside the image: never live
        for y in range(down):
            for x in range(wide_row):
                j = y * L.TILE + x
                state[index(j + L.T_)], state[index(j + L.NORM)] = f(1), norms[index(ty + y), index(tx + x)]
        for q in range(starts[t], starts[t + 1]):
            if q + 1 < starts[t + 1]:
                fetch_ahead(np.int64(ids[q + 1]), rows, spans, boxes)
            i = ids[q]
            p = rows[i]
            y0, y1 = max(boxes[i, 1] - ty, 0), min(boxes[i, 3] - ty, L.TILE)
            x0, x1 = max(boxes[i, 0] - tx, 0), min(boxes[i, 2] - tx, L.TILE)
            fx0, fy0 = f(tx) + f(0.5) - p[L.UX], f(ty) + f(0.5) - p[L.UY]
            row_spans(spans[i], fx0, fy0, y0, y1, x0, x1, rows_live, bounds)
            n = compact(S, state, offset, bounds, y0, y1)
            if keep:
                live[q], found[q] = alive(rows_live), evaluated
            if n > 0:
                n16 = ((n + 15) // 16) * 16
                field_values(
                    S,
                    D,
                    n16,
                    bounds,
                    y0,
                    y1,
                    tx,
                    ty,
                    fx0,
                    fy0,
                    i,
                    rows,
                    wide,
                    slots,
                    kinds,
                    neurons,
                    floor,
                    with_depth,
                    False,
                    edge,
                )
                _opacity(S, n16, amin, amax, edge, keep, depths, evaluated)
                evaluated += n16
                if net is not None:
                    ray_colours(S, D, waves, n16, i, net, slots, colors[i], False)
                rank = f(q - starts[t] + 1)
                for y in range(y0, y1):
                    a, b = bounds[y], bounds[y + L.TILE]
                    if b > a:
                        at = (
                            offset[y] - a
                        )  # the row's lanes start at offset[y], its pixels at a: shift so that both run with k
                        if C == 3 and not with_depth:
                            if net is None:
                                _composite_rgb_row(
                                    state,
                                    S,
                                    y * L.TILE,
                                    L.ALPHA + at,
                                    a,
                                    b,
                                    tmin,
                                    rank,
                                    colors[i, 0],
                                    colors[i, 1],
                                    colors[i, 2],
                                )
                            else:
                                composite_rgb_ray_colours(state, S, y * L.TILE, at, a, b, tmin, rank)
                        else:
                            _composite_row(state[y * L.TILE :], S[L.ALPHA + at :], w, a, b, tmin, rank)
                            if net is None:
                                for c in range(C):
                                    st, color = state[L.COLOR + c * L.PIXELS + y * L.TILE :], colors[i, c]
                                    for k in range(L.TILE):
                                        st[k] += w[k] * color
                            else:
                                add_ray_colours(state, S, y * L.TILE, at, w, C)
                            if with_depth:
                                st = state[L.ZSUM + y * L.TILE :]
                                for k in range(a, b):
                                    st[k] += w[k] * (p[L.ANCHOR_Z] + p[L.UNIT] * S[L.MID + at + k])
            if (q - starts[t]) % _LIVE_EVERY == _LIVE_EVERY - 1:
                any_live = f(0)
                for y in range(L.TILE):
                    if rows_live[y] > f(0):
                        top = f(-1)
                        for k in range(L.TILE):
                            top = max(top, state[L.T_ + y * L.TILE + k])
                        rows_live[y] = f(1) if top >= tmin else f(0)
                        any_live += rows_live[y]
                if any_live == f(0):
                    break
        for y in range(down):
            Y, j = index(ty + y), y * L.TILE
            for x in range(wide_row):
                transmittance[Y, index(tx + x)] = state[index(j + x + L.T_)]
                last[Y, index(tx + x)] = np.int32(state[index(j + x + L.LAST)])
            for c in range(C):
                behind = background[c]
                for x in range(wide_row):
                    rgb[Y, index(tx + x), index(c)] = (
                        state[index(j + x + L.COLOR + c * L.PIXELS)] + state[index(j + x + L.T_)] * behind
                    )
            if with_depth:
                for x in range(wide_row):
                    zsum[Y, index(tx + x)] = state[index(j + x + L.ZSUM)]
    for mine in (lanes, pixels, weights, lives):
        release_array(mine)
    release_array(wide_lanes)
    for numbers in (ends, begins):
        release_array(numbers)
    return evaluated, found_depths
