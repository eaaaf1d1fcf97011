"""Optics of a volume: settings, presets (``scene.look``), and conversion of a frame's grids to extinction and light."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, Literal, get_args

import numpy as np
from scipy import ndimage

from neuprim.core.errors import ConfigError, DataError, nearest
from neuprim.core.io.vdb import DENSE_LIMIT, Bounds, VdbGrid
from neuprim.core.validation import Accepts, Range, Unbounded, field_types, validate_fields, validate_setting_names
from neuprim.tasks.dynamic.scattering import MOST_OCTAVES, scattered_light
from neuprim.tasks.dynamic.volume.raymarch import NOT_FINITE, Medium, light_transmittance

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

    With d the value of the extinction grid and f that of the flame grid, at every voxel

        σ_s = extinction · d                               scatters and absorbs
        σ_f = flame_extinction · f                         soot that only glows
        σ   = σ_s + σ_f
        σ c = σ_s · albedo · (ambient + T_light · irradiance / 4π) + σ · emission · B(K(f))

    B is the radiance of a black body relative to the hottest one, whose largest channel is 1; K maps
    ``flame_range`` linearly to ``kelvin`` and clamps. T_light is the transmittance to the light: single scattering,
    isotropic phase function 1/4π, with shadows. With ``octaves`` above 1,
    :func:`~neuprim.tasks.dynamic.scattering.scattered_light` replaces T_light. Extinctions are per scene unit, and a
    scene unit is the longest side of the sequence's box; radiances are linear sRGB in one arbitrary unit. Negative, NaN
    and infinite voxels count as 0.

    Attributes:
        extinction_grids: names of the grid d in order of preference; the first that a file has is used.
        extinction: extinction per unit of d.
        albedo: share of extinction that scatters, RGB.
        ambient: radiance that arrives from all directions, without shadows, RGB.
        light: a light at infinity; null for none.
        octaves: 1 for single scattering; more also approximate light that is scattered several times.
        flame_grid: name of the grid f; a file without it does not glow.
        flame_range: values of f at the two ends of ``kelvin``.
        kelvin: temperatures of the coldest and the hottest flame.
        emission: radiance of the hottest flame; 0 for no glow.
        flame_extinction: extinction per unit of f.
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

    @property
    def octave_share(self) -> float:
        """Light of an octave of scattering as a fraction of the octave before: half the mean albedo.

        In two to four octaves, this comes close to path tracing for albedos of 0.45 to 0.99 and thin to dense smoke
        (benchmarks/multiple_scattering.py).
        """
        return min(sum(self.albedo) / 6, 1.0)

    def mixes(self, names: Container[str]) -> bool:
        """Return whether both the extinction grid and the flames absorb, in files with the grids ``names``."""
        return self.extinction > 0 and self.flame_extinction > 0 and self.flame_grid in names

    def turn_to_axis(self, up: Axis) -> Optics:
        """Return these optics for sequences with the up axis ``up``: the light's direction is rotated accordingly."""
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
"""EmberGen's free fire, which has no density: hot gas absorbs, flames glow, an ambient grey of 0.05 shows the rest."""

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
    """Return the optics of the preset ``scene.look=name`` for the up axis ``up``; ConfigError if it does not exist."""
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


# ---------------------------------------------------------------- further lights

_LOWEST = math.radians(10.0)  # lowest elevation of random lights


def draw_lights(optics: Optics, count: int, *key: int) -> list[Light | None]:
    """Draw ``count`` random lights, as strong as the optics' light, uniform over the sky; ``key`` is the seed."""
    own = optics.light
    if own is None:
        return [None] * count
    lights: list[Light | None] = []
    for across, up in np.random.default_rng([20261126, *key]).random((count, 2)).tolist():
        height = math.sin(_LOWEST) + (1 - math.sin(_LOWEST)) * up
        around = math.sqrt(1 - height * height)
        x, y = around * math.cos(2 * math.pi * across), around * math.sin(2 * math.pi * across)
        lights.append(Light((x, y, height) if optics.up == "z" else (y, height, x), own.irradiance))
    return lights


# ---------------------------------------------------------------- the medium of a frame


def light_medium(medium: Medium, light: Light | None, optics: Optics) -> Medium:
    """Add isotropic scattering of a light, with shadows, to a medium's source; return the new medium."""
    if light is None or medium.empty or medium.scattered is None:
        return medium
    values = medium.values.copy()
    arriving = np.array(light.irradiance, np.float32) / np.float32(4.0 * math.pi)
    scattered = scattered_light(light_transmittance(medium, light.direction), optics.octaves, optics.octave_share)
    values[..., 1:] += medium.scattered * (scattered[..., None] * arriving)
    if not np.isfinite(values).all():
        raise DataError(NOT_FINITE)
    return replace(medium, values=values)


_BLACK_BODY_STEPS = 1024  # entries of the table of black bodies; linear between them


def build_medium(grids: Mapping[str, VdbGrid], optics: Optics, scene_from_world: np.ndarray) -> Medium:
    """Build the medium of one frame on the voxels of its extinction grid, without the optics' light.

    Other grids are sampled at the centres of these voxels, trilinearly unless they have the same transform. If flames
    absorb, the voxels are extended to contain all flames. An empty frame gives an empty medium.

    Args:
        grids: meaning -> grid; grids that the optics do not use are ignored.
        scene_from_world: (4, 4) float64.

    Raises:
        DataError: no extinction grid exists, a grid has a wrong number of channels, the box is too large, or an
            extinction overflows.
    """
    flames = grids.get(optics.flame_grid) if optics.emission > 0.0 or optics.flame_extinction > 0.0 else None
    base = next((grids[name] for name in optics.extinction_grids if name in grids), None)
    if base is None and flames is not None and optics.flame_extinction > 0.0:  # flames absorb by themselves
        base = VdbGrid.from_dense(
            optics.extinction_grids[0], np.zeros((0, 0, 0), np.float32), transform=flames.transform
        )
    if base is None:
        wanted = " or ".join(repr(n) for n in optics.extinction_grids)
        raise DataError(f"no grid {wanted} to take the extinction from{nearest(optics.extinction_grids[0], grids)}")
    box = base.bounds
    if flames is not None and optics.flame_extinction > 0.0:
        box = _unite_medium_boxes(box, _transform_medium_bounds(flames, base.transform))
    if box is None:
        return Medium.without_voxels()
    sigma_s = _sample_medium_grid(base, base.transform, box) * np.float32(optics.extinction)
    flame = None if flames is None else _sample_medium_grid(flames, base.transform, box)
    sigma = sigma_s if flame is None else sigma_s + flame * np.float32(optics.flame_extinction)
    values = np.zeros((*sigma.shape, 4), np.float32)
    values[..., 0] = sigma
    scene_from_index = scene_from_world @ base.transform
    scene_from_index[:3, 3] += scene_from_index[:3, :3] @ np.array(box[0], np.float64)
    scattered = sigma_s[..., None] * _scattering_albedo(grids, optics, base.transform, box, scene_from_index)
    values[..., 1:] = scattered * np.array(optics.ambient, np.float32)
    if flame is not None and optics.emission > 0.0:
        values[..., 1:] += sigma[..., None] * _flame_radiance(flame, optics)
    mixed = sigma_s if optics.mixes(grids) else None
    return Medium.padded(values, scene_from_index, mixed, None if optics.light is None else scattered)


def _transform_medium_bounds(grid: VdbGrid, transform: np.ndarray) -> Bounds | None:
    """Return the bounds of the voxels of ``transform`` whose centres lie in a grid's active box."""
    if grid.bounds is None or _same_voxels(grid.transform, transform):
        return grid.bounds
    ends = np.array(grid.bounds, np.float64) - 0.5  # faces of the outermost voxels, not centres
    corners = np.stack(np.meshgrid(*ends.T, indexing="ij"), -1).reshape(-1, 3)
    chain = np.linalg.inv(transform) @ grid.transform
    index = corners @ chain[:3, :3].T + chain[:3, 3]
    return _make_medium_bounds(np.ceil(index.min(0) - 1e-6), np.floor(index.max(0) + 1e-6) + 1)


def _unite_medium_boxes(a: Bounds | None, b: Bounds | None) -> Bounds | None:
    if a is None or b is None:
        return b if a is None else a
    return _make_medium_bounds(np.minimum(a[0], b[0]), np.maximum(a[1], b[1]))


def _make_medium_bounds(low: np.ndarray, high: np.ndarray) -> Bounds:
    (a, b, c), (d, e, f) = low.astype(int).tolist(), high.astype(int).tolist()
    return (a, b, c), (d, e, f)


def _same_voxels(a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two index-to-world matrices define the same voxels, to a millionth of a voxel."""
    scale = float(np.abs(b[:3, :3]).max())
    shift = np.linalg.inv(b) @ a[:, 3]  # not a difference, as the world's origin may be far away
    same_axes = np.allclose(a[:3, :3], b[:3, :3], rtol=0, atol=1e-9 * scale)
    return same_axes and np.allclose(shift, [0, 0, 0, 1], rtol=0, atol=1e-6)


def _sample_medium_grid(grid: VdbGrid, transform: np.ndarray, box: Bounds, channels: int = 1) -> np.ndarray:
    """Sample a grid at the voxel centres of ``box`` under ``transform``.

    Values that are not finite and negative scalars become 0.
    """
    if grid.channels != channels:
        raise DataError(f"grid {grid.name!r} has {grid.channels} channels; expected {channels}")
    limit = DENSE_LIMIT // 4 * channels  # the medium has four numbers per voxel
    shape = tuple(h - l for l, h in zip(*box, strict=True))
    if _same_voxels(grid.transform, transform):
        values = grid.to_dense(box, limit, 0.0)
    elif grid.bounds is None:
        values = np.zeros((*shape, 3)[: 2 + min(channels, 2)], np.float32)
    else:
        around = _make_medium_bounds(np.array(grid.bounds[0]) - 1, np.array(grid.bounds[1]) + 1)
        own = grid.to_dense(around, limit, 0.0)
        matrix = np.linalg.inv(grid.transform) @ transform
        offset = matrix[:3, :3] @ np.array(box[0], np.float64) + matrix[:3, 3] - np.array(around[0])
        planes = [own] if channels == 1 else list(np.moveaxis(own, -1, 0))
        settings = (matrix[:3, :3], offset, shape)
        sampled = [ndimage.affine_transform(p, *settings, order=1, mode="grid-constant") for p in planes]
        values = sampled[0] if channels == 1 else np.stack(sampled, -1)
    return np.maximum(values, 0.0) if channels == 1 else values


def _scattering_albedo(
    grids: Mapping[str, VdbGrid], optics: Optics, transform: np.ndarray, box: Bounds, scene_from_index: np.ndarray
) -> np.ndarray:
    """Return the albedo times colour grid or gradient, broadcastable to (X, Y, Z, 3)."""
    albedo = np.array(optics.albedo, np.float32)
    if optics.color_grid is not None and optics.color_grid in grids:
        return albedo * np.clip(_sample_medium_grid(grids[optics.color_grid], transform, box, 3), 0.0, 1.0)
    if optics.gradient is None:
        return albedo
    axis = "xyz".index(optics.up)
    sizes = [h - l for l, h in zip(*box, strict=True)]
    indices = np.meshgrid(*(np.arange(n) for n in sizes), indexing="ij", sparse=True)
    height = sum(scene_from_index[axis, a] * indices[a] for a in range(3)) + scene_from_index[axis, 3] + 0.5
    stops = np.linspace(0.0, 1.0, len(optics.gradient))
    colours = [np.interp(height, stops, [stop[c] for stop in optics.gradient]) for c in range(3)]
    return albedo * np.stack(colours, -1).astype(np.float32)


def _flame_radiance(flame: np.ndarray, optics: Optics) -> np.ndarray:
    """Return the radiance of flames, emission · B(K(flame)) of :class:`Optics`, (X, Y, Z, 3) float32."""
    low, high = optics.flame_range
    table = black_body_rgb(np.linspace(*optics.kelvin, _BLACK_BODY_STEPS), optics.kelvin[1]) * optics.emission
    where = np.clip((flame - low) / (high - low), 0.0, 1.0) * (_BLACK_BODY_STEPS - 1)
    entries = np.arange(_BLACK_BODY_STEPS)
    return np.stack([np.interp(where, entries, table[:, c]) for c in range(3)], -1).astype(np.float32)


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
