"""Project primitives to the screen, in float64: anchor pixels, rays in whitened space, exact screen bounds.

In whitened space (units of the semi-axes), a primitive is the unit ball. The anchor of a primitive is the pixel that
shows its centre, at the centre's depth. A primitive near or behind the camera is anchored at the camera instead. The
numbers of a whitened ray are affine in the pixel offset from the anchor, so float32 need not represent the distance to
the camera. The ray parameter t has the unit m, the longest semi-axis. Images do not depend on the choice of anchor and
unit, so the backward pass treats both as constants.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from neuprim.core.compute.kernels import borrow_arrays, exact_kernel, release_array, strict
from neuprim.core.model.edge import NORMS
from neuprim.core.render import layout as P
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.blocks import (
    AXES,
    BIGGEST,
    BLOCK,
    BOX,
    CENTRE,
    FASTEST,
    FLOAT64,
    MOST,
    REACH,
    SPAN,
    SQUARE,
    STATUS,
    SZZ,
    TC,
    TOTAL,
    UX,
    UY,
    B,
    M,
    allocate_block,
    dot3,
    fill_block,
    load3,
    store3,
    store_row,
)

Array = np.ndarray[Any, Any]


class PrimitiveArrays(NamedTuple):
    """Geometry and density parameters of N primitives with K neurons, or gradients with respect to them."""

    means: Array
    log_scales: Array
    quats: Array
    W1: Array
    b1: Array
    w2: Array
    b2: Array


class View(NamedTuple):
    """A camera: world-to-camera rotation R and translation t, intrinsics and size in pixels, depth of the near plane.

    Kernels count phases in turns of 2 pi. The density's weights W1 and biases b1 times ``turns`` = omega0 / 2 pi are in
    turns.
    """

    R: Array
    t: Array
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float
    turns: float


class Projected(NamedTuple):
    """Results of :func:`prepare_primitives`, one element or row per primitive."""

    rows: Array  # (N, row_width) float32 rows of the pixel kernels
    # (N, SPAN_WIDTH) silhouettes and (N, 4) pixel boxes
    spans: Array
    boxes: Array
    kinds: Array  # (N, K/2) range of rates (SLOW, MEDIUM, FAST) of row neurons 2m and 2m + 1
    order: Array  # (N, K) the model's index of each neuron of a row; a row stores neurons by rising rate
    depth: Array  # (N,) camera-z of the centres
    status: Array  # (N,) P.VISIBLE, P.CULLED or P.NON_FINITE
    in_float64: Array  # (N,) whether float32 is not enough for the primitive's pixels

    @classmethod
    def allocate(cls, count: int, neurons: int) -> Projected:
        """Allocate arrays for ``count`` primitives; ``rows`` and ``kinds`` pad ``neurons`` to an even number."""
        padded = neurons + neurons % 2
        return cls(
            rows=np.empty((count, L.row_width(padded)), np.float32),
            spans=np.zeros((count, P.SPAN_WIDTH), np.float32),
            boxes=np.empty((count, 4), np.int32),
            kinds=np.empty((count, padded // 2), np.uint8),
            order=np.empty((count, neurons), np.uint8),
            depth=np.empty(count, np.float64),
            status=np.empty(count, np.uint8),
            in_float64=np.empty(count, np.bool_),
        )


@strict
def _is_too_faint_to_draw(most, edge, least):  # type: ignore[no-untyped-def]
    """Return whether no chord through a primitive, from any camera, can reach the optical depth ``least``.

    ``most`` = b2 + sum |w2| is an upper bound of density times m, the longest semi-axis. Half chords are at most m, so
    the optical depth is at most ``most`` N_p. N_p is the integral of (1 - u^2)^p over [-1, 1], p = ``edge``.
    """
    return most <= 0.0 or most * NORMS[edge] <= least


@strict
def _visible_square(most, longest, edge, least):  # type: ignore[no-untyped-def]
    """Return r^2, where only rays through the ellipsoid scaled by r can reach the optical depth ``least``.

    r^2 = 1 - (least / (most N_p longest))^(1/(p + 1/2)) with p = ``edge``, see :mod:`neuprim.core.render.layout`. r^2
    is 1 for the whole ellipsoid, and 0 if no ray can reach ``least``. ``most`` is b2 + sum |w2|. ``longest`` is an
    upper bound of half chords, in units of the longest semi-axis. r^2 is rounded to float32, so that backends agree.
    """
    share = least / (most * NORMS[edge] * longest)
    if share >= 1.0:
        return 0.0
    if share <= P.MIN_RIM_SHARES[edge]:
        return 1.0
    return np.float64(np.float32(1.0 - np.exp(np.log(share) * P.RIM_POWERS[edge])))


@strict
def _is_finite_undrawn_primitive(i, parameters, most):  # type: ignore[no-untyped-def]
    """Return whether all parameters of primitive ``i``, which is not drawn, are finite; ``most`` is b2 + sum |w2|."""
    means, log_scales, quats, W1, b1, _, _ = parameters
    total, square = most, np.float64(0.0)
    for a in range(3):
        total += np.float64(means[i, a]) + np.float64(log_scales[i, a])
    for a in range(4):
        square += np.float64(quats[i, a]) * np.float64(quats[i, a])
    for k in range(W1.shape[1]):
        total += np.float64(W1[i, k, 0]) + np.float64(W1[i, k, 1]) + np.float64(W1[i, k, 2]) + np.float64(b1[i, k])
    return np.isfinite(total + 1.0 / square)


@strict
def _silhouette_screen_extent(z, ci, s22, square, b, axes, towards, focal, middle):  # type: ignore[no-untyped-def]
    """Return the first and last pixel coordinate, along one screen axis, of an ellipsoid's silhouette.

    The ellipsoid is first scaled by ``square`` ** 0.5. The two coordinates are those of the tangents to the silhouette,
    as in :func:`~neuprim.core.render.reference.screen_boxes`. Lengths are in units of the longest semi-axis. ``z`` is
    the centre's depth, ``ci`` the centre's camera coordinate along the screen axis. ``axes`` are the semi-axes,
    ``focal`` and ``middle`` the focal length and principal point in pixels. ``b`` and ``towards`` are the rows of the
    orientation matrix B, in camera axes, for the screen axis and for depth. ``s22`` is the (z, z) entry of B diag(s^2)
    B^T of the unscaled ellipsoid.
    """
    (b0, b1, b2), (s0, s1, s2), (d0, d1, d2), szz = b, axes, towards, square * s22
    sii = square * ((b0 * s0) ** 2 + (b1 * s1) ** 2 + (b2 * s2) ** 2)
    siz = square * (b0 * d0 * s0**2 + b1 * d1 * s1**2 + b2 * d2 * s2**2)
    D = z * z * sii - 2 * ci * z * siz + ci * ci * szz - (sii * szz - siz * siz)
    root, mid, den = np.sqrt(max(D, 0.0)), ci * z - siz, z * z - szz
    return focal * (mid - root) / den + middle, focal * (mid + root) / den + middle


@strict
def _longest_half_chord(c, m, reach, tc, fx, fy, e_length, ex_length, ey_length):  # type: ignore[no-untyped-def]
    """Return an upper bound, <= 1, of the half chords of all rays, in units of the longest semi-axis m.

    Let e be a ray direction d with camera-z 1, converted to whitened space. The half chord is at most m |d|/|e|. No
    point of the ellipsoid is farther than m from the centre, which limits the slopes of the rays and so |d| and |e|.
    The bound is 1 if the primitive is anchored at the camera (``tc`` is 0). ``c`` is the centre in camera axes,
    ``reach`` half the ellipsoid's extent in depth. The last three arguments are the length of e at the anchor, and the
    lengths of the change of e per pixel in x and in y.
    """
    u, v, wide = abs(c[0] / c[2]), abs(c[1] / c[2]), m / (c[2] - reach)
    du, dv = wide * (1.0 + u), wide * (1.0 + v)
    least = e_length - fx * du * ex_length - fy * dv * ey_length
    most = np.sqrt(1.0 + (u + du) ** 2 + (v + dv) ** 2)
    return most / least if (tc != 0.0) & (least > most) else 1.0


@strict
def _cross(a, b):  # type: ignore[no-untyped-def]
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@strict
def _moment_slope(x, e, axis, tc):  # type: ignore[no-untyped-def]
    """Return the derivative, by the pixel offset along a screen axis, of x cross e for a ray with point x, direction e.

    ``axis`` is the derivative of e, and ``tc`` times ``axis`` the derivative of x.
    """
    a, b = _cross(x, axis), _cross(axis, e)
    return a[0] + tc * b[0], a[1] + tc * b[1], a[2] + tc * b[2]


@strict
def _rounded(x):  # type: ignore[no-untyped-def]
    return np.float64(np.float32(x))


@strict
def _bound_block(S, view, edge, least):  # type: ignore[no-untyped-def]
    """Fill silhouettes, pixel boxes and status of a block of primitives, and whether each primitive needs float64.

    ``S`` is a block (32 primitives) with the columns of :func:`fill_block` and MOST. ``edge`` is the exponent p,
    ``least`` the lowest optical depth that is drawn. Ray origins of float64 primitives are not slid along the ray, so
    the function replaces TU, TV, XU and XV of these primitives.
    """
    fx, fy, cx, cy, near = view.fx, view.fy, view.cx, view.cy, view.near
    width, height, soft = float(view.width), float(view.height), edge > 0
    for k in range(BLOCK):
        m, axes, towards = S[M + k], load3(S, AXES, k), load3(S, B + 6 * BLOCK, k)
        e, ex, ey = load3(S, BLOCK * P.E0, k), load3(S, BLOCK * P.EX, k), load3(S, BLOCK * P.EY, k)
        szz = m * m * ((towards[0] * axes[0]) ** 2 + (towards[1] * axes[1]) ** 2 + (towards[2] * axes[2]) ** 2)
        lengths = np.sqrt(dot3(e, e)), np.sqrt(dot3(ex, ex)), np.sqrt(dot3(ey, ey))
        reach = np.sqrt(szz)
        S[SZZ + k], S[REACH + k] = szz, reach
        S[SQUARE + k] = _longest_half_chord(load3(S, CENTRE, k), m, reach, S[TC + k], fx, fy, *lengths)
    for k in range(BLOCK):
        S[SQUARE + k] = _visible_square(S[MOST + k], S[SQUARE + k], edge, least)
    for k in range(BLOCK):
        m, tc, reach, square, s22 = S[M + k], S[TC + k], S[REACH + k], S[SQUARE + k], S[SZZ + k] / (S[M + k] * S[M + k])
        c, axes, towards = load3(S, CENTRE, k), load3(S, AXES, k), load3(S, B + 6 * BLOCK, k)
        z, x, y = c[2] / m, load3(S, B, k), load3(S, B + 3 * BLOCK, k)
        x0, x1 = _silhouette_screen_extent(z, c[0] / m, s22, square, x, axes, towards, fx, cx)
        y0, y1 = _silhouette_screen_extent(z, c[1] / m, s22, square, y, axes, towards, fy, cy)
        whole = c[2] - reach > 1e-3 * reach  # in front of the camera plane: the silhouette is an ellipse
        x0, x1 = max(0.0, np.ceil(x0 - 0.5)) if whole else 0.0, min(width, np.floor(x1 - 0.5) + 1) if whole else width
        y0, y1 = max(0.0, np.ceil(y0 - 0.5)) if whole else 0.0, min(height, np.floor(y1 - 0.5) + 1) if whole else height
        S[BOX + k], S[BOX + BLOCK + k], S[BOX + 2 * BLOCK + k], S[BOX + 3 * BLOCK + k] = x0, y0, x1, y1
        reached, beyond = c[2] + reach > near, S[BIGGEST + k] > P.FLOAT32_MAX
        drawn = reached & (x1 > x0) & (y1 > y0) & (not (whole & (square == 0.0)))
        # beyond float32: an error if m > 1 (scale or weight); else too small for its distance to hit a pixel centre
        bad = (not (abs(S[TOTAL + k]) < np.inf)) | (reached & beyond & (m > 1.0))
        status = P.VISIBLE if drawn & (not beyond) else P.CULLED
        S[STATUS + k] = P.NON_FINITE if bad else status
    for k in range(BLOCK):
        tc, square, c, reach = S[TC + k], S[SQUARE + k], load3(S, CENTRE, k), S[REACH + k]
        e, ex, ey, x = (
            load3(S, BLOCK * P.E0, k),
            load3(S, BLOCK * P.EX, k),
            load3(S, BLOCK * P.EY, k),
            load3(S, BLOCK * P.XA, k),
        )
        # |r e|^2 - |x x e|^2 > 0 is a quadratic in (du, dv); per row: centre XC + SKEW (dv - YC), half width by HX, HY
        k0, ka, kb = _cross(x, e), _moment_slope(x, e, ex, tc), _moment_slope(x, e, ey, tc)
        q0, q1 = square * dot3(e, e) - dot3(k0, k0), square * dot3(e, ex) - dot3(k0, ka)
        q2, q3 = square * dot3(e, ey) - dot3(k0, kb), square * dot3(ex, ex) - dot3(ka, ka)
        q4, q5 = square * dot3(ex, ey) - dot3(ka, kb), square * dot3(ey, ey) - dot3(kb, kb)
        d0, d1, d2 = q1 * q1 - q3 * q0, q1 * q4 - q3 * q2, q4 * q4 - q3 * q5
        yc = -d1 / d2
        peak = d0 + d1 * yc
        ellipse = (c[2] - reach > 1e-3 * reach) & (q3 < 0.0) & (d2 < 0.0) & (peak > 0.0)
        skew, xc = (-q4 / q3 if ellipse else 0.0), (-(q1 + q4 * yc) / q3 if ellipse else 0.0)
        hx, hy = np.sqrt(peak) / -q3, np.sqrt(-peak / d2)
        store3(S, SPAN, k, (skew, xc, yc if ellipse else 0.0))
        S[SPAN + P.HX * BLOCK + k] = hx if ellipse else P.UNBOUNDED
        S[SPAN + P.HY * BLOCK + k] = hy if ellipse else P.UNBOUNDED
    for k in range(BLOCK):
        tc, yc = S[TC + k], S[SPAN + P.YC * BLOCK + k]
        skew, xc = _rounded(S[SPAN + P.SKEW * BLOCK + k]), _rounded(S[SPAN + P.XC * BLOCK + k])
        hx, hy = _rounded(S[SPAN + P.HX * BLOCK + k]), _rounded(S[SPAN + P.HY * BLOCK + k])
        ex, ey, x = load3(S, BLOCK * P.EX, k), load3(S, BLOCK * P.EY, k), load3(S, BLOCK * P.XA, k)
        ux, uy, c, axes, reach = S[UX + k], S[UY + k], load3(S, CENTRE, k), load3(S, AXES, k), S[REACH + k]
        ellipse = hy < P.UNBOUNDED
        # the largest pixel offsets of the silhouette on the screen
        tall = min(abs(yc) + hy, max(abs(0.5 - uy), abs(height - 0.5 - uy)))
        broad = min(abs(xc) + abs(skew) * (abs(yc) + hy) + hx, max(abs(0.5 - ux), abs(width - 0.5 - ux)))
        # the rest of sliding the origin, s G, and the two terms of the closest point: across a slanted needle, each is
        # many radii of its thin axis long, and they cancel
        slide = abs(S[BLOCK * P.TU + k]) * broad + abs(S[BLOCK * P.TV + k]) * tall
        cancels = slide * (np.sqrt(dot3(ex, ex)) * broad + np.sqrt(dot3(ey, ey)) * tall) > P.FLOAT64_RADII
        xu, xv = load3(S, BLOCK * P.XU, k), load3(S, BLOCK * P.XV, k)
        cancels |= abs(xu[0]) * broad + abs(xv[0]) * tall > P.FLOAT64_RADII
        cancels |= abs(xu[1]) * broad + abs(xv[1]) * tall > P.FLOAT64_RADII
        cancels |= abs(xu[2]) * broad + abs(xv[2]) * tall > P.FLOAT64_RADII
        coarse = (S[FASTEST + k] > P.FLOAT64_TURNS) | (max(abs(ux), abs(uy)) > P.FLOAT64_PIXELS)
        coarse |= dot3(x, x) > P.FLOAT64_ANCHOR**2  # centre far from the anchor, in the thinnest axis
        ratio = P.FLOAT64_RATIO_NEAR if tc == 0.0 else P.FLOAT64_RATIO
        coarse |= min(axes[0], axes[1], axes[2]) * ratio < 1.0
        # only the float64 stage can integrate cut chords with a soft edge
        coarse |= soft & (c[2] - reach < near + P.CUT * reach)
        coarse |= ellipse & cancels
        S[FLOAT64 + k] = 1.0 if coarse else 0.0
        # the float64 rows do not slide
        slide_x, slide_y = (0.0 if coarse else S[BLOCK * P.TU + k]), (0.0 if coarse else S[BLOCK * P.TV + k])
        S[BLOCK * P.TU + k], S[BLOCK * P.TV + k] = slide_x, slide_y
        for a in range(3):
            S[BLOCK * (P.XU + a) + k] = tc * ex[a] if coarse else xu[a]
            S[BLOCK * (P.XV + a) + k] = tc * ey[a] if coarse else xv[a]


@exact_kernel
def prepare_wide(start, stop, which, parameters, view, order, wide):  # type: ignore[no-untyped-def]
    """Fill ``wide[n]``, the float64 row of primitive ``which[n]``, for n in ``start:stop``."""
    parameters, view, own = borrow_arrays(parameters), borrow_arrays(view), allocate_block(parameters.W1.shape[1])
    S, waves, rate, block = borrow_arrays(own)
    for first in range(start, stop, BLOCK):
        n = min(BLOCK, stop - first)
        for k in range(n):
            block[k] = which[first + k]
        fill_block(block, n, parameters, view, S, waves)
        for k in range(n):
            store_row(k, S, waves, rate, order[block[k]], wide[first + k])
    release_array(own)


@strict
def _store_block(block, n, S, waves, rate, out):  # type: ignore[no-untyped-def]
    rows, spans, boxes, kinds, order, depth, status, in_float64 = out
    K = order.shape[1]
    for k in range(n):
        i = block[k]
        store_row(k, S, waves, rate, order[i], rows[i])
        for pair in range(kinds.shape[1]):
            fastest = rate[min(2 * pair + 1, K - 1)]
            kinds[i, pair] = L.SLOW if fastest < L.SLOW_TURNS else (L.MEDIUM if fastest < L.MEDIUM_TURNS else L.FAST)
        depth[i], status[i] = S[CENTRE + 2 * BLOCK + k], S[STATUS + k]
        in_float64[i] = S[FLOAT64 + k] > 0.0
        seen = status[i] == P.VISIBLE
        for j in range(5):
            spans[i, j] = S[SPAN + j * BLOCK + k]
        for j in range(4):
            boxes[i, j] = np.int32(S[BOX + j * BLOCK + k]) if seen else 0


@exact_kernel
def prepare_primitives(start, stop, parameters, view, edge, least, out):  # type: ignore[no-untyped-def]
    """Project primitives ``start:stop``; fill ``out``. Silhouettes contain all rays that reach optical depth ``least``.

    ``out`` is a :class:`Projected`, ``edge`` the exponent p. A primitive that is too faint for any ray to reach
    ``least`` gets only a status, an empty box and a depth of 0.
    """
    parameters, view, out = borrow_arrays(parameters), borrow_arrays(view), borrow_arrays(out)
    w2, b2, boxes = parameters.w2, parameters.b2, out.boxes
    own = allocate_block(w2.shape[1])
    S, waves, rate, block = borrow_arrays(own)
    n = 0
    for i in range(start, stop):
        most = np.float64(b2[i])
        for k in range(w2.shape[1]):
            most += abs(np.float64(w2[i, k]))
        if _is_too_faint_to_draw(most, edge, least):  # wherever it is
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, 0, 0, 0
            out.in_float64[i], out.depth[i] = False, 0.0
            out.status[i] = P.CULLED if _is_finite_undrawn_primitive(i, parameters, most) else P.NON_FINITE
        else:
            block[n], S[MOST + n] = i, most
            n += 1
        if n == BLOCK or (i + 1 == stop and n > 0):
            fill_block(block, n, parameters, view, S, waves)
            _bound_block(S, view, edge, least)
            _store_block(block, n, S, waves, rate, out)
            n = 0
    release_array(own)
