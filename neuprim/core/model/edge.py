"""Edges: how a primitive's density fades at the ellipsoid's boundary, or at both ends of the primitive's time span.

The density is multiplied by (1 - u^2)^p, where u is the distance from the middle divided by the distance from the
middle to the edge. The exponent p = 0 gives a hard edge, 1 and 2 give soft edges. Let y be the position in coordinates
in which the ellipsoid is the unit ball; then the weight is (1 - |y|^2)^p. A ray crosses the ellipsoid on a chord, along
which u runs from -1 to 1. If no plane (such as the near plane) cuts the chord, the weight is D^p (1 - u^2)^p, with
D = 1 - |y|^2 at the chord's middle. A cosine with the weight (1 - u^2)^p has the integral

    1/2 integral of (1 - u^2)^p cos(phase + z u) du = N_p/2 cos(phase) B_p(z),   N = 2, 4/3, 16/15
    B_0 = sin z / z,   B_1 = 3 (B_0 - cos z)/z^2,   B_2 = 15 (B_1 - B_0)/z^2        (all 1 at z = 0)

The B_p are scaled spherical Bessel functions, B_p = (2p + 1)!! j_p(z)/z^p. On a chord that a plane cuts, 1 - |y|^2 is a
general quadratic c0 + c1 u + c2 u^2. The p-th power of this quadratic is a sum of Legendre polynomials, sum a_n P_n.
Each term has a closed form: 1/2 integral of P_n exp(i z u) du = i^n j_n(z).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

EDGES = (0, 1, 2)  # supported exponents p

NORMS = (2.0, 4 / 3, 16 / 15)  # N_p: the integral of (1 - u^2)^p over [-1, 1]. numba freezes them into kernels

_SERIES_BELOW = 2.0  # below, upward recursion loses digits as z^-n
_TERMS = 14  # of the series; the last term is below 1e-17 of the first


def edge_weight(square: Tensor, edge: int) -> Tensor:
    """Return the factor (1 - u^2)^p of a density that fades towards its edge, from ``square`` = u^2 and ``edge`` = p.

    u is 0 in the middle and 1 at the edge. With p = 1 or 2, the factor is 0 where u^2 > 1; with p = 0, it is always 1.
    """
    if edge == 0:
        return torch.ones_like(square)
    inner = (1 - square).clamp_min(0)
    return inner if edge == 1 else inner.square()


def sinc(z: Tensor) -> Tensor:
    """Return sin z / z, differentiable at 0."""
    small = z.abs() < 1e-3
    safe = torch.where(small, torch.ones_like(z), z)
    z2 = z * z
    series = 1 - z2 / 6 * (1 - z2 / 20 * (1 - z2 / 42))
    return torch.where(small, series, safe.sin() / safe)


def spherical_bessel(z: Tensor, last: int) -> list[Tensor]:
    """Return the spherical Bessel functions j_0(z) to j_last(z), float64, differentiable; absolute error <= 1e-15."""
    small = z.abs() < _SERIES_BELOW
    safe = torch.where(small, torch.full_like(z, _SERIES_BELOW), z)
    j = [safe.sin() / safe]
    j.append((j[0] - safe.cos()) / safe)
    for n in range(1, last):
        j.append((2 * n + 1) / safe * j[n] - j[n - 1])
    near = torch.where(small, z, torch.zeros_like(z))
    one, half_square = torch.ones_like(z), near * near / 2
    power, found = one, []
    for n in range(last + 1):
        series = one
        for k in range(_TERMS - 1, 0, -1):
            series = torch.addcmul(one, half_square, series, value=-1 / (k * (2 * n + 2 * k + 1)))
        found.append(torch.where(small, power * series, j[n]))
        power = power * near / (2 * n + 3)
    return found


def edge_legendre(c0: Tensor, c1: Tensor, c2: Tensor, edge: int) -> list[Tensor]:
    """Return the Legendre coefficients a_0 to a_2p of a soft edge's weight along a chord, where p = ``edge`` is 1 or 2.

    The weight is (c0 + c1 u + c2 u^2)^p = sum of a_n P_n(u), with u in [-1, 1] and the Legendre polynomials P_n.
    """
    if edge == 1:
        return [c0 + c2 / 3, c1, 2 * c2 / 3]
    d0, d1, d2, d3, d4 = c0 * c0, 2 * c0 * c1, c1 * c1 + 2 * c0 * c2, 2 * c1 * c2, c2 * c2
    return [d0 + d2 / 3 + d4 / 5, d1 + 3 * d3 / 5, 2 * d2 / 3 + 4 * d4 / 7, 2 * d3 / 5, 8 * d4 / 35]


def soft_edge_chord_integral(
    quadratic: tuple[Tensor, Tensor, Tensor], edge: int, phase: Tensor, z: Tensor, amplitude: Tensor, offset: Tensor
) -> Tensor:
    """Return the (M,) means of a cosine density with a soft edge along M chords, parts of rays inside an ellipsoid.

    The mean is 1/2 integral over [-1, 1] of (c0 + c1 u + c2 u^2)^p (offset + sum_k amplitude_k cos(phase_k + z_k u)),
    p = ``edge``, 1 or 2. ``quadratic`` holds c0, c1 and c2 of M chords, (M,) each. ``amplitude``, ``phase`` and ``z``
    are (M, K), for K neurons, and ``offset`` is (M,).
    """
    a = edge_legendre(*quadratic, edge)
    total = offset * a[0]
    if z.shape[1]:
        j = spherical_bessel(z, 2 * edge)
        even = a[0][:, None] * j[0] - a[2][:, None] * j[2]
        odd = a[1][:, None] * j[1]
        if edge == 2:
            even, odd = even + a[4][:, None] * j[4], odd - a[3][:, None] * j[3]
        total = total + (amplitude * (phase.cos() * even - phase.sin() * odd)).sum(-1)
    return total


def edge_profile(z: Tensor, order: int) -> Tensor:
    """Return B_p(z) = (2p + 1)!! j_p(z)/z^p for p = ``order``, where j_p is a spherical Bessel function.

    B_p is the Fourier transform of (1 - u^2)^p, u in [-1, 1], scaled so that B_p(0) = 1. Float64, differentiable.
    """
    if order == 0:
        return sinc(z)
    small = z.abs() < 1e-3
    safe = torch.where(small, torch.ones_like(z), z)
    series = 1 - z.square() / (2 * (2 * order + 3))
    return torch.where(
        small, series, math.prod(range(1, 2 * order + 2, 2)) * spherical_bessel(safe, order)[order] / safe**order
    )
