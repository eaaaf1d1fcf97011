# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""The per-primitive stage, one thread a primitive, float64 inside: the twin of :mod:`neuprim.core.render.cpu.prepare`.

Rows are float4 with the colours in them, and neurons stay in the model's order. It also counts each primitive's tiles.
"""

import functools
from typing import Any

from neuprim.core.compute.warp import Bools, Bytes, Doubles, Doubles2d, Floats2d, Ints, Ints2d, Vec4is, Vec4s2d, wp
from neuprim.core.model.edge import NORMS
from neuprim.core.render import layout as W
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.binning import silhouette_ellipse, tile_range
from neuprim.core.render.cuda.projection import (
    EXACT,
    ProjectedPrimitive,
    Ray,
    View,
    load_projection_view,
    project_primitive,
    round_projected_to_float32,
    whiten_rays,
)

d, f = wp.float64, wp.float32
_VISIBLE, _CULLED, _NON_FINITE = (
    wp.constant(wp.uint8(W.VISIBLE)),
    wp.constant(wp.uint8(W.CULLED)),
    wp.constant(wp.uint8(W.NON_FINITE)),
)
_FLOAT32_MAX, _CUT = wp.constant(d(W.FLOAT32_MAX)), wp.constant(d(W.CUT))
_RADII, _TURNS = wp.constant(d(W.FLOAT64_RADII)), wp.constant(d(W.FLOAT64_TURNS))
_ANCHOR, _PIXELS = wp.constant(d(W.FLOAT64_ANCHOR**2)), wp.constant(d(W.FLOAT64_PIXELS))
_RATIO, _RATIO_NEAR = wp.constant(d(W.FLOAT64_RATIO)), wp.constant(d(W.FLOAT64_RATIO_NEAR))
_UNBOUNDED = wp.constant(d(W.UNBOUNDED))
_E0, _EX, _EY, _XA, _XU, _XV, _REST, _NEURONS = L.E0, L.EX, L.EY, L.XA, L.XU, L.XV, L.REST, L.NEURONS
_TILE = L.TILE
(_N0, _N1, _N2), (_P0, _P1, _P2), (_W0, _W1, _W2) = (
    [wp.constant(d(number)) for number in numbers] for numbers in (NORMS, W.RIM_POWERS, W.MIN_RIM_SHARES)
)

_STORE = """
#if defined(__CUDA_ARCH__)
    *reinterpret_cast<float4*>(wp::address(rows, i, j)) = make_float4(x, y, z, w);
#else
    *wp::address(rows, i, j) = wp::vec_t<4, float>(x, y, z, w);
#endif
"""


@wp.func_native(_STORE)
def store_float4(rows: Vec4s2d, i: int, j: int, x: float, y: float, z: float, w: float): ...


@wp.func
def _store_vector(rows: Vec4s2d, i: int, j: int, v: wp.vec3d, scalar: wp.float64):
    """16 bytes at once: Warp's own store of a vector is four."""
    store_float4(rows, i, j, f(v[0]), f(v[1]), f(v[2]), f(scalar))


@wp.func
def _largest_ray_component(v: wp.vec3d):
    return wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))


@wp.func
def _projected_covariance(p: ProjectedPrimitive, i: int, j: int):
    """Entry (i, j) of the covariance in camera axes, in units of m^2."""
    return wp.dot(wp.cw_mul(p.B[i], p.B[j]), wp.cw_mul(p.axes, p.axes))


@wp.func
def _silhouette_screen_extent(p: ProjectedPrimitive, v: View, axis: int, s22: wp.float64, square: wp.float64):
    """Where the silhouette, ``square`` ** 0.5 times as large, begins and ends along a screen axis, in pixels."""
    z, ci, szz = p.centre[2] / p.m, p.centre[axis] / p.m, square * s22
    sii, siz = square * _projected_covariance(p, axis, axis), square * _projected_covariance(p, axis, 2)
    D = z * z * sii - d(2.0) * ci * z * siz + ci * ci * szz - (sii * szz - siz * siz)
    root, mid, den = wp.sqrt(wp.max(D, d(0.0))), ci * z - siz, z * z - szz
    return wp.vec2d(
        v.focal[axis] * (mid - root) / den + v.centre[axis], v.focal[axis] * (mid + root) / den + v.centre[axis]
    )


@wp.struct
class SilhouetteSpans:
    """A silhouette's row spans; whether it is an ellipse, and too coarse for float32."""

    skew: wp.float64
    xc: wp.float64
    yc: wp.float64
    hx: wp.float64
    hy: wp.float64
    in_float64: wp.int32


@wp.func
def _silhouette_spans(p: ProjectedPrimitive, r: Ray, width: int, height: int, square: wp.float64):
    """|r e|^2 - |x x e|^2 > 0, r^2 = ``square``, as row spans: centre XC + SKEW (dv - YC), half width from (HX, HY)."""
    o = SilhouetteSpans()
    o.hx = _UNBOUNDED
    o.hy = _UNBOUNDED
    k0 = wp.cross(r.xa, r.e0)
    ka = wp.cross(r.xa, r.ex) + r.tc * wp.cross(r.ex, r.e0)
    kb = wp.cross(r.xa, r.ey) + r.tc * wp.cross(r.ey, r.e0)
    q0, q1 = square * wp.dot(r.e0, r.e0) - wp.dot(k0, k0), square * wp.dot(r.e0, r.ex) - wp.dot(k0, ka)
    q2, q3 = square * wp.dot(r.e0, r.ey) - wp.dot(k0, kb), square * wp.dot(r.ex, r.ex) - wp.dot(ka, ka)
    q4, q5 = square * wp.dot(r.ex, r.ey) - wp.dot(ka, kb), square * wp.dot(r.ey, r.ey) - wp.dot(kb, kb)
    d0, d1, d2 = q1 * q1 - q3 * q0, q1 * q4 - q3 * q2, q4 * q4 - q3 * q5
    if q3 < d(0.0) and d2 < d(0.0):
        yc = -d1 / d2
        peak = d0 + d1 * yc
        if peak > d(0.0):
            o.skew = round_projected_to_float32(-q4 / q3)
            o.xc = round_projected_to_float32(-(q1 + q4 * yc) / q3)
            o.yc = round_projected_to_float32(yc)
            o.hx = round_projected_to_float32(wp.sqrt(peak) / -q3)
            o.hy = round_projected_to_float32(wp.sqrt(-peak / d2))
            # the pixel offsets that meet the silhouette on the screen
            ux, uy, half = p.anchor[1], p.anchor[2], d(0.5)
            tall = wp.min(wp.abs(yc) + o.hy, wp.max(wp.abs(half - uy), wp.abs(d(height) - half - uy)))
            broad = wp.abs(o.xc) + wp.abs(o.skew) * (wp.abs(yc) + o.hy) + o.hx
            broad = wp.min(broad, wp.max(wp.abs(half - ux), wp.abs(d(width) - half - ux)))
            # what sliding the origin leaves over, s G, and the two terms of the closest point: across a slanted needle
            # each is many radii of its thin axis, and they cancel
            slide = wp.abs(r.tu) * broad + wp.abs(r.tv) * tall
            if slide * (wp.sqrt(wp.dot(r.ex, r.ex)) * broad + wp.sqrt(wp.dot(r.ey, r.ey)) * tall) > _RADII:
                o.in_float64 = 1
            xu, xv = r.tc * r.ex + r.tu * r.e0, r.tc * r.ey + r.tv * r.e0
            for a in range(3):
                if wp.abs(xu[a]) * broad + wp.abs(xv[a]) * tall > _RADII:
                    o.in_float64 = 1
    return o


@wp.func
def _projected_frequency(w: wp.vec3d, p: ProjectedPrimitive, turns: wp.float64):
    """A neuron's frequencies on whitened axes, in turns."""
    t = wp.transpose(p.local) * w
    return wp.vec3d(turns * p.axes[0] * t[0], turns * p.axes[1] * t[1], turns * p.axes[2] * t[2])


@wp.func
def _longest_half_chord(p: ProjectedPrimitive, r: Ray, v: View, reach: wp.float64):
    """A bound, at most 1, of the half chords of all rays that meet the ellipsoid, in its longest semi-axes."""
    bound, one = d(1.0), d(1.0)
    if r.tc != d(0.0):
        z = p.centre[2]
        slope_x, slope_y, wide = wp.abs(p.centre[0] / z), wp.abs(p.centre[1] / z), p.m / (z - reach)
        du, dv = wide * (one + slope_x), wide * (one + slope_y)
        least = (
            wp.sqrt(wp.dot(r.e0, r.e0))
            - v.focal[0] * du * wp.sqrt(wp.dot(r.ex, r.ex))
            - v.focal[1] * dv * wp.sqrt(wp.dot(r.ey, r.ey))
        )
        most = wp.sqrt(one + (slope_x + du) * (slope_x + du) + (slope_y + dv) * (slope_y + dv))
        if least > most:
            bound = most / least
    return bound


@wp.func
def _chord_bound_by_edge(edge: int, hard: wp.float64, one: wp.float64, two: wp.float64):
    """An array would be a stack: its index is not known to the compiler."""
    number = hard
    if edge == 1:
        number = one
    if edge == 2:
        number = two
    return number


@wp.func
def _is_too_faint_to_draw(most: wp.float64, edge: int, least: wp.float64):
    """Whether no chord can reach the depth ``least``, however long."""
    return most <= d(0.0) or most * _chord_bound_by_edge(edge, _N0, _N1, _N2) <= least


@wp.func
def _visible_square(most: wp.float64, bound: wp.float64, edge: int, least: wp.float64):
    """r^2 of the visible extent: 1 for all of it, 0 for nothing. ``most``: b2 + sum |w2|, positive."""
    square, share = d(0.0), least / (most * _chord_bound_by_edge(edge, _N0, _N1, _N2) * bound)
    if share <= _chord_bound_by_edge(edge, _W0, _W1, _W2):
        square = d(1.0)
    elif share < d(1.0):
        square = round_projected_to_float32(d(1.0) - wp.exp(wp.log(share) * _chord_bound_by_edge(edge, _P0, _P1, _P2)))
    return square


@functools.cache
def project_primitives_kernel(double: bool) -> Any:
    """Fills rows, spans, boxes, depth, status and counts of every primitive; dim (N,).

    ``counts`` (2, N): tiles reached, and 1 where float32 is too coarse and something is seen. ``bad`` (1,): the first
    primitive that is not finite, colours included. ``least``: the optical depth below which nothing is drawn.
    """
    real, vec3, vec4 = (wp.float64, wp.vec3d, wp.vec4d) if double else (wp.float32, wp.vec3, wp.vec4)

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def prepare(
        means: wp.array(dtype=vec3), log_scales: wp.array(dtype=vec3), quats: wp.array(dtype=vec4),
        W1: wp.array2d(dtype=vec3), b1: wp.array2d(dtype=real), w2: wp.array2d(dtype=real), b2: wp.array(dtype=real),
        palette: Floats2d, forced: Bools, matrix: Doubles, intrinsics: wp.vec4d, width: int, height: int,
        near: wp.float64, turns: wp.float64, edge: int, least: wp.float64, neurons: int, channels: int,
        rows: Vec4s2d, spans: Vec4s2d, boxes: Vec4is, depth: Doubles, status: Bytes, counts: Ints2d, bad: Ints,
    ):  # fmt: skip
        i = wp.tid()
        most = d(b2[i])
        for k in range(neurons):
            most += d(wp.abs(w2[i, k]))
        if _is_too_faint_to_draw(most, edge, least):  # whatever its place
            state = int(_CULLED)
            given, turn = wp.vec3d(means[i]) + wp.vec3d(log_scales[i]), wp.vec4d(quats[i])
            given_sum = most + given[0] + given[1] + given[2] + d(1.0) / wp.dot(turn, turn)
            for k in range(neurons):
                given_sum += d(W1[i, k][0]) + d(W1[i, k][1]) + d(W1[i, k][2]) + d(b1[i, k])
            for c in range(channels):
                given_sum += d(palette[i, c])
            if not wp.isfinite(given_sum):
                state = int(_NON_FINITE)
                wp.atomic_min(bad, 0, i)
            boxes[i] = wp.vec4i()
            depth[i] = d(0.0)
            status[i] = wp.uint8(state)
            counts[0, i] = 0
            counts[1, i] = 0
            return
        v = load_projection_view(matrix, intrinsics, near)
        p = project_primitive(wp.vec3d(means[i]), wp.vec3d(log_scales[i]), wp.vec4d(quats[i]), v)
        r = whiten_rays(p, v)
        m, z, ux, uy = p.m, p.centre[2], p.anchor[1], p.anchor[2]
        offset = d(b2[i])
        biggest = wp.max(
            wp.max(_largest_ray_component(r.xa), _largest_ray_component(r.e0)),
            wp.max(wp.max(r.tc, wp.abs(r.near)), wp.max(m, wp.abs(offset))),
        )
        total = r.tc + r.near + m + offset
        for a in range(3):
            total += r.e0[a] + r.ex[a] + r.ey[a] + r.xa[a]
        fastest = d(0.0)
        for k in range(neurons):
            wave, phase, amplitude = (
                _projected_frequency(wp.vec3d(W1[i, k]), p, turns),
                turns * d(b1[i, k]),
                d(w2[i, k]),
            )
            speed = wp.sqrt(wp.dot(wave, wave))
            fastest = wp.max(fastest, speed)
            biggest = wp.max(biggest, wp.max(speed, wp.abs(amplitude)))
            total += speed + phase + amplitude
            _store_vector(rows, i, _NEURONS + k, wave, phase - wp.rint(phase))
        column = _NEURONS + neurons
        for q in range((neurons + 3) // 4):
            four = wp.vec4()
            for j in range(4):
                if 4 * q + j < neurons:
                    four[j] = f(w2[i, 4 * q + j])
            store_float4(rows, i, column + q, four[0], four[1], four[2], four[3])
        column += (neurons + 3) // 4
        for q in range((channels + 3) // 4):
            four = wp.vec4()
            for j in range(4):
                if 4 * q + j < channels:
                    four[j] = palette[i, 4 * q + j]
                    total += d(four[j])
            store_float4(rows, i, column + q, four[0], four[1], four[2], four[3])

        in_float64 = wp.int32(0)
        thinnest, ratio = wp.min(wp.min(p.axes[0], p.axes[1]), p.axes[2]), _RATIO
        if r.tc == d(0.0):
            ratio = _RATIO_NEAR
        # a centre far from the anchor, in the thinnest axis, among them
        if (
            fastest > _TURNS
            or wp.max(wp.abs(ux), wp.abs(uy)) > _PIXELS
            or wp.dot(r.xa, r.xa) > _ANCHOR
            or thinnest * ratio < d(1.0)
        ):
            in_float64 = 1
        if forced:
            if forced[i]:
                in_float64 = 1
        s22 = _projected_covariance(p, 2, 2)
        reach = wp.sqrt(m * m * s22)
        if edge > 0 and z - reach < near + _CUT * reach:  # only there are integrals of cut chords with a soft edge
            in_float64 = 1

        state, box, tiles = int(_CULLED), wp.vec4i(), wp.int32(0)
        o = SilhouetteSpans()
        if not wp.isfinite(total):
            state = int(_NON_FINITE)
        elif z + reach > near:
            if biggest > _FLOAT32_MAX:
                # so small against its distance that no pixel centre can hit it, or a scale or weight beyond float32
                if m > d(1.0):
                    state = int(_NON_FINITE)
            else:
                x0, x1, y0, y1 = d(0.0), d(width), d(0.0), d(height)
                o.hx = _UNBOUNDED
                o.hy = _UNBOUNDED
                if z - reach > d(1e-3) * reach:  # wholly in front of the camera plane: the silhouette is an ellipse
                    half, one, square = (
                        d(0.5),
                        d(1.0),
                        _visible_square(most, _longest_half_chord(p, r, v, reach), edge, least),
                    )
                    if square == d(0.0):
                        x1 = x0  # nothing can be seen of it
                    else:
                        across, down = (
                            _silhouette_screen_extent(p, v, 0, s22, square),
                            _silhouette_screen_extent(p, v, 1, s22, square),
                        )
                        x0, x1 = wp.max(x0, wp.ceil(across[0] - half)), wp.min(x1, wp.floor(across[1] - half) + one)
                        y0, y1 = wp.max(y0, wp.ceil(down[0] - half)), wp.min(y1, wp.floor(down[1] - half) + one)
                        o = _silhouette_spans(p, r, width, height, square)
                        if o.in_float64 > 0:
                            in_float64 = 1
                if x1 > x0 and y1 > y0:
                    box = wp.vec4i(int(x0), int(y0), int(x1), int(y1))
                    state = int(_VISIBLE)

        xu, xv, tu, tv = r.tc * r.ex, r.tc * r.ey, d(0.0), d(0.0)
        if in_float64 == 0:  # float64 does not slide
            xu, xv, tu, tv = xu + r.tu * r.e0, xv + r.tv * r.e0, d(r.tu), d(r.tv)
        if state != int(_VISIBLE):
            in_float64 = 0
        _store_vector(rows, i, _E0, r.e0, ux)
        _store_vector(rows, i, _EX, r.ex, uy)
        _store_vector(rows, i, _EY, r.ey, r.near)
        _store_vector(rows, i, _XA, r.xa, offset)
        _store_vector(rows, i, _XU, xu, tu)
        _store_vector(rows, i, _XV, xv, tv)
        store_float4(rows, i, _REST, f(r.tc), f(m), f(p.anchor[0]), f(in_float64))
        store_float4(spans, i, 0, f(o.skew), f(o.xc), f(o.yc), f(o.hx))
        store_float4(spans, i, 1, f(o.hy), f(0.0), f(0.0), f(0.0))
        boxes[i] = box
        depth[i] = z
        status[i] = wp.uint8(state)
        if state == int(_VISIBLE):
            e = silhouette_ellipse(spans[i, 0], spans[i, 1][0], f(ux), f(uy), box)
            for ty in range(box[1] // _TILE, (box[3] - 1) // _TILE + 1):
                lo_hi = tile_range(e, ty)
                tiles += wp.max(lo_hi[1] - lo_hi[0], 0)
        if state == int(_NON_FINITE):
            wp.atomic_min(bad, 0, i)
        counts[0, i] = tiles
        counts[1, i] = in_float64

    return prepare


@wp.func
def _store_wide_vector(wide: Doubles2d, n: int, column: int, v: wp.vec3d):
    for a in range(3):
        wide[n, column + a] = v[a]


@functools.cache
def wide_kernel(double: bool) -> Any:
    """Fills ``wide``, the float64 rows of primitives ``which``, which the pixel stage draws in float64; dim (M,)."""
    real, vec3, vec4 = (wp.float64, wp.vec3d, wp.vec4d) if double else (wp.float32, wp.vec3, wp.vec4)

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def prepare_wide(
        which: Ints, means: wp.array(dtype=vec3), log_scales: wp.array(dtype=vec3), quats: wp.array(dtype=vec4),
        W1: wp.array2d(dtype=vec3), b1: wp.array2d(dtype=real), w2: wp.array2d(dtype=real), b2: wp.array(dtype=real),
        matrix: Doubles, intrinsics: wp.vec4d, near: wp.float64, turns: wp.float64, neurons: int, wide: Doubles2d,
    ):  # fmt: skip
        n = wp.tid()
        i = which[n]
        v = load_projection_view(matrix, intrinsics, near)
        p = project_primitive(wp.vec3d(means[i]), wp.vec3d(log_scales[i]), wp.vec4d(quats[i]), v)
        r = whiten_rays(p, v)
        _store_wide_vector(wide, n, W.E0, r.e0)
        _store_wide_vector(wide, n, W.EX, r.ex)
        _store_wide_vector(wide, n, W.EY, r.ey)
        _store_wide_vector(wide, n, W.XA, r.xa)
        _store_wide_vector(wide, n, W.XU, r.tc * r.ex + r.tu * r.e0)
        _store_wide_vector(wide, n, W.XV, r.tc * r.ey + r.tv * r.e0)
        wide[n, W.TC] = r.tc
        wide[n, W.TU] = r.tu
        wide[n, W.TV] = r.tv
        wide[n, W.UX] = p.anchor[1]
        wide[n, W.UY] = p.anchor[2]
        wide[n, W.NEAR] = r.near
        wide[n, W.OFFSET] = d(b2[i])
        wide[n, W.UNIT] = p.m
        wide[n, W.ANCHOR_Z] = p.anchor[0]
        for k in range(neurons):
            column, phase = W.NEURONS + W.PER_NEURON * k, turns * d(b1[i, k])
            _store_wide_vector(wide, n, column, _projected_frequency(wp.vec3d(W1[i, k]), p, turns))
            wide[n, column + W.PHASE] = phase - wp.rint(phase)
            wide[n, column + W.AMPLITUDE] = d(w2[i, k])

    return prepare_wide
