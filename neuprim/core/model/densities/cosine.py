"""The density of a neural primitive: one hidden layer of K cosines (equation 10 of the paper; method: "Density")."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neuprim.core.model.fields import Conditions, Cosine, DensityField
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import InitContext, ParameterSpec, Params
from neuprim.core.model.tensors import number_fault

__all__ = ["OMEGA0", "CosineDensity", "cosine_density", "split_cosine"]

OMEGA0 = 30.0
"""SIREN boost: multiplies the whole phase."""


class CosineDensity(DensityField):
    """f(x~) = sum_k w2_k cos(omega0 (W1_k . x~ + b1_k)) + b2 with x~ = (x - mu)/m, sigma = f/m; 5K + 1 parameters.

    Args:
        neurons: K, 0 to 16.
        omega0: a positive number.

    ``init.mode`` of the model settings: "opaque" (default) starts every primitive at central opacity ``init.alpha``;
    "paper" draws the offset as the authors do, which leaves half of all chords without a gradient.
    """

    init_settings = ("mode", "alpha")

    def __init__(self, neurons: int = 8, omega0: float = OMEGA0) -> None:
        if not isinstance(neurons, int) or not 0 <= neurons <= 16:
            raise ValueError(f"{neurons!r} neurons; expected 0..16")
        if number_fault(omega0) is not None or omega0 <= 0:
            raise ValueError(f"omega0 {omega0!r}; expected a positive number")
        self.neurons, self.omega0 = neurons, omega0

    def settings(self) -> dict[str, Any]:
        own = {"neurons": self.neurons}
        return own if self.omega0 == OMEGA0 else {**own, "omega0": self.omega0}

    def parameters(self) -> list[ParameterSpec]:
        K = self.neurons
        third = 1.0 / 3.0
        amplitude = math.sqrt(6.0 / K) / self.omega0 if K else 0.0
        return [
            ParameterSpec("W1", (K, 3), 3e-3, lambda c: c.uniform(K, 3, bound=third)),
            ParameterSpec("b1", (K,), 3e-3, lambda c: c.uniform(K, bound=third)),
            ParameterSpec("w2", (K,), 1e-2, lambda c: c.uniform(K, bound=amplitude)),
            ParameterSpec("b2", (1,), 1e-2, lambda c: _initial_offset(c, amplitude)),
        ]

    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> Cosine:
        return Cosine(params["W1"], params["b1"], params["w2"], params["b2"], self.omega0)

    def density(self, params: Params, geometry: Geometry, prim: Tensor, x: Tensor, conditions: Conditions) -> Tensor:
        return cosine_density(self.lower(params, geometry, conditions), geometry, prim, x)

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        return split_cosine(params, old, new, self.omega0)

    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        return {**params, "w2": params["w2"] * factor[:, None], "b2": params["b2"] * factor[:, None]}


_FAINT, _SOLID = 0.02, 0.98
"""Starting points that say how opaque they are start within these: beyond, little light or little gradient passes."""


def _initial_offset(ctx: InitContext, amplitude: float) -> Tensor:
    mode, alpha = ctx.choice("mode", "opaque", "paper"), ctx.number("alpha", 0.8, 0, 1)
    opaque = -math.log1p(-alpha) / 2.0  # a central chord of a sphere has optical depth 2 b2
    if mode == "paper" and amplitude:
        return ctx.uniform(1, bound=amplitude)
    if ctx.alphas is not None:
        return -torch.log1p(-ctx.alphas.float().clamp(_FAINT, _SOLID))[:, None] / 2.0
    return torch.full((ctx.count, 1), opaque)


def cosine_density(form: Cosine, geometry: Geometry, prim: Tensor, x: Tensor) -> Tensor:
    """Unclamped world density (M,), 1/scene unit, of a lowered cosine field at (M, 3) points of primitives ``prim``."""
    m = geometry.length_scale[prim]
    local = (x - geometry.means[prim]) / m[:, None]
    phase = form.omega0 * ((form.W1[prim] * local[:, None, :]).sum(-1) + form.b1[prim])
    return ((form.w2[prim] * phase.cos()).sum(-1) + form.b2[prim].reshape(-1)) / m


def split_cosine(params: Params, old: Geometry, new: Geometry, omega0: float = OMEGA0) -> dict[str, Tensor]:
    """Children that carry their parents' sigma unchanged: W1' = r W1, b1' = b1 + W1 (mu'-mu)/m, (w2, b2)' = r (w2, b2), r = m'/m.

    ``omega0`` is that of the form which ``params`` lower to. Computed in float64, so the field changes by no more than the final rounding; other tensors pass through.
    """
    r = (new.log_length_scale.double() - old.log_length_scale.double()).exp()
    shift = (new.means.double() - old.means.double()) / old.length_scale.double()[:, None]
    W1, b1 = params["W1"].double(), params["b1"].double()
    b1 = b1 + (W1 * shift[:, None, :]).sum(-1)
    turns = 2 * math.pi / omega0
    b1 = b1 - turns * torch.round(b1 / turns)  # a phase is only known modulo one turn; keep it small for float32
    return {
        **params,
        "W1": (W1 * r[:, None, None]).to(params["W1"]),
        "b1": b1.to(params["b1"]),
        "w2": (params["w2"].double() * r[:, None]).to(params["w2"]),
        "b2": (params["b2"].double() * r[:, None]).to(params["b2"]),
    }
