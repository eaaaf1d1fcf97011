"""Compute geometry and neurons of 32 primitives (a block) at a time, in float64.

A block is one flat array ``S`` with a column of 32 numbers per quantity: ``S[M + k]`` is the longest semi-axis m of the
block's primitive k. Columns lie at constant offsets, so that LLVM vectorises. With strict floating-point arithmetic,
the results of a primitive are bitwise the same in any block.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from neuprim.core.compute.kernels import strict
from neuprim.core.model.rows import ellipsoid_rotation
from neuprim.core.render import layout as P

Array = np.ndarray[Any, Any]

BLOCK = 32  # primitives per block: the columns below fit into the L1 cache


def column(number: int) -> int:
    """Return the offset of column ``number`` in the flat array of a block; a column has one number per primitive."""
    return BLOCK * number


# The first columns are those of a row (:mod:`neuprim.core.render.layout`), before the neurons.
MEANS, LOG_SCALES, QUATS, INVERSE = (column(P.NEURONS + n) for n in (0, 3, 6, 10))
AXES, CENTRE, B, LOCAL = (column(P.NEURONS + n) for n in (11, 14, 17, 26))  # matrices row by row
NEURON = column(P.NEURONS + 35)  # one neuron at a time: the columns of a row, then its speed
_SPEED = NEURON + column(P.PER_NEURON)
MOST, TOTAL, BIGGEST, FASTEST, SQUARE, SZZ, REACH = (_SPEED + column(n) for n in range(1, 8))
SPAN, BOX, STATUS, FLOAT64 = (_SPEED + column(n) for n in (8, 13, 17, 18))
COLUMNS = P.NEURONS + 35 + P.PER_NEURON + 1 + 19
TC, UX, UY, M, ANCHOR_Z = (column(n) for n in (P.TC, P.UX, P.UY, P.UNIT, P.ANCHOR_Z))


@strict
def load3(S, at, k):  # type: ignore[no-untyped-def]
    return S[at + k], S[at + BLOCK + k], S[at + 2 * BLOCK + k]


@strict
def load9(S, at, k):  # type: ignore[no-untyped-def]
    a, b, c = load3(S, at, k)
    d, e, f = load3(S, at + 3 * BLOCK, k)
    g, h, i = load3(S, at + 6 * BLOCK, k)
    return a, b, c, d, e, f, g, h, i


@strict
def store3(S, at, k, v):  # type: ignore[no-untyped-def]
    S[at + k], S[at + BLOCK + k], S[at + 2 * BLOCK + k] = v


@strict
def dot3(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@strict
def load_block(which, n, parameters, S):  # type: ignore[no-untyped-def]
    """Load MEANS, LOG_SCALES, QUATS, M and AXES (semi-axes / m) of primitives ``which[:n]``.

    The last primitive is repeated to fill the block.
    """
    means, log_scales, quats = parameters.means, parameters.log_scales, parameters.quats
    for k in range(BLOCK):
        i = which[min(k, n - 1)]
        top = np.float64(max(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2]))
        S[M + k] = np.exp(top)
        for a in range(3):
            log_scale = np.float64(log_scales[i, a])
            S[MEANS + a * BLOCK + k], S[LOG_SCALES + a * BLOCK + k] = means[i, a], log_scale
            S[AXES + a * BLOCK + k] = np.exp(log_scale - top)
        for a in range(4):
            S[QUATS + a * BLOCK + k] = quats[i, a]


@strict
def project_block(S, view):  # type: ignore[no-untyped-def]
    """Compute for each primitive of a block its orientation, its centre in camera coordinates and its anchor pixel.

    Fills B and LOCAL (orientation in camera and scene axes), INVERSE (1/|q|), CENTRE, ANCHOR_Z, UX and UY. The anchor
    (UX, UY) is the pixel that shows the centre, at depth ANCHOR_Z. For a primitive near or behind the camera, the
    anchor is the camera, with depth 0. Pixel and depth are rounded to float32 *before* they are used, so that the pixel
    kernels subtract exactly the same values.
    """
    R, t, fx, fy, cx, cy, near = view.R, view.t, view.fx, view.fy, view.cx, view.cy, view.near
    r0, r1, r2 = (R[0, 0], R[0, 1], R[0, 2]), (R[1, 0], R[1, 1], R[1, 2]), (R[2, 0], R[2, 1], R[2, 2])
    t0, t1, t2 = t[0], t[1], t[2]
    for k in range(BLOCK):
        q0, q1, q2 = load3(S, QUATS, k)
        n, l00, l01, l02, l10, l11, l12, l20, l21, l22 = ellipsoid_rotation(q0, q1, q2, S[QUATS + 3 * BLOCK + k])
        S[INVERSE + k] = n
        store3(S, LOCAL, k, (l00, l01, l02))
        store3(S, LOCAL + 3 * BLOCK, k, (l10, l11, l12))
        store3(S, LOCAL + 6 * BLOCK, k, (l20, l21, l22))
        x, y, z = (l00, l10, l20), (l01, l11, l21), (l02, l12, l22)
        store3(S, B, k, (dot3(r0, x), dot3(r0, y), dot3(r0, z)))
        store3(S, B + 3 * BLOCK, k, (dot3(r1, x), dot3(r1, y), dot3(r1, z)))
        store3(S, B + 6 * BLOCK, k, (dot3(r2, x), dot3(r2, y), dot3(r2, z)))
    for k in range(BLOCK):
        mean, m = load3(S, MEANS, k), S[M + k]
        c0, c1, c2 = dot3(r0, mean) + t0, dot3(r1, mean) + t1, dot3(r2, mean) + t2
        store3(S, CENTRE, k, (c0, c1, c2))
        # a primitive near or behind the camera, or wholly before the near plane, is anchored at the camera
        ahead = (c2 > P.ANCHOR_RADII * m) & (c2 + m > near)
        S[ANCHOR_Z + k] = m * np.float64(np.float32(c2 / m)) if ahead else 0.0
        S[UX + k] = np.float64(np.float32(fx * c0 / c2 + cx if ahead else cx))
        S[UY + k] = np.float64(np.float32(fy * c1 / c2 + cy if ahead else cy))


@strict
def _whiten_axis(b, s, u, v, fx, fy, w):  # type: ignore[no-untyped-def]
    """Return the components of E0, EX, EY and XA along one ellipsoid axis, in whitened space.

    In whitened space, the ellipsoid is the unit ball. E0 is the direction of the ray through (``u``, ``v``) on the
    image plane z = 1. EX and EY are the changes of the direction per pixel in x and y. XA is the vector ``w`` from
    centre to anchor, divided by m. ``b`` is the axis in camera axes, ``s`` the semi-axis divided by the longest
    semi-axis m, and ``fx``, ``fy`` are focal lengths in pixels.
    """
    a0, a1, a2 = b[0] / s, b[1] / s, b[2] / s
    return a0 * u + a1 * v + a2, a0 / fx, a1 / fy, dot3((a0, a1, a2), w)


@strict
def _fill_block_rays(S, view):  # type: ignore[no-untyped-def]
    """Fill the numbers of rays, columns E0 to NEAR of a block, and TOTAL and BIGGEST.

    TOTAL is the sum of numbers of a row, to detect NaN and infinity. BIGGEST is their largest magnitude, to detect
    numbers that overflow float32.
    """
    fx, fy, cx, cy, near = view.fx, view.fy, view.cx, view.cy, view.near
    for k in range(BLOCK):
        m, anchor_z, offset = S[M + k], S[ANCHOR_Z + k], S[BLOCK * P.OFFSET + k]
        c, s, (b00, b01, b02, b10, b11, b12, b20, b21, b22) = load3(S, CENTRE, k), load3(S, AXES, k), load9(S, B, k)
        tc, u, v = anchor_z / m, (S[UX + k] - cx) / fx, (S[UY + k] - cy) / fy
        w = tc * u - c[0] / m, tc * v - c[1] / m, tc - c[2] / m
        e0, ex0, ey0, x0 = _whiten_axis((b00, b10, b20), s[0], u, v, fx, fy, w)
        e1, ex1, ey1, x1 = _whiten_axis((b01, b11, b21), s[1], u, v, fx, fy, w)
        e2, ex2, ey2, x2 = _whiten_axis((b02, b12, b22), s[2], u, v, fx, fy, w)
        e, ex, ey = (e0, e1, e2), (ex0, ex1, ex2), (ey0, ey1, ey2)
        aa = dot3(e, e)
        tu, tv = -tc * dot3(ex, e) / aa, -tc * dot3(ey, e) / aa
        store3(S, BLOCK * P.E0, k, e)
        store3(S, BLOCK * P.EX, k, ex)
        store3(S, BLOCK * P.EY, k, ey)
        store3(S, BLOCK * P.XA, k, (x0, x1, x2))
        store3(S, BLOCK * P.XU, k, (tc * ex0 + tu * e0, tc * ex1 + tu * e1, tc * ex2 + tu * e2))
        store3(S, BLOCK * P.XV, k, (tc * ey0 + tv * e0, tc * ey1 + tv * e1, tc * ey2 + tv * e2))
        cut = (near - anchor_z) / m
        S[TC + k], S[BLOCK * P.TU + k], S[BLOCK * P.TV + k], S[BLOCK * P.NEAR + k] = tc, tu, tv, cut
        biggest = max(max(max(abs(x0), abs(e0)), max(abs(x1), abs(e1))), max(abs(x2), abs(e2)))
        S[BIGGEST + k] = max(max(max(biggest, tc), max(abs(cut), m)), abs(offset))
        S[TOTAL + k] = e0 + ex0 + ey0 + x0 + (e1 + ex1 + ey1 + x1) + (e2 + ex2 + ey2 + x2) + tc + cut + m + offset


@strict
def _fill_block_neurons(which, n, parameters, turns, S, waves):  # type: ignore[no-untyped-def]
    """Fill ``waves`` (K, 6 BLOCK) with the neurons of a block of primitives: frequencies, phase, amplitude and speed.

    Frequencies are on whitened axes, in turns. The speed is the length of the frequency vector, and so the largest
    change of the phase over half a chord, in turns.
    """
    W1, b1, w2 = parameters.W1, parameters.b1, parameters.w2
    for k in range(BLOCK):
        S[FASTEST + k] = 0.0
    for neuron in range(W1.shape[1]):
        for k in range(BLOCK):
            i = which[min(k, n - 1)]
            for a in range(3):
                S[NEURON + a * BLOCK + k] = W1[i, neuron, a]
            S[NEURON + BLOCK * P.PHASE + k], S[NEURON + BLOCK * P.AMPLITUDE + k] = b1[i, neuron], w2[i, neuron]
        for k in range(BLOCK):
            w, s = load3(S, NEURON, k), load3(S, AXES, k)
            l00, l01, l02, l10, l11, l12, l20, l21, l22 = load9(S, LOCAL, k)
            x, y = turns * s[0] * dot3(w, (l00, l10, l20)), turns * s[1] * dot3(w, (l01, l11, l21))
            wave = x, y, turns * s[2] * dot3(w, (l02, l12, l22))
            speed, amplitude = np.sqrt(dot3(wave, wave)), S[NEURON + BLOCK * P.AMPLITUDE + k]
            phase = turns * S[NEURON + BLOCK * P.PHASE + k]
            store3(S, NEURON, k, wave)
            S[NEURON + BLOCK * P.PHASE + k], S[_SPEED + k] = phase - np.rint(phase), speed
            S[FASTEST + k] = max(S[FASTEST + k], speed)
            S[BIGGEST + k] = max(max(S[BIGGEST + k], speed), abs(amplitude))
            S[TOTAL + k] += speed + phase + amplitude
        for k in range(6 * BLOCK):
            waves[neuron, k] = S[NEURON + k]


@strict
def fill_block(which, n, parameters, view, S, waves):  # type: ignore[no-untyped-def]
    """Fill the block ``S`` with geometry and rays of primitives ``which[:n]``, and ``waves`` with their neurons.

    ``waves`` (K, 6 BLOCK) has the columns of a neuron for each of K neurons, see :func:`_fill_block_neurons`.
    """
    load_block(which, n, parameters, S)
    for k in range(BLOCK):
        S[BLOCK * P.OFFSET + k] = parameters.b2[which[min(k, n - 1)]]
    project_block(S, view)
    _fill_block_rays(S, view)
    _fill_block_neurons(which, n, parameters, view.turns, S, waves)


@strict
def store_row(k, S, waves, rate, order, row):  # type: ignore[no-untyped-def]
    """Copy primitive ``k`` of a block to ``row``, with neurons sorted by speed, the length of the frequency vector.

    Also fills ``rate`` (K,) with the sorted speeds and ``order`` (K,) with the neurons' indices.
    """
    for j in range(P.NEURONS):
        row[j] = S[j * BLOCK + k]
    K = rate.shape[0]
    for neuron in range(K):
        # sort by counting the slower neurons, without a branch; equally fast ones keep their order
        at, speed = np.int64(0), waves[neuron, BLOCK * P.PER_NEURON + k]
        for j in range(K):
            other = waves[j, BLOCK * P.PER_NEURON + k]
            at += np.int64((other < speed) | ((other == speed) & (j < neuron)))
        rate[at], order[at] = speed, neuron
        o = P.NEURONS + P.PER_NEURON * at
        for j in range(P.PER_NEURON):
            row[o + j] = waves[neuron, j * BLOCK + k]
    for j in range(P.NEURONS + P.PER_NEURON * K, row.shape[0]):
        row[j] = 0.0


class BlockMemory(NamedTuple):
    """Memory for a block: columns ``S``, neurons ``waves`` (K, 6 BLOCK), sorted ``rate`` (K,), ``which`` (BLOCK,)."""

    S: Array
    waves: Array
    rate: Array
    which: Array


@strict
def allocate_block(K):  # type: ignore[no-untyped-def]
    return BlockMemory(np.zeros(COLUMNS * BLOCK), np.empty((K, 6 * BLOCK)), np.empty(K), np.empty(BLOCK, np.int64))
