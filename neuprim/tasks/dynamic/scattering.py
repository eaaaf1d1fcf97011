"""Colour field of smoke and fire under a light that is an input (condition) of the model: ScatteringHarmonics."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.compute import device
from neuprim.core.environment import Environment, Illumination
from neuprim.core.errors import DataError
from neuprim.core.light_conditions import lights_from_environment
from neuprim.core.model.fields import Conditions, Constant, LoweredDensity, Shading, read_script
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import ParameterSpec, Params
from neuprim.core.model.sh import lowest_band_colors
from neuprim.core.render.light import check_typical_light, light_factor, shade_volume_by_light
from neuprim.core.settings import RenderSettings
from neuprim.tasks.dynamic.colour import TimeHarmonics

SHINES = "shines"
"""Name of a condition, 0 or 1: whether an image includes emission. Of several images to be summed, only one does."""

MOST_OCTAVES = 8

_Transmittance = TypeVar("_Transmittance", np.ndarray, Tensor)


def scattered_light(transmittance: _Transmittance, octaves: int, share: float) -> _Transmittance:
    """Return the light that a point scatters, divided by the unoccluded light: sum_{o < octaves} share^o T^(1/2^o).

    T is the transmittance to the light. The first octave is single scattering. Each further octave approximates light
    that is scattered more often: it is weaker, and extinction weakens it half as much (Wrenninge et al. 2013, Oz: The
    Great and Volumetric).
    """
    found, arriving = transmittance, transmittance
    for octave in range(1, octaves):
        arriving = arriving**0.5
        found = found + share**octave * arriving
    return found


def light_smoke_by_environment(environment: Environment, count: int, facts: Mapping[str, Any]) -> Illumination:
    """Convert an environment to ``count`` lights for smoke and fire; only the first light's image includes emission.

    See :func:`~neuprim.core.light_conditions.lights_from_environment`.

    Raises:
        DataError: the model was not trained with several lights.
    """
    if "lights" not in facts:
        raise DataError("--environment: this model's light is fixed; expected a model trained with scene.lights=4")
    found = lights_from_environment(environment, count, facts)
    lights = [{**light, SHINES: torch.tensor(float(not i))} for i, light in enumerate(found.conditions)]
    return replace(found, conditions=tuple(lights))


class ScatteringHarmonics(TimeHarmonics):
    """Colour field of emission (the colour of :class:`TimeHarmonics`) plus scattered light, S max(0, a) E/typical.

    a (C,) is a parameter of each primitive: albedo times the scattering fraction of the extinction times the isotropic
    phase function 1/(4 pi). S is the :func:`scattered_light` for the model's transmittance from the primitive's centre
    to the light, without gradient (:func:`~neuprim.core.render.light.shade_volume_by_light`). E is the condition
    ``light_intensity``: the irradiance of the unoccluded light.

    Args:
        typical: irradiance of a typical training light.
        octaves, share: arguments of :func:`scattered_light`.
    """

    def __init__(self, *settings: Any, typical: float = 1.0, octaves: int = 1, share: float = 0.5, **more: Any) -> None:
        super().__init__(*settings, **more)
        check_typical_light(typical)
        if isinstance(octaves, bool) or not isinstance(octaves, int) or not 1 <= octaves <= MOST_OCTAVES:
            raise ValueError(f"octaves {octaves!r}; expected 1..{MOST_OCTAVES}")
        if not 0 <= share <= 1:
            raise ValueError(f"share {share!r}; expected 0..1")
        self.typical, self.octaves, self.share = float(typical), octaves, float(share)
        self._brightest = float(scattered_light(np.ones(()), octaves, self.share))

    def settings(self) -> dict[str, Any]:
        return {**super().settings(), "typical": self.typical, "octaves": self.octaves, "share": self.share}

    def parameters(self) -> list[ParameterSpec]:
        C = self.channels
        dc, *others = super().parameters()
        scattered = ParameterSpec("scattered", (C,), 1e-2, lambda c: c.colors.clamp_min(0).float(), low=0.0)
        return [dc, scattered, *others]

    def harmonics(self, params: Params, conditions: Conditions) -> None:
        """Return None, since spherical harmonics cannot represent scattered light."""

    def isotropic(self, params: Params, conditions: Conditions) -> Tensor | None:
        return lowest_band_colors(self.lowest_band(params, conditions))

    def scattering(self, params: Params) -> Tensor:
        return params["scattered"].clamp_min(0.0) / self.typical

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        own = super().lower(params, geometry, camera, conditions).rgb
        if SHINES in conditions:
            own = own * device.to_device_like(conditions[SHINES], own)
        strength = self._brightest * light_factor(geometry, conditions, self.typical, falloff=False)
        return Constant(params["scattered"].clamp_min(0.0) * strength, own)

    def shade(
        self, geometry: Geometry, density: LoweredDensity, conditions: Conditions, settings: RenderSettings
    ) -> Shading:
        shading = shade_volume_by_light(geometry, density, conditions, settings)
        if self.octaves == 1 or shading.primitives is None:
            return shading
        return Shading(scattered_light(shading.primitives, self.octaves, self.share) / self._brightest)

    def script(self) -> str:
        return read_script(__package__, "scattering.js").replace("TIME_HARMONICS", super().script().strip())
