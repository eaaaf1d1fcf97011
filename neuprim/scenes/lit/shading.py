"""What rays see of solids under one point light: direct light and hard shadows, nothing else. Linear RGB throughout.

Radiance = (albedo / pi + highlight) cosine intensity / distance^2 where nothing lies between, else 0; see
:mod:`neuprim.scenes.reflectance`. Every ray falls into one class:

* attached shadow: the surface, or its shading normal, faces away from the light;
* cast shadow: it faces the light, but something lies between;
* highlight: neither, and the highlight is brighter than the diffuse part and than half of a white surface that faces
  the light
  from the rig's mean distance (:data:`BRIGHT`);
* lit: all else that is hit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from neuprim.scenes.lit import CLASSES
from neuprim.scenes.lit.rig import DISTANCE
from neuprim.scenes.raycast import Scene
from neuprim.scenes.reflectance import dot, lobes

__all__ = ["BRIGHT", "Shaded", "shade"]

BRIGHT = 0.5 / (np.pi * (sum(DISTANCE) / 2) ** 2)
"""Radiance per unit intensity from which a highlight counts as one, 1/length^2."""

_LIT, _CAST, _ATTACHED, _HIGHLIGHT = (CLASSES.index(n) for n in ("lit", "cast_shadow", "attached_shadow", "highlight"))


@dataclass(frozen=True)
class Shaded:
    """What N rays see.

    Attributes:
        rgb: (N, 3) float32 linear radiance, zero where nothing is hit.
        unshadowed: (N, 3) the same as if nothing cast a shadow.
        classes: (N,) uint8, index into :data:`neuprim.scenes.lit.CLASSES`; 0 where nothing is hit.
    """

    rgb: NDArray[np.float32]
    unshadowed: NDArray[np.float32]
    classes: NDArray[np.uint8]


def shade(scene: Scene, origins: ArrayLike, directions: ArrayLike, light: ArrayLike, intensity: float) -> Shaded:
    """Cast N rays.

    Args:
        origins: (N, 3) or (3,).
        directions: (N, 3) unit vectors.
        light: (3,) position of the point light.
        intensity: its radiant intensity, equal in all colours and directions.
    """
    d = np.asarray(directions, dtype=np.float32)
    hits = scene.intersect(origins, d)
    way = np.asarray(light, dtype=np.float32) - hits.position
    square = dot(way, way)
    to_light = (way / np.sqrt(square)[:, None]).astype(np.float32, copy=False)
    cosine, highlight = lobes(hits, -d[hits.hit], to_light)
    facing = (cosine > 0) & (dot(hits.face, to_light) > 0)
    irradiance = np.where(facing, cosine * np.float32(intensity / np.pi) / square, np.float32(0))
    unshadowed = (hits.albedo + highlight[:, None]) * irradiance[:, None]
    starts = hits.lifted()[facing]  # what faces away needs no ray
    visible = facing.copy()
    visible[facing] = ~scene.occluded(starts, np.asarray(light, dtype=np.float32) - starts, 1.0)
    gleam = highlight * irradiance
    shining = visible & (highlight > hits.albedo.max(axis=1)) & (gleam > np.float32(BRIGHT * intensity))
    classes = np.where(facing, np.where(visible, np.where(shining, _HIGHLIGHT, _LIT), _CAST), _ATTACHED)
    shaded = Shaded(np.zeros(d.shape, np.float32), np.zeros(d.shape, np.float32), np.zeros(len(d), np.uint8))
    shaded.rgb[hits.hit] = unshadowed * visible[:, None]
    shaded.unshadowed[hits.hit] = unshadowed
    shaded.classes[hits.hit] = classes
    return shaded
