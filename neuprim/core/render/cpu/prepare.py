"""The per-primitive stage, in float64: anchors, whitening, exact bounds; and its hand-written backward.

Precision is won here. Each primitive is anchored at its own projected centre, so that whitened rays are affine in the
pixel offset and float32 never sees the distance to the camera (method: "Line integral").

The anchor (depth, pixel) and the unit of t are constants of the frame: the image does not depend on their choice, so
they carry no gradient.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import exact_kernel, strict
from neuprim.core.model.rotation import rotation, rotation_backward
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.limits import (
    ANCHOR_RADII,
    CULLED,
    CUT,
    FLOAT32_MAX,
    FLOAT64_ANCHOR,
    FLOAT64_PIXELS,
    FLOAT64_RADII,
    FLOAT64_RATIO,
    FLOAT64_RATIO_NEAR,
    FLOAT64_TURNS,
    NON_FINITE,
    VISIBLE,
)
from neuprim.core.render.cpu.seen import seen_square, too_faint

__all__ = [
    "CULLED",
    "FLOAT64_TURNS",
    "NON_FINITE",
    "VISIBLE",
    "prepare",
    "prepare_backward",
    "prepare_wide",
]


@strict
def _cross(a, b, out):  # type: ignore[no-untyped-def]
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@strict
def _dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@strict
def _frame(mean, log_scale, quat, R, t, cam, near, local, B, axes, c, anchor):  # type: ignore[no-untyped-def]
    """Fill camera-axes orientation B, axes s/m, centre c and the anchor (depth, pixel x, pixel y); returns (m, 1/|q|).

    The anchor is rounded to float32 *before* it is used, so that the pixel kernels subtract exactly the same number.
    """
    n = rotation(quat, local)
    top = max(np.float64(log_scale[0]), np.float64(log_scale[1]), np.float64(log_scale[2]))
    m = np.exp(top)
    for i in range(3):
        axes[i] = np.exp(np.float64(log_scale[i]) - top)
        c[i] = R[i, 0] * mean[0] + R[i, 1] * mean[1] + R[i, 2] * mean[2] + t[i]
        for j in range(3):
            B[i, j] = R[i, 0] * local[0, j] + R[i, 1] * local[1, j] + R[i, 2] * local[2, j]
    fx, fy, cx, cy = cam[0], cam[1], cam[2], cam[3]
    if c[2] > ANCHOR_RADII * m and c[2] + m > near:
        anchor[0] = m * np.float64(np.float32(c[2] / m))
        anchor[1] = np.float64(np.float32(fx * c[0] / c[2] + cx))
        anchor[2] = np.float64(np.float32(fy * c[1] / c[2] + cy))
    else:  # the centre is near or behind the camera, or nothing is seen of it: anchor at the camera itself
        anchor[0] = 0.0
        anchor[1] = np.float64(np.float32(cx))
        anchor[2] = np.float64(np.float32(cy))
    return m, n


@strict
def _wide_row(i, means, log_scales, quats, W1, b1, w2, b2, R, t, cam, near, turns, work, waves, rate, order, row):  # type: ignore[no-untyped-def]
    """Fill the float64 kernel row of primitive ``i`` and ``order[i]``; returns (m, whether all is finite, largest
    number).

    ``work`` (10, 3): scratch, of which rows 0..2 return B, 3 the axes s/m, 4 the centre in camera axes. ``waves`` (K,
    4): scratch.
    ``rate`` (K,) returns the neurons' rates, rising.
    """
    K = W1.shape[1]
    B, axes, c, local, anchor, w = work[0:3], work[3], work[4], work[5:8], work[8], work[9]
    fx, fy, cx, cy = cam[0], cam[1], cam[2], cam[3]
    m, _ = _frame(means[i], log_scales[i], quats[i], R, t, cam, near, local, B, axes, c, anchor)
    tc = anchor[0] / m
    u, v = (anchor[1] - cx) / fx, (anchor[2] - cy) / fy
    w[0], w[1], w[2] = tc * u - c[0] / m, tc * v - c[1] / m, tc - c[2] / m
    biggest, total, aa, xe, ye = 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(3):
        A0, A1, A2 = B[0, a] / axes[a], B[1, a] / axes[a], B[2, a] / axes[a]  # m S^-1 B^T
        e0, ex, ey, xa = A0 * u + A1 * v + A2, A0 / fx, A1 / fy, A0 * w[0] + A1 * w[1] + A2 * w[2]
        row[L.E0 + a], row[L.EX + a], row[L.EY + a], row[L.XA + a] = e0, ex, ey, xa
        aa, xe, ye = aa + e0 * e0, xe + ex * e0, ye + ey * e0
        biggest = max(biggest, abs(xa), abs(e0))
        total += e0 + ex + ey + xa
    tu, tv = -tc * xe / aa, -tc * ye / aa
    for a in range(3):
        row[L.XU + a], row[L.XV + a] = tc * row[L.EX + a] + tu * row[L.E0 + a], tc * row[L.EY + a] + tv * row[L.E0 + a]
    row[L.TC], row[L.TU], row[L.TV], row[L.UX], row[L.UY] = tc, tu, tv, anchor[1], anchor[2]
    row[L.NEAR], row[L.OFFSET], row[L.UNIT], row[L.ANCHOR_Z] = (near - anchor[0]) / m, b2[i], m, anchor[0]
    biggest = max(biggest, tc, abs(row[L.NEAR]), m, abs(row[L.OFFSET]))
    total += tc + row[L.NEAR] + m + row[L.OFFSET]
    for k in range(K):
        waves[k, 0] = (
            turns * axes[0] * (W1[i, k, 0] * local[0, 0] + W1[i, k, 1] * local[1, 0] + W1[i, k, 2] * local[2, 0])
        )
        waves[k, 1] = (
            turns * axes[1] * (W1[i, k, 0] * local[0, 1] + W1[i, k, 1] * local[1, 1] + W1[i, k, 2] * local[2, 1])
        )
        waves[k, 2] = (
            turns * axes[2] * (W1[i, k, 0] * local[0, 2] + W1[i, k, 1] * local[1, 2] + W1[i, k, 2] * local[2, 2])
        )
        speed = np.sqrt(waves[k, 0] * waves[k, 0] + waves[k, 1] * waves[k, 1] + waves[k, 2] * waves[k, 2])
        waves[k, 3] = speed
        biggest = max(biggest, speed, abs(np.float64(w2[i, k])))
        total += speed + turns * np.float64(b1[i, k]) + w2[i, k]
    for k in range(K):
        at, speed = (
            np.int64(0),
            waves[k, 3],
        )  # counting the slower ones sorts without a branch; neurons as fast keep their order
        for j in range(K):
            at += np.int64((waves[j, 3] < speed) | ((waves[j, 3] == speed) & (j < k)))
        o, phase = L.NEURONS + L.PER_NEURON * at, turns * np.float64(b1[i, k])
        rate[at], order[i, at] = speed, k
        row[o + L.WX], row[o + L.WY], row[o + L.WZ] = waves[k, 0], waves[k, 1], waves[k, 2]
        row[o + L.PHASE], row[o + L.AMPLITUDE] = phase - np.rint(phase), w2[i, k]
    return m, np.isfinite(total), biggest


@strict
def _are_finite(i, means, log_scales, quats, W1, b1, most):  # type: ignore[no-untyped-def]
    """Whether the numbers of a primitive that is not drawn are finite, ``most`` for its amplitudes, and its quaternion
    a rotation."""
    total, square = most, np.float64(0.0)
    for a in range(3):
        total += np.float64(means[i, a]) + np.float64(log_scales[i, a])
    for a in range(4):
        square += np.float64(quats[i, a]) * np.float64(quats[i, a])
    for k in range(W1.shape[1]):
        total += np.float64(W1[i, k, 0]) + np.float64(W1[i, k, 1]) + np.float64(W1[i, k, 2]) + np.float64(b1[i, k])
    return np.isfinite(total + 1.0 / square)


@strict
def _extent(c, m, B, axes, cam, axis, s22, square):  # type: ignore[no-untyped-def]
    """Where the silhouette of the ellipsoid that is ``square`` ** 0.5 times as large begins and ends along an axis of
    the screen, in pixels.

    In units of m: tangents (k +- sqrt(D))/(z^2 - S_zz), see projection.screen_boxes; ``s22``: S_zz of the whole
    ellipsoid.
    """
    z, ci, szz = c[2] / m, c[axis] / m, square * s22
    sii = square * ((B[axis, 0] * axes[0]) ** 2 + (B[axis, 1] * axes[1]) ** 2 + (B[axis, 2] * axes[2]) ** 2)
    siz = square * (
        B[axis, 0] * B[2, 0] * axes[0] ** 2 + B[axis, 1] * B[2, 1] * axes[1] ** 2 + B[axis, 2] * B[2, 2] * axes[2] ** 2
    )
    D = z * z * sii - 2 * ci * z * siz + ci * ci * szz - (sii * szz - siz * siz)
    root, mid, den = np.sqrt(max(D, 0.0)), ci * z - siz, z * z - szz
    return cam[axis] * (mid - root) / den + cam[2 + axis], cam[axis] * (mid + root) / den + cam[2 + axis]


@strict
def _longest(c, m, reach, row, cam, e0, ex, ey):  # type: ignore[no-untyped-def]
    """A bound of the half chords of all rays that meet the ellipsoid, in units of its longest semi-axis; at most that,
    1.

    A ray's direction is e on whitened axes, and m / |e| its half chord through the centre. No point of the ellipsoid is
    farther than m from the centre, which bounds how far a ray's slopes are from the centre's.
    """
    if row[L.TC] == 0.0:  # the anchor is not the centre
        return 1.0
    u, v, wide = abs(c[0] / c[2]), abs(c[1] / c[2]), m / (c[2] - reach)
    du, dv = wide * (1.0 + u), wide * (1.0 + v)
    least = np.sqrt(_dot(e0, e0)) - cam[0] * du * np.sqrt(_dot(ex, ex)) - cam[1] * dv * np.sqrt(_dot(ey, ey))
    most = np.sqrt(1.0 + (u + du) ** 2 + (v + dv) ** 2)
    return most / least if least > most else 1.0


@exact_kernel
def prepare_wide(start, stop, which, means, log_scales, quats, W1, b1, w2, b2, R, t, cam, near, turns, order, wide):  # type: ignore[no-untyped-def]
    """float64 rows of primitives ``which[start:stop]``, which the pixel stage draws in float64."""
    work, waves, rate = np.empty((10, 3)), np.empty((W1.shape[1], 4)), np.empty(W1.shape[1])
    for n in range(start, stop):
        wide[n, :] = 0.0
        _wide_row(
            which[n],
            means,
            log_scales,
            quats,
            W1,
            b1,
            w2,
            b2,
            R,
            t,
            cam,
            near,
            turns,
            work,
            waves,
            rate,
            order,
            wide[n],
        )


@exact_kernel
def prepare(  # type: ignore[no-untyped-def]
    start, stop, means, log_scales, quats, W1, b1, w2, b2, R, t, cam, size, near, turns, edge, least,
    rows, spans, kinds, order, boxes, depth, status, in_float64,
):  # fmt: skip
    """Fill kernel rows, silhouette spans, pixel boxes, view depths and status of primitives ``start:stop``.

    cam = (fx, fy, cx, cy); size = (width, height); turns = omega0 / 2 pi. Neurons are stored by rising rate: ``order[i,
    k]`` is the model's index of row neuron k, ``kinds[i, m]`` the range of rates (SLOW, MEDIUM, FAST) of row neurons 2m
    and 2m + 1.
    ``in_float64[i]`` says that float32 is not enough for the primitive's pixels (see :func:`prepare_wide`). ``least``:
    the optical depth below which nothing is drawn; silhouettes are those of the rays that can reach it
    (:mod:`~neuprim.core.render.cpu.seen`), and of a primitive that cannot anywhere nothing is filled but its status, an
    empty box and a depth of 0.
    """
    K = W1.shape[1]
    work, waves, rate, row = np.empty((10, 3)), np.empty((K, 4)), np.empty(K), np.zeros(rows.shape[1])
    B, axes, c, e0, ex, ey, xa = (
        work[0:3],
        work[3],
        work[4],
        row[L.E0 : L.EX],
        row[L.EX : L.EY],
        row[L.EY : L.XA],
        row[L.XA : L.XU],
    )
    k0, ka, kb, tmp = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(start, stop):
        most = np.float64(b2[i])
        for k in range(K):
            most += abs(np.float64(w2[i, k]))
        if too_faint(most, edge, least):  # whatever its place
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, 0, 0, 0
            in_float64[i], depth[i] = False, 0.0
            status[i] = CULLED if _are_finite(i, means, log_scales, quats, W1, b1, most) else NON_FINITE
            continue
        m, finite, biggest = _wide_row(
            i, means, log_scales, quats, W1, b1, w2, b2, R, t, cam, near, turns, work, waves, rate, order, row
        )
        for n in range(kinds.shape[1]):
            fastest = rate[min(2 * n + 1, K - 1)]
            kinds[i, n] = L.SLOW if fastest < L.SLOW_TURNS else (L.MEDIUM if fastest < L.MEDIUM_TURNS else L.FAST)
        for j in range(row.shape[0]):
            rows[i, j] = row[j]
        tc = row[L.TC]
        in_float64[i] = (K > 0 and rate[K - 1] > FLOAT64_TURNS) or max(abs(row[L.UX]), abs(row[L.UY])) > FLOAT64_PIXELS
        in_float64[i] |= _dot(xa, xa) > FLOAT64_ANCHOR**2  # centre far from the anchor, in the thinnest axis
        thinnest = min(axes[0], axes[1], axes[2])
        in_float64[i] |= thinnest * (FLOAT64_RATIO_NEAR if tc == 0.0 else FLOAT64_RATIO) < 1.0
        depth[i] = c[2]
        boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = 0, 0, 0, 0
        if not finite:
            status[i] = NON_FINITE
            continue
        status[i] = CULLED
        szz = m * m * ((B[2, 0] * axes[0]) ** 2 + (B[2, 1] * axes[1]) ** 2 + (B[2, 2] * axes[2]) ** 2)
        reach = np.sqrt(szz)
        in_float64[i] |= (
            edge > 0 and c[2] - reach < near + CUT * reach
        )  # only there are integrals of cut chords with a soft edge
        if c[2] + reach <= near:
            continue
        if biggest > FLOAT32_MAX:
            if m > 1.0:
                status[i] = NON_FINITE  # a scale or weight beyond float32
            continue  # so small against its distance that no pixel centre can hit it
        span = spans[i]
        span[L.SKEW], span[L.XC], span[L.YC], span[L.HX], span[L.HY] = 0.0, 0.0, 0.0, L.UNBOUNDED, L.UNBOUNDED
        x0, x1, y0, y1 = 0.0, float(size[0]), 0.0, float(size[1])
        if c[2] - reach > 1e-3 * reach:  # wholly in front of the camera plane: the silhouette is an ellipse
            s22 = szz / (m * m)
            square = seen_square(most, _longest(c, m, reach, row, cam, e0, ex, ey), edge, least)
            if square == 0.0:
                continue
            (x0, x1), (y0, y1) = (
                _extent(c, m, B, axes, cam, 0, s22, square),
                _extent(c, m, B, axes, cam, 1, s22, square),
            )
            x0, x1 = max(0.0, np.ceil(x0 - 0.5)), min(float(size[0]), np.floor(x1 - 0.5) + 1)
            y0, y1 = max(0.0, np.ceil(y0 - 0.5)), min(float(size[1]), np.floor(y1 - 0.5) + 1)
            # |r e|^2 - |x x e|^2 > 0 is a quadratic in (du, dv); per row: centre XC + SKEW (dv - YC), half width from
            # (HX, HY)
            _cross(xa, e0, k0)
            _cross(xa, ex, ka)
            _cross(ex, e0, tmp)
            for j in range(3):
                ka[j] += tc * tmp[j]
            _cross(xa, ey, kb)
            _cross(ey, e0, tmp)
            for j in range(3):
                kb[j] += tc * tmp[j]
            q0, q1, q2 = (
                square * _dot(e0, e0) - _dot(k0, k0),
                square * _dot(e0, ex) - _dot(k0, ka),
                square * _dot(e0, ey) - _dot(k0, kb),
            )
            q3, q4, q5 = (
                square * _dot(ex, ex) - _dot(ka, ka),
                square * _dot(ex, ey) - _dot(ka, kb),
                square * _dot(ey, ey) - _dot(kb, kb),
            )
            d0, d1, d2 = q1 * q1 - q3 * q0, q1 * q4 - q3 * q2, q4 * q4 - q3 * q5
            if q3 < 0.0 and d2 < 0.0:
                yc = -d1 / d2
                peak = d0 + d1 * yc
                if peak > 0.0:
                    span[L.SKEW], span[L.XC], span[L.YC] = -q4 / q3, -(q1 + q4 * yc) / q3, yc
                    span[L.HX], span[L.HY] = np.sqrt(peak) / -q3, np.sqrt(-peak / d2)
                    # the pixel offsets that meet the silhouette on the screen
                    tall = min(abs(yc) + span[L.HY], max(abs(0.5 - row[L.UY]), abs(size[1] - 0.5 - row[L.UY])))
                    broad = abs(span[L.XC]) + abs(span[L.SKEW]) * (abs(yc) + span[L.HY]) + span[L.HX]
                    broad = min(broad, max(abs(0.5 - row[L.UX]), abs(size[0] - 0.5 - row[L.UX])))
                    # what sliding the origin leaves over, s G, and the two terms of the closest point: across a slanted
                    # needle
                    # each is many radii of its thin axis, and they cancel
                    slide = abs(row[L.TU]) * broad + abs(row[L.TV]) * tall
                    in_float64[i] |= (
                        slide * (np.sqrt(_dot(ex, ex)) * broad + np.sqrt(_dot(ey, ey)) * tall) > FLOAT64_RADII
                    )
                    for a in range(3):
                        in_float64[i] |= abs(row[L.XU + a]) * broad + abs(row[L.XV + a]) * tall > FLOAT64_RADII
        if in_float64[i]:  # the float64 rows do not slide
            for a in range(3):
                rows[i, L.XU + a], rows[i, L.XV + a] = tc * ex[a], tc * ey[a]
            rows[i, L.TU], rows[i, L.TV] = 0.0, 0.0
        if x1 > x0 and y1 > y0:
            boxes[i, 0], boxes[i, 1], boxes[i, 2], boxes[i, 3] = int(x0), int(y0), int(x1), int(y1)
            status[i] = VISIBLE


@exact_kernel
def prepare_backward(  # type: ignore[no-untyped-def]
    start, stop, means, log_scales, quats, W1, R, t, cam, near, turns, rows, order, grads, touched,
    g_means, g_log_scales, g_quats, g_W1, g_b1, g_w2, g_b2, g_view, want_view,
):  # fmt: skip
    """Chain rule from gradient rows to parameters, for primitives ``start:stop``.

    With ``want_view`` it also fills ``g_view`` (N, 3, 4), each primitive's part of dL/d(R | t); rows that are not
    ``touched`` stay as they are.
    """
    K = W1.shape[1]
    local, B, A, gA, gB, gL = (
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
    )
    axes, c, anchor, ref, w = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    gc, gl, gq, q = np.empty(3), np.empty(3), np.empty(4), np.empty(4)
    fx, fy, cx, cy = cam[0], cam[1], cam[2], cam[3]
    for i in range(start, stop):
        if not touched[i]:
            continue
        g = grads[i]
        m, inverse = _frame(means[i], log_scales[i], quats[i], R, t, cam, near, local, B, axes, c, anchor)
        tc = anchor[0] / m
        ref[0], ref[1], ref[2] = (anchor[1] - cx) / fx, (anchor[2] - cy) / fy, 1.0
        for j in range(3):
            w[j] = tc * ref[j] - c[j] / m
            gc[j] = 0.0
        for a in range(3):
            gx = np.float64(g[L.XA + a])
            row_sum = 0.0
            for j in range(3):
                A[a, j] = B[j, a] / axes[a]
                gA[a, j] = g[L.E0 + a] * ref[j] + gx * w[j]
            gA[a, 0] += g[L.EX + a] / fx
            gA[a, 1] += g[L.EY + a] / fy
            for j in range(3):
                gB[j, a] = gA[a, j] / axes[a]
                row_sum += gA[a, j] * A[a, j]
                gc[j] -= A[a, j] * gx / m
            gl[a] = -row_sum  # A scales with 1/s_a
        log_m = -np.float64(g[L.G_LOG_M])  # the density's own 1/m
        for a in range(3):
            for j in range(3):
                gL[a, j] = 0.0
        for n in range(K):
            k, o, og = order[i, n], L.NEURONS + L.PER_NEURON * n, L.G_NEURONS + L.PER_NEURON * n
            for j in range(3):
                gw = np.float64(g[og + L.WX + j])
                gl[j] += gw * rows[i, o + L.WX + j]  # W on whitened axes scales with s_j/m
                log_m -= gw * rows[i, o + L.WX + j]
                for a in range(3):
                    gL[a, j] += turns * axes[j] * W1[i, k, a] * gw
            for a in range(3):
                g_W1[i, k, a] = turns * (
                    g[og + L.WX] * axes[0] * local[a, 0]
                    + g[og + L.WX + 1] * axes[1] * local[a, 1]
                    + g[og + L.WX + 2] * axes[2] * local[a, 2]
                )
            g_b1[i, k] = turns * g[og + L.PHASE]
            g_w2[i, k] = g[og + L.AMPLITUDE]
        g_b2[i] = g[L.G_OFFSET]
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
        rotation_backward(q, inverse, gL, gq)
        for j in range(4):
            g_quats[i, j] = gq[j]
        if want_view:
            for a in range(3):
                for j in range(3):
                    value = gc[a] * means[i, j]
                    for b in range(3):
                        value += gB[a, b] * local[j, b]
                    g_view[i, a, j] = value
                g_view[i, a, 3] = gc[a]
