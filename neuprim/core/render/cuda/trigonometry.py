# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""cos and B_p of a phase in turns: polynomials up to half a turn, recursion beyond (:mod:`neuprim.core.model.edge`).

B_p' = -z B_(p+1)/(2p + 3): the backward pass needs one more member. Coefficients: tools/fit_polynomials.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from neuprim.core.compute.warp import wp

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
"""B_0 to B_3 of v^2, lowest power first."""

_C0, _C1, _C2, _C3, _C4, _C5, _C6 = COSINE

Function = Callable[..., Any]


@wp.func
def cos_turns(y: float):
    """cos(2 pi r) of y = r^2, |r| <= 1/2."""
    return (((((_C6 * y + _C5) * y + _C4) * y + _C3) * y + _C2) * y + _C1) * y + _C0


def _warp_polynomial(coefficients: tuple[float, ...]) -> Function:
    c0, c1, c2, c3, c4, c5 = coefficients

    @wp.func
    def polynomial(y: float):
        return ((((c5 * y + c4) * y + c3) * y + c2) * y + c1) * y + c0

    return polynomial


_B = tuple(_warp_polynomial(c) for c in BANDS)
_sinc = _B[0]


@wp.func
def sin_turns(r: float):
    """sin(2 pi r), |r| <= 1/2."""
    return TAU * r * _sinc(r * r)


def chord_edge_profiles(edge: int) -> tuple[Function, Function]:
    """Warp functions v -> B_p and v -> (B_p, B_(p+1)), p = 0, 1, 2, for any v."""
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
    """1 - exp(-I), I >= 0; a faint one keeps its digits, which the difference would lose."""
    if I < 0.25:
        return I * (((((-I / 720.0 + 1.0 / 120.0) * I - 1.0 / 24.0) * I + 1.0 / 6.0) * I - 0.5) * I + 1.0)
    return 1.0 - wp.exp(-I)
