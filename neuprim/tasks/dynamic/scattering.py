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
from neuprim.core.render.light import check_typical_light, light_factor, normalize_direction, shade_volume_by_light
from neuprim.core.settings import RenderSettings
from neuprim.tasks.dynamic.colour import TimeHarmonics

SHINES = "shines"
"""Name of a condition, 0 or 1: whether an image includes emission. If images under several lights are summed, only one
image includes emission."""

MOST_OCTAVES = 8
MOST_ANISOTROPY = 0.95

_Array = TypeVar("_Array", np.ndarray, Tensor)


def octaves_of_light(transmittance: _Array, octaves: int, share: float) -> list[_Array]:
    """Return the octaves of the light that a point scatters, divided by the unoccluded light: share^o T^(1/2^o).

    T is the transmittance to the light, and o = 0, 1, ... is the number of the octave. Octave 0 is single scattering.
    Each further octave approximates light that is scattered more often: the light is weaker by the factor ``share``,
    but only half of the previous octave's optical depth attenuates it (Wrenninge et al. 2013, Oz: The Great and
    Volumetric).
    """
    found = [transmittance]
    for octave in range(1, octaves):
        transmittance = transmittance**0.5
        found.append(share**octave * transmittance)
    return found


def scattered_light(transmittance: _Array, octaves: int, share: float) -> _Array:
    """Return the sum of :func:`octaves_of_light`: the scattered light, averaged over all view directions."""
    parts = octaves_of_light(transmittance, octaves, share)
    found = parts[0]
    for part in parts[1:]:
        found = found + part
    return found


def phase_factor(cosine: _Array, anisotropy: float) -> _Array:
    """Return 4 pi times the phase function of Henyey and Greenstein (1941): (1 - g^2) / (1 + g^2 - 2 g cosine)^(3/2).

    The mean over all directions is 1. ``cosine``, -1 to 1, is the cosine of the angle by which light is deflected. g is
    ``anisotropy``: above 0, most light is scattered forward.
    """
    g = anisotropy
    return (1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5


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

    The parameter a (C,) of each primitive is albedo times the scattering fraction of the extinction, divided by 4 pi. E
    is the condition ``light_intensity``: the irradiance of the unoccluded light. S is the sum of the
    :func:`octaves_of_light`; octave o is multiplied by the :func:`phase_factor` for anisotropy/2^o. The transmittance
    in these functions is the model's, from the primitive's centre to the light, without gradient
    (:func:`~neuprim.core.render.light.shade_volume_by_light`).

    Args:
        typical: irradiance of a typical training light.
        octaves, share: arguments of :func:`octaves_of_light`.
        anisotropy: argument of :func:`phase_factor`, -0.95 to 0.95; 0: light is scattered equally in all directions.
    """

    stage = None  # type: ignore[assignment]  # shadow maps wait for the GPU

    def __init__(
        self, *settings: Any, typical: float = 1.0, octaves: int = 1, share: float = 0.5, anisotropy: float = 0.0,
        **more: Any,
    ) -> None:  # fmt: skip
        super().__init__(*settings, **more)
        check_typical_light(typical)
        if isinstance(octaves, bool) or not isinstance(octaves, int) or not 1 <= octaves <= MOST_OCTAVES:
            raise ValueError(f"octaves {octaves!r}; expected 1..{MOST_OCTAVES}")
        if not 0 <= share <= 1:
            raise ValueError(f"share {share!r}; expected 0..1")
        if not abs(anisotropy) <= MOST_ANISOTROPY:
            raise ValueError(f"anisotropy {anisotropy!r}; expected {-MOST_ANISOTROPY}..{MOST_ANISOTROPY}")
        self.typical, self.octaves, self.share, self.anisotropy = float(typical), octaves, float(share), anisotropy

    def settings(self) -> dict[str, Any]:
        own = {name: getattr(self, name) for name in ("typical", "octaves", "share", "anisotropy")}
        return {**super().settings(), **own}

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
        strength = sum(self._phases(geometry, camera, conditions))
        strength = strength * light_factor(geometry, conditions, self.typical, falloff=False)
        return Constant(params["scattered"].clamp_min(0.0) * strength, own)

    def shade(
        self,
        geometry: Geometry,
        density: LoweredDensity,
        camera: AnyCamera,
        conditions: Conditions,
        settings: RenderSettings,
    ) -> Shading:
        shading = shade_volume_by_light(geometry, density, conditions, settings)
        if self.octaves == 1 or shading.primitives is None:
            return shading
        with torch.no_grad():
            phases = self._phases(geometry, camera, conditions)
            octaves = octaves_of_light(shading.primitives.to(geometry.means)[:, None], self.octaves, 1.0)
            found = sum(phase * light for phase, light in zip(phases, octaves, strict=True)) / sum(phases)
        return Shading(found[:, 0])

    def _phases(self, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> list[Any]:
        """Return share^o times the phase factor of each octave o: (N, 1), or a number for isotropic scattering."""
        if not self.anisotropy:
            return [self.share**octave for octave in range(self.octaves)]
        means, size = geometry.means, geometry.detached_length_scale[:, None]
        towards = normalize_direction(device.to_device_like(conditions["light"], means) - means, size)
        view = normalize_direction(means - device.to_device_like(camera.position, means), size)
        cosine = (towards * view).sum(-1, keepdim=True)
        return [self.share**o * phase_factor(cosine, self.anisotropy / 2**o) for o in range(self.octaves)]

    def script(self) -> str:
        return read_script(__package__, "scattering.js").replace("TIME_HARMONICS", super().script().strip())
