"""Trigonometry: cos and sinc of a phase in turns, and the exponential, as polynomials (coefficients:
benchmarks/fit_polynomials.py).

With W1 and b1 divided by 2 pi beforehand, reducing a phase to |r| <= 1/2 turn is ``r = u - rint(u)``, which is exact.
float32 Horner errors: cos 4.3e-7, sinc 2.6e-7, dsinc/dz 9.3e-7; up to 1.5 turns sinc 4.4e-7, dsinc/dv 1.9e-6.

Between half a turn and 1.5 turns a longer polynomial takes the place of the range reduction and its division.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import inline

__all__ = [
    "TAU",
    "cos_turns",
    "one_minus_exp",
    "reduced",
    "sinc_turns",
    "sincs_fast",
    "sincs_medium",
    "sincs_slow",
    "slopes_fast",
    "slopes_medium",
    "slopes_slow",
]

f = np.float32
TAU = f(2 * np.pi)

_C = tuple(
    f(c)
    for c in (
        1.0,
        -19.73920440673828,
        64.93911743164062,
        -85.45016479492188,
        60.16783142089844,
        -25.968313217163086,
        6.529610633850098,
    )
)
_S = tuple(
    f(c)
    for c in (
        0.9999999403953552,
        -6.579718589782715,
        12.987038612365723,
        -12.193624496459961,
        6.580165386199951,
        -1.9852460622787476,
    )
)
_D = tuple(
    f(c)
    for c in (
        -6.579736232757568,
        25.975732803344727,
        -36.623226165771484,
        26.756011962890625,
        -11.860190391540527,
        3.093101978302002,
    )
)
_M = tuple(
    f(c)
    for c in (
        0.05581631940701254, 0.4362123752771363, -0.6370321672800427, -0.27636890430229927, 0.8312559868298691, -0.5947233435367446,
        0.2374873217981118, -0.06324641573684713, 0.012253660547389418, -0.0018736913572860911, 0.00021887869764285634,
    )
)  # fmt: skip
_N = tuple(
    f(c)
    for c in (
        0.3877441347416979, -1.132501461406376, -0.7369757903376593, 2.9555745464283736, -2.6432625907720526, 1.2666074512059946,
        -0.3934441512729933, 0.08712575631466417, -0.015040448572156936, 0.0019507300281688589,
    )
)  # fmt: skip
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = _C
_S0, _S1, _S2, _S3, _S4, _S5 = _S
_D0, _D1, _D2, _D3, _D4, _D5 = _D
_M0, _M1, _M2, _M3, _M4, _M5, _M6, _M7, _M8, _M9, _M10 = _M
_N0, _N1, _N2, _N3, _N4, _N5, _N6, _N7, _N8, _N9 = _N
_TO_UNIT = f(2 / 1.5**2)  # v^2 on [0, 1.5^2] to [-1, 1]: small coefficients, nothing cancels
_E2, _E3, _E4, _E5, _E6 = f(1 / 2), f(1 / 6), f(1 / 24), f(1 / 120), f(1 / 720)
_ONE, _TWO, _SIXTEENTH, _CEIL = f(1), f(2), f(-1 / 16), f(9.4)


@inline
def cos_turns(z):  # type: ignore[no-untyped-def]
    """cos(2 pi r) from z = r^2, |r| <= 1/2."""
    return (((((_C6 * z + _C5) * z + _C4) * z + _C3) * z + _C2) * z + _C1) * z + _C0


@inline
def sinc_turns(z):  # type: ignore[no-untyped-def]
    """sin(2 pi r)/(2 pi r) from z = r^2, |r| <= 1/2."""
    return ((((_S5 * z + _S4) * z + _S3) * z + _S2) * z + _S1) * z + _S0


@inline
def dsinc_turns(z):  # type: ignore[no-untyped-def]
    """d/dz of :func:`sinc_turns`, from a fit of its own: the difference cos - sinc cancels for small z."""
    return ((((_D5 * z + _D4) * z + _D3) * z + _D2) * z + _D1) * z + _D0


@inline
def _sinc_medium(t):  # type: ignore[no-untyped-def]
    """sinc(2 pi v) from t = v^2 2/1.5^2 - 1, |v| <= 1.5."""
    low = ((((_M5 * t + _M4) * t + _M3) * t + _M2) * t + _M1) * t + _M0
    high = (((_M10 * t + _M9) * t + _M8) * t + _M7) * t + _M6
    t2 = t * t
    return high * (t2 * t2 * t2) + low


@inline
def _dsinc_medium(t):  # type: ignore[no-untyped-def]
    """d sinc / d(v^2) of :func:`_sinc_medium`."""
    return ((((((((_N9 * t + _N8) * t + _N7) * t + _N6) * t + _N5) * t + _N4) * t + _N3) * t + _N2) * t + _N1) * t + _N0


# sinc(2 pi v) of two neurons, and the same with d sinc / dv, for the three ranges of v


@inline
def sincs_slow(v, w):  # type: ignore[no-untyped-def]
    """|v|, |w| <= 1/2."""
    return sinc_turns(v * v), sinc_turns(w * w)


@inline
def slopes_slow(v, w):  # type: ignore[no-untyped-def]
    y, z = v * v, w * w
    return sinc_turns(y), dsinc_turns(y) * _TWO * v, sinc_turns(z), dsinc_turns(z) * _TWO * w


@inline
def sincs_medium(v, w):  # type: ignore[no-untyped-def]
    """|v|, |w| <= 3/2."""
    return _sinc_medium(v * v * _TO_UNIT - _ONE), _sinc_medium(w * w * _TO_UNIT - _ONE)


@inline
def slopes_medium(v, w):  # type: ignore[no-untyped-def]
    y, z = v * v * _TO_UNIT - _ONE, w * w * _TO_UNIT - _ONE
    return _sinc_medium(y), _dsinc_medium(y) * _TWO * v, _sinc_medium(z), _dsinc_medium(z) * _TWO * w


@inline
def reduced(v, w):  # type: ignore[no-untyped-def]
    """v and w reduced to half a turn, whether they were within, and their reciprocals (1 where within) from one
    division."""
    k, j = np.rint(v), np.rint(w)
    a, b = k == f(0), j == f(0)
    sv, sw = f(1) if a else v, f(1) if b else w
    q = f(1) / (sv * sw)
    return v - k, w - j, a, b, q * sw, q * sv


@inline
def sincs_fast(v, w):  # type: ignore[no-untyped-def]
    """Any v and w: sinc(2 pi v) = sinc(2 pi r) r/v with r = v - rint(v), exactly reduced."""
    r, s, a, b, iv, iw = reduced(v, w)
    x, y = sinc_turns(r * r), sinc_turns(s * s)
    return x if a else x * r * iv, y if b else y * s * iw


@inline
def slopes_fast(v, w):  # type: ignore[no-untyped-def]
    """d sinc/dv = (cos - sinc)/v beyond half a turn."""
    r, s, a, b, iv, iw = reduced(v, w)
    y, z = r * r, s * s
    x, u = sinc_turns(y), sinc_turns(z)
    sx, su = x if a else x * r * iv, u if b else u * s * iw
    dx = dsinc_turns(y) * _TWO * v if a else (cos_turns(y) - sx) * iv
    du = dsinc_turns(z) * _TWO * w if b else (cos_turns(z) - su) * iw
    return sx, dx, su, du


@inline
def one_minus_exp(x):  # type: ignore[no-untyped-def]
    """1 - exp(-x) for x clamped to [0, 9.4] (alpha is clamped to at most 0.9999): expm1 of x/16, doubled four times."""
    r = min(max(x, f(0)), _CEIL) * _SIXTEENTH
    q = (((((_E6 * r + _E5) * r + _E4) * r + _E3) * r + _E2) * r + _ONE) * r
    q = q * (q + _TWO)
    q = q * (q + _TWO)
    q = q * (q + _TWO)
    q = q * (q + _TWO)
    return -q
