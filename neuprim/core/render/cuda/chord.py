# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Optical depth of a primitive along one pixel's ray, with gradients: the cpu backend's formulas in Warp.

A chord is the part of a ray inside an ellipsoid. The optical depth of a chord is I = N_p |d| D^p half field. N_p is the
integral of (1 - u^2)^p over [-1, 1], p the exponent of the edge. |d| is the length of the ray direction whose camera-z
is 1. D is 1 - |y|^2 at the chord's middle, y in whitened space, where the ellipsoid is the unit sphere. half is half
the chord's extent along camera z, in units of the longest semi-axis m. field is the mean of m x density without edge,
weighted by the edge: b2 + sum_k w2_k cos(phase_k) B_p(rate_k). rate_k is the change of phase_k over half a chord.

Phases are in turns. cos is a polynomial of the phase minus whole turns. B_p(z) (:mod:`neuprim.core.model.edge`) is a
polynomial for rates up to half a turn, and a recursion beyond. The backward pass also needs B_(p+1), because
B_p' = -z B_(p+1)/(2p + 3). tools/fit_polynomials.py computes the coefficients.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from neuprim.core.compute.warp import wp
from neuprim.core.render.cuda import layout as L

TAU = 2.0 * math.pi

COSINE = (
    1.0, -19.73920440673828, 64.93911743164062, -85.45014190673828, 60.16762924194336, -25.967599868774414,
    6.528658390045166,
)  # fmt: skip
BANDS = (
    (0.9999999403953552, -6.579718112945557, 12.987034797668457, -12.193572044372559, 6.5799241065979,
        -1.9848600625991821),
    (1.0, -3.947838068008423, 5.566061973571777, -4.0664167404174805, 1.8024897575378418, -0.4700262248516083),
    (1.0, -2.8198859691619873, 3.0923008918762207, -1.84883451461792, 0.6952810883522034, -0.15978121757507324),
    (1.0, -2.1932449340820312, 1.967841386795044, -0.9956727027893066, 0.32511693239212036, -0.06681565195322037),
)  # fmt: skip
"""Coefficients of B_0(2 pi v) to B_3(2 pi v) as polynomials in v^2, lowest power first."""

_C0, _C1, _C2, _C3, _C4, _C5, _C6 = COSINE

Function = Callable[..., Any]


@wp.func
def cos_turns(y: float):
    """Return cos(2 pi r) from y = r^2, |r| <= 1/2."""
    return (((((_C6 * y + _C5) * y + _C4) * y + _C3) * y + _C2) * y + _C1) * y + _C0


def _warp_polynomial(coefficients: tuple[float, ...]) -> Function:
    """Return a Warp function that evaluates a polynomial with six ``coefficients``, lowest power first."""
    c0, c1, c2, c3, c4, c5 = coefficients

    @wp.func
    def polynomial(y: float):
        return ((((c5 * y + c4) * y + c3) * y + c2) * y + c1) * y + c0

    return polynomial


_B = tuple(_warp_polynomial(c) for c in BANDS)
_sinc = _B[0]


@wp.func
def sin_turns(r: float):
    """Return sin(2 pi r), |r| <= 1/2."""
    return TAU * r * _sinc(r * r)


def chord_edge_profiles(edge: int) -> tuple[Function, Function]:
    """Return Warp functions v -> B_p(2 pi v) and v -> (B_p, B_(p+1)) for edge exponent p = ``edge`` and any rate v.

    v is the change of a neuron's phase over half a chord, in turns. B_p is the mean of the neuron's cosine over the
    chord, weighted by the edge weight, divided by the cosine at the chord's middle.
    """
    low, high = _B[edge], _B[edge + 1]

    @wp.func
    def value(v: float):
        if wp.abs(v) <= 0.5:
            return low(v * v)
        r = v - wp.rint(v)
        y = r * r
        iz = 1.0 / (TAU * v)
        j0 = TAU * r * _sinc(y) * iz
        if wp.static(edge == 0):
            return j0
        j1 = (j0 - cos_turns(y)) * iz
        if wp.static(edge == 1):
            return 3.0 * j1 * iz
        return 15.0 * (3.0 * j1 * iz - j0) * iz * iz

    @wp.func
    def pair(v: float):
        if wp.abs(v) <= 0.5:
            return wp.vec2(low(v * v), high(v * v))
        r = v - wp.rint(v)
        y = r * r
        iz = 1.0 / (TAU * v)
        j0 = TAU * r * _sinc(y) * iz
        j1 = (j0 - cos_turns(y)) * iz
        if wp.static(edge == 0):
            return wp.vec2(j0, 3.0 * j1 * iz)
        j2 = 3.0 * j1 * iz - j0
        if wp.static(edge == 1):
            return wp.vec2(3.0 * j1 * iz, 15.0 * j2 * iz * iz)
        j3 = 5.0 * j2 * iz - j1
        return wp.vec2(15.0 * j2 * iz * iz, 105.0 * j3 * iz * iz * iz)

    return value, pair


@wp.func
def opacity_of_depth(I: float):  # type: ignore[no-untyped-def]
    """Return 1 - exp(-I) for I >= 0; for small I, sum a series, because the difference would lose digits."""
    if I < 0.25:
        return I * (((((-I / 720.0 + 1.0 / 120.0) * I - 1.0 / 24.0) * I + 1.0 / 6.0) * I - 0.5) * I + 1.0)
    return 1.0 - wp.exp(-I)


@wp.struct
class Ray:
    """The float4 columns E0 to XV of a primitive's row: the rays of all pixels (:mod:`neuprim.core.render.layout`)."""

    e0: wp.vec4
    ex: wp.vec4
    ey: wp.vec4
    xa: wp.vec4
    xu: wp.vec4
    xv: wp.vec4


@wp.struct
class Chord:
    """The part of a pixel's ray inside a primitive, in whitened space (where the primitive is the unit sphere).

    t is the position on the ray: t + ``slide`` is the depth beyond the anchor, in units of the longest semi-axis.
    ``mid`` is t at the chord's middle, and ``half`` is half of the chord's range of t.
    """

    du: float  # pixel offset from the anchor
    dv: float
    slide: float
    e: wp.vec3  # direction of the ray
    x: wp.vec3  # point of the ray closest to the ellipsoid's centre
    D: float  # 1 - |x|^2
    ia: float  # 1/(e.e)
    tm: float  # t of the closest point
    h: float  # half chord before the near plane cuts it
    uncut: float  # 1 if the near plane does not cut the chord, else 0
    mid: float
    half: float  # 0 where the ray misses


@wp.func
def xyz(a: wp.vec4):
    return wp.vec3(a[0], a[1], a[2])


@wp.func
def neuron_phase(q: wp.vec3, w: wp.vec4):
    """Return a neuron's phase at point ``q``, in turns, by three fused multiply-adds; ``w`` is (WX, WY, WZ, PHASE)."""
    return w[3] + q[0] * w[0] + q[1] * w[1] + q[2] * w[2]


@wp.func
def load_ray(rows: Any, j: int):
    """Return the :class:`Ray` of row ``j``, from a tile of rows or from the whole array."""
    r = Ray()
    r.e0 = rows[j, L.E0]
    r.ex = rows[j, L.EX]
    r.ey = rows[j, L.EY]
    r.xa = rows[j, L.XA]
    r.xu = rows[j, L.XU]
    r.xv = rows[j, L.XV]
    return r


@wp.func
def intersect_chord(r: Ray, px: float, py: float):
    """Return the chord of the ray through pixel centre (px, py) in the primitive to which ``r`` belongs."""
    c = Chord()
    c.du = px - r.e0[3]
    c.dv = py - r.ex[3]
    G = c.du * xyz(r.ex) + c.dv * xyz(r.ey)
    c.e = xyz(r.e0) + G
    c.slide = c.du * r.xu[3] + c.dv * r.xv[3]
    m = xyz(r.xa) + c.du * xyz(r.xu) + c.dv * xyz(r.xv) + c.slide * G
    c.ia = 1.0 / wp.dot(c.e, c.e)
    c.tm = -wp.dot(m, c.e) * c.ia
    c.x = m + c.tm * c.e
    c.D = 1.0 - c.x[0] * c.x[0] - c.x[1] * c.x[1] - c.x[2] * c.x[2]
    c.h = wp.sqrt(wp.max(c.D, 1.0e-12) * c.ia)
    near = r.ey[3] - c.slide
    t0 = c.tm - c.h
    c.uncut = wp.where(t0 > near, 1.0, 0.0)
    t0 = wp.max(t0, near)
    c.half = 0.5 * (c.tm + c.h - t0)
    c.mid = t0 + c.half
    if c.D <= 0.0 or c.half < 0.0:
        c.half = 0.0
    return c


@wp.struct
class Pull:
    """Gradients of the loss by a ray's origin m and direction e."""

    m: wp.vec3
    e: wp.vec3


@wp.func
def chord_ends_backward(
    c: Chord, g_half: float, g_mid: float, g_tm: float, gD: float, gA: float, gq: wp.vec3, gv: wp.vec3
):
    """Return dL/dm and dL/de of a ray with origin m and direction e, from the gradients of its chord.

    ``gq`` is dL/d(chord's middle point), and ``gv`` is dL/d(half e). ``g_half``, ``g_mid`` and ``g_tm`` are the
    gradients by the half chord, by t of the chord's middle and by t of the closest point x. ``gD`` is the gradient by
    D = 1 - |x|^2, including dL/dh dh/dD, and ``gA`` the gradient by a = e.e.
    """
    gt1 = 0.5 * (g_mid + g_half)
    gt0 = 0.5 * (g_mid - g_half) * c.uncut
    tm = g_tm + gt0 + gt1
    g_h = gt1 - gt0
    a = gA - (0.5 * g_h * c.h + tm * c.tm) * c.ia
    b = -tm * c.ia
    m2 = -2.0 * gD
    out = Pull()
    out.m = gq + m2 * c.x + b * c.e
    out.e = c.half * gv + c.mid * gq + (c.tm * m2 + b) * c.x + (2.0 * a - b * c.tm) * c.e
    return out


@wp.func
def chord_backward(c: Chord, g_half: float, g_mid: float, gD: float, by_depth: float, gq: wp.vec3, gv: wp.vec3):
    """Like :func:`chord_ends_backward`, for chords without gradients by tm and by a = e.e.

    ``gD`` excludes dL/dh dh/dD, which this function adds with ``by_depth`` = dh/dD.
    """
    gt1 = 0.5 * (g_mid + g_half)
    gt0 = 0.5 * (g_mid - g_half) * c.uncut
    return chord_ends_backward(c, g_half, g_mid, 0.0, gD + (gt1 - gt0) * by_depth, 0.0, gq, gv)


@wp.func
def pixel_of_lane(lane: int):
    """Return the pixel (x, y) in the tile that thread ``lane`` computes.

    A warp covers 8 x 4 pixels, because a small primitive fills such a block better than two rows of 16 pixels.
    """
    return wp.vec2i((lane & 7) | ((lane >> 2) & 8), ((lane >> 3) & 3) | ((lane >> 4) & 12))


@wp.func
def slot_of_pixel(span: int, offset: int, x: int):
    """Return the slot of pixel x in a tile row of a (tile, primitive) pair; -1 outside the row's span.

    ``span`` is start << 8 | last << 4 | first: the number of covered pixels in earlier rows, the last and the first
    covered pixel of the row. ``offset`` is the pair's first slot.
    """
    slot = int(-1)
    if x >= (span & 15) and x <= ((span >> 4) & 15):
        slot = offset + (span >> 8) + x - (span & 15)
    return slot


@wp.func
def pixel_of_slot(spans: Any, n: int, s: int):
    """Return the pixel (x, y), in its tile, of slot ``s`` of pair ``n``; ``s`` counts from the pair's first slot.

    ``spans`` has 16 row spans per pair (:func:`slot_of_pixel`). y is the last row whose span starts at or before ``s``.
    """
    y = int(0)
    for b in range(4):
        if int(spans[n, y + (8 >> b)]) >> 8 <= s:
            y += 8 >> b
    row = int(spans[n, y])
    return wp.vec2i((row & 15) + s - (row >> 8), y)
