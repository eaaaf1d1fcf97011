"""Colour that changes in time: the zero-order spherical-harmonics coefficient is a function of it (equations 10 to 12)."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras.rays import AnyCamera
from neuprim.core.compute import device
from neuprim.core.model.colours import sh
from neuprim.core.model.fields import ColourField, Conditions, Constant
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import ParameterSpec, Params
from neuprim.tasks.dynamic.density import time_of

__all__ = ["TimeHarmonics"]

FREQUENCIES = {"periods": 2 * math.pi, "printed": 1.0}
"""Angle of the first Fourier term at xi = 1. The paper prints i xi, whose basis is nearly rank-deficient on [0, 1] (condition
5e13); whole periods are well conditioned (2e5)."""

RENAMED = {"turns": "periods"}
"""Words of before, which configurations and models on disk still hold."""


class TimeHarmonics(ColourField):
    """c = max(0, C0 S(xi) + sum of higher bands + 1/2), S(xi) = S0 + sum_i a_i xi^i + sum_i b_i cos(w i xi) + c_i sin(w i xi).

    Per channel 1 + n + 2 l parameters in the zero-order coefficient, i = 1..n and 1..l; the higher bands do not change. With
    n = l = 4, three channels and degree 3: 84 parameters, 39 at degree 0. ``frequencies`` chooses w, see :data:`FREQUENCIES`.
    """

    def __init__(
        self,
        degree: int = 3,
        channels: int = 3,
        sh_every: float = 0.0,
        powers: int = 4,
        waves: int = 4,
        frequencies: str = "periods",
    ) -> None:
        if not isinstance(degree, int) or not 0 <= degree <= 3:
            raise ValueError(f"spherical-harmonics degree {degree!r}; expected 0..3")
        if not isinstance(channels, int) or channels < 1:
            raise ValueError(f"{channels!r} colour channels; expected at least 1")
        if not all(isinstance(n, int) and 0 <= n <= 16 for n in (powers, waves)):
            raise ValueError(f"{powers!r} powers and {waves!r} waves; expected 0..16")
        frequencies = RENAMED.get(frequencies, frequencies)
        if frequencies not in FREQUENCIES:
            raise ValueError(f"frequencies {frequencies!r}; expected {' or '.join(FREQUENCIES)}")
        self.degree, self.channels, self.sh_every = degree, channels, sh_every
        self.powers, self.waves, self.frequencies = powers, waves, frequencies
        self.active = degree

    def settings(self) -> dict[str, Any]:
        names = ("degree", "channels", "powers", "waves", "frequencies")
        return {name: getattr(self, name) for name in names}

    def set_progress(self, progress: float) -> None:
        self.active = min(self.degree, int(progress / self.sh_every + 1e-9)) if self.sh_every > 0 else self.degree

    def parameters(self) -> list[ParameterSpec]:
        C, rest = self.channels, sh.coefficient_count(self.degree) - 1
        specs = [ParameterSpec("sh_dc", (C,), 1e-2, lambda c: sh.initial_dc(c.colors))]
        for name, terms in (("time_poly", self.powers), ("time_cos", self.waves), ("time_sin", self.waves)):
            if terms:
                specs.append(ParameterSpec(name, (terms, C), 5e-3, _zeros(terms, C)))
        if rest:
            specs.append(ParameterSpec("sh_rest", (rest, C), 2e-3, _zeros(rest, C)))
        return specs

    def harmonics(self, params: Params, conditions: Conditions) -> tuple[Tensor, Tensor | None]:
        dc = params["sh_dc"]
        xi = time_of(conditions)
        waves = FREQUENCIES[self.frequencies] * xi * torch.arange(1, self.waves + 1, dtype=torch.float64, device=xi.device)
        powers = xi ** torch.arange(1, self.powers + 1, dtype=torch.float64, device=xi.device)
        for name, basis in (("time_poly", powers), ("time_cos", waves.cos()), ("time_sin", waves.sin())):
            if name in params:
                dc = dc + (params[name] * device.beside(basis, dc)[:, None]).sum(1)
        return dc, params.get("sh_rest")

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        dc, rest = self.harmonics(params, conditions)
        return Constant(sh.colors(geometry.means, dc, rest, camera.position, self.active))


def _zeros(terms: int, channels: int) -> Any:
    return lambda ctx: torch.zeros(ctx.count, terms, channels)
