"""Colour of a static scene: spherical harmonics of the direction from the camera to the primitive's centre."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras.projections import AnyCamera
from neuprim.core.model.colours import sh
from neuprim.core.model.fields import ColourField, Conditions, Constant, read_script
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import ParameterSpec, Params


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
        specs = [ParameterSpec("sh_dc", (C,), 2e-2, lambda c: sh.initial_dc(c.colors))]
        if rest:
            specs.append(ParameterSpec("sh_rest", (rest, C), 2e-3, lambda c: torch.zeros(c.count, rest, C)))
        return specs

    def reductions(self) -> dict[str, tuple[int, ...]]:
        return {"degree": tuple(range(self.degree - 1, -1, -1))} if self.degree else {}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[SphericalHarmonics, dict[str, Tensor]]:
        return SphericalHarmonics(value, self.channels), sh.truncate_bands(params, "sh_rest", value)

    def harmonics(self, params: Params, conditions: Conditions) -> tuple[Tensor, Tensor | None]:
        return params["sh_dc"], params.get("sh_rest")

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Coefficients, each of one channel."""
        return sh.coefficients(self.degree, self.channels, "sh_rest")

    def script(self) -> str:
        return read_script(__package__, "fields.js")

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        return Constant(sh.colors(geometry.means, params["sh_dc"], params.get("sh_rest"), camera.position, self.active))
