"""B_p of soft edges in float32: what sinc is for a hard one (:mod:`neuprim.core.model.edge`). Coefficients:
benchmarks/fit_polynomials.py.

Rates v are in turns over half a chord, as for :mod:`~neuprim.core.render.cpu.trigonometry`: B_p(2 pi v). Beyond half a
turn, or one and a half, the recursions B_1 = 3 (B_0 - cos z)/z^2 and B_2 = 15 (B_1 - B_0)/z^2 take over, and dB_1/dz =
-3 (B_1 - B_0)/z, dB_2/dz = -5 (B_2 - B_1)/z. float32 Horner errors: B 1.3e-7 and 9e-8 up to half a turn, 4.8e-7 and
3.2e-7 up to 1.5; derivatives 4.4e-7 and 2.6e-7, 5.8e-7 and 4.1e-7.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from neuprim.core.compute.kernels import dispatch_by_length, inline
from neuprim.core.render.cpu import trigonometry as T

__all__ = [
    "EDGE_TYPES",
    "profiles_fast",
    "profiles_medium",
    "profiles_slow",
    "slopes_fast",
    "slopes_medium",
    "slopes_slow",
]

EDGE_TYPES: tuple[tuple[int, ...], ...] = ((), (0,), (0, 0))
"""The exponents p = 0, 1, 2 as kernels take them: as many zeros. A tuple's length belongs to its type, so that numba
compiles a kernel for each p that is drawn, and none that is not."""

f = np.float32
_TO_UNIT = f(2 / 1.5**2)  # v^2 on [0, 1.5^2] to [-1, 1]

_SLOW = {
    1: (
        1.0, -3.947838068008423, 5.566062927246094, -4.0664262771606445, 1.8025330305099487, -0.4700953960418701,
    ),
    2: (
        1.0, -2.8198859691619873, 3.0923011302948, -1.8488370180130005, 0.695292592048645, -0.15979965031147003,
    ),
}  # fmt: skip
_SLOW_SLOPE = {
    1: (
        -3.9478418827056885, 11.132474899291992, -12.208269119262695, 7.302683353424072, -2.7615163326263428, 0.6567270755767822,
    ),
    2: (
        -2.8198869228363037, 6.184709548950195, -5.549287796020508, 2.8098440170288086, -0.9264959692955017, 0.20373320579528809,
    ),
}  # fmt: skip
_MEDIUM = {
    1: (
        -0.05893004313111305, 0.17211958765983582, 0.11200688779354095, -0.44919347763061523, 0.40172773599624634, -0.1925012469291687,
        0.05979634076356888, -0.013241526670753956, 0.002285874215885997, -0.00029647554038092494,
    ),
    2: (
        -0.03875413164496422, -0.05043990537524223, 0.30341872572898865, -0.3617872893810272, 0.2167164385318756, -0.08087369054555893,
        0.0208695400506258, -0.003977504093199968, 0.0006010864744894207, -6.996675801929086e-05,
    ),
}  # fmt: skip
_MEDIUM_SLOPE = {
    1: (
        0.15299518406391144, 0.19912876188755035, -1.1978490352630615, 1.428278923034668, -0.8555622100830078, 0.31927651166915894,
        -0.08238963782787323, 0.01570255681872368, -0.0023729943204671144, 0.00027621767367236316,
    ),
    2: (
        -0.044835470616817474, 0.5394122004508972, -0.9647660255432129, 0.7705288529396057, -0.35943883657455444, 0.11138193309307098,
        -0.024748504161834717, 0.004155985079705715, -0.0005599680007435381, 5.919351679040119e-05,
    ),
}  # fmt: skip

Kernel = Callable[..., Any]


def _horner(coefficients: tuple[float, ...]) -> Kernel:
    """The polynomial with these coefficients, lowest first, unrolled."""
    first = f(coefficients[0])
    if len(coefficients) == 1:

        @inline
        def last(z):  # type: ignore[no-untyped-def]
            return first

        return last
    rest = _horner(coefficients[1:])

    @inline
    def polynomial(z):  # type: ignore[no-untyped-def]
        return rest(z) * z + first

    return polynomial


def _halves(coefficients: tuple[float, ...]) -> Kernel:
    """The same as two shorter chains, whose latencies overlap; ten coefficients."""
    low, high = _horner(coefficients[:5]), _horner(coefficients[5:])

    @inline
    def polynomial(t):  # type: ignore[no-untyped-def]
        t2 = t * t
        return high(t) * (t2 * t2 * t) + low(t)

    return polynomial


def _slow(p: int) -> tuple[Kernel, Kernel]:
    value, slope = _horner(_SLOW[p]), _horner(_SLOW_SLOPE[p])

    @inline
    def profiles(v, w):  # type: ignore[no-untyped-def]
        return value(v * v), value(w * w)

    @inline
    def slopes(v, w):  # type: ignore[no-untyped-def]
        y, z = v * v, w * w
        return value(y), slope(y) * f(2) * v, value(z), slope(z) * f(2) * w

    return profiles, slopes


def _medium(p: int) -> tuple[Kernel, Kernel]:
    value, slope = _halves(_MEDIUM[p]), _halves(_MEDIUM_SLOPE[p])

    @inline
    def profiles(v, w):  # type: ignore[no-untyped-def]
        return value(v * v * _TO_UNIT - f(1)), value(w * w * _TO_UNIT - f(1))

    @inline
    def slopes(v, w):  # type: ignore[no-untyped-def]
        y, z = v * v * _TO_UNIT - f(1), w * w * _TO_UNIT - f(1)
        return value(y), slope(y) * f(2) * v, value(z), slope(z) * f(2) * w

    return profiles, slopes


def _fast(p: int) -> tuple[Kernel, Kernel]:
    value, slope = _horner(_SLOW[p]), _horner(_SLOW_SLOPE[p])
    first = p == 1

    @inline
    def one(v, near, r, iv):  # type: ignore[no-untyped-def]
        """(B_p, dB_p/dv) of v = whole + r, iv = 1/v; the polynomial where ``near``."""
        z, iz = r * r, iv * f(1 / T.TAU)  # iz = 1/(2 pi v)
        b0, cosine = T.sinc_turns(z) * r * iv, T.cos_turns(z)
        b1 = f(3) * (b0 - cosine) * iz * iz
        if first:
            b, db = b1, f(-3) * (b1 - b0) * iv
        else:
            b2 = f(15) * (b1 - b0) * iz * iz
            b, db = b2, f(-5) * (b2 - b1) * iv
        y = v * v if near else f(0)
        return value(y) if near else b, slope(y) * f(2) * v if near else db

    @inline
    def profiles(v, w):  # type: ignore[no-untyped-def]
        r, s, a, b, iv, iw = T.reduced(v, w)
        return one(v, a, r, iv)[0], one(w, b, s, iw)[0]

    @inline
    def slopes(v, w):  # type: ignore[no-untyped-def]
        r, s, a, b, iv, iw = T.reduced(v, w)
        x, dx = one(v, a, r, iv)
        y, dy = one(w, b, s, iw)
        return x, dx, y, dy

    return profiles, slopes


_soft_slow, _soft_medium, _soft_fast = ((kind(1), kind(2)) for kind in (_slow, _medium, _fast))
profiles_slow = dispatch_by_length(T.sincs_slow, _soft_slow[0][0], _soft_slow[1][0])
profiles_medium = dispatch_by_length(T.sincs_medium, _soft_medium[0][0], _soft_medium[1][0])
profiles_fast = dispatch_by_length(T.sincs_fast, _soft_fast[0][0], _soft_fast[1][0])
slopes_slow = dispatch_by_length(T.slopes_slow, _soft_slow[0][1], _soft_slow[1][1])
slopes_medium = dispatch_by_length(T.slopes_medium, _soft_medium[0][1], _soft_medium[1][1])
slopes_fast = dispatch_by_length(T.slopes_fast, _soft_fast[0][1], _soft_fast[1][1])
