"""Presets of the optics by name (``scene.look``). Up is z; :meth:`Look.turned` makes it y."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.validation import field_types, refuse_unknown
from neuprim.tasks.dynamic.volume.optics import Light, Look
from neuprim.tasks.dynamic.volume.settings import Axis

__all__ = ["EMBERGEN_FIRE", "LOOKS", "changed", "named_look"]

EMBERGEN_FIRE = Look(
    extinction_grids=("temperature",),
    extinction=10.0,
    ambient=(0.05, 0.05, 0.05),
    flame_range=(0.0, 0.181396484375),  # the largest flame of the sequence
    kelvin=(1050.0, 2155.0),
    emission=2.0,
)
"""EmberGen's free fire, which has no density: hot gas absorbs, flames glow, and a grey of 0.05 shows the rest.

The strength of the glow beside the grey decides how dark the images are beside their brightest pixel, and so what a
black image scores: ``benchmarks/dynamic_quality.py`` prints it beside every number.
"""

SMOKE_FIRE = Look(
    extinction=14.0,
    albedo=(0.42, 0.41, 0.41),
    ambient=(0.10, 0.11, 0.13),
    light=Light((-0.6, -0.35, 0.7), (5.0, 5.0, 5.2)),
    kelvin=(1100.0, 2400.0),
    emission=1.5,
    flame_extinction=14.0,
)
"""Dark smoke under a soft light, and flames that outshine it."""

COLORFUL_SMOKE = Look(
    extinction=45.0,
    albedo=(0.97, 0.97, 0.97),
    ambient=(0.20, 0.20, 0.22),
    light=Light((0.55, -0.45, 0.7), (9.0, 8.8, 8.4)),
    color_grid="color",
    gradient=((0.95, 0.25, 0.15), (0.95, 0.75, 0.15), (0.20, 0.75, 0.45), (0.20, 0.40, 0.95), (0.70, 0.25, 0.85)),
)
"""Dense smoke in many colours that shadows itself."""

GROUND_EXPLOSION = Look(
    extinction=60.0,
    albedo=(0.46, 0.36, 0.29),
    ambient=(0.10, 0.11, 0.12),
    light=Light((-0.7, 0.4, 0.6), (9.0, 8.4, 7.6)),
    kelvin=(1000.0, 2900.0),
    emission=6.0,
    flame_extinction=30.0,
)
"""A hot core inside thick brown-grey smoke."""

DUST_TORNADO = Look(
    extinction=26.0,
    albedo=(0.92, 0.74, 0.50),
    ambient=(0.14, 0.17, 0.22),
    light=Light((0.75, 0.3, 0.6), (8.5, 7.8, 6.6)),
)
"""Sand in the sun under a blue sky."""

LOOKS = {
    "embergen_fire": EMBERGEN_FIRE,
    "smoke_fire": SMOKE_FIRE,
    "colorful_smoke": COLORFUL_SMOKE,
    "ground_explosion": GROUND_EXPLOSION,
    "dust_tornado": DUST_TORNADO,
}


def named_look(name: str, up: Axis = "z") -> Look:
    """The preset of that name, for sequences with this up axis."""
    if name not in LOOKS:
        raise ConfigError(f"scene.look={name}: no such look{nearest(name, LOOKS)}")
    return LOOKS[name].turned(up)


def changed(look: Look, changes: Mapping[str, Any]) -> Look:
    """The look with ``scene.optics.KEY=VALUE`` put in; a light keeps the part of it that is not given.

    Raises:
        ConfigError: no such setting, a value of another form, or an impossible one.
    """
    refuse_unknown(changes, field_types(Look), "scene.optics")
    light = changes.get("light")
    if look.light is not None and isinstance(light, Mapping):
        changes = {**changes, "light": {**vars(look.light), **light}}
    return dataclasses.replace(look, **changes)
