"""Fit the even polynomials in turns that the kernels use for cos, sinc and sinc's derivative, and print their float32 errors.

    python benchmarks/fit_polynomials.py

Lawson-weighted least squares on Chebyshev nodes in z = r^2, |r| <= 1/2 turn: close to minimax, reproducible, no tables.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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


def fit(function, degree: int) -> tuple[F64, float]:  # type: ignore[no-untyped-def]
    nodes = 0.125 * (1 - np.cos(np.pi * (np.arange(4000) + 0.5) / 4000))
    target, weight = function(nodes), np.ones(4000)
    vander = np.vander(nodes * 4, degree + 1, increasing=True)
    for _ in range(300):
        root = np.sqrt(weight)
        c = np.linalg.lstsq(vander * root[:, None], target * root, rcond=None)[0]
        error = np.abs(vander @ c - target)
        weight *= error / error.mean() + 1e-12
        weight /= weight.sum()
    return c * 4.0 ** np.arange(degree + 1), float(error.max())


def main() -> None:
    for name, function, degree in (("cos", cos_turns, 6), ("sinc", sinc_turns, 5), ("dsinc", dsinc_turns, 5)):
        c, error = fit(function, degree)
        z = (np.linspace(0, 0.5, 200_001) ** 2).astype(np.float32)
        p = np.full_like(z, np.float32(c[-1]))
        for q in c[-2::-1]:
            p = (p * z + np.float32(q)).astype(np.float32)
        e32 = np.abs(p - function(z.astype(np.float64))).max()
        print(f"{name:6} degree {degree}: fit {error:.2e}, float32 Horner {e32:.2e}")
        print("   ", ", ".join(repr(float(np.float32(x))) for x in c))


if __name__ == "__main__":
    main()
