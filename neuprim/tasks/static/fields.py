"""Colour of a static scene: spherical harmonics of the direction from the camera to the primitive's centre."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from neuprim.core import sh
from neuprim.core.fields import ColourField, Conditions, Constant
from neuprim.core.geometry import Geometry
from neuprim.core.ray_cameras import AnyCamera
from neuprim.core.schema import InitContext, ParameterSpec, Params

__all__ = ["SphericalHarmonics"]


class SphericalHarmonics(ColourField):
    """c = max(0, SH(direction camera -> mu) + 0.5), degree 0..3; C (degree + 1)^2 parameters.

    While training, one band is unlocked every ``sh_every`` of the budget; a loaded model uses all of them.
    """

    def __init__(self, degree: int = 3, channels: int = 3, sh_every: float = 0.0) -> None:
        if not isinstance(degree, int) or not 0 <= degree <= 3:
            raise ValueError(f"spherical-harmonics degree {degree!r}; expected 0..3")
        if not isinstance(channels, int) or channels < 1:
            raise ValueError(f"{channels!r} colour channels; expected at least 1")
        self.degree, self.channels, self.sh_every = degree, channels, sh_every
        self.active = degree

    def settings(self) -> dict[str, Any]:
        return {"degree": self.degree, "channels": self.channels}

    def set_progress(self, progress: float) -> None:
        self.active = min(self.degree, int(progress / self.sh_every + 1e-9)) if self.sh_every > 0 else self.degree

    def parameters(self) -> list[ParameterSpec]:
        C, rest = self.channels, sh.coefficient_count(self.degree) - 1
        specs = [ParameterSpec("sh_dc", (C,), 2e-2, _initial_dc, group="colour")]
        if rest:
            specs.append(ParameterSpec("sh_rest", (rest, C), 2e-3, lambda c: torch.zeros(c.count, rest, C), group="colour"))
        return specs

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        dc = params["sh_dc"]
        if self.active and dc.device.type == "cpu" and dc.dtype == geometry.means.dtype == torch.float32:
            from neuprim.core.sh_cpu import fused_colors  # numba, loaded when first needed

            return Constant(fused_colors(geometry.means, dc, params["sh_rest"], camera.position, self.active))
        color = dc * sh.C0 + 0.5
        if self.active:
            offset = geometry.means - camera.position.to(geometry.means)
            direction = offset / offset.norm(dim=-1, keepdim=True).clamp_min(1e-30)
            bands = sh.basis(direction, self.active)[:, 1:]
            color = color + (bands[:, :, None] * params["sh_rest"][:, : bands.shape[1]]).sum(1)
        return Constant(color.clamp_min(0.0))


_DARKEST = 1e-3
"""Initial colours start at least this far above zero: at zero and below, max(0, .) passes no gradient and black stays black."""


def _initial_dc(ctx: InitContext) -> Tensor:
    return ((ctx.colors.clamp_min(_DARKEST) - 0.5) / sh.C0).float()
