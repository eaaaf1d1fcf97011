"""View-dependent colour fields of static scenes: spherical harmonics (SH) or spherical Gaussian lobes."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.model import lobes, sh
from neuprim.core.model.colour_constants import MOST_LOBES
from neuprim.core.model.fields import ColourField, Conditions, Constant, read_script
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.lobes import AMPLITUDE, AXIS, LOG_SHARPNESS
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import ParameterSpec, Params

_SHARPNESS = 2.0  # initial sharpness of a lobe: half as bright 49 degrees off its axis


class SphericalHarmonics(ColourField):
    """SH colour c = max(0, SH(d) + 0.5) of degree 0..3, with (degree + 1)^2 parameters per channel.

    d is the direction from the camera to the primitive's centre. During training, one more SH band becomes active after
    every fraction ``sh_every`` of the training budget. A loaded model uses all bands.
    """

    def __init__(self, degree: int = 3, channels: int = 3, sh_every: float = 0.0) -> None:
        if not isinstance(degree, int) or not 0 <= degree <= 3:
            raise ValueError(f"spherical-harmonics degree {degree!r}; expected 0..3")
        _check_channels(channels)
        self.degree, self.channels, self.sh_every = degree, channels, sh_every
        self.active = degree

    @property
    def stage(self) -> int:  # type: ignore[override]
        return self.active

    def settings(self) -> dict[str, Any]:
        return {"degree": self.degree, "channels": self.channels}

    def set_progress(self, progress: float) -> None:
        self.active = min(self.degree, int(progress / self.sh_every + 1e-9)) if self.sh_every > 0 else self.degree

    def parameters(self) -> list[ParameterSpec]:
        C, rest = self.channels, sh.sh_coefficient_count(self.degree) - 1
        specs = [ParameterSpec("sh_dc", (C,), 2e-2, lambda c: sh.initial_sh_dc(c.colors))]
        if rest:
            specs.append(ParameterSpec("sh_rest", (rest, C), 2e-3, lambda c: torch.zeros(c.count, rest, C)))
        return specs

    def reductions(self) -> dict[str, tuple[int, ...]]:
        return {"degree": tuple(range(self.degree - 1, -1, -1))} if self.degree else {}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[SphericalHarmonics, dict[str, Tensor]]:
        return SphericalHarmonics(value, self.channels), sh.truncate_sh_bands(params, "sh_rest", value)

    def harmonics(self, params: Params, conditions: Conditions) -> tuple[Tensor, Tensor | None]:
        return params["sh_dc"], params.get("sh_rest")

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Return one prunable unit (parameters zeroed together) per channel and SH coefficient above degree 0."""
        return sh.prunable_sh_coefficients(self.degree, self.channels, "sh_rest")

    def script(self) -> str:
        return read_script(__package__, "fields.js")

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        return Constant(
            sh.sh_colors(geometry.means, params["sh_dc"], params.get("sh_rest"), camera.position, self.active)
        )


class SphericalLobes(ColourField):
    """Colour of 0..8 spherical Gaussian lobes, c = max(0, C0 sh_dc + 1/2 + sum_l a_l exp(s_l (m_l . d - 1))).

    d is the direction from the camera to the primitive's centre, and C0 is the constant SH of degree 0. L lobes and C
    channels have C + L (C + 4) parameters: ``sh_dc`` and, for each lobe l, an amplitude a_l per channel, an axis m_l
    (three parameters, normalised when used) and the logarithm of a sharpness s_l. Lobes start with random axes and
    amplitude zero.
    """

    stage = 0

    def __init__(self, lobes: int = 2, channels: int = 3) -> None:
        _check_lobe_count(lobes)
        _check_channels(channels)
        self.lobes, self.channels = lobes, channels

    def settings(self) -> dict[str, Any]:
        return {"lobes": self.lobes, "channels": self.channels}

    def parameters(self) -> list[ParameterSpec]:
        L, C = self.lobes, self.channels
        specs = [ParameterSpec("sh_dc", (C,), 2e-2, lambda c: sh.initial_sh_dc(c.colors))]
        if L:
            specs += [
                ParameterSpec(AMPLITUDE, (L, C), 6e-3, lambda c: torch.zeros(c.count, L, C)),
                ParameterSpec(AXIS, (L, 3), 2e-2, lambda c: lobes.random_lobe_axes(c.count, L, c.generator)),
                ParameterSpec(LOG_SHARPNESS, (L,), 2e-2, lambda c: torch.full((c.count, L), math.log(_SHARPNESS))),
            ]
        return specs

    def reductions(self) -> dict[str, tuple[int, ...]]:
        return {"lobes": tuple(range(self.lobes - 1, -1, -1))} if self.lobes else {}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[SphericalLobes, dict[str, Tensor]]:
        return SphericalLobes(value, self.channels), lobes.reduce_lobes(params, value)

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Return one prunable unit (parameters that pruning zeroes together) per lobe."""
        names = (AMPLITUDE, AXIS, LOG_SHARPNESS)
        return tuple(PrunableUnit(f"lobe {j}", dict.fromkeys(names, (j,))) for j in range(self.lobes))

    def script(self) -> str:
        return read_script(__package__, "lobes.js")

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        if not self.lobes:
            return Constant(sh.sh_colors(geometry.means, params["sh_dc"], None, camera.position, 0))
        dc, amplitude, axis, log_sharpness = (params[name] for name in ("sh_dc", AMPLITUDE, AXIS, LOG_SHARPNESS))
        return Constant(lobes.lobe_colors(geometry.means, dc, amplitude, axis, log_sharpness, camera.position))


def _check_lobe_count(count: Any) -> None:
    if not isinstance(count, int) or isinstance(count, bool) or not 0 <= count <= MOST_LOBES:
        raise ValueError(f"{count!r} lobes; expected 0..{MOST_LOBES}")


def _check_channels(channels: Any) -> None:
    if not isinstance(channels, int) or channels < 1:
        raise ValueError(f"{channels!r} colour channels; expected at least 1")
