"""Tile-wise compositing, backward: back to front, transmittance recovered by T/(1 - alpha).

The optical depths of the lanes are the forward pass's (:mod:`~neuprim.core.render.cpu.kept`), so that what reaches a
lane is known before its neurons are evaluated. Each (tile, primitive) pair writes one gradient row; the rows of a
primitive are then added in a fixed order, so the result is bit-identical for any number of threads.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import exact_kernel, inline, kernel
from neuprim.core.compute.views import borrow_array, compress16, copy16, release_array
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.float64 import FLOAT64_SCRATCH
from neuprim.core.render.cpu.gradients import (
    AT_ONCE,
    chord_gradient,
    gradients_at_once,
    lanes_with_slopes,
    neuron_gradients,
)
from neuprim.core.render.cpu.ray_colours import (
    ray_colour_gradient,
    ray_colour_gradient_row,
    ray_colours,
    uncomposite_rgb_ray_colours,
    weigh_ray_colours,
)
from neuprim.core.render.cpu.tiles import aligned, chords, compact, fetch_ahead, lanes_ahead, row_spans
from neuprim.core.render.cpu.trigonometry import one_minus_exp

__all__ = ["backward_tiles", "opacity", "optical_depths", "sum_rows"]

f = np.float32
index = np.uint64  # an unsigned index cannot count from the end: LLVM vectorises without slicing first
_STEPS = np.arange(L.TILE).astype(np.float32)


@inline
def optical_depths(S, n, edge):  # type: ignore[no-untyped-def]
    """DEPTH of every lane, as the forward pass computes it."""
    for k in range(n):
        depth = S[L.FIELD + k] * S[L.HALF + k] * S[L.NORM_L + k] * f(2)
        if len(edge) > 0:
            depth *= S[L.FADE + k]
        S[L.DEPTH + k] = depth


@inline
def opacity(S, n, amin, amax):  # type: ignore[no-untyped-def]
    """ALPHA, 1/(1 - alpha) and d alpha/d(2 FIELD HALF FADE) of every lane from its DEPTH, with exactly the forward
    pass's clamp and cut."""
    for k in range(n):
        norm, depth = S[L.NORM_L + k], S[L.DEPTH + k]
        raw = one_minus_exp(depth)
        alpha = min(raw, amax)
        alpha = alpha if alpha >= amin else f(0)
        alpha = alpha if depth > f(0) else f(0)
        slope = (f(1) - raw) * norm
        slope = slope if raw < amax else f(0)
        S[L.ALPHA + k], S[L.OVER + k] = alpha, f(1) / (f(1) - alpha)
        S[L.SLOPE + k] = slope if alpha > f(0) else f(0)


@inline
def _uncomposite_row(st, lanes, cg, w, a, b, rank):  # type: ignore[no-untyped-def]
    """One pixel row: recover T before this primitive; weights and dL/d(2 FIELD HALF).

    ``cg`` holds sum_c color_c dL/drgb_c (+ z dL/dz). ``lanes`` starts at ALPHA of the row's first pixel.
    """
    a, b = f(a), f(b)
    for k in range(L.TILE):
        step, alpha = _STEPS[k], lanes[k]
        inside = (step >= a) & (step < b)
        use = inside & (alpha > f(0)) & (st[k + L.LAST] >= rank)
        alpha = alpha if use else f(0)
        over = lanes[k + L.OVER - L.ALPHA] if use else f(1)
        behind = st[k + L.BEHIND]
        before = st[k + L.T_] * over
        weight = alpha * before
        g = (before * cg[k] - behind * over) * lanes[k + L.SLOPE - L.ALPHA]
        w[k] = weight
        st[k + L.BEHIND] = behind + weight * cg[k]
        st[k + L.T_] = before
        g = g if use else f(0)
        lanes[k + L.GRAD - L.ALPHA] = g if inside else lanes[k + L.GRAD - L.ALPHA]


@inline
def _uncomposite_rgb_row(state, S, base, at, sums, a, b, rank, c0, c1, c2):  # type: ignore[no-untyped-def]
    """:func:`_uncomposite_row` and the tallies of three channels in one pass; ``sums`` are 16 wide and reduced once per
    pair."""
    a, b = f(a), f(b)
    for k in range(L.TILE):
        step, alpha = _STEPS[k], S[index(at + k + L.ALPHA)]
        inside = (step >= a) & (step < b)
        use = inside & (alpha > f(0)) & (state[index(base + k + L.LAST)] >= rank)
        alpha = alpha if use else f(0)
        over = S[index(at + k + L.OVER)] if use else f(1)
        g0, g1, g2 = (
            state[index(base + k + L.G_COLOR)],
            state[index(base + k + L.G_COLOR + L.PIXELS)],
            state[index(base + k + L.G_COLOR + 2 * L.PIXELS)],
        )
        cg = g0 * c0 + g1 * c1 + g2 * c2
        behind = state[index(base + k + L.BEHIND)]
        before = state[index(base + k + L.T_)] * over
        weight = alpha * before
        g = (before * cg - behind * over) * S[index(at + k + L.SLOPE)]
        state[index(base + k + L.BEHIND)] = behind + weight * cg
        state[index(base + k + L.T_)] = before
        g = g if use else f(0)
        S[index(at + k + L.GRAD)] = g if inside else S[index(at + k + L.GRAD)]
        sums[k] += weight
        sums[k + L.TILE] += weight * state[index(base + k + L.ERR)]
        sums[k + 2 * L.TILE] += weight * g0
        sums[k + 3 * L.TILE] += weight * g1
        sums[k + 4 * L.TILE] += weight * g2


@inline
def _tally(st, w, sums):  # type: ignore[no-untyped-def]
    """Add w and w x error of one row to the 16-wide sums."""
    for k in range(L.TILE):
        sums[k] += w[k]
        sums[k + L.TILE] += w[k] * st[k + L.ERR]


@inline
def _lanes_that_count(S, n, with_depths):  # type: ignore[no-untyped-def]
    """Move the lanes with a gradient together, and zeros behind them; returns their number. ``with_depths``: DEPTH and
    NORM_L, too.

    Many have none: rays below the cut, and those of pixels that are opaque before they get here.
    """
    kept = 0
    for k in range(0, n, L.TILE):
        if with_depths:
            compress16(S, L.DEPTH + kept, L.DEPTH + k, L.GRAD + k)
            compress16(S, L.NORM_L + kept, L.NORM_L + k, L.GRAD + k)
        compress16(S, L.PIXEL + kept, L.PIXEL + k, L.GRAD + k)
        kept += compress16(S, L.GRAD + kept, L.GRAD + k, L.GRAD + k)
    for k in range(L.TILE):
        S[index(L.PIXEL + kept + k)], S[index(L.GRAD + kept + k)] = f(0), f(0)
        if with_depths:
            S[index(L.DEPTH + kept + k)], S[index(L.NORM_L + kept + k)] = f(0), f(0)
    return kept


@inline
def _total(sums, first):  # type: ignore[no-untyped-def]
    total = f(0)
    for k in range(L.TILE):
        total += sums[first + k]
    return total


@kernel
def backward_tiles(  # type: ignore[no-untyped-def]
    start, stop, depths, rows, wide, slots, spans, kinds, boxes, starts, ids, colors, norms, limits, with_depth, neurons,
    transmittance, last, g_rgb, g_transmittance, g_z, error, pair_rows, live, found, net, edge,
):  # fmt: skip
    """Gradient rows of every pair of tiles ``start:stop``. ``g_transmittance`` already holds the background's share.

    ``depths``, ``live``, ``found``: what the forward pass kept of these tiles (:mod:`~neuprim.core.render.cpu.kept`).
    ``net``: as for :func:`~neuprim.core.render.cpu.forward.composite_tiles`.
    """
    depths, rows, wide, slots, spans, kinds = (
        borrow_array(depths),
        borrow_array(rows),
        borrow_array(wide),
        borrow_array(slots),
        borrow_array(spans),
        borrow_array(kinds),
    )
    boxes, starts, ids, colors, pair_rows = (
        borrow_array(boxes),
        borrow_array(starts),
        borrow_array(ids),
        borrow_array(colors),
        borrow_array(pair_rows),
    )
    live, found = borrow_array(live), borrow_array(found)
    height, width = norms.shape
    across = (width + L.TILE - 1) // L.TILE
    C = colors.shape[1]
    color_at = L.G_NEURONS + L.PER_NEURON * neurons
    amin, amax, floor = limits[0], limits[1], limits[3]
    scratch = L.BACKWARD_SCRATCH
    if net is not None:
        scratch = L.BACKWARD_SCRATCH + 2 * C * L.LANES
        waves = aligned(net.hidden * L.NET_SCRATCH).reshape((net.hidden, L.NET_SCRATCH))
    lanes, wide_lanes, slopes = (
        aligned(scratch + 1024),
        np.zeros(FLOAT64_SCRATCH, np.float64),
        aligned(neurons * L.NEURON_SCRATCH),
    )
    pixels, weights, rays, totals = (
        aligned((6 + C) * L.PIXELS + 2 * L.TILE),
        aligned(L.TILE),
        aligned(L.TILE),
        aligned((2 + C) * L.TILE),
    )
    ends, begins, lives = np.zeros(2 * L.TILE, np.int32), np.zeros(L.TILE, np.int32), aligned(L.TILE)
    S, D, V = borrow_array(lanes), borrow_array(wide_lanes), borrow_array(slopes).reshape((neurons, L.NEURON_SCRATCH))
    state, w, cg, sums = borrow_array(pixels), borrow_array(weights), borrow_array(rays), borrow_array(totals)
    bounds, offset, rows_live = borrow_array(ends), borrow_array(begins), borrow_array(lives)
    evaluated = 0
    for t in range(start, stop):
        if starts[t] == starts[t + 1]:
            continue
        tx, ty = (t % across) * L.TILE, (t // across) * L.TILE
        state[:] = f(0)
        deepest = 0
        down, wide_row = min(L.TILE, height - ty), min(L.TILE, width - tx)
        for j in range(L.PIXELS):
            state[index(j + L.T_)] = f(1)
        for y in range(down):
            Y, j = index(ty + y), y * L.TILE
            for x in range(wide_row):
                X, T = index(tx + x), transmittance[Y, index(tx + x)]
                state[index(j + x + L.T_)], state[index(j + x + L.NORM)] = T, norms[Y, X]
                state[index(j + x + L.BEHIND)] = T * g_transmittance[Y, X]
                state[index(j + x + L.LAST)], state[index(j + x + L.ERR)] = f(last[Y, X]), error[Y, X]
                deepest = max(deepest, last[Y, X])
            if with_depth:
                for x in range(wide_row):
                    state[index(j + x + L.GZ)] = g_z[Y, index(tx + x)]
            for c in range(C):
                for x in range(wide_row):
                    state[index(j + x + L.G_COLOR + c * L.PIXELS)] = g_rgb[Y, index(tx + x), index(c)]
        first = starts[t]
        for q in range(first + deepest, starts[t + 1]):
            pair_rows[q, :] = f(0)
        for back in range(deepest):
            q = first + deepest - 1 - back
            if back + 1 < deepest:
                fetch_ahead(np.int64(ids[q - 1]), rows, spans, boxes)
                lanes_ahead(depths, np.int64(found[q - 1]), np.int64(found[q]))
            i = ids[q]
            p, out = rows[i], pair_rows[q]
            rank = f(q - first + 1)
            y0, y1 = max(boxes[i, 1] - ty, 0), min(boxes[i, 3] - ty, L.TILE)
            x0, x1 = max(boxes[i, 0] - tx, 0), min(boxes[i, 2] - tx, L.TILE)
            fx0, fy0 = f(tx) + f(0.5) - p[L.UX], f(ty) + f(0.5) - p[L.UY]
            alive = np.int32(live[q])
            for y in range(L.TILE):
                rows_live[y] = f((alive >> y) & 1)
            row_spans(spans[i], fx0, fy0, y0, y1, x0, x1, rows_live, bounds)
            n = compact(S, state, offset, bounds, y0, y1)
            out[:] = f(0)
            if n == 0:
                continue
            n16 = ((n + 15) // 16) * 16
            for k in range(0, n16, L.TILE):
                copy16(S, L.DEPTH + k, depths, found[q] + k)
            # where nothing but the gradients asks for chords, they are those of the lanes that have a gradient
            later = slots[i] < 0 and net is None and not with_depth
            if not later:
                evaluated += n16
                lanes_with_slopes(
                    S, D, V, n16, bounds, y0, y1, tx, ty, fx0, fy0, i, rows, wide, slots, neurons, floor, edge
                )
            opacity(S, n16, amin, amax)
            for k in range(n, n16):
                S[L.GRAD + k] = f(0)
            if net is not None:
                ray_colours(S, D, waves, n16, i, net, slots, colors[i], True)
                for c in range(C, 2 * C):
                    for k in range(n, n16):
                        S[L.RAY_COLOUR + c * L.LANES + k] = f(0)
            if not later:
                for k in range(n16):
                    S[L.GMID + k] = f(0)
            sums[:] = f(0)
            for y in range(y0, y1):
                a, b = bounds[y], bounds[y + L.TILE]
                if b > a:
                    at = offset[y] - a
                    if C == 3 and not with_depth:
                        if net is None:
                            _uncomposite_rgb_row(
                                state, S, y * L.TILE, at, sums, a, b, rank, colors[i, 0], colors[i, 1], colors[i, 2]
                            )
                        else:
                            uncomposite_rgb_ray_colours(state, S, y * L.TILE, at, sums, a, b, rank)
                        continue
                    cg[:] = f(0)
                    if net is None:
                        for c in range(C):
                            st, color = state[L.G_COLOR + c * L.PIXELS + y * L.TILE :], colors[i, c]
                            for k in range(L.TILE):
                                cg[k] += color * st[k]
                    else:
                        weigh_ray_colours(state, S, y * L.TILE, at, cg, C)
                    if with_depth:
                        st = state[L.GZ + y * L.TILE :]
                        for k in range(a, b):
                            cg[k] += st[k] * (p[L.ANCHOR_Z] + p[L.UNIT] * (S[L.MID + at + k] + S[L.SLIDE + at + k]))
                    _uncomposite_row(state[y * L.TILE :], S[L.ALPHA + at :], cg, w, a, b, rank)
                    _tally(state[y * L.TILE :], w, sums)
                    if net is None:
                        for c in range(C):
                            st = state[L.G_COLOR + c * L.PIXELS + y * L.TILE :]
                            for k in range(L.TILE):
                                sums[(2 + c) * L.TILE + k] += w[k] * st[k]
                    else:
                        ray_colour_gradient_row(state, S, y * L.TILE, at, w, a, b, C)
                    if with_depth:
                        st = state[L.GZ + y * L.TILE :]
                        for k in range(a, b):
                            S[L.GMID + at + k] = w[k] * st[k] * p[L.UNIT]
            weight = _total(sums, 0)
            if weight == f(0):
                continue  # hidden or below the cut everywhere: every gradient is zero
            out[L.G_WEIGHT], out[L.G_ERROR] = weight, _total(sums, L.TILE)
            if net is None:
                for c in range(C):
                    out[color_at + c] = _total(sums, (2 + c) * L.TILE)
            if later:
                n16 = ((_lanes_that_count(S, n16, neurons > AT_ONCE) + 15) // 16) * 16
                evaluated += n16
            if later and neurons <= AT_ONCE:
                gradients_at_once(S, n16, p, kinds[i], fx0, fy0, floor, neurons, edge, out)
                continue
            if later:
                chords(S, n16, p, fx0, fy0, floor, False, True, edge)
                for k in range(n16):
                    S[L.GMID + k] = f(0)
            neuron_gradients(S, V, n16, p, kinds[i], neurons, edge, slots[i] >= 0, out)
            if net is not None:
                ray_colour_gradient(S, waves, n16, i, net, C, out, color_at)
            chord_gradient(S, n16, p, out, edge, slots[i] >= 0)
    for mine in (lanes, slopes, pixels, weights, rays, totals, lives):
        release_array(mine)
    release_array(wide_lanes)
    for numbers in (ends, begins):
        release_array(numbers)
    return evaluated


@exact_kernel
def sum_rows(start, stop, first, slots, pair_rows, grads, touched):  # type: ignore[no-untyped-def]
    """grads[i] = sum of primitive i's pair rows, in pair order, for primitives ``start:stop``."""
    for i in range(start, stop):
        g = grads[i]
        g[:] = np.float32(0)
        for k in range(first[i], first[i + 1]):
            row = pair_rows[slots[k]]
            if row[L.G_WEIGHT] > np.float32(0):
                for c in range(g.shape[0]):
                    g[c] += row[c]
        touched[i] = g[L.G_WEIGHT] > np.float32(0)
