# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""One pixel's chord and the mean density along it in float64, for the few primitives that float32 cannot follow.

Needles and discs near the camera, fast neurons, and every soft edge that the near plane may cut. The formulas are the
CPU's (:mod:`neuprim.core.render.cpu.float64_edge`): (1 - |y|^2)^p is a polynomial q of u in [-1, 1], and the mean of
q(u) cos(phase + z u) follows from moments C_n (even n) and S_n (odd n) of cos and sin, sums of spherical Bessel
functions j_0 to j_5. A hard edge is q = 1.
"""

from __future__ import annotations

from neuprim.core.compute.warp import wp
from neuprim.core.render.cpu import layout as W

__all__ = [
    "Chord64",
    "Moments",
    "Weight",
    "chord64",
    "dot64",
    "moments",
    "neuron64",
    "phase64",
    "rate64",
    "through64",
    "vec6d",
    "weight_of",
]

vec6d = wp.types.vector(length=6, dtype=wp.float64)
vec5d = wp.types.vector(length=5, dtype=wp.float64)

_TERMS = 14


@wp.struct
class Chord64:
    """As :class:`~neuprim.core.render.cuda.chord.Chord`; the ray's origin does not slide."""

    du: wp.float64
    dv: wp.float64
    e: wp.vec3d
    x: wp.vec3d
    D: wp.float64
    ia: wp.float64
    tm: wp.float64
    h: wp.float64
    uncut: wp.float64
    mid: wp.float64
    half: wp.float64
    q: wp.vec3d  # the chord's middle


@wp.func
def _vector(wide: wp.array2d(dtype=wp.float64), r: int, c: int):
    return wp.vec3d(wide[r, c], wide[r, c + 1], wide[r, c + 2])


@wp.func
def chord64(wide: wp.array2d(dtype=wp.float64), r: int, X: int, Y: int):
    """Of pixel (X, Y) and row ``r``."""
    c = Chord64()
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    c.du = wp.float64(X) + wp.float64(0.5) - wide[r, W.UX]
    c.dv = wp.float64(Y) + wp.float64(0.5) - wide[r, W.UY]
    G = c.du * _vector(wide, r, W.EX) + c.dv * _vector(wide, r, W.EY)
    c.e = _vector(wide, r, W.E0) + G
    m = _vector(wide, r, W.XA) + wide[r, W.TC] * G
    c.ia = one / wp.dot(c.e, c.e)
    c.tm = -wp.dot(m, c.e) * c.ia
    c.x = m + c.tm * c.e
    c.D = one - wp.dot(c.x, c.x)
    c.h = wp.sqrt(wp.max(c.D, zero) * c.ia)
    near = wide[r, W.NEAR]
    t0 = c.tm - c.h
    c.uncut = wp.where(t0 > near, one, zero)
    t0 = wp.max(t0, near)
    c.mid = wp.float64(0.5) * (t0 + c.tm + c.h)
    c.half = wp.max(wp.float64(0.5) * (c.tm + c.h - t0), zero)
    c.q = c.x + (c.mid - c.tm) * c.e
    return c


@wp.struct
class Weight:
    """q of u, its mean, and of d q/d(1 - |y|^2) as a polynomial b0 + b1 u + b2 u^2."""

    q: vec5d
    mean: wp.float64
    b0: wp.float64
    b1: wp.float64
    b2: wp.float64


@wp.func
def weight_of(c: Chord64, edge: int):
    """(D - a (shift + half u)^2)^p."""
    w = Weight()
    two = wp.float64(2.0)
    a = wp.float64(1.0) / c.ia
    shift = c.mid - c.tm
    c0 = c.D - a * shift * shift
    c1 = -two * a * shift * c.half
    c2 = -a * c.half * c.half
    w.q = vec5d()
    if edge == 0:
        w.q[0] = wp.float64(1.0)
    elif edge == 1:
        w.q[0] = c0
        w.q[1] = c1
        w.q[2] = c2
        w.b0 = wp.float64(1.0)
    else:
        w.q[0] = c0 * c0
        w.q[1] = two * c0 * c1
        w.q[2] = c1 * c1 + two * c0 * c2
        w.q[3] = two * c1 * c2
        w.q[4] = c2 * c2
        w.b0 = two * c0
        w.b1 = two * c1
        w.b2 = two * c2
    w.mean = w.q[0] + w.q[2] / wp.float64(3.0) + w.q[4] / wp.float64(5.0)
    return w


@wp.func
def _bessel(z: wp.float64):
    """j_0 to j_5 of any z: a series below 2, where upward recursion loses digits."""
    j = vec6d()
    one = wp.float64(1.0)
    if wp.abs(z) < wp.float64(2.0):
        square = wp.float64(0.5) * z * z
        power = wp.float64(1.0)
        for n in range(6):
            term = wp.float64(power)
            total = wp.float64(power)
            for k in range(1, _TERMS):
                term *= -square / wp.float64(k * (2 * n + 2 * k + 1))
                total += term
            j[n] = total
            power *= z / wp.float64(2 * n + 3)
    else:
        j[0] = wp.sin(z) / z
        j[1] = (j[0] - wp.cos(z)) / z
        over = one / z
        j[2] = wp.float64(3.0) * over * j[1] - j[0]
        j[3] = wp.float64(5.0) * over * j[2] - j[1]
        j[4] = wp.float64(7.0) * over * j[3] - j[2]
        j[5] = wp.float64(9.0) * over * j[4] - j[3]
    return j


@wp.func
def moments(z: wp.float64):
    """C_0, S_1, C_2, S_3, C_4, S_5."""
    j = _bessel(z)
    two = wp.float64(2.0)
    three = wp.float64(3.0)
    eight = wp.float64(8.0)
    M = vec6d()
    M[0] = j[0]
    M[1] = j[1]
    M[2] = (j[0] - two * j[2]) / three
    M[3] = (three * j[1] - two * j[3]) / wp.float64(5.0)
    M[4] = (wp.float64(7.0) * j[0] - wp.float64(20.0) * j[2] + eight * j[4]) / wp.float64(35.0)
    M[5] = (wp.float64(27.0) * j[1] - wp.float64(28.0) * j[3] + eight * j[5]) / wp.float64(63.0)
    return M


@wp.func
def neuron64(wide: wp.array2d(dtype=wp.float64), r: int, o: int):
    """(WX, WY, WZ) of the unit at column ``o``."""
    return _vector(wide, r, o)


@wp.func
def phase64(c: Chord64, w: wp.vec3d, phase: wp.float64):
    """At the chord's middle, in radians, of less than half a turn."""
    u = wp.dot(c.q, w) + phase
    return wp.float64(6.283185307179586) * (u - wp.rint(u))


@wp.func
def rate64(c: Chord64, w: wp.vec3d):
    """z, radians over half a chord."""
    return wp.float64(6.283185307179586) * c.half * wp.dot(c.e, w)


@wp.struct
class Moments:
    """Means of q(u) cos(z u) and q(u) sin(z u), and their derivatives by z."""

    even: wp.float64
    odd: wp.float64
    d_even: wp.float64
    d_odd: wp.float64


@wp.func
def dot64(w: Weight, M: vec6d):
    """The moments of a weight."""
    out = Moments()
    out.even = w.q[0] * M[0] + w.q[2] * M[2] + w.q[4] * M[4]
    out.odd = w.q[1] * M[1] + w.q[3] * M[3]
    out.d_even = -(w.q[0] * M[1] + w.q[2] * M[3] + w.q[4] * M[5])
    out.d_odd = w.q[1] * M[2] + w.q[3] * M[4]
    return out


@wp.struct
class Pull64:
    """dL/d(origin m, direction e) of a ray, and with respect to what grows with the pixel offset."""

    m: wp.vec3d
    e: wp.vec3d
    G: wp.vec3d


@wp.func
def through64(
    c: Chord64, tc: wp.float64, depth_floor: float, g_half: wp.float64, g_mid: wp.float64, g_tm: wp.float64, gD: wp.float64, gA: wp.float64,
    gq: wp.vec3d, gv: wp.vec3d,
):  # fmt: skip
    """As :func:`~neuprim.core.render.cuda.chord.through`, with dh/dD from the floor on D; g_tm, gD, gA: on other ways
    than the chord's ends."""
    half = wp.float64(0.5)
    two = wp.float64(2.0)
    gt1 = half * (g_mid + g_half)
    gt0 = half * (g_mid - g_half) * c.uncut
    tm = g_tm + gt0 + gt1
    g_h = gt1 - gt0
    D = gD + g_h * half * c.ia / wp.sqrt(wp.max(c.D, wp.float64(depth_floor)) * c.ia)
    a = gA - (half * g_h * c.h + tm * c.tm) * c.ia
    b = -tm * c.ia
    m2 = -two * D
    out = Pull64()
    out.m = gq + m2 * c.x + b * c.e
    out.e = c.half * gv + c.mid * gq + (c.tm * m2 + b) * c.x + (two * a - b * c.tm) * c.e
    out.G = out.e + tc * out.m
    return out
