"""A Gaussian in space, cut off at the ellipsoid.

    sigma(x) = kappa/m exp(-c^2 |y|^2 / 2),   y = diag(1/s) R^T (x - mu),   m = max(s)

kappa/m, not kappa: an optical depth has no unit, so a density must scale as one over length.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neuprim.core.model.fields import Conditions, CustomDensity, DensityField
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import InitContext, ParameterSpec, Params

__all__ = ["BellDensity", "bell"]


class BellDensity(DensityField):
    """One parameter per primitive, log kappa.

    Args:
        deviations: c, standard deviations from the centre to the edge of the support, 0.5 to 10.
    """

    init_settings = ("alpha",)
    exact_split = False  # see on_split

    def __init__(self, deviations: float = 3.0) -> None:
        if not isinstance(deviations, int | float) or not 0.5 <= deviations <= 10:
            raise ValueError(f"{deviations!r} standard deviations; expected 0.5 to 10")
        self.deviations = float(deviations)

    def settings(self) -> dict[str, Any]:
        """What a saved model needs to rebuild this object."""
        return {"deviations": self.deviations}

    def parameters(self) -> list[ParameterSpec]:
        return [ParameterSpec("log_kappa", (1,), lr=5e-2, init=self._initial)]

    def _initial(self, context: InitContext) -> Tensor:
        """Opacity ``model.init.alpha`` through the centre of a fresh primitive, which is a ball."""
        depth = -math.log1p(-context.number("alpha", 0.5, 0, 1))
        depth_at_one = math.sqrt(2 * math.pi) / self.deviations * math.erf(self.deviations / math.sqrt(2))
        return torch.full((context.count, 1), math.log(depth / depth_at_one))

    def density(self, params: Params, geometry: Geometry, prim: Tensor, x: Tensor, conditions: Conditions) -> Tensor:
        """sigma at points: what everything else is checked against."""
        y = (geometry.rotations[prim].transpose(1, 2) @ (x - geometry.means[prim])[:, :, None])[
            ..., 0
        ] / geometry.scales[prim]
        return self._peak(params, geometry)[prim] * (-0.5 * self.deviations**2 * y.square().sum(-1)).exp()

    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> CustomDensity:
        """The integral of sigma over a chord, in closed form.

        With q the whitened middle of the chord, v the whitened direction, a = |v|^2, u = q.v/a the way from the ray's
        closest approach to the middle and h half the chord, the exponent at distance t from the middle is -c^2/2 (|q -
        u v|^2 + a (u + t)^2), so

            I = kappa/m exp(-c^2/2 |q - u v|^2) B(g u, g h)/g,   g = c sqrt(a/2),   B(z, w) = integral of exp(-t^2) over
            z - w .. z + w.
        """
        c = self.deviations
        whiten = geometry.rotations.double().transpose(1, 2) / geometry.scales.double()[:, :, None]
        means, peak = geometry.means.double(), self._peak(params, geometry).double()

        def line_integral(prim: Tensor, origin: Tensor, direction: Tensor, t0: Tensor, t1: Tensor) -> Tensor:
            W, d = whiten[prim], direction.double()
            middle = origin.double() - means[prim] + ((t0 + t1) / 2)[:, None] * d
            q, v = (W @ middle[:, :, None])[..., 0], (W @ d[:, :, None])[..., 0]
            a = v.square().sum(-1)
            u = (q * v).sum(-1) / a
            closest = (q - u[:, None] * v).square().sum(-1)
            g = c * (a / 2).sqrt()
            return peak[prim] * (-0.5 * c * c * closest).exp() * bell(g * u, g * (t1 - t0) / 2) / g

        return CustomDensity(line_integral)

    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        """A factor of zero would be minus infinity here; 1e-30 is as good."""
        return {
            **params,
            "log_kappa": params["log_kappa"] + factor.to(params["log_kappa"]).clamp_min(1e-30).log()[:, None],
        }

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        """Each child holds half its parent's mass, kappa/m s1 s2 s3 up to a constant.

        A smaller Gaussian cannot continue a larger one, so the picture changes a little; ``exact_split`` says so.
        """
        smaller = (new.log_scales - old.log_scales).sum(-1) - (new.log_length_scale - old.log_length_scale)
        return {**params, "log_kappa": params["log_kappa"] - smaller[:, None] - math.log(2)}

    def _peak(self, params: Params, geometry: Geometry) -> Tensor:
        return (params["log_kappa"][:, 0] - geometry.log_length_scale).exp()


def bell(z: Tensor, w: Tensor) -> Tensor:
    """The integral of exp(-t^2) from z - w to z + w, w >= 0, float64; three forms, each where it keeps its digits.

    Where the interval holds 0, a sum of two erf. In a tail, where erf is all but 1, a difference of two erfc. And where
    it is short against the curve, w (1 + |z|) < 0.01, both would cancel: three terms of the Taylor series about z.
    """
    side = z.abs()
    around = torch.erf(side + w) - torch.erf(side - w)
    tail = torch.erfc(side - w) - torch.erfc(side + w)
    long = math.sqrt(math.pi) / 2 * torch.where(side < w, around, tail)
    z2, w2 = z.square(), w.square()
    series = 1 + w2 * (2 * z2 - 1) / 3 + w2.square() * (4 * z2.square() - 12 * z2 + 3) / 30
    return torch.where(w * (1 + side) < 1e-2, 2 * w * (-z2).exp() * series, long)
