"""Optics of a volume: how grids become extinction and light; settings and presets (``scene.look``)."""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal, get_args

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.validation import Accepts, Range, Unbounded, field_types, refuse_unknown, validate_fields

Axis = Literal["y", "z"]
"""The upward axis of a sequence's files."""

UP_AXES = {"y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}

GridMeaning = Literal["density", "temperature", "flames", "color"]

GRIDS: tuple[str, ...] = get_args(GridMeaning)
"""What a grid may mean; ``scene.grids.MEANING=NAME`` names the grid of the files that has it."""

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
"""Settings that are derived from the values of given files, unless the user sets them."""


@dataclass(frozen=True)
class Light:
    """A light at infinity: its direction, scene axes, any length, and RGB irradiance on a plane that faces it."""

    direction: Direction
    irradiance: RGB

    def __post_init__(self) -> None:
        validate_fields(self, "scene.optics.light")


@dataclass(frozen=True)
class Optics:
    """Everything that turns grids into extinction σ and source radiance c.

    With d the value of the extinction grid and f that of the flame grid, at every voxel

        σ_s = extinction · d                               scatters and absorbs
        σ_f = flame_extinction · f                         soot that only glows
        σ   = σ_s + σ_f
        σ c = σ_s · albedo · (ambient + T_light · irradiance / 4π) + σ · emission · B(K(f))

    B is the radiance of a black body relative to the hottest one, whose largest channel is 1; K maps
    ``flame_range`` linearly to ``kelvin`` and clamps. T_light is the transmittance to the light: single scattering,
    isotropic phase function 1/4π, with shadows. Extinctions are per scene unit, and a scene unit is the longest side of
    the sequence's box; radiances are linear sRGB in one arbitrary unit. Negative, NaN and infinite voxels count as 0.

    Attributes:
        extinction_grids: names in order of preference; the first that a file has is d.
        ambient: radiance that arrives from everywhere, unshadowed.
        flame_grid: f; a file without it does not glow.
        flame_range: values of f that mean ``kelvin``'s ends.
        emission: strength of the glow, radiance of the hottest flame; 0 for none.
        color_grid: a vec3s grid that multiplies the albedo, clamped to 0..1.
        gradient: RGB from the bottom to the top of the unit box, where a file has no ``color_grid``.
        up: 'y' or 'z', for the gradient.
    """

    extinction_grids: ExtinctionGrids = ("density", "temperature")
    extinction: NotNegative = 10.0
    albedo: RGB = (1.0, 1.0, 1.0)
    ambient: RGB = (0.0, 0.0, 0.0)
    light: Light | None = None
    flame_grid: GridMeaning = "flames"
    flame_range: FlameRange = (0.0, 1.0)
    kelvin: KelvinRange = (1000.0, 2000.0)
    emission: NotNegative = 0.0
    flame_extinction: NotNegative = 0.0
    color_grid: GridMeaning | None = None
    gradient: Gradient | None = None
    up: Axis = "z"

    def __post_init__(self) -> None:
        validate_fields(self, "scene.optics")

    def mixes(self, names: Container[str]) -> bool:
        """Whether flames add to the extinction of the extinction grid, given the grids ``names``."""
        return self.extinction > 0 and self.flame_extinction > 0 and self.flame_grid in names

    def turn_to_axis(self, up: Axis) -> Optics:
        """The same optics for sequences whose up axis is ``up``; the light turns along."""
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
"""EmberGen's free fire, which has no density: hot gas absorbs, flames glow, and a grey of 0.05 shows the rest."""

SMOKE_FIRE = Optics(
    extinction=14.0,
    albedo=(0.42, 0.41, 0.41),
    ambient=(0.10, 0.11, 0.13),
    light=Light((-0.6, -0.35, 0.7), (5.0, 5.0, 5.2)),
    kelvin=(1100.0, 2400.0),
    emission=1.5,
    flame_extinction=14.0,
)
"""Dark smoke under a soft light, and flames that outshine it."""

COLORFUL_SMOKE = Optics(
    extinction=45.0,
    albedo=(0.97, 0.97, 0.97),
    ambient=(0.20, 0.20, 0.22),
    light=Light((0.55, -0.45, 0.7), (9.0, 8.8, 8.4)),
    color_grid="color",
    gradient=((0.95, 0.25, 0.15), (0.95, 0.75, 0.15), (0.20, 0.75, 0.45), (0.20, 0.40, 0.95), (0.70, 0.25, 0.85)),
)
"""Dense smoke in many colours that shadows itself."""

GROUND_EXPLOSION = Optics(
    extinction=60.0,
    albedo=(0.46, 0.36, 0.29),
    ambient=(0.10, 0.11, 0.12),
    light=Light((-0.7, 0.4, 0.6), (9.0, 8.4, 7.6)),
    kelvin=(1000.0, 2900.0),
    emission=6.0,
    flame_extinction=30.0,
)
"""A hot core inside thick brown-grey smoke."""

DUST_TORNADO = Optics(
    extinction=26.0,
    albedo=(0.92, 0.74, 0.50),
    ambient=(0.14, 0.17, 0.22),
    light=Light((0.75, 0.3, 0.6), (8.5, 7.8, 6.6)),
)
"""Sand in the sun under a blue sky."""

OPTICS_PRESETS = {
    "embergen_fire": EMBERGEN_FIRE,
    "smoke_fire": SMOKE_FIRE,
    "colorful_smoke": COLORFUL_SMOKE,
    "ground_explosion": GROUND_EXPLOSION,
    "dust_tornado": DUST_TORNADO,
}


def optics_preset(name: str, up: Axis = "z") -> Optics:
    """The preset ``scene.look`` of that name, for sequences with this up axis; ConfigError if there is none."""
    if name not in OPTICS_PRESETS:
        raise ConfigError(f"scene.look={name}: no such look{nearest(name, OPTICS_PRESETS)}")
    return OPTICS_PRESETS[name].turn_to_axis(up)


def override_optics(optics: Optics, changes: Mapping[str, Any]) -> Optics:
    """Apply ``scene.optics.KEY=VALUE``; a light keeps the part of it that is not given.

    Raises:
        ConfigError: no such setting, a value of another form, or an impossible one.
    """
    refuse_unknown(changes, field_types(Optics), "scene.optics")
    light = changes.get("light")
    if optics.light is not None and isinstance(light, Mapping):
        changes = {**changes, "light": {**vars(optics.light), **light}}
    return replace(optics, **changes)
