"""Colour that changes with the side a primitive is seen from: spherical harmonics, of which neuprim's core has the
basis."""

from __future__ import annotations

from typing import Any

import torch

from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.model import sh
from neuprim.core.model.fields import ColourField, Conditions, Constant
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import ParameterSpec, Params

__all__ = ["ViewDependentColour"]


class ViewDependentColour(ColourField):
    """max(0, SH(direction from the camera to the centre) + 0.5); degree 0 to 3."""

    def __init__(self, degree: int = 1, channels: int = 3) -> None:
        self.degree, self.channels = degree, channels

    def settings(self) -> dict[str, Any]:
        return {"degree": self.degree, "channels": self.channels}

    def parameters(self) -> list[ParameterSpec]:
        rest, C = sh.sh_coefficient_count(self.degree) - 1, self.channels
        base = ParameterSpec("base", (C,), lr=2e-2, init=lambda c: sh.initial_sh_dc(c.colors))
        shine = ParameterSpec("shine", (rest, C), lr=2e-3, init=lambda c: torch.zeros(c.count, rest, C))
        return [base, shine] if rest else [base]

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        return Constant(sh.sh_colors(geometry.means, params["base"], params.get("shine"), camera.position, self.degree))
