"""Fit the even polynomials in turns that the kernels use for cos, sinc, the profiles of soft edges, and their
derivatives; print float32 errors.

    python tools/fit_polynomials.py

Lawson-weighted least squares on Chebyshev nodes in z = r^2, |r| up to 1/2 or 3/2 turn: close to minimax, reproducible,
no tables.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.polynomial import Polynomial, chebyshev
from numpy.typing import NDArray
from scipy.special import spherical_jn

F64 = NDArray[np.float64]


def cos_turns(z: F64) -> F64:
    return np.cos(2 * np.pi * np.sqrt(z))


def sinc_turns(z: F64) -> F64:
    h = 2 * np.pi * np.sqrt(z)
    return np.where(h < 1e-4, 1 - h * h / 6, np.sin(h) / np.where(h == 0, 1, h))


def dsinc_turns(z: F64) -> F64:
    """d sinc(2 pi r) / d(r^2)."""
    h = 2 * np.pi * np.sqrt(z)
    s = np.where(h < 1e-2, 1, h)
    exact = (np.cos(s) - np.sin(s) / s) / s * (2 * np.pi) ** 2 / (2 * s)
    return np.where(h < 1e-2, (2 * np.pi) ** 2 * (-1 / 6 + h * h / 60), exact)


def profile_turns(p: int) -> Callable[[F64], F64]:
    """B_p(2 pi r) = (2p + 1)!! j_p(2 pi r)/(2 pi r)^p, p = 1 or 2, of z = r^2."""
    factor = (1, 3, 15)[p]

    def function(z: F64) -> F64:
        h = 2 * np.pi * np.sqrt(z)
        s = np.where(h < 1e-3, 1, h)
        return np.where(h < 1e-3, 1 - h * h / (2 * (2 * p + 3)), factor * spherical_jn(p, s) / s**p)

    return function


def dprofile_turns(p: int) -> Callable[[F64], F64]:
    """d B_p(2 pi r) / d(r^2), from dB_p/dh = -(2p + 1)!! j_(p+1)(h)/h^p."""
    factor, limit = (1, 3, 15)[p], -1 / (2 * p + 3)

    def function(z: F64) -> F64:
        h = 2 * np.pi * np.sqrt(z)
        s = np.where(h < 1e-3, 1, h)
        return np.where(h < 1e-3, limit, -factor * spherical_jn(p + 1, s) / s ** (p + 1)) * (2 * np.pi) ** 2 / 2

    return function


def fit(function, degree: int, reach: float, centred: bool) -> tuple[F64, float]:  # type: ignore[no-untyped-def]
    """Coefficients in z = r^2, |r| <= reach, or in t = 2 z / reach^2 - 1 (long polynomials cancel less there), and the
    worst error."""
    t = -np.cos(np.pi * (np.arange(4000) + 0.5) / 4000)
    target, weight = function((t + 1) / 2 * reach**2), np.ones(4000)
    vander = chebyshev.chebvander(t, degree)
    for _ in range(300):
        root = np.sqrt(weight)
        c = np.linalg.lstsq(vander * root[:, None], target * root, rcond=None)[0]
        error = np.abs(vander @ c - target)
        weight *= error / error.mean() + 1e-12
        weight /= weight.sum()
    p = chebyshev.cheb2poly(c)
    if not centred:
        p = Polynomial(p)(Polynomial([-1, 2 / reach**2])).coef
    return p, float(error.max())


def main() -> None:
    for name, function, degree, centred in (
        ("cos", cos_turns, 6, False),
        ("sinc", sinc_turns, 5, False),
        ("dsinc", dsinc_turns, 5, False),
        ("sinc medium", sinc_turns, 10, True),
        ("dsinc medium", dsinc_turns, 9, True),
        *(
            (f"{mark}B{p}{size}", make(p), degree, centred)
            for p in (1, 2)
            for size, degree, centred in (("", 5, False), (" medium", 9, True))
            for mark, make in (("", profile_turns), ("d", dprofile_turns))
        ),
    ):
        reach = 1.5 if centred else 0.5
        c, error = fit(function, degree, reach, centred)
        r = np.linspace(0, reach, 200_001).astype(np.float32)
        z = r * r
        x = z * np.float32(2 / reach**2) - np.float32(1) if centred else z
        p = np.full_like(x, np.float32(c[-1]))
        for q in c[-2::-1]:
            p = (p * x + np.float32(q)).astype(np.float32)
        scale = 2 * r if name.startswith("d") else 1  # what the kernels use is the derivative by r
        e32 = (np.abs(p - function(z.astype(np.float64))) * scale).max()
        print(f"{name:12} degree {degree}, |r| <= {reach}: fit {error:.2e}, float32 Horner {e32:.2e}")
        print("   ", ", ".join(repr(float(np.float32(x))) for x in c))


if __name__ == "__main__":
    main()
