"""Backward pass for primitives sorted by the depth of their centres: visit the primitives of each tile back to front.

T is a pixel's transmittance. T in front of a primitive is T behind the primitive divided by (1 - alpha). A lane is one
pixel of a (tile, primitive) pair. The optical depths of the lanes come from the forward pass. Each pair writes one row
of gradients. The rows of a primitive are added in a fixed order, so that results do not depend on the number of
threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from neuprim.core.compute.kernels import (
    borrow_array,
    borrow_arrays,
    compress16,
    copy16,
    exact_kernel,
    inline,
    kernel,
    release_array,
)
from neuprim.core.render import layout as P
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.chord import one_minus_exp
from neuprim.core.render.cpu.colour_net import ray_colour_gradient, ray_colours
from neuprim.core.render.cpu.float64 import FLOAT64_SCRATCH
from neuprim.core.render.cpu.gradients import (
    AT_ONCE,
    chord_gradient,
    gradients_at_once,
    lanes_with_slopes,
    neuron_gradients,
)
from neuprim.core.render.cpu.tiles import (
    aligned_tile_zeros,
    compact_lanes,
    lane_chords,
    pair_window,
    prefetch_lane_depths,
    prefetch_pair,
    row_spans,
)

f = np.float32
index = np.uint64  # an unsigned index is never negative (from the end), so that LLVM vectorises without slices
_STEPS = np.arange(P.TILE).astype(np.float32)
_RGB_GRADIENT = L.RAY_COLOUR + 3 * L.LANES  # dL/d RAY_COLOUR of three channels, behind the C arrays of RAY_COLOUR
Array = np.ndarray[Any, Any]


class ImageGradient(NamedTuple):
    """Inputs of the backward kernels for one frame, and the rows of gradients that the kernels fill."""

    # results of the forward pass, see TileImage
    transmittance: Array
    last: Array
    # gradients of the loss by the image's colours, transmittance (including the part through the background) and zsum;
    # z is read only if with_depth
    rgb: Array
    g_transmittance: Array
    z: Array
    error: Array  # (H, W) error of each pixel for the contributions
    pair_rows: Array  # (pairs, gradient_width) filled
    with_depth: bool


@inline
def lane_optical_depths(S, n, edge):  # type: ignore[no-untyped-def]
    """Fill DEPTH, the optical depth of ``n`` lanes (pixels of one (tile, primitive) pair), as in the forward pass."""
    for k in range(n):
        depth = S[L.FIELD + k] * S[L.HALF + k] * S[L.NORM_L + k] * f(2)
        if len(edge) > 0:
            depth *= S[L.FADE + k]
        S[L.DEPTH + k] = depth


@inline
def lane_opacities(S, n, amin, amax):  # type: ignore[no-untyped-def]
    """Fill ALPHA, the opacity, OVER = 1/(1 - alpha) and SLOPE of ``n`` lanes (pixels) from DEPTH, the optical depth.

    SLOPE is d alpha/d(2 FIELD HALF FADE), the derivative by the density integral. An opacity below ``amin`` becomes 0,
    and an opacity above ``amax`` becomes ``amax``. In both cases, SLOPE is 0.
    """
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


# ---- One pixel row, as in the forward pass; lanes of other rows do not change.


@inline
def _uncomposite_rgb_row(state, S, base, at, sums, a, b, rank, color, net):  # type: ignore[no-untyped-def]
    """Undo the compositing of one primitive in a row of pixels, for three channels: recover transmittance T, fill GRAD.

    GRAD is the gradient by the density integral. The function adds weights alpha T, weights x error and colour
    gradients to ``sums``, 16 numbers for each. With a ``net`` (colour network), it fills dL/d RAY_COLOUR instead of
    adding colour gradients. For the other arguments see ``_composite_rgb_row`` in
    :mod:`~neuprim.core.render.cpu.forward`.
    """
    a, b = f(a), f(b)
    c0, c1, c2 = color[0], color[1], color[2]
    for k in range(P.TILE):
        step, alpha = _STEPS[k], S[index(at + k + L.ALPHA)]
        inside = (step >= a) & (step < b)
        use = inside & (alpha > f(0)) & (state[index(base + k + L.LAST)] >= rank)
        alpha = alpha if use else f(0)
        over = S[index(at + k + L.OVER)] if use else f(1)
        g0 = state[index(base + k + L.G_COLOR)]
        g1 = state[index(base + k + L.G_COLOR + P.PIXELS)]
        g2 = state[index(base + k + L.G_COLOR + 2 * P.PIXELS)]
        if net is None:
            cg = g0 * c0 + g1 * c1 + g2 * c2
        else:
            c0 = S[index(at + k + L.RAY_COLOUR)]
            c1 = S[index(at + k + L.RAY_COLOUR + L.LANES)]
            c2 = S[index(at + k + L.RAY_COLOUR + 2 * L.LANES)]
            cg = g0 * max(c0, f(0)) + g1 * max(c1, f(0)) + g2 * max(c2, f(0))
        behind = state[index(base + k + L.BEHIND)]
        before = state[index(base + k + L.T_)] * over
        weight = alpha * before
        g = (before * cg - behind * over) * S[index(at + k + L.SLOPE)]
        state[index(base + k + L.BEHIND)] = behind + weight * cg
        state[index(base + k + L.T_)] = before
        g = g if use else f(0)
        S[index(at + k + L.GRAD)] = g if inside else S[index(at + k + L.GRAD)]
        sums[k] += weight
        sums[k + P.TILE] += weight * state[index(base + k + L.ERR)]
        if net is None:
            sums[k + 2 * P.TILE] += weight * g0
            sums[k + 3 * P.TILE] += weight * g1
            sums[k + 4 * P.TILE] += weight * g2
        else:
            h0 = weight * g0 if c0 >= f(0) else f(0)
            h1 = weight * g1 if c1 >= f(0) else f(0)
            h2 = weight * g2 if c2 >= f(0) else f(0)
            to0, to1 = index(at + k + _RGB_GRADIENT), index(at + k + _RGB_GRADIENT + L.LANES)
            to2 = index(at + k + _RGB_GRADIENT + 2 * L.LANES)
            S[to0] = h0 if inside else S[to0]
            S[to1] = h1 if inside else S[to1]
            S[to2] = h2 if inside else S[to2]


@inline
def _weigh_colours(state, S, base, at, cg, color, net):  # type: ignore[no-untyped-def]
    """Add the sum over channels of colour times dL/d colour to ``cg`` of a pixel row, for any number of channels."""
    for c in range(color.shape[0]):
        st = state[L.G_COLOR + c * P.PIXELS + base :]
        if net is None:
            own = color[c]
            for k in range(P.TILE):
                cg[k] += own * st[k]
        else:
            lanes = S[L.RAY_COLOUR + c * L.LANES + at :]
            for k in range(P.TILE):
                cg[k] += max(lanes[k], f(0)) * st[k]


@inline
def _uncomposite_row(state, S, base, at, cg, w, a, b, rank):  # type: ignore[no-untyped-def]
    """Undo the compositing of one primitive in a row of pixels: recover transmittance T, fill weights ``w`` and GRAD.

    GRAD is the gradient by the density integral. This function supports any number of channels, and depth. ``cg`` is
    the sum over channels of colour times dL/d colour, plus z dL/dz if depth has a gradient.
    """
    a, b = f(a), f(b)
    st, lanes = state[base:], S[L.ALPHA + at :]
    for k in range(P.TILE):
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
def _add_row_sums(state, S, base, at, w, sums, a, b, C, net):  # type: ignore[no-untyped-def]
    """Add weights ``w``, w x error and colour gradients of one row of pixels to ``sums``; for any number of channels.

    ``sums`` has 16 numbers for the weights, for weights x error and for each channel. With a ``net`` (colour network),
    the function fills dL/d RAY_COLOUR instead of adding colour gradients.
    """
    st = state[base:]
    for k in range(P.TILE):
        sums[k] += w[k]
        sums[k + P.TILE] += w[k] * st[k + L.ERR]
    a, b = f(a), f(b)
    for c in range(C):
        g_color = state[L.G_COLOR + c * P.PIXELS + base :]
        if net is None:
            for k in range(P.TILE):
                sums[(2 + c) * P.TILE + k] += w[k] * g_color[k]
        else:
            colour, gradient = S[L.RAY_COLOUR + c * L.LANES + at :], S[L.RAY_COLOUR + (C + c) * L.LANES + at :]
            for k in range(P.TILE):
                g = w[k] * g_color[k] if colour[k] >= f(0) else f(0)
                gradient[k] = g if (_STEPS[k] >= a) & (_STEPS[k] < b) else gradient[k]


@inline
def _compact_lane_gradients(S, n, with_depths):  # type: ignore[no-untyped-def]
    """Move the lanes (pixels) with GRAD != 0 to the front, append zeros, and return the number of moved lanes.

    Later steps then skip the many lanes with GRAD = 0.
    """
    count = 0
    for k in range(0, n, P.TILE):
        if with_depths:
            compress16(S, L.DEPTH + count, L.DEPTH + k, L.GRAD + k)
            compress16(S, L.NORM_L + count, L.NORM_L + k, L.GRAD + k)
        compress16(S, L.PIXEL + count, L.PIXEL + k, L.GRAD + k)
        count += compress16(S, L.GRAD + count, L.GRAD + k, L.GRAD + k)
    for k in range(P.TILE):
        S[index(L.PIXEL + count + k)], S[index(L.GRAD + count + k)] = f(0), f(0)
        if with_depths:
            S[index(L.DEPTH + count + k)], S[index(L.NORM_L + count + k)] = f(0), f(0)
    return count


@inline
def _sum_row(sums, first):  # type: ignore[no-untyped-def]
    total = f(0)
    for k in range(P.TILE):
        total += sums[first + k]
    return total


@inline
def _load_tile_gradients(state, tx, ty, norms, image, C):  # type: ignore[no-untyped-def]
    """Load the data of a tile's pixels into ``state``; return the number of primitives to visit.

    The number is 1 + the rank (position in the tile's list, from 0) of the last primitive composited in any pixel.
    """
    transmittance, last, g_rgb, g_transmittance, g_z, error, _, with_depth = image
    height, width = norms.shape
    state[:] = f(0)
    deepest = 0
    down, wide_row = min(P.TILE, height - ty), min(P.TILE, width - tx)
    for j in range(P.PIXELS):
        state[index(j + L.T_)] = f(1)
    for y in range(down):
        Y, j = index(ty + y), y * P.TILE
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
                state[index(j + x + L.G_COLOR + c * P.PIXELS)] = g_rgb[Y, index(tx + x), index(c)]
    return deepest


@kernel
def backward_tiles(start, stop, frame, colors, image, live, first_lane, depths, net, edge):  # type: ignore[no-untyped-def]
    """Fill the gradient rows of all (tile, primitive) pairs of tiles ``start:stop``; return the number of lanes.

    ``image`` is an :class:`ImageGradient`. ``live``, ``first_lane`` and ``depths`` are fields of
    :class:`~neuprim.core.render.cpu.forward.SavedForBackward`, ``depths`` of this chunk. For the other arguments see
    :func:`~neuprim.core.render.cpu.forward.composite_tiles`.
    """
    frame, image, colors = borrow_arrays(frame), borrow_arrays(image), borrow_array(colors)
    live, first_lane, depths = borrow_array(live), borrow_array(first_lane), borrow_array(depths)
    rows, starts, ids, slots, neurons = frame.rows, frame.starts, frame.ids, frame.slots, frame.neurons
    pair_rows, with_depth = image.pair_rows, image.with_depth
    across = (frame.norms.shape[1] + P.TILE - 1) // P.TILE
    C = colors.shape[1]
    color_at = P.G_NEURONS + P.PER_NEURON * neurons
    scratch = L.BACKWARD_SCRATCH
    if net is not None:
        scratch = L.BACKWARD_SCRATCH + 2 * C * L.LANES
        waves = aligned_tile_zeros(net.hidden * L.NET_SCRATCH).reshape((net.hidden, L.NET_SCRATCH))
    lanes, wide_lanes = aligned_tile_zeros(scratch + 1024), np.zeros(FLOAT64_SCRATCH, np.float64)
    slopes, pixels = aligned_tile_zeros(neurons * L.NEURON_SCRATCH), aligned_tile_zeros((6 + C) * P.PIXELS + 2 * P.TILE)
    weights, rays, totals = aligned_tile_zeros(P.TILE), aligned_tile_zeros(P.TILE), aligned_tile_zeros((2 + C) * P.TILE)
    ends, begins, lives = np.zeros(2 * P.TILE, np.int32), np.zeros(P.TILE, np.int32), aligned_tile_zeros(P.TILE)
    S, D, V = borrow_array(lanes), borrow_array(wide_lanes), borrow_array(slopes).reshape((neurons, L.NEURON_SCRATCH))
    state, w, cg, sums = borrow_array(pixels), borrow_array(weights), borrow_array(rays), borrow_array(totals)
    bounds, offset, rows_live = borrow_array(ends), borrow_array(begins), borrow_array(lives)
    evaluated = 0
    for t in range(start, stop):
        if starts[t] == starts[t + 1]:
            continue
        tx, ty = (t % across) * P.TILE, (t // across) * P.TILE
        deepest = _load_tile_gradients(state, tx, ty, frame.norms, image, C)
        first = starts[t]
        for q in range(first + deepest, starts[t + 1]):
            pair_rows[q, :] = f(0)
        for back in range(deepest):
            q = first + deepest - 1 - back
            if back + 1 < deepest:
                prefetch_pair(np.int64(ids[q - 1]), frame)
                prefetch_lane_depths(depths, np.int64(first_lane[q - 1]), np.int64(first_lane[q]))
            i = ids[q]
            p, out = rows[i], pair_rows[q]
            rank = f(q - first + 1)
            pair = pair_window(frame, i, tx, ty)
            live_bits = np.int32(live[q])
            for y in range(P.TILE):
                rows_live[y] = f((live_bits >> y) & 1)
            row_spans(frame.spans[i], pair, rows_live, bounds)
            n = compact_lanes(S, state, offset, bounds, pair.y0, pair.y1)
            out[:] = f(0)
            if n == 0:
                continue
            n16 = ((n + 15) // 16) * 16
            for k in range(0, n16, P.TILE):
                copy16(S, L.DEPTH + k, depths, first_lane[q] + k)
            # if only the gradients need chords, compute them later, and only for lanes with a gradient
            later = slots[i] < 0 and net is None and not with_depth
            cut = False
            if not later:
                evaluated += n16
                cut = lanes_with_slopes(S, D, V, n16, frame, pair, edge)
            lane_opacities(S, n16, frame.alpha_min, frame.alpha_max)
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
            for y in range(pair.y0, pair.y1):
                a, b = bounds[y], bounds[y + P.TILE]
                if b > a:
                    at, base = offset[y] - a, y * P.TILE
                    if C == 3 and not with_depth:
                        _uncomposite_rgb_row(state, S, base, at, sums, a, b, rank, colors[i], net)
                        continue
                    cg[:] = f(0)
                    _weigh_colours(state, S, base, at, cg, colors[i], net)
                    if with_depth:
                        st = state[L.GZ + base :]
                        for k in range(a, b):
                            cg[k] += st[k] * (p[P.ANCHOR_Z] + p[P.UNIT] * (S[L.MID + at + k] + S[L.SLIDE + at + k]))
                    _uncomposite_row(state, S, base, at, cg, w, a, b, rank)
                    _add_row_sums(state, S, base, at, w, sums, a, b, C, net)
                    if with_depth:
                        st = state[L.GZ + base :]
                        for k in range(a, b):
                            S[L.GMID + at + k] = w[k] * st[k] * p[P.UNIT]
            weight = _sum_row(sums, 0)
            if weight == f(0):
                continue  # hidden or below the cut everywhere: every gradient is zero
            out[P.G_WEIGHT], out[P.G_ERROR] = weight, _sum_row(sums, P.TILE)
            if net is None:
                for c in range(C):
                    out[color_at + c] = _sum_row(sums, (2 + c) * P.TILE)
            if later:
                n16 = ((_compact_lane_gradients(S, n16, neurons > AT_ONCE) + 15) // 16) * 16
                evaluated += n16
            if later and neurons <= AT_ONCE:
                gradients_at_once(S, n16, frame, pair, edge, out)
                continue
            if later:
                lane_chords(S, n16, frame, pair, False, True, edge)
                for k in range(n16):
                    S[L.GMID + k] = f(0)
            neuron_gradients(S, V, n16, p, frame.kinds[i], neurons, edge, slots[i] >= 0, cut, out)
            if net is not None:
                ray_colour_gradient(S, waves, n16, i, net, C, out, color_at)
            chord_gradient(S, n16, p, out, edge, cut)
    for own in (lanes, slopes, pixels, weights, rays, totals, lives):
        release_array(own)
    release_array(wide_lanes)
    for numbers in (ends, begins):
        release_array(numbers)
    return evaluated


@exact_kernel
def sum_tile_pair_gradients(start, stop, first, slots, pair_rows, grads, touched):  # type: ignore[no-untyped-def]
    """Fill grads[i], the sum of the gradient rows of primitive i's pairs, and touched[i], for i in ``start:stop``.

    A pair is a tile and a primitive that reaches it. ``first`` and ``slots`` are fields of
    :class:`~neuprim.core.render.cpu.tiles.TileLists`. touched[i] is True if any pixel shows primitive i.
    """
    for i in range(start, stop):
        g = grads[i]
        g[:] = np.float32(0)
        for k in range(first[i], first[i + 1]):
            row = pair_rows[slots[k]]
            if row[P.G_WEIGHT] > np.float32(0):
                for c in range(g.shape[0]):
                    g[c] += row[c]
        touched[i] = g[P.G_WEIGHT] > np.float32(0)
