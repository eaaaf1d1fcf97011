"""A true Gaussian density, as a baseline for comparisons. Only the reference backend (float64 PyTorch) renders it.

    sigma(x) = kappa/m exp(-c^2 |y|^2 / 2)   inside the ellipsoid |y| < 1, 0 outside,   m = max(s)

y = diag(1/s) R^T (x - mu) is x in coordinates in which the ellipsoid, with centre mu, semi-axes s and rotation R, is
the unit ball. c is the number of standard deviations from centre to boundary, and kappa a learned amplitude. This is
the Gaussian of 3D Gaussian splatting (Kerbl et al. 2023) as a density in space. Along a ray, the exponent is quadratic
in the ray distance, and the optical depth is a difference of two erf values.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neuprim.core.model.fields import Conditions, CustomDensity, DensityField
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import InitContext, ParameterSpec, Params

__all__ = ["GaussianDensity"]

_SHORT = 0.2
"""Intervals [u - w, u + w] with w (1 + |u|) below this value are integrated by a Taylor series, because differences of
erfc lose one digit per decade of w."""
_TERMS = 8  # of that series; the first one left out is below 1e-17 of the sum
_START = 0.02, 0.98  # range to which the opacities of starting points are clamped
_FAINTEST = 1e-30  # a density scaled by zero keeps a finite logarithm


class GaussianDensity(DensityField):
    """Density field of Gaussians, sigma = kappa/m exp(-c^2 |y|^2 / 2), with one parameter, log kappa.

    m is the longest semi-axis, and |y| = 1 on the ellipsoid. A primitive starts with the opacity of its starting point,
    if known. Otherwise, its central opacity is ``init.alpha`` with ``init.mode`` "opaque" (default), and 0.1, as in 3D
    Gaussian splatting, with "paper".

    Args:
        deviations: c, standard deviations from the centre to the edge of the support, 0.5 to 10; else ValueError.
    """

    init_settings = ("mode", "alpha")
    exact_split = False

    def __init__(self, deviations: float = 3.0) -> None:
        if isinstance(deviations, bool) or not isinstance(deviations, (int, float)) or not 0.5 <= deviations <= 10:
            raise ValueError(f"{deviations!r} standard deviations; expected 0.5..10")
        self.deviations = float(deviations)

    def settings(self) -> dict[str, Any]:
        return {"deviations": self.deviations}

    def parameters(self) -> list[ParameterSpec]:
        return [ParameterSpec("log_amplitude", (1,), 1e-1, self._initial)]

    def _initial(self, ctx: InitContext) -> Tensor:
        alpha = 0.1 if ctx.choice("mode", "opaque", "paper") == "paper" else ctx.number("alpha", 0.8, 0, 1)
        central = (
            math.sqrt(2 * math.pi) / self.deviations * math.erf(self.deviations / math.sqrt(2))
        )  # a sphere's depth at kappa = 1
        if ctx.alphas is None:
            return torch.full((ctx.count, 1), math.log(-math.log1p(-alpha) / central))
        depth = -torch.log1p(-ctx.alphas.double().clamp(*_START))
        return (depth / ctx.thickness / central).log().float()[:, None]

    def from_gaussians(self, alphas: Tensor) -> tuple[Tensor, Tensor]:
        """Return the (N,) sizes and opacities of primitives that replace Gaussians with the opacities ``alphas`` (N,).

        The size is the distance from centre to boundary in standard deviations: c for all primitives. The opacities
        are ``alphas``, unchanged.
        """
        return torch.full_like(alphas, self.deviations), alphas

    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> CustomDensity:
        """Return the line integral over a chord [t0, t1] in closed form, float64, differentiable in every argument.

        Let y be the whitened chord middle, d the direction of the ray, v = diag(1/s) R^T d the whitened direction,
        a = v.v, u = y.v/a, and x = y - u v the whitened point of the ray that is closest to the centre. Then

            I = kappa/m sqrt(2/a)/c exp(-c^2 x.x / 2) B(c sqrt(a/2) u, c sqrt(a/2) (t1 - t0)/2)

        where B(u, w) is :func:`bell_integral`. The chord middle is computed relative to the primitive's centre, so that
        a distant camera does not make the terms large and inaccurate.
        """
        c = self.deviations
        whiten = geometry.rotations.double().transpose(1, 2) / geometry.scales.double()[:, :, None]
        means = geometry.means.double()
        peak = (params["log_amplitude"].double()[:, 0] - geometry.log_length_scale.double()).exp()

        def line_integral(prim: Tensor, origin: Tensor, direction: Tensor, t0: Tensor, t1: Tensor) -> Tensor:
            W, d = whiten[prim], direction.double()
            middle = origin.double() - means[prim] + ((t0 + t1) / 2)[:, None] * d
            y, v = (W @ middle[:, :, None])[..., 0], (W @ d[:, :, None])[..., 0]
            a = (v * v).sum(-1)
            u = (y * v).sum(-1) / a
            x = y - u[:, None] * v
            rate = c * (a / 2).sqrt()
            return (
                peak[prim]
                / rate
                * (-0.5 * c * c * (x * x).sum(-1)).exp()
                * bell_integral(rate * u, rate * (t1 - t0) / 2)
            )

        return CustomDensity(line_integral)

    def density(self, params: Params, geometry: Geometry, prim: Tensor, x: Tensor, conditions: Conditions) -> Tensor:
        y = (geometry.rotations[prim].transpose(1, 2) @ (x - geometry.means[prim])[:, :, None])[
            ..., 0
        ] / geometry.scales[prim]
        peak = (params["log_amplitude"][:, 0] - geometry.log_length_scale).exp()
        return peak[prim] * (-0.5 * self.deviations**2 * (y * y).sum(-1)).exp()

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        """Return the parameters of children; a child has half of its parent's mass, the integral of sigma over space.

        kappa'/m' prod s' = (1/2) kappa/m prod s. Primes mark the child, s are the semi-axes and m is the longest
        semi-axis. A Gaussian in a smaller ellipsoid cannot continue the parent's Gaussian, so this split changes the
        image.
        """
        grown = (new.log_scales.double() - old.log_scales.double()).sum(-1)
        longer = new.log_length_scale.double() - old.log_length_scale.double()
        change = longer - grown - math.log(2.0)
        return {
            **params,
            "log_amplitude": (params["log_amplitude"].double() + change[:, None]).to(params["log_amplitude"]),
        }

    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        """Return the parameters with kappa, the amplitude, multiplied by max(``factor``, 1e-30), ``factor`` (N,); raise
        ValueError if a factor is negative."""
        if bool((factor < 0).any()):
            raise ValueError(f"density factor {float(factor.min())}; a Gaussian's must not be negative")
        shift = factor.to(params["log_amplitude"]).clamp_min(_FAINTEST).log()
        return {**params, "log_amplitude": params["log_amplitude"] + shift[:, None]}


def bell_integral(u: Tensor, w: Tensor) -> Tensor:
    """Return B(u, w) = integral of exp(-z^2) over [u - w, u + w], w >= 0, to a few ulp; float64, differentiable.

    The function uses three exact forms, each where no digits cancel (Abramowitz and Stegun 1964, 7.1 and 22.11). An
    interval that contains 0 has the integral sqrt(pi)/2 (erf(w + u) + erf(w - u)). An interval in one tail has
    sqrt(pi)/2 (erfc(|u| - w) - erfc(|u| + w)). A short interval uses the Taylor series
    2 exp(-u^2) sum_k w^(2k+1) H_2k(u) / (2k+1)!, with the Hermite polynomials H_n.
    """
    side = u.abs()
    both = torch.erf(w + u) + torch.erf(w - u)
    tail = torch.erfc(side - w) - torch.erfc(side + w)
    whole = math.sqrt(math.pi) / 2 * torch.where(side <= w, both, tail)
    short = w * (1 + side) < _SHORT
    return whole.masked_scatter(short, _gaussian_series(u[short], w[short]))


def _gaussian_series(u: Tensor, w: Tensor) -> Tensor:
    """Return :func:`bell_integral` for short intervals, by a Taylor series.

    The series uses the scaled polynomials P_n = w^n H_n(u)/n!, H_n the Hermite polynomials, so that every term is
    small.
    """
    low, high = torch.ones_like(u), 2 * u * w  # P_0, P_1;  P_(n+1) = 2 (u w P_n - w^2 P_(n-1)) / (n + 1)
    total = low
    for n in range(1, 2 * _TERMS - 1, 2):
        low = 2 * (u * w * high - w * w * low) / (n + 1)
        total = total + low / (n + 2)
        high = 2 * (u * w * low - w * w * high) / (n + 2)
    return 2 * w * (-u * u).exp() * total
