"""cos and sinc of a phase in turns, and the exponential, as polynomials (coefficients: benchmarks/fit_polynomials.py).

With W1 and b1 divided by 2 pi beforehand, reducing a phase to |r| <= 1/2 turn is ``r = u - rint(u)``, which is exact.
float32 Horner errors: cos 4.3e-7, sinc 2.6e-7, dsinc/dz 9.3e-7.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.render.cpu.compile import inline

__all__ = ["TAU", "cos_turns", "dsinc_turns", "one_minus_exp", "sinc_turns"]

f = np.float32
TAU = f(2 * np.pi)

_C = tuple(
    f(c)
    for c in (1.0, -19.73920440673828, 64.93911743164062, -85.45016479492188, 60.16783142089844, -25.968313217163086, 6.529610633850098)
)
_S = tuple(
    f(c) for c in (0.9999999403953552, -6.579718589782715, 12.987038612365723, -12.193624496459961, 6.580165386199951, -1.9852460622787476)
)
_D = tuple(
    f(c) for c in (-6.579736232757568, 25.975732803344727, -36.623226165771484, 26.756011962890625, -11.860190391540527, 3.093101978302002)
)
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = _C
_S0, _S1, _S2, _S3, _S4, _S5 = _S
_D0, _D1, _D2, _D3, _D4, _D5 = _D
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
def one_minus_exp(x):  # type: ignore[no-untyped-def]
    """1 - exp(-x) for x clamped to [0, 9.4] (alpha is clamped to at most 0.9999): expm1 of x/16, doubled four times."""
    r = min(max(x, f(0)), _CEIL) * _SIXTEENTH
    q = (((((_E6 * r + _E5) * r + _E4) * r + _E3) * r + _E2) * r + _ONE) * r
    q = q * (q + _TWO)
    q = q * (q + _TWO)
    q = q * (q + _TWO)
    q = q * (q + _TWO)
    return -q
