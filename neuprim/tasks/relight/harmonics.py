"""Colour as spherical harmonics of the direction to the light: the baseline that equation 14 is measured against."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras.projections import AnyCamera
from neuprim.core.compute import device
from neuprim.core.model.colours.sh import coefficients, truncate_bands
from neuprim.core.model.fields import ColourField, Conditions, Constant, read_script
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import ParameterSpec, Params
from neuprim.tasks.relight.directions import least_square, unit

__all__ = ["LightHarmonics", "real_harmonics"]


class LightHarmonics(ColourField):
    """c = E max(0, SH(direction mu -> light)), C (degree + 1)^2 parameters; degree 5 has as many as the network of 8
    units.

    It knows neither the view (no highlights move) nor what stands between (no shadows move).
    """

    def __init__(self, degree: int = 5, channels: int = 3, falloff: bool = False, typical: float = 1.0) -> None:
        if not isinstance(degree, int) or not 0 <= degree <= 8:
            raise ValueError(f"spherical-harmonics degree {degree!r}; expected 0..8")
        if not 0 < typical < math.inf:
            raise ValueError(f"typical light {typical!r}; expected a number above 0")
        self.degree, self.channels, self.falloff, self.typical = degree, channels, bool(falloff), float(typical)

    def settings(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("degree", "channels", "falloff", "typical")}

    def parameters(self) -> list[ParameterSpec]:
        C, rest = self.channels, (self.degree + 1) ** 2 - 1
        specs = [ParameterSpec("c_dc", (C,), 1e-2, lambda c: c.colors.clamp_min(1e-3).float())]
        if rest:
            specs.append(ParameterSpec("light_sh", (rest, C), 1e-2, lambda c: torch.zeros(c.count, rest, C)))
        return specs

    def reductions(self) -> dict[str, tuple[int, ...]]:
        return {"degree": tuple(range(self.degree - 1, -1, -1))} if self.degree else {}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[LightHarmonics, dict[str, Tensor]]:
        return LightHarmonics(**{**self.settings(), "degree": value}), truncate_bands(params, "light_sh", value)

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Coefficients, each of one channel."""
        return coefficients(self.degree, self.channels, "light_sh")

    def script(self) -> str:
        return read_script(__package__, "harmonics.js")

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        color = params["c_dc"]
        to_light = device.to_like(conditions["light"], color) - geometry.means
        squared = to_light.square().sum(-1, keepdim=True).clamp_min(least_square(geometry))
        if self.degree:
            bands = real_harmonics(unit(to_light, geometry.length_scale.detach()[:, None]), self.degree)[:, 1:]
            color = color + (bands[:, :, None] * params["light_sh"]).sum(1)
        strength = (
            device.to_like(conditions["light_intensity"], color) / self.typical / (squared if self.falloff else 1.0)
        )
        return Constant(color.clamp_min(0.0) * strength)


def real_harmonics(directions: Tensor, degree: int) -> Tensor:
    """(N, (degree + 1)^2) orthonormal real spherical harmonics of unit directions, bands in order, m = -l..l, by
    recurrence.

    The associated Legendre functions without the Condon-Shortley phase: P_m^m = (2m - 1)!! sin^m, P_{m+1}^m = (2m + 1)
    z P_m^m, (l - m) P_l^m = (2l - 1) z P_{l-1}^m - (l + m - 1) P_{l-2}^m; sin^m cos(m phi) and sin^m sin(m phi) are
    polynomials in x, y.
    """
    x, y, z = directions.unbind(-1)
    cosine, sine = [torch.ones_like(x)], [torch.zeros_like(x)]
    for _ in range(degree):
        cosine.append(x * cosine[-1] - y * sine[-1])
        sine.append(x * sine[-1] + y * cosine[-2])
    legendre: dict[tuple[int, int], Tensor] = {}
    for m in range(degree + 1):
        legendre[m, m] = torch.full_like(x, math.prod(range(1, 2 * m, 2)))
        if m < degree:
            legendre[m + 1, m] = (2 * m + 1) * z * legendre[m, m]
        for l in range(m + 2, degree + 1):
            legendre[l, m] = ((2 * l - 1) * z * legendre[l - 1, m] - (l + m - 1) * legendre[l - 2, m]) / (l - m)
    columns = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            a = abs(m)
            scale = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - a) / math.factorial(l + a)) * (
                math.sqrt(2) if m else 1
            )
            columns.append(scale * legendre[l, a] * (cosine[a] if m >= 0 else sine[a]))
    return torch.stack(columns, -1)
