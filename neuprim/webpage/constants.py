"""What the shaders take from the mathematics: polynomials for cos, sinc and the soft edges' profiles, and a quadrature
rule."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from neuprim.core.model.edge import profile

_DEGREE = 7
_SAMPLES = 200
_POINTS = 16
"""Of the rule for chords that the near plane cuts; with 8 of them errors reach 3e-4."""


def shader_constants(edge: int) -> dict[str, list[float]]:
    """Coefficients in z = v^2, highest power first, for v in turns, |v| <= 1/2, and the positive half of Gauss's and
    Legendre's rule.

    ``cos`` is cos(2 pi v), ``sinc`` sin(2 pi v)/(2 pi v), ``edge`` B_p(2 pi v) of :mod:`neuprim.core.model.edge`.
    """
    nodes, weights = np.polynomial.legendre.leggauss(_POINTS)
    turn = 2 * math.pi
    return {
        "cos": _fitted(lambda v: np.cos(turn * v)),
        "sinc": _fitted(lambda v: np.sinc(2 * v)),
        "edge": _fitted(lambda v: profile(torch.from_numpy(turn * v), edge).numpy()),
        "nodes": nodes[_POINTS // 2 :].tolist(),
        "weights": weights[_POINTS // 2 :].tolist(),
    }


def _fitted(function: Callable[[np.ndarray], np.ndarray]) -> list[float]:
    """A polynomial through the function at Chebyshev's points of z in [0, 1/4]."""
    z = 0.125 * (1 + np.cos(np.pi * (np.arange(_SAMPLES) + 0.5) / _SAMPLES))
    fit = np.polynomial.chebyshev.Chebyshev.fit(z, function(np.sqrt(z)), _DEGREE, domain=[0, 0.25])
    found: list[float] = fit.convert(kind=np.polynomial.Polynomial).coef[::-1].tolist()
    return found
