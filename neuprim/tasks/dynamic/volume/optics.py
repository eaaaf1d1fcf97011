"""Optics of a volume: settings, presets (``scene.look``), and conversion of a frame's grids to extinction and light."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, Literal, get_args

import numpy as np

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.validation import Accepts, Range, Unbounded, field_types, validate_fields, validate_setting_names
from neuprim.tasks.dynamic.scattering import MOST_ANISOTROPY, MOST_OCTAVES

Axis = Literal["y", "z"]
"""The upward axis of a sequence's files."""

UP_AXES = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}

GridMeaning = Literal["density", "temperature", "flames", "color"]

GRIDS: tuple[str, ...] = get_args(GridMeaning)
"""Possible meanings of a grid; the setting ``scene.grids.MEANING=NAME`` names the grid of the files with a meaning."""

NotNegative = Annotated[float, Range(at_least=0)]
RGB = Annotated[
    tuple[NotNegative, NotNegative, NotNegative],
    Accepts(lambda colour: True, "three numbers of at least 0, as [1, 0.5, 0]"),
]
Coordinate = Annotated[float, Unbounded("any direction, of any length")]
Level = Annotated[float, Unbounded("values of a grid, in whatever unit its files have")]
Kelvin = Annotated[float, Range(above=0, at_most=1e5)]
Direction = Annotated[
    tuple[Coordinate, Coordinate, Coordinate], Accepts(any, "three numbers that are not all 0, as [0, 0, 1]")
]

FlameRange = Annotated[tuple[Level, Level], Accepts(lambda ends: ends[0] < ends[1], "two rising numbers, as [0, 1]")]
KelvinRange = Annotated[
    tuple[Kelvin, Kelvin], Accepts(lambda k: k[0] <= k[1], "two rising numbers within 0..1e5, as [1000, 2000]")
]
Gradient = Annotated[tuple[RGB, ...], Accepts(bool, "colours from bottom to top, as [[1, 0, 0], [0, 0, 1]]")]
ExtinctionGrids = Annotated[
    tuple[str, ...],
    Accepts(
        lambda names: bool(names) and set(names) <= set(GRIDS),
        f"a list of {', '.join(GRIDS)} (scene.grids says which grid that is)",
    ),
]

DATA_DEPENDENT = ("extinction", "flame_extinction", "flame_range")
"""Settings of :class:`Optics` that are derived from the values in given .vdb files, unless the user sets them."""


@dataclass(frozen=True)
class Light:
    """A light at infinity.

    Attributes:
        direction: towards the light, on the scene's axes, of any length.
        irradiance: RGB irradiance on a plane that faces the light.
    """

    direction: Direction
    irradiance: RGB

    def __post_init__(self) -> None:
        validate_fields(self, "scene.optics.light")


@dataclass(frozen=True)
class Optics:
    """Everything that turns grids into extinction σ and source radiance c.

    At every voxel, with the value d of the extinction grid and the value f of the flame grid:

        σ_s = extinction · d                               scatters and absorbs
        σ_f = flame_extinction · f                         soot that only glows
        σ   = σ_s + σ_f
        σ c = σ_s · albedo · (ambient + T_light · irradiance / 4π) + σ · emission · B(K(f))

    B is the radiance of a black body relative to the hottest one, whose largest channel is 1; K maps
    ``flame_range`` linearly to ``kelvin`` and clamps. T_light is the transmittance to the light: single scattering,
    isotropic phase function 1/4π, with shadows. With ``octaves`` above 1,
    :func:`~neuprim.tasks.dynamic.scattering.scattered_light` replaces T_light. With an ``anisotropy``, octave o is
    multiplied by :func:`~neuprim.tasks.dynamic.scattering.phase_factor` for anisotropy/2^o. Extinctions are per scene
    unit, and a scene unit is the longest side of the sequence's box; radiances are linear sRGB in one arbitrary unit.
    Negative, NaN and infinite voxels count as 0. With ``fire_lights`` above 0, flames light the smoke, too, equally in
    all directions.

    Attributes:
        extinction_grids: names of the grid d in order of preference; the first that a file has is used.
        extinction: extinction per unit of d.
        albedo: share of extinction that scatters, RGB.
        ambient: radiance that arrives from all directions, without shadows, RGB.
        light: a light at infinity; null for none.
        octaves: 1 for single scattering; more also approximate light that is scattered several times.
        anisotropy: g of Henyey and Greenstein's phase function. Above 0, smoke scatters most of the light forward and
            is brightest against the light; below 0, backward; 0: equally in all directions.
        flame_grid: name of the grid f; files without this grid do not glow.
        flame_range: values of f at the two ends of ``kelvin``.
        kelvin: temperatures of the coldest and the hottest flame.
        emission: radiance of the hottest flame; 0 for no glow.
        flame_extinction: extinction per unit of f.
        fire_lights: number of point lights that represent the flames of a frame and light its smoke, e.g. 16; 0: flames
            do not light the smoke.
        color_grid: name of a vec3s grid that multiplies the albedo, clamped to 0..1; null for none.
        gradient: RGB from the bottom to the top of the unit box, where a file has no ``color_grid``; null for none.
        up: upward axis of the gradient, y or z.
    """

    extinction_grids: ExtinctionGrids = ("density", "temperature")
    extinction: NotNegative = 10.0
    albedo: RGB = (1.0, 1.0, 1.0)
    ambient: RGB = (0.0, 0.0, 0.0)
    light: Light | None = None
    octaves: Annotated[int, Range(1, MOST_OCTAVES)] = 1
    anisotropy: Annotated[float, Range(-MOST_ANISOTROPY, MOST_ANISOTROPY)] = 0.0
    flame_grid: GridMeaning = "flames"
    flame_range: FlameRange = (0.0, 1.0)
    kelvin: KelvinRange = (1000.0, 2000.0)
    emission: NotNegative = 0.0
    flame_extinction: NotNegative = 0.0
    fire_lights: Annotated[int, Range(0, 4096)] = 0
    color_grid: GridMeaning | None = None
    gradient: Gradient | None = None
    up: Axis = "z"

    def __post_init__(self) -> None:
        validate_fields(self, "scene.optics")

    @property
    def octave_share(self) -> float:
        """Strength of each further octave of scattered light, relative to the previous octave: half the mean albedo.

        An octave approximates one more order of multiple scattering. benchmarks/multiple_scattering.py compares images
        with path tracing, for an albedo of 0.9.
        """
        return min(sum(self.albedo) / 6, 1.0)

    @property
    def uses_flames(self) -> bool:
        """Whether flames glow or absorb."""
        return self.emission > 0.0 or self.flame_extinction > 0.0

    def mixes(self, names: Container[str]) -> bool:
        """Return whether both the extinction grid and the flames absorb, in files with the grids ``names``."""
        return self.extinction > 0 and self.flame_extinction > 0 and self.flame_grid in names

    def turn_to_axis(self, up: Axis) -> Optics:
        """Return these optics for sequences whose upward axis is ``up``, with the light's direction rotated to it."""
        if up == self.up or self.light is None:
            return replace(self, up=up)
        x, y, z = self.light.direction
        return replace(self, up=up, light=replace(self.light, direction=(y, z, x) if up == "y" else (z, x, y)))


# ---------------------------------------------------------------- presets, with z up

EMBERGEN_FIRE = Optics(
    extinction_grids=("temperature",),
    extinction=10.0,
    ambient=(0.05, 0.05, 0.05),
    flame_range=(0.0, 0.181396484375),  # the largest flame of the sequence
    kelvin=(1050.0, 2155.0),
    emission=2.0,
)
"""Optics of EmberGen's free fire, which has no density grid: the temperature grid absorbs, flames glow. A grey ambient
radiance of 0.05 makes the gas without flames visible."""

SMOKE_FIRE = Optics(
    extinction=14.0,
    albedo=(0.42, 0.41, 0.41),
    ambient=(0.10, 0.11, 0.13),
    light=Light((-0.6, -0.35, 0.7), (5.0, 5.0, 5.2)),
    kelvin=(1100.0, 2400.0),
    emission=1.5,
    flame_extinction=14.0,
)
"""Optics of dark smoke under a soft light, and of brighter flames."""

COLORFUL_SMOKE = Optics(
    extinction=45.0,
    albedo=(0.97, 0.97, 0.97),
    ambient=(0.20, 0.20, 0.22),
    light=Light((0.55, -0.45, 0.7), (9.0, 8.8, 8.4)),
    color_grid="color",
    gradient=((0.95, 0.25, 0.15), (0.95, 0.75, 0.15), (0.20, 0.75, 0.45), (0.20, 0.40, 0.95), (0.70, 0.25, 0.85)),
)
"""Optics of dense smoke in many colours that shadows itself."""

GROUND_EXPLOSION = Optics(
    extinction=60.0,
    albedo=(0.46, 0.36, 0.29),
    ambient=(0.10, 0.11, 0.12),
    light=Light((-0.7, 0.4, 0.6), (9.0, 8.4, 7.6)),
    kelvin=(1000.0, 2900.0),
    emission=6.0,
    flame_extinction=30.0,
)
"""Optics of a hot core inside thick brown-grey smoke."""

DUST_TORNADO = Optics(
    extinction=26.0,
    albedo=(0.92, 0.74, 0.50),
    ambient=(0.14, 0.17, 0.22),
    light=Light((0.75, 0.3, 0.6), (8.5, 7.8, 6.6)),
)
"""Optics of sand in the sun under a blue sky."""

OPTICS_PRESETS = {
    "embergen_fire": EMBERGEN_FIRE,
    "smoke_fire": SMOKE_FIRE,
    "colorful_smoke": COLORFUL_SMOKE,
    "ground_explosion": GROUND_EXPLOSION,
    "dust_tornado": DUST_TORNADO,
}


def optics_preset(name: str, up: Axis = "z") -> Optics:
    """Return the optics of the preset ``name`` (``scene.look``) for the upward axis ``up``.

    Raises ConfigError if the preset does not exist.
    """
    if name not in OPTICS_PRESETS:
        raise ConfigError(f"scene.look={name}: no such look{nearest(name, OPTICS_PRESETS)}")
    return OPTICS_PRESETS[name].turn_to_axis(up)


def override_optics(optics: Optics, changes: Mapping[str, Any]) -> Optics:
    """Apply changes ``scene.optics.KEY=VALUE`` to optics; settings of the light that are not given do not change.

    Raises:
        ConfigError: a setting does not exist, or a value has a wrong type or is out of range.
    """
    validate_setting_names(changes, field_types(Optics), "scene.optics")
    light = changes.get("light")
    if optics.light is not None and isinstance(light, Mapping):
        changes = {**changes, "light": {**vars(optics.light), **light}}
    return replace(optics, **changes)


# ---------------------------------------------------------------- black bodies

_WAVELENGTHS = np.arange(360.0, 831.0, 1.0)
_SECOND_RADIATION_CONSTANT = 1.438776877e7  # h c / k in nm K
_SRGB_FROM_XYZ = np.array(
    [[3.2406255, -1.5372080, -0.4986286], [-0.9689307, 1.8757561, 0.0415175], [0.0557101, -0.2040211, 1.0569959]]
)  # IEC 61966-2-1 with the white of D65 at (1, 1, 1)


def _black_body_observer_lobe(mean: float, below: float, above: float) -> np.ndarray:
    off = _WAVELENGTHS - mean
    return np.exp(-0.5 * (off * np.where(off < 0, below, above)) ** 2)


@cache
def _standard_observer() -> np.ndarray:
    """Return (3, L) CIE 1931 2° colour matching functions, by the fit of Wyman, Sloan, Shirley (JCGT 2013)."""
    x = 0.362 * _black_body_observer_lobe(442.0, 0.0624, 0.0374) + 1.056 * _black_body_observer_lobe(
        599.8, 0.0264, 0.0323
    )
    x -= 0.065 * _black_body_observer_lobe(501.1, 0.0490, 0.0382)
    y = 0.821 * _black_body_observer_lobe(568.8, 0.0213, 0.0247) + 0.286 * _black_body_observer_lobe(
        530.9, 0.0613, 0.0322
    )
    z = 1.217 * _black_body_observer_lobe(437.0, 0.0845, 0.0278) + 0.681 * _black_body_observer_lobe(
        459.0, 0.0385, 0.0725
    )
    return np.stack([x, y, z])


def black_body_xyz(kelvin: np.ndarray) -> np.ndarray:
    """Return (…, 3) CIE XYZ of black bodies at temperatures ``kelvin``, in an arbitrary common unit.

    XYZ = ∫ B(λ, T) (x̄, ȳ, z̄) dλ, B ∝ λ⁻⁵ / (exp(hc/λkT) - 1).
    """
    exponent = _SECOND_RADIATION_CONSTANT / (_WAVELENGTHS * np.asarray(kelvin, np.float64)[..., None])
    spectrum = (_WAVELENGTHS / 560.0) ** -5.0 / np.expm1(np.minimum(exponent, 700.0))
    return spectrum @ _standard_observer().T


def black_body_rgb(kelvin: np.ndarray, hottest: float) -> np.ndarray:
    """Return (…, 3) linear sRGB of black bodies, clipped at 0; the largest channel at ``hottest`` kelvin is 1."""
    top = np.maximum(black_body_xyz(np.array(hottest)) @ _SRGB_FROM_XYZ.T, 0.0).max()
    return np.maximum(black_body_xyz(kelvin) @ _SRGB_FROM_XYZ.T, 0.0) / top
