"""The per-primitive stage, in float64: anchors, whitening, exact bounds; forward and backward.

Each primitive is anchored at its own projected centre, so that whitened rays are affine in the pixel offset and float32
never sees the distance to the camera (method: "Line integral"). Anchor and unit of t are constants without gradient.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from neuprim.core.compute.kernels import borrow_arrays, exact_kernel, release_array, strict
from neuprim.core.model.edge import NORMS
from neuprim.core.model.rows import ellipsoid_rotation_backward, fill_ellipsoid_rotation
from neuprim.core.render import layout as P
from neuprim.core.render.cpu import layout as L

Array = np.ndarray[Any, Any]


class PrimitiveArrays(NamedTuple):
    """Geometry and density of N primitives with K neurons, or the gradients by them."""

    means: Array
    log_scales: Array
    quats: Array
    W1: Array
    b1: Array
    w2: Array
    b2: Array


class View(NamedTuple):
    """A camera: rotation and translation from world, intrinsics, size, near plane; ``turns``: omega0 / 2 pi."""

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
    """What :func:`prepare_primitives` fills for each primitive."""

    rows: Array  # (N, row_width) float32 rows of the pixel kernels
    # (N, SPAN_WIDTH) silhouettes and (N, 4) pixel boxes
    spans: Array
    boxes: Array
    kinds: Array  # (N, K/2) range of rates (SLOW, MEDIUM, FAST) of row neurons 2m and 2m + 1
    order: Array  # (N, K) the model's index of each row neuron; they are stored by rising rate
    depth: Array  # (N,) camera-z of the centres
    status: Array  # (N,) P.VISIBLE, P.CULLED or P.NON_FINITE
    in_float64: Array  # (N,) whether float32 is not enough for the primitive's pixels

    @classmethod
    def allocate(cls, count: int, neurons: int) -> Projected:
        """Room for primitives with ``neurons`` each, which the kernels take in pairs."""
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


class _Scratch(NamedTuple):
    """``work`` (10, 3): rows 0..2 return B, 3 the axes s/m, 4 the centre; ``waves`` (K, 4); rising ``rate`` (K,)."""

    work: Array
    waves: Array
    rate: Array


@strict
def _scratch(K):  # type: ignore[no-untyped-def]
    return _Scratch(np.empty((10, 3)), np.empty((K, 4)), np.empty(K))


@strict
def _is_too_faint_to_draw(most, edge, least):  # type: ignore[no-untyped-def]
    """Whether no chord can reach the depth ``least``: no half chord is longer than the longest semi-axis."""
    return most <= 0.0 or most * NORMS[edge] <= least


@strict
def _visible_square(most, longest, edge, least):  # type: ignore[no-untyped-def]
    """r^2 of an ellipsoid's visible extent in units of its semi-axes: 1 for all of it, 0 for nothing.

    ``most``: F; ``longest``: s, in units of the longest semi-axis. Rounded to float32, so that backends agree.
    """
    share = least / (most * NORMS[edge] * longest)
    if share >= 1.0:
        return 0.0
    if share <= P.MIN_RIM_SHARES[edge]:
        return 1.0
    return np.float64(np.float32(1.0 - np.exp(np.log(share) * P.RIM_POWERS[edge])))


@strict
def _cross_product(a, b, out):  # type: ignore[no-untyped-def]
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@strict
def _dot_product(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@strict
def project_primitive_frame(mean, log_scale, quat, view, local, B, axes, c, anchor):  # type: ignore[no-untyped-def]
    """Fill camera-axes orientation B, axes s/m, centre c and anchor (depth, pixel x, y); returns (m, 1/|q|).

    The anchor is rounded to float32 *before* it is used, so that the pixel kernels subtract exactly the same number.
    """
    R, t = view.R, view.t
    n = fill_ellipsoid_rotation(quat, local)
    top = max(np.float64(log_scale[0]), np.float64(log_scale[1]), np.float64(log_scale[2]))
    m = np.exp(top)
    for i in range(3):
        axes[i] = np.exp(np.float64(log_scale[i]) - top)
        c[i] = R[i, 0] * mean[0] + R[i, 1] * mean[1] + R[i, 2] * mean[2] + t[i]
        for j in range(3):
            B[i, j] = R[i, 0] * local[0, j] + R[i, 1] * local[1, j] + R[i, 2] * local[2, j]
    fx, fy, cx, cy = view.fx, view.fy, view.cx, view.cy
    if c[2] > P.ANCHOR_RADII * m and c[2] + m > view.near:
        anchor[0] = m * np.float64(np.float32(c[2] / m))
        anchor[1] = np.float64(np.float32(fx * c[0] / c[2] + cx))
        anchor[2] = np.float64(np.float32(fy * c[1] / c[2] + cy))
    else:  # the centre is near or behind the camera, or nothing is seen of it: anchor at the camera itself
        anchor[0] = 0.0
        anchor[1] = np.float64(np.float32(cx))
        anchor[2] = np.float64(np.float32(cy))
    return m, n


@strict
def _fill_wide_row(i, parameters, view, scratch, order, row):  # type: ignore[no-untyped-def]
    """Fill the float64 row of primitive ``i`` and ``order[i]``; returns (m, whether all is finite, largest number)."""
    means, log_scales, quats, W1, b1, w2, b2 = parameters
    work, waves, rate = scratch
    near, turns, K = view.near, view.turns, W1.shape[1]
    B, axes, c, local, anchor, w = work[0:3], work[3], work[4], work[5:8], work[8], work[9]
    fx, fy, cx, cy = view.fx, view.fy, view.cx, view.cy
    m, _ = project_primitive_frame(means[i], log_scales[i], quats[i], view, local, B, axes, c, anchor)
    tc = anchor[0] / m
    u, v = (anchor[1] - cx) / fx, (anchor[2] - cy) / fy
    w[0], w[1], w[2] = tc * u - c[0] / m, tc * v - c[1] / m, tc - c[2] / m
    biggest, total, aa, xe, ye = 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(3):
        A0, A1, A2 = B[0, a] / axes[a], B[1, a] / axes[a], B[2, a] / axes[a]  # m S^-1 B^T
        e0, ex, ey, xa = A0 * u + A1 * v + A2, A0 / fx, A1 / fy, A0 * w[0] + A1 * w[1] + A2 * w[2]
        row[P.E0 + a], row[P.EX + a], row[P.EY + a], row[P.XA + a] = e0, ex, ey, xa
        aa, xe, ye = aa + e0 * e0, xe + ex * e0, ye + ey * e0
        biggest = max(biggest, abs(xa), abs(e0))
        total += e0 + ex + ey + xa
    tu, tv = -tc * xe / aa, -tc * ye / aa
    for a in range(3):
        row[P.XU + a], row[P.XV + a] = tc * row[P.EX + a] + tu * row[P.E0 + a], tc * row[P.EY + a] + tv * row[P.E0 + a]
    row[P.TC], row[P.TU], row[P.TV], row[P.UX], row[P.UY] = tc, tu, tv, anchor[1], anchor[2]
    row[P.NEAR], row[P.OFFSET], row[P.UNIT], row[P.ANCHOR_Z] = (near - anchor[0]) / m, b2[i], m, anchor[0]
    biggest = max(biggest, tc, abs(row[P.NEAR]), m, abs(row[P.OFFSET]))
    total += tc + row[P.NEAR] + m + row[P.OFFSET]
    for k in range(K):
        for a in range(3):
            waves[k, a] = (
                turns * axes[a] * (W1[i, k, 0] * local[0, a] + W1[i, k, 1] * local[1, a] + W1[i, k, 2] * local[2, a])
            )
        speed = np.sqrt(waves[k, 0] * waves[k, 0] + waves[k, 1] * waves[k, 1] + waves[k, 2] * waves[k, 2])
        waves[k, 3] = speed
        biggest = max(biggest, speed, abs(np.float64(w2[i, k])))
        total += speed + turns * np.float64(b1[i, k]) + w2[i, k]
    for k in range(K):
        # counting the slower ones sorts without a branch; neurons as fast keep their order
        at, speed = np.int64(0), waves[k, 3]
        for j in range(K):
            at += np.int64((waves[j, 3] < speed) | ((waves[j, 3] == speed) & (j < k)))
        o, phase = P.NEURONS + P.PER_NEURON * at, turns * np.float64(b1[i, k])
        rate[at], order[i, at] = speed, k
        row[o + P.WX], row[o + P.WY], row[o + P.WZ] = waves[k, 0], waves[k, 1], waves[k, 2]
        row[o + P.PHASE], row[o + P.AMPLITUDE] = phase - np.rint(phase), w2[i, k]
    return m, np.isfinite(total), biggest


@strict
def _is_finite_undrawn_primitive(i, parameters, most):  # type: ignore[no-untyped-def]
    """Whether the numbers of a primitive that is not drawn are finite, ``most`` for its amplitudes."""
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
def _silhouette_screen_extent(c, m, B, axes, focal, middle, axis, s22, square):  # type: ignore[no-untyped-def]
    """Where the silhouette, ``square`` ** 0.5 times as large, begins and ends along a screen axis, in pixels.

    Tangents as in ``screen_boxes`` of the reference, in units of m; ``s22``: S_zz of the whole ellipsoid.
    """
    z, ci, szz = c[2] / m, c[axis] / m, square * s22
    sii = square * ((B[axis, 0] * axes[0]) ** 2 + (B[axis, 1] * axes[1]) ** 2 + (B[axis, 2] * axes[2]) ** 2)
    siz = square * (
        B[axis, 0] * B[2, 0] * axes[0] ** 2 + B[axis, 1] * B[2, 1] * axes[1] ** 2 + B[axis, 2] * B[2, 2] * axes[2] ** 2
    )
    D = z * z * sii - 2 * ci * z * siz + ci * ci * szz - (sii * szz - siz * siz)
    root, mid, den = np.sqrt(max(D, 0.0)), ci * z - siz, z * z - szz
    return focal * (mid - root) / den + middle, focal * (mid + root) / den + middle


@strict
def _longest_half_chord(c, m, reach, row, view, e0, ex, ey):  # type: ignore[no-untyped-def]
    """A bound, at most 1, of the half chords of all rays that meet the ellipsoid, in its longest semi-axes.

    A ray's half chord through the centre is m / |e|. No point is farther than m from the centre, which bounds the
    slopes.
    """
    if row[P.TC] == 0.0:  # the anchor is not the centre
        return 1.0
    u, v, wide = abs(c[0] / c[2]), abs(c[1] / c[2]), m / (c[2] - reach)
    du, dv = wide * (1.0 + u), wide * (1.0 + v)
    least = (
        np.sqrt(_dot_product(e0, e0))
        - view.fx * du * np.sqrt(_dot_product(ex, ex))
        - view.fy * dv * np.sqrt(_dot_product(ey, ey))
    )
    most = np.sqrt(1.0 + (u + du) ** 2 + (v + dv) ** 2)
    return most / least if least > most else 1.0


@exact_kernel
def prepare_wide(start, stop, which, parameters, view, order, wide):  # type: ignore[no-untyped-def]
    """Fill the float64 rows of primitives ``which[start:stop]``, which the pixel stage draws in float64."""
    parameters, view, memory = borrow_arrays(parameters), borrow_arrays(view), _scratch(parameters.W1.shape[1])
    scratch = borrow_arrays(memory)
    for n in range(start, stop):
        wide[n, :] = 0.0
        _fill_wide_row(which[n], parameters, view, scratch, order, wide[n])
    release_array(memory)


@exact_kernel
def prepare_primitives(start, stop, parameters, view, edge, least, out):  # type: ignore[no-untyped-def]
    """Fill ``out`` for primitives ``start:stop``; silhouettes are those of rays that reach the optical depth ``least``.

    A primitive that cannot reach it anywhere gets a status, an empty box and a depth of 0 alone.
    """
    parameters, view = borrow_arrays(parameters), borrow_arrays(view)
    rows, spans, boxes, kinds, order, depth, status, in_float64 = out
    w2, b2, near, K = parameters.w2, parameters.b2, view.near, parameters.W1.shape[1]
    memory, row = _scratch(K), np.zeros(rows.shape[1])
    scratch = borrow_arrays(memory)
    work, rate = scratch.work, scratch.rate
    B, axes, c = work[0:3], work[3], work[4]
    e0, ex, ey, xa = row[P.E0 : P.EX], row[P.EX : P.EY], row[P.EY : P.XA], row[P.XA : P.XU]
    k0, ka, kb, tmp = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(start, stop):
        most = np.float64(b2[i])
        for k in range(K):
            most += abs(np.float64(w2[i, k]))
        if _is_too_faint_to_draw(most, edge, least):  # whatever its place
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, 0, 0, 0
            in_float64[i], depth[i] = False, 0.0
            status[i] = P.CULLED if _is_finite_undrawn_primitive(i, parameters, most) else P.NON_FINITE
            continue
        m, finite, biggest = _fill_wide_row(i, parameters, view, scratch, order, row)
        for n in range(kinds.shape[1]):
            fastest = rate[min(2 * n + 1, K - 1)]
            kinds[i, n] = L.SLOW if fastest < L.SLOW_TURNS else (L.MEDIUM if fastest < L.MEDIUM_TURNS else L.FAST)
        for j in range(row.shape[0]):
            rows[i, j] = row[j]
        tc = row[P.TC]
        in_float64[i] = (K > 0 and rate[K - 1] > P.FLOAT64_TURNS) or max(
            abs(row[P.UX]), abs(row[P.UY])
        ) > P.FLOAT64_PIXELS
        in_float64[i] |= _dot_product(xa, xa) > P.FLOAT64_ANCHOR**2  # centre far from the anchor, in the thinnest axis
        thinnest = min(axes[0], axes[1], axes[2])
        in_float64[i] |= thinnest * (P.FLOAT64_RATIO_NEAR if tc == 0.0 else P.FLOAT64_RATIO) < 1.0
        depth[i] = c[2]
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, 0, 0, 0
        if not finite:
            status[i] = P.NON_FINITE
            continue
        status[i] = P.CULLED
        szz = m * m * ((B[2, 0] * axes[0]) ** 2 + (B[2, 1] * axes[1]) ** 2 + (B[2, 2] * axes[2]) ** 2)
        reach = np.sqrt(szz)
        # only in float64 are there integrals of cut chords with a soft edge
        in_float64[i] |= edge > 0 and c[2] - reach < near + P.CUT * reach
        if c[2] + reach <= near:
            continue
        if biggest > P.FLOAT32_MAX:
            if m > 1.0:
                status[i] = P.NON_FINITE  # a scale or weight beyond float32
            continue  # so small against its distance that no pixel centre can hit it
        span = spans[i]
        span[P.SKEW], span[P.XC], span[P.YC], span[P.HX], span[P.HY] = 0.0, 0.0, 0.0, P.UNBOUNDED, P.UNBOUNDED
        x0, x1, y0, y1 = 0.0, float(view.width), 0.0, float(view.height)
        if c[2] - reach > 1e-3 * reach:  # wholly in front of the camera plane: the silhouette is an ellipse
            s22 = szz / (m * m)
            square = _visible_square(most, _longest_half_chord(c, m, reach, row, view, e0, ex, ey), edge, least)
            if square == 0.0:
                continue
            x0, x1 = _silhouette_screen_extent(c, m, B, axes, view.fx, view.cx, 0, s22, square)
            y0, y1 = _silhouette_screen_extent(c, m, B, axes, view.fy, view.cy, 1, s22, square)
            x0, x1 = max(0.0, np.ceil(x0 - 0.5)), min(float(view.width), np.floor(x1 - 0.5) + 1)
            y0, y1 = max(0.0, np.ceil(y0 - 0.5)), min(float(view.height), np.floor(y1 - 0.5) + 1)
            # |r e|^2 - |x x e|^2 > 0 is a quadratic in (du, dv); per row: centre XC + SKEW (dv - YC), half width by HX,
            # HY
            _cross_product(xa, e0, k0)
            _cross_product(xa, ex, ka)
            _cross_product(ex, e0, tmp)
            for j in range(3):
                ka[j] += tc * tmp[j]
            _cross_product(xa, ey, kb)
            _cross_product(ey, e0, tmp)
            for j in range(3):
                kb[j] += tc * tmp[j]
            q0 = square * _dot_product(e0, e0) - _dot_product(k0, k0)
            q1 = square * _dot_product(e0, ex) - _dot_product(k0, ka)
            q2 = square * _dot_product(e0, ey) - _dot_product(k0, kb)
            q3 = square * _dot_product(ex, ex) - _dot_product(ka, ka)
            q4 = square * _dot_product(ex, ey) - _dot_product(ka, kb)
            q5 = square * _dot_product(ey, ey) - _dot_product(kb, kb)
            d0, d1, d2 = q1 * q1 - q3 * q0, q1 * q4 - q3 * q2, q4 * q4 - q3 * q5
            if q3 < 0.0 and d2 < 0.0:
                yc = -d1 / d2
                peak = d0 + d1 * yc
                if peak > 0.0:
                    span[P.SKEW], span[P.XC], span[P.YC] = -q4 / q3, -(q1 + q4 * yc) / q3, yc
                    span[P.HX], span[P.HY] = np.sqrt(peak) / -q3, np.sqrt(-peak / d2)
                    # the pixel offsets that meet the silhouette on the screen
                    tall = min(abs(yc) + span[P.HY], max(abs(0.5 - row[P.UY]), abs(view.height - 0.5 - row[P.UY])))
                    broad = abs(span[P.XC]) + abs(span[P.SKEW]) * (abs(yc) + span[P.HY]) + span[P.HX]
                    broad = min(broad, max(abs(0.5 - row[P.UX]), abs(view.width - 0.5 - row[P.UX])))
                    # what sliding the origin leaves over, s G, and the two terms of the closest point: across a slanted
                    # needle each is many radii of its thin axis, and they cancel
                    slide = abs(row[P.TU]) * broad + abs(row[P.TV]) * tall
                    reached = np.sqrt(_dot_product(ex, ex)) * broad + np.sqrt(_dot_product(ey, ey)) * tall
                    in_float64[i] |= slide * reached > P.FLOAT64_RADII
                    for a in range(3):
                        in_float64[i] |= abs(row[P.XU + a]) * broad + abs(row[P.XV + a]) * tall > P.FLOAT64_RADII
        if in_float64[i]:  # the float64 rows do not slide
            for a in range(3):
                rows[i, P.XU + a], rows[i, P.XV + a] = tc * ex[a], tc * ey[a]
            rows[i, P.TU], rows[i, P.TV] = 0.0, 0.0
        if x1 > x0 and y1 > y0:
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = int(x0), int(y0), int(x1), int(y1)
            status[i] = P.VISIBLE
    release_array(memory)


@exact_kernel
def prepare_backward(start, stop, parameters, view, projected, grads, touched, out, g_view):  # type: ignore[no-untyped-def]
    """Chain rule from gradient rows to parameters, for the ``touched`` primitives among ``start:stop``.

    Fills ``out`` (:class:`PrimitiveArrays`, float32) and ``g_view`` (N, 3, 4), each one's part of dL/d(R | t); empty:
    unwanted.
    """
    view = borrow_arrays(view)
    means, log_scales, quats, W1, _, _, _ = borrow_arrays(parameters)
    g_means, g_log_scales, g_quats, g_W1, g_b1, g_w2, g_b2 = out
    rows, order, R, turns, K = projected.rows, projected.order, view.R, view.turns, W1.shape[1]
    local, B, A = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    gA, gB, gL = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    axes, c, anchor, ref, w = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    gc, gl, gq, q = np.empty(3), np.empty(3), np.empty(4), np.empty(4)
    fx, fy, cx, cy = view.fx, view.fy, view.cx, view.cy
    for i in range(start, stop):
        if not touched[i]:
            continue
        g = grads[i]
        m, inverse = project_primitive_frame(means[i], log_scales[i], quats[i], view, local, B, axes, c, anchor)
        tc = anchor[0] / m
        ref[0], ref[1], ref[2] = (anchor[1] - cx) / fx, (anchor[2] - cy) / fy, 1.0
        for j in range(3):
            w[j] = tc * ref[j] - c[j] / m
            gc[j] = 0.0
        for a in range(3):
            gx = np.float64(g[P.XA + a])
            row_sum = 0.0
            for j in range(3):
                A[a, j] = B[j, a] / axes[a]
                gA[a, j] = g[P.E0 + a] * ref[j] + gx * w[j]
            gA[a, 0] += g[P.EX + a] / fx
            gA[a, 1] += g[P.EY + a] / fy
            for j in range(3):
                gB[j, a] = gA[a, j] / axes[a]
                row_sum += gA[a, j] * A[a, j]
                gc[j] -= A[a, j] * gx / m
            gl[a] = -row_sum  # A scales with 1/s_a
        log_m = -np.float64(g[P.G_LOG_M])  # the density's own 1/m
        for a in range(3):
            for j in range(3):
                gL[a, j] = 0.0
        for n in range(K):
            k, o, og = order[i, n], P.NEURONS + P.PER_NEURON * n, P.G_NEURONS + P.PER_NEURON * n
            for j in range(3):
                gw = np.float64(g[og + P.WX + j])
                gl[j] += gw * rows[i, o + P.WX + j]  # W on whitened axes scales with s_j/m
                log_m -= gw * rows[i, o + P.WX + j]
                for a in range(3):
                    gL[a, j] += turns * axes[j] * W1[i, k, a] * gw
            for a in range(3):
                g_W1[i, k, a] = turns * (
                    g[og + P.WX] * axes[0] * local[a, 0]
                    + g[og + P.WY] * axes[1] * local[a, 1]
                    + g[og + P.WZ] * axes[2] * local[a, 2]
                )
            g_b1[i, k] = turns * g[og + P.PHASE]
            g_w2[i, k] = g[og + P.AMPLITUDE]
        g_b2[i] = g[P.G_OFFSET]
        first = 0
        for j in range(1, 3):
            if log_scales[i, j] > log_scales[i, first]:
                first = j
        gl[first] += log_m
        for a in range(3):
            g_log_scales[i, a] = gl[a]
            g_means[i, a] = R[0, a] * gc[0] + R[1, a] * gc[1] + R[2, a] * gc[2]
            for j in range(3):  # B = R local
                gL[a, j] += R[0, a] * gB[0, j] + R[1, a] * gB[1, j] + R[2, a] * gB[2, j]
        for j in range(4):
            q[j] = quats[i, j]
        ellipsoid_rotation_backward(q, inverse, gL, gq)
        for j in range(4):
            g_quats[i, j] = gq[j]
        if g_view.shape[0] > 0:
            for a in range(3):
                for j in range(3):
                    value = gc[a] * means[i, j]
                    for b in range(3):
                        value += gB[a, b] * local[j, b]
                    g_view[i, a, j] = value
                g_view[i, a, 3] = gc[a]
